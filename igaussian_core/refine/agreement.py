"""Does an image show what the map shows at a pose, where the matches say so?

A wrong pose can have as many matches as a right one where a scene resembles itself; between the
matched points it then shows something else. Only cells around matched points are compared, so that
what covers part of the view says nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.contrast import Gray, blocks

Mask = NDArray[np.bool_]
Pixels = NDArray[np.float32]

CELL_PX = 24
_SHRINK = 4  # a pose that is right to a pixel or two changes nothing
_MIN_CELLS = 4
_MIN_TEXTURE = 6.0  # grey levels of standard deviation that a cell of the render must have
_FLAT = 0.5  # and one of the image: what covers the lens is flat
_DETAIL_PX = (2.0, 4.0)  # sigmas of the band that blur takes first


def plane_homography(
    camera: Camera, T_image_render: NDArray[np.float64], depth: float
) -> NDArray[np.float64]:
    """Pixels of a render to pixels of the image, 3x3, as if all lay on a plane across the view.

    Args:
        T_image_render: between their cameras, 4x4; a few pixels apart.
        depth: of the plane in the render.
    """
    R, t = T_image_render[:3, :3], T_image_render[:3, 3]
    across = R + np.outer(t, (0, 0, 1 / max(depth, 1e-9)))
    return np.asarray(camera.K @ across @ np.linalg.inv(camera.K))


def seen_through(H: NDArray[np.float64], image: Gray) -> Gray:
    """An image as the render's camera would see it; its edge goes on where it saw nothing."""
    size = image.shape[1], image.shape[0]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shifted = cv2.warpPerspective(image, H, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(shifted, np.uint8)


def agreement(image: Gray, render: Gray, known: Mask, uv: Pixels) -> float:
    """Mean correlation of brightness in the cells of matched points, -1 to 1.

    Normalised cross-correlation by cell: gain and offset of brightness do not matter.

    Args:
        image, render: uint8 grey [H, W], at one pose.
        known: mask [H, W] of pixels that the map covers.
        uv: pixels [N, 2] of the matched points.

    Returns:
        NaN where fewer than 4 such cells have texture: nothing can be said.
    """
    a, b, m = (
        blocks(_small(array), CELL_PX // _SHRINK)
        for array in (image, render, known.astype(np.uint8) * 255)
    )
    m = (m > 127).astype(np.float32)
    count = np.maximum(m.sum(axis=1), 1e-9)
    a = (a - ((a * m).sum(axis=1) / count)[:, None]) * m
    b = (b - ((b * m).sum(axis=1) / count)[:, None]) * m
    deviation_a, deviation_b = (np.sqrt((x * x).sum(axis=1) / count) for x in (a, b))
    use = (2 * count > m.shape[1]) & (deviation_b > _MIN_TEXTURE) & (deviation_a > _FLAT)
    use &= _occupied(image.shape, uv)
    if use.sum() < _MIN_CELLS:
        return float("nan")
    correlation = (a * b).sum(axis=1) / (count * np.maximum(deviation_a * deviation_b, 1e-9))
    return float(correlation[use].mean())


def sharpness(image: Gray, render: Gray, known: Mask, uv: Pixels) -> float:
    """How much of the render's fine detail the image shows in the cells of matched points.

    The slope by which the image follows the render in a band of 2 to 4 pixels: 1 for a photo as
    sharp as the map, 0 where blur has taken the detail. Noise has none of it.

    Args:
        image, render: locally normalised grey [H, W]; otherwise as `agreement`.

    Returns:
        NaN where fewer than 4 cells hold matched points.
    """
    occupied = _occupied(image.shape, uv)
    if occupied.sum() < _MIN_CELLS:
        return float("nan")
    height, width = image.shape
    half = (max(width // 2, 1), max(height // 2, 1))
    inside = cv2.resize(known.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    a, b = (_detail(array, half) * inside for array in (image, render))
    cells_a, cells_b = (blocks(x, CELL_PX // 2)[occupied] for x in (a, b))
    energy = float((cells_b * cells_b).sum())
    return float((cells_a * cells_b).sum()) / energy if energy > 0 else float("nan")


def _detail(gray: Gray, size: tuple[int, int]) -> NDArray[np.float32]:
    """The band of fine detail at half the resolution."""
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    fine, coarse = (cv2.GaussianBlur(small, (0, 0), sigma / 2) for sigma in _DETAIL_PX)
    return np.asarray(fine - coarse, np.float32)


def _small(array: Gray) -> NDArray[np.float32]:
    height, width = array.shape
    size = (max(width // _SHRINK, 1), max(height // _SHRINK, 1))
    return cv2.resize(array, size, interpolation=cv2.INTER_AREA).astype(np.float32)


def _grid(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of whole cells."""
    return shape[0] // CELL_PX, shape[1] // CELL_PX


def _occupied(shape: tuple[int, ...], uv: Pixels) -> Mask:
    """Mask [cells] of those that hold a pixel of `uv`."""
    rows, columns = _grid(shape)
    column, row = (uv / CELL_PX).astype(int).T if len(uv) else np.zeros((2, 0), int)
    whole = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    occupied = np.zeros(rows * columns, bool)
    occupied[row[whole] * columns + column[whole]] = True
    return occupied
