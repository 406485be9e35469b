"""What may befall a photo, done to renders so that the network learns to live with it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import torch
from torch import Tensor

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
        background: the map's own colour [3] in [0, 1].
    """
    count, height, width = rgba.shape[:3]

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

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
    images = torch.where(_borders(uniform, count, height, width), background, images)
    images = images.clamp_(0, 1).permute(0, 3, 1, 2)
    return images.contiguous(memory_format=torch.channels_last)


def _blurred(rgba: Tensor, chance: Tensor) -> Tensor:
    """Uint8 images, most of them as they are, the others blurred over 3 pixels, few over 5."""
    images = rgba.numpy().copy()
    for image, draw in zip(images, chance.flatten().tolist(), strict=True):
        if draw > 0.85:
            side = 3 if draw < 0.97 else 5
            image[:] = cv2.blur(image, (side, side))
    return torch.from_numpy(images)


def _rectangles(uniform: Uniform, count: int, height: int, width: int) -> Tensor:
    """Mask [B, H, W, 1] of one rectangle in some of the images, else empty."""
    size = 0.05 + 0.35 * uniform(count, 2)
    corner = uniform(count, 2) * (1 - size)
    present = uniform(count, 1) < 0.15
    y, x = torch.arange(height) / height, torch.arange(width) / width
    rows = (y > corner[:, :1]) & (y < (corner + size)[:, :1]) & present
    columns = (x > corner[:, 1:]) & (x < (corner + size)[:, 1:])
    return (rows[:, :, None] & columns[:, None, :])[..., None]


def _borders(uniform: Uniform, count: int, height: int, width: int) -> Tensor:
    """Mask [B, H, W, 1] of a frame around a few of the images, else empty."""
    cut = 0.18 * uniform(count, 2) * (uniform(count, 1) < 0.05)
    y, x = (torch.arange(height) + 0.5) / height - 0.5, (torch.arange(width) + 0.5) / width - 0.5
    rows = y.abs() > 0.5 - cut[:, :1]
    columns = x.abs() > 0.5 - cut[:, 1:]
    return (rows[:, :, None] | columns[:, None, :])[..., None]
