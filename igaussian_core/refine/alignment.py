"""Sub-pixel correspondences between a render and an image of nearly the same view.

Pyramidal Lucas-Kanade (Bouguet 2001) on locally normalised images, which take exposure, white
balance and vignetting out. Keypoint matches are good to about a pixel; these to about a tenth.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.contrast import Gray

Pixels = NDArray[np.float32]

_MAX_ROUND_TRIP_PX = 0.7
# least texture of a corner, as a share of the strongest one's; the second where few reach the first
_QUALITY, _WEAK_QUALITY = 0.02, 0.002
_ENOUGH = 0.25  # share of the corners asked for


def corners(gray: Gray, mask: NDArray[np.bool_], count: int) -> Pixels:
    """At most `count` well-textured pixels [N, 2] inside a mask, spread over the image.

    Weakly textured ones count as well where there are few others: of a bare wall and a clock,
    the clock's alone tell less than both.
    """
    spacing = max(4.0, 0.6 * float(np.sqrt(gray.size / max(count, 1))))
    inside = mask.astype(np.uint8) * 255
    for quality in (_QUALITY, _WEAK_QUALITY):
        found = cv2.goodFeaturesToTrack(gray, count, quality, spacing, mask=inside, blockSize=5)
        if found is not None and len(found) >= _ENOUGH * count:
            break
    return np.zeros((0, 2), np.float32) if found is None else found[:, 0].astype(np.float32)


def follow(
    render: Gray, image: Gray, uv_render: Pixels, uv_guess: Pixels, window: int, levels: int
) -> tuple[Pixels, NDArray[np.bool_]]:
    """Where points of the render lie in the image: pixels [N, 2] and which can be trusted.

    Args:
        uv_render: points in the render.
        uv_guess: where to start in the image.
        window: side of the patch in pixels.
        levels: pyramid levels above the full resolution; 0 keeps to the guess.

    Returns:
        A point is trusted where following it back ends where it began.
    """
    if len(uv_render) == 0:
        return np.zeros((0, 2), np.float32), np.zeros(0, bool)
    there, ok = _lucas_kanade(render, image, uv_render, uv_guess, window, levels)
    back, ok_back = _lucas_kanade(image, render, there, uv_render, window, 0)
    round_trip = np.linalg.norm(back - uv_render, axis=1)
    return there, ok & ok_back & (round_trip < _MAX_ROUND_TRIP_PX)


def _lucas_kanade(
    source: Gray, target: Gray, uv: Pixels, guess: Pixels, window: int, levels: int
) -> tuple[Pixels, NDArray[np.bool_]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source, target, uv.reshape(-1, 1, 2).copy(), guess.reshape(-1, 1, 2).copy(),
        winSize=(window, window), maxLevel=levels,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return np.asarray(found[:, 0], np.float32), np.asarray(status[:, 0] == 1)
