"""What may befall a photo, done to renders so that the network learns to live with it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

Uniform = Callable[..., Tensor]


def composite(rgba: Tensor, background: Tensor) -> Tensor:
    """Float images [B, H, W, 3] in [0, 1] of uint8 [B, H, W, 4], colours premultiplied by alpha,
    over colours [B or 1, 3]."""
    alpha = rgba[..., 3:].float() / 255
    return rgba[..., :3].float() / 255 + (1 - alpha) * background[:, None, None]


def unchanged(rgba: Tensor, background: Tensor) -> Tensor:
    """Float images [B, 3, H, W] in [0, 1] of uint8 [B, H, W, 4] over a colour [3]."""
    images = composite(rgba, background[None]).permute(0, 3, 1, 2)
    return images.contiguous(memory_format=torch.channels_last)


def augmented(rgba: Tensor, background: Tensor, generator: torch.Generator) -> Tensor:
    """Float images [B, 3, H, W] in [0, 1] with changes drawn anew for each.

    Background, exposure, white balance, gamma, offset, blur, noise, an occluder, and a border
    that the camera does not see.

    Args:
        rgba: uint8 [B, H, W, 4], colours premultiplied by alpha.
        background: the map's own colour [3] in [0, 1], or each image's [B, 3].
        generator: of the images' device.
    """
    count, height, width = rgba.shape[:3]

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, device=generator.device)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, device=generator.device)

    own = uniform(count, 1) < 0.7
    rgba = _blurred(rgba, uniform(count))
    images = composite(rgba, torch.where(own, background, uniform(count, 3)))
    gain = torch.exp(0.13 * normal(count, 1, 1, 1) + 0.05 * normal(count, 1, 1, 3))
    gamma = torch.exp(0.15 * normal(count, 1, 1, 1))
    images = images.clamp(1e-3, 1).pow_(gamma).mul_(gain)
    images += 0.02 * normal(count, 1, 1, 1)
    noise = 0.08 * uniform(count, 1, 1, 1).square()
    images += noise * (uniform(count, height, width, 1) - 0.5)
    hidden = _rectangles(uniform, count, height, width)
    images = torch.where(hidden, uniform(count, 1, 1, 3), images)
    hidden = _borders(uniform, count, height, width)
    images = torch.where(hidden, background.reshape(-1, 1, 1, 3), images)
    images = images.clamp_(0, 1).permute(0, 3, 1, 2)
    return images.contiguous(memory_format=torch.channels_last)


def _blurred(rgba: Tensor, chance: Tensor) -> Tensor:
    """Uint8 images, most of them as they are, the others blurred over 3 pixels, few over 5."""
    images = rgba.clone()
    for side, chosen in ((3, (chance > 0.85) & (chance < 0.97)), (5, chance >= 0.97)):
        channels = F.pad(rgba[chosen].permute(0, 3, 1, 2).float(), [side // 2] * 4, "reflect")
        soft = F.avg_pool2d(channels, side, 1).round()
        images[chosen] = soft.permute(0, 2, 3, 1).to(torch.uint8)
    return images


def _rectangles(uniform: Uniform, count: int, height: int, width: int) -> Tensor:
    """Mask [B, H, W, 1] of one rectangle in some of the images, else empty."""
    size = 0.05 + 0.35 * uniform(count, 2)
    corner = uniform(count, 2) * (1 - size)
    present = uniform(count, 1) < 0.15
    y, x = (torch.arange(side, device=size.device) / side for side in (height, width))
    rows = (y > corner[:, :1]) & (y < (corner + size)[:, :1]) & present
    columns = (x > corner[:, 1:]) & (x < (corner + size)[:, 1:])
    return (rows[:, :, None] & columns[:, None, :])[..., None]


def _borders(uniform: Uniform, count: int, height: int, width: int) -> Tensor:
    """Mask [B, H, W, 1] of a frame around a few of the images, else empty."""
    cut = 0.18 * uniform(count, 2) * (uniform(count, 1) < 0.05)
    y, x = (
        (torch.arange(side, device=cut.device) + 0.5) / side - 0.5 for side in (height, width)
    )
    rows = y.abs() > 0.5 - cut[:, :1]
    columns = x.abs() > 0.5 - cut[:, 1:]
    return (rows[:, :, None] | columns[:, None, :])[..., None]
