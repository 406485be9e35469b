"""Rendered depth to 3D points, and which pixels can be trusted."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera


def trusted_depth(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], min_alpha: float, max_step: float
) -> NDArray[np.bool_]:
    """Mask [H, W] of pixels that are opaque and on no depth edge.

    At a silhouette the expected depth mixes near and far surfaces; a point lifted there lies
    on neither. `max_step` is the relative range of depth within 2 pixels.
    """
    kernel = np.ones((5, 5), np.uint8)
    filled = np.where(alpha > 1e-3, depth, np.float32(1e6)).astype(np.float32)
    far, near = cv2.dilate(filled, kernel), cv2.erode(filled, kernel)
    opaque = cv2.erode(alpha, np.ones((3, 3), np.uint8)) >= min_alpha
    return np.asarray(opaque & (near > 0) & (far - near <= max_step * depth))


def sample(image: NDArray[np.float32], uv: NDArray[np.float32]) -> NDArray[np.float32]:
    """Bilinear samples [N] of an image [H, W] at pixels [N, 2]."""
    if len(uv) == 0:
        return np.zeros(0, np.float32)
    u = np.ascontiguousarray(uv[:, 0], np.float32)[:, None]
    v = np.ascontiguousarray(uv[:, 1], np.float32)[:, None]
    out = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out[:, 0], np.float32)


def at_pixels(mask: NDArray[np.bool_], uv: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Values [N] of a mask [H, W] at the nearest pixels of [N, 2]."""
    h, w = mask.shape
    u = np.clip(np.rint(uv[:, 0]).astype(int), 0, w - 1)
    v = np.clip(np.rint(uv[:, 1]).astype(int), 0, h - 1)
    return np.asarray(mask[v, u])


def unproject(
    camera: Camera, uv: NDArray[np.float32], depth: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Points [N, 3] in the pinhole camera's frame of pixels [N, 2] at depths z [N]."""
    z = depth.astype(np.float64)
    x = (uv[:, 0] - camera.cx) / camera.fx * z
    y = (uv[:, 1] - camera.cy) / camera.fy * z
    return np.stack([x, y, z], axis=1)
