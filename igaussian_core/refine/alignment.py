"""Sub-pixel correspondences between a render and an image of nearly the same view.

Pyramidal Lucas-Kanade (Bouguet 2001) on locally normalised images, which take exposure, white
balance and vignetting out. Keypoint matches are good to about a pixel; these to about a tenth.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.contrast import Gray

Pixels = NDArray[np.float32]

_MAX_ROUND_TRIP_PX = 0.7
# least texture of a corner, as a share of the strongest one's; the second where few reach the first
_QUALITY, _FAINT_QUALITY = 0.02, 0.002
_ENOUGH = 0.25  # share of the corners asked for
_MIN_FAINT_CORRELATION = 0.4  # of a faint corner's patches: noise has less


class Followed(NamedTuple):
    """Points of a render found in an image.

    Attributes:
        uv_render, uv_image: pixels [N, 2] of those that can be trusted.
        looked_at: how many were looked for; of faint ones only those that were found, since
            noise may hide them from an image that shows the same place.
    """

    uv_render: Pixels
    uv_image: Pixels
    looked_at: int


def follow_corners(
    render: Gray, image: Gray, mask: NDArray[np.bool_], count: int, window: int, levels: int
) -> Followed:
    """At most `count` corners of a render inside a mask, followed into an image.

    Where a render has few corners, as of a bare wall with a clock, faint ones are followed as
    well; those must look alike in both.
    """
    uv_render, distinct = corners(render, mask, count)
    uv_image, good = follow(render, image, uv_render, uv_render, window, levels)
    if len(uv_render) > distinct:
        alike = _correlation(render, image, uv_render[distinct:], uv_image[distinct:], window)
        good[distinct:] &= alike > _MIN_FAINT_CORRELATION
    looked_at = distinct + int(good[distinct:].sum())
    return Followed(uv_render[good], uv_image[good], looked_at)


def corners(gray: Gray, mask: NDArray[np.bool_], count: int) -> tuple[Pixels, int]:
    """At most `count` pixels [N, 2] with texture inside a mask, spread over the image, and how
    many of them, the first ones, have plenty: the others are there where those are few."""
    spacing = max(4.0, 0.6 * float(np.sqrt(gray.size / max(count, 1))))
    inside = mask.astype(np.uint8) * 255

    def found(quality: float) -> Pixels:
        uv = cv2.goodFeaturesToTrack(gray, count, quality, spacing, mask=inside, blockSize=5)
        return np.zeros((0, 2), np.float32) if uv is None else uv[:, 0].astype(np.float32)

    distinct = found(_QUALITY)
    if len(distinct) >= _ENOUGH * count:
        return distinct, len(distinct)
    return found(_FAINT_QUALITY), len(distinct)  # the best first, so that those are among them


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


def _correlation(
    a: Gray, b: Gray, uv_a: Pixels, uv_b: Pixels, window: int
) -> NDArray[np.float32]:
    """Normalised cross-correlation [N] of patches around pixels of two images, -1 to 1."""
    patches = []
    for image, uv in ((a, uv_a), (b, uv_b)):
        patch = _patches(image, uv, window)
        patch -= patch.mean(axis=1, keepdims=True)
        patches.append(patch / np.maximum(np.linalg.norm(patch, axis=1, keepdims=True), 1e-9))
    return np.asarray((patches[0] * patches[1]).sum(axis=1))


def _patches(image: Gray, uv: Pixels, window: int) -> NDArray[np.float32]:
    """Bilinear samples [N, window * window] around pixels."""
    offset = np.arange(window, dtype=np.float32) - window // 2
    u = uv[:, :1] + np.tile(offset, window)
    v = uv[:, 1:] + np.repeat(offset, window)
    out = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(out, np.float32)
