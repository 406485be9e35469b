"""Grey images that compare in spite of exposure, white balance and vignetting."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]

_SIGMA = 6.0  # pixels of the neighbourhood that is normalised
_NOISE = 4.0  # grey levels of contrast below which nothing is amplified


def normalize_contrast(image: NDArray[np.uint8]) -> Gray:
    """Grey image [H, W] of uint8 RGB [H, W, 3] with local mean 128 and local deviation 40."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.GaussianBlur(gray, (0, 0), _SIGMA)
    variance = cv2.GaussianBlur(gray * gray, (0, 0), _SIGMA) - mean * mean
    deviation = np.sqrt(np.maximum(variance, 0)) + _NOISE
    return np.asarray(np.clip((gray - mean) / deviation * 40 + 128, 0, 255), np.uint8)
