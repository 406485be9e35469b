"""The picture of ~/debug/overlay: what the camera sees against what the map says it should."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.colour import match_colours
from igaussian_core.result import LocalizationResult

Image = NDArray[np.uint8]
_BAR = 22  # height of the caption in pixels
_SOLID = 0.9  # alpha of pixels whose colours are compared


def compare(live: Image, render: Image | None, mode: str) -> Image:
    """Live image and render [H, W, 3] as one picture; the live image alone without a render.

    Args:
        mode: split (live left, render right of the middle), blend, or side (twice as wide).
    """
    if render is None:
        return live
    if mode == "side":
        return np.concatenate([live, render], 1)
    if mode == "blend":
        return np.asarray(cv2.addWeighted(live, 0.5, render, 0.5, 0), np.uint8)
    middle = live.shape[1] // 2
    picture = live.copy()
    picture[:, middle:] = render[:, middle:]
    picture[:, middle - 1 : middle + 1] = (255, 255, 0)
    return picture


def captioned(picture: Image, text: str, good: bool) -> Image:
    """The picture with a bar of text below it, green or red."""
    bar = np.full((_BAR, picture.shape[1], 3), (16, 80, 32) if good else (130, 24, 24), np.uint8)
    cv2.putText(
        bar, text, (6, _BAR - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA
    )
    return np.concatenate([picture, bar], 0)


def caption(result: LocalizationResult) -> str:
    """One line that says what became of the frame."""
    total_ms = result.timings_ms.get("total", float("nan"))
    if not result.ok or result.T_map_cam is None:
        return f"LOST {result.status.value}: {result.reason}"
    x, y, z = result.T_map_cam[:3, 3]
    return (
        f"{result.status.value} {result.inliers}/{result.matches} inliers "
        f"{result.residual_px:.2f} px | camera {x:.2f} {y:.2f} {z:.2f} m | "
        f"{result.source} {total_ms:.0f} ms"
    )


def in_colours_of(
    live: Image, rgb: NDArray[np.float32], alpha: NDArray[np.float32]
) -> Image:
    """uint8 of a render, in the live image's exposure where a fit is plausible."""
    matched = match_colours(rgb, live, alpha > _SOLID)
    return (np.clip(matched, 0, 1) * 255 + 0.5).astype(np.uint8)
