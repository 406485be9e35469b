"""Ray casting of the analytic room: what a camera sees, without any Gaussian.

Each surface is a rectangle c + s u + t v. A camera ray through (x, y, 1) meets its plane where
(x, y, 1)^T = [u v c] (s k, t k, k)^T with k = 1 / depth, so s k, t k and k are linear in
(x, y): one 3x3 inverse a surface, six multiplications a pixel, and the largest k wins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .surfaces import Array, Image, Room, Surface

Array32 = NDArray[np.float32]
NEAR = 0.03
_LEVELS = 4
_FOLD = 512  # width of the strips that cv2.remap samples lists of pixels in


@dataclass(frozen=True)
class Rays:
    """Undistorted image-plane coordinates (x/z, y/z) of every pixel, float32 [H, W]."""

    x: Array32
    y: Array32

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest and largest x, then y."""
        return (float(self.x.min()), float(self.x.max()), float(self.y.min()), float(self.y.max()))


class RayCaster:
    """Holds the room's textures as pyramids; cast() is read-only."""

    def __init__(self, room: Room) -> None:
        self.surfaces = room.surfaces
        self._pyramids = [_pyramid(surface.texture) for surface in room.surfaces]

    def cast(self, rays: Rays, T_map_cam: Array) -> tuple[Image, Array32]:
        """Colour uint8 [H, W, 3] and depth along the optical axis, metres [H, W] (0: nothing)."""
        k, s, t, who = self._visible(rays, T_map_cam)
        colour = np.zeros((*k.shape, 3), np.uint8)
        for index, pixels in _grouped(who):
            hit = np.unravel_index(pixels, who.shape)
            colour[hit] = self._sample(index, s[hit], t[hit], k[hit], rays, T_map_cam)
        depth = np.where(who >= 0, 1 / np.maximum(k, 1e-9), 0).astype(np.float32)
        return colour, depth

    def _visible(
        self, rays: Rays, T_map_cam: Array
    ) -> tuple[Array32, Array32, Array32, NDArray[np.int16]]:
        """Per pixel: inverse depth, place (s, t) on the nearest surface, and its index or -1."""
        shape = rays.x.shape
        k_best: Array32 = np.zeros(shape, np.float32)
        s_best, t_best = np.zeros_like(k_best), np.zeros_like(k_best)
        who: NDArray[np.int16] = np.full(shape, -1, np.int16)
        for index, surface in enumerate(self.surfaces):
            window = _window(surface, rays, T_map_cam)
            if window is None:
                continue
            a, b, k = _linear_forms(surface, T_map_cam, rays.x[window], rays.y[window])
            hit = (a >= 0) & (a <= k) & (b >= 0) & (b <= k) & (k > k_best[window])
            if surface.mask is not None:
                hit &= _in_mask(surface.mask, a, b, k)
            if not hit.any():
                continue
            np.copyto(k_best[window], k, where=hit)
            np.copyto(s_best[window], a, where=hit)
            np.copyto(t_best[window], b, where=hit)
            np.copyto(who[window], np.int16(index), where=hit)
        safe = np.maximum(k_best, np.float32(1e-9))
        return k_best, s_best / safe, t_best / safe, who

    def _sample(
        self, index: int, s: Array32, t: Array32, k: Array32, rays: Rays, T_map_cam: Array
    ) -> Image:
        """Texture colours at (s, t), from the pyramid level that fits the pixel's footprint."""
        surface = self.surfaces[index]
        pitch = abs(float(rays.x[0, 1] - rays.x[0, 0]))
        texel = surface.size[0] / surface.texture.shape[1]
        level = np.floor(np.log2(np.maximum(pitch / k / texel, 1e-3)) + 0.3)
        level = np.clip(level, 0, len(self._pyramids[index]) - 1).astype(np.int8)
        result = np.empty((len(s), 3), np.uint8)
        for value in np.unique(level):
            pick = level == value
            texture = self._pyramids[index][int(value)]
            rows, cols = texture.shape[:2]
            result[pick] = _remap(texture, s[pick] * cols - 0.5, t[pick] * rows - 0.5)
        return result


def _grouped(who: NDArray[np.int16]) -> Iterator[tuple[int, NDArray[np.intp]]]:
    """Each surface that is seen with its pixels' flat indices in ascending order."""
    order = np.argsort(who, axis=None, kind="stable")
    found, first = np.unique(who.ravel()[order], return_index=True)
    for index, pixels in zip(found.tolist(), np.split(order, first[1:]), strict=True):
        if index >= 0:
            yield index, pixels


def _pyramid(texture: Image) -> list[Image]:
    levels = [texture]
    while len(levels) < _LEVELS and min(levels[-1].shape[:2]) >= 8:
        rows, cols = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], (cols // 2, rows // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, np.uint8))
    return levels


def _linear_forms(
    surface: Surface, T_map_cam: Array, x: Array32, y: Array32
) -> tuple[Array32, Array32, Array32]:
    """s k, t k and k at the rays (x, y)."""
    R = T_map_cam[:3, :3]
    centre = T_map_cam[:3, 3]
    columns = np.stack([surface.edge_u, surface.edge_v, surface.corner - centre], 1)
    forms = np.linalg.inv(R.T @ columns).astype(np.float32)
    a, b, k = (row[0] * x + row[1] * y + row[2] for row in forms)
    return a, b, k


def _window(surface: Surface, rays: Rays, T_map_cam: Array) -> tuple[slice, slice] | None:
    """The part of the image that the surface can cover, or None."""
    R, centre = T_map_cam[:3, :3], T_map_cam[:3, 3]
    facing = float(np.sum(surface.normal * (centre - surface.corner)))
    if abs(facing) < 1e-6 or (facing < 0 and not surface.two_sided):
        return None
    u, v = surface.edge_u, surface.edge_v
    corners = surface.corner + np.stack([np.zeros(3), u, u + v, v])
    polygon = (corners - centre) @ R
    x0, x1, y0, y1 = rays.bounds
    planes = ((0, 0, 1, -NEAR), (1, 0, -x0, 0), (-1, 0, x1, 0), (0, 1, -y0, 0), (0, -1, y1, 0))
    for plane in planes:
        polygon = _clip(polygon, np.array(plane, float))
        if len(polygon) == 0:
            return None
    flat = polygon[:, :2] / polygon[:, 2:]
    height, width = rays.x.shape
    cols = (flat[:, 0] - x0) / (x1 - x0) * (width - 1)
    rows = (flat[:, 1] - y0) / (y1 - y0) * (height - 1)
    margin = 18  # distortion bends the grid of rays by less than this many pixels
    row_slice = slice(max(0, int(rows.min()) - margin), int(rows.max()) + margin)
    return row_slice, slice(max(0, int(cols.min()) - margin), int(cols.max()) + margin)


def _clip(polygon: Array, plane: Array) -> Array:
    """Sutherland and Hodgman: the part of a convex polygon [N, 3] where plane . (x, 1) >= 0."""
    side = polygon @ plane[:3] + plane[3]
    kept = []
    for i in range(len(polygon)):
        j = (i + 1) % len(polygon)
        if side[i] >= 0:
            kept.append(polygon[i])
        if (side[i] >= 0) != (side[j] >= 0):
            f = side[i] / (side[i] - side[j])
            kept.append(polygon[i] + f * (polygon[j] - polygon[i]))
    return np.array(kept).reshape(-1, 3)


def _in_mask(mask: NDArray[np.bool_], a: Array32, b: Array32, k: Array32) -> NDArray[np.bool_]:
    rows, cols = mask.shape
    safe = np.where(k > 1e-6, k, 1)
    col = np.clip(a / safe * cols, 0, cols - 1).astype(np.intp)
    row = np.clip(b / safe * rows, 0, rows - 1).astype(np.intp)
    return mask[row, col]


def _remap(texture: Image, x: Array32, y: Array32) -> Image:
    """Bilinear samples [N, 3] of a texture at lists of places."""
    count = len(x)
    if count == 1:  # cv2 wants at least a row
        x, y = np.repeat(x, 2), np.repeat(y, 2)
    padded = -(-len(x) // _FOLD) * _FOLD
    map_x = np.pad(x, (0, padded - len(x))).reshape(-1, _FOLD)
    map_y = np.pad(y, (0, padded - len(y))).reshape(-1, _FOLD)
    sampled = cv2.remap(texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled.reshape(-1, 3)[:count], np.uint8)
