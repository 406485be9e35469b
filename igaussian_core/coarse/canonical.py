"""The pose network's own camera: every image is resampled to it, whatever took it."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igaussian_core.camera import Camera
from igaussian_core.coarse.backbone import STRIDE

_PIXELS = 128 * 128
# renders of a map are made so many times as large and averaged, about the size of the images
# that maps are trained with: in small ones the low-pass filter leaves Gaussians too soft
OVERSAMPLING = 3


def canonical_camera(camera: Camera) -> Camera:
    """A small pinhole camera with the field of view of `camera`, whose sides are whole cells."""
    aspect = camera.width / camera.height
    width = max(1, round((_PIXELS * aspect) ** 0.5 / STRIDE)) * STRIDE
    height = max(1, round(_PIXELS / width / STRIDE)) * STRIDE
    return camera.resized(width, height)


def resampled(
    image: NDArray[np.uint8], camera: Camera, canonical: Camera
) -> NDArray[np.uint8]:
    """The image as the canonical camera would have seen it, grey-brown where it saw nothing.

    Args:
        image: uint8 RGB [H, W, 3] of a pinhole camera.

    Returns:
        uint8 RGB of the canonical camera's size.
    """
    scale = np.array([canonical.fx / camera.fx, canonical.fy / camera.fy])
    size = np.maximum(1, np.round(scale * (camera.width, camera.height))).astype(int)
    if (scale < 1).all():  # averaging first: a warp alone would alias
        image = np.asarray(cv2.resize(image, size.tolist(), interpolation=cv2.INTER_AREA), np.uint8)
        camera = camera.resized(int(size[0]), int(size[1]))
    sx, sy = canonical.fx / camera.fx, canonical.fy / camera.fy
    warp = np.array(
        [[sx, 0, canonical.cx - sx * camera.cx], [0, sy, canonical.cy - sy * camera.cy]]
    )
    mean = [float(value) for value in image.reshape(-1, 3).mean(0)]
    return np.asarray(
        cv2.warpAffine(
            image, warp, (canonical.width, canonical.height), borderMode=cv2.BORDER_CONSTANT,
            borderValue=mean,
        ),
        np.uint8,
    )  # fmt: skip


def turned(
    image: NDArray[np.uint8], camera: Camera, rotation: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """The image of the camera turned to T_scene_cam @ rotation; its edge goes on where it saw
    nothing."""
    return np.asarray(
        cv2.warpPerspective(
            image, camera.K @ rotation.T @ np.linalg.inv(camera.K), (camera.width, camera.height),
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.uint8,
    )  # fmt: skip


def cell_centres(camera: Camera) -> NDArray[np.float64]:
    """Pixels [h, w, 2] of the cells' centres; the first pixel's centre is (0, 0)."""
    u = np.arange(camera.width // STRIDE) * STRIDE + 0.5 * (STRIDE - 1)
    v = np.arange(camera.height // STRIDE) * STRIDE + 0.5 * (STRIDE - 1)
    return np.stack(np.meshgrid(u, v), -1)


def cell_rays(camera: Camera) -> Tensor:
    """x/z and y/z of the cells' centres: float32 [h, w, 2]."""
    offset = cell_centres(camera) - (camera.cx, camera.cy)
    return torch.from_numpy((offset / (camera.fx, camera.fy)).astype(np.float32))


def to_tensor(images: NDArray[np.uint8]) -> Tensor:
    """float32 [B, 3, H, W] in [0, 1] of uint8 [B, H, W, 3]."""
    x = torch.from_numpy(images).float().div_(255).permute(0, 3, 1, 2)
    return x.contiguous(memory_format=torch.channels_last)
