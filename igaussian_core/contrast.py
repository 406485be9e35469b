"""Grey images that compare in spite of exposure, white balance and vignetting."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]

_SIGMA = 6.0  # pixels of the neighbourhood that is normalised
_SHRINK = 4  # mean and deviation are smooth: a quarter of the resolution tells them
_NOISE = 4.0  # grey levels of contrast below which nothing is amplified


def blocks(image: NDArray[np.float32], side: int) -> NDArray[np.float32]:
    """Pixels [blocks, side * side] of an image's whole square blocks, row by row."""
    rows, columns = (size // side for size in image.shape)
    whole = image[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return np.asarray(whole.transpose(0, 2, 1, 3).reshape(rows * columns, side * side))


def normalize_contrast(image: NDArray[np.uint8]) -> Gray:
    """Grey image [H, W] of uint8 RGB [H, W, 3] with local mean 128 and local deviation 40."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = gray.shape
    small = (max(width // _SHRINK, 1), max(height // _SHRINK, 1))
    mean, square = (
        cv2.GaussianBlur(
            cv2.resize(x, small, interpolation=cv2.INTER_AREA), (0, 0), _SIGMA / _SHRINK
        )
        for x in (gray, gray * gray)
    )
    gain = 40 / (np.sqrt(np.maximum(square - mean * mean, 0)) + _NOISE)
    gray -= cv2.resize(mean, (width, height))
    gray *= cv2.resize(gain, (width, height))
    gray += 128
    return np.asarray(np.clip(gray, 0, 255, out=gray), np.uint8)
