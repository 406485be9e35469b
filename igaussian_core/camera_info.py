"""A Camera from the plain values of a ROS camera_info message; knows nothing of ROS.

Shared by the bag reader and the node.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import MODELS, Camera
from igaussian_core.errors import CameraError

Roi = tuple[int, int, int, int]


def camera_from_info(
    width: int,
    height: int,
    K: Sequence[float],
    D: Sequence[float] = (),
    distortion_model: str = "plumb_bob",
    binning: tuple[int, int] = (0, 0),
    roi: Roi = (0, 0, 0, 0),
    P: Sequence[float] | None = None,
    rectified: bool = False,
) -> Camera:
    """The camera of the images that come with this camera_info.

    K, D and the sizes describe the full-resolution sensor (REP 104); the images are its region
    of interest, binned. Binning averages neighbouring pixels, so that a pixel's centre moves as
    in Camera.resized.

    Args:
        width, height: full-resolution size in pixels.
        K: 9 values of the 3x3 intrinsic matrix, row by row.
        D: distortion coefficients; empty means none.
        distortion_model: plumb_bob, rational_polynomial or equidistant; any name where all of
            D is zero, as there is nothing to distort.
        binning: binning_x, binning_y; 0 and 1 both mean none.
        roi: x_offset, y_offset, width, height in full-resolution pixels; all 0 means the whole.
        P: 12 values of the 3x4 projection matrix, used for rectified images only.
        rectified: the images are rectified (image_rect*): P holds, and D no more.

    Raises:
        CameraError: an uncalibrated camera (K of zeros), values that make no sense, an unknown
            distortion model, a region outside the sensor.
    """
    matrix = _matrix("P", P, 12) if rectified else _matrix("K", K, 9)
    dist = () if rectified else tuple(float(value) for value in D)
    if not any(matrix.ravel()):
        name = "P" if rectified else "K"
        raise CameraError(f"camera_info: {name} is all zeros: the camera is not calibrated")
    if np.isfinite(matrix[0, 1]) and matrix[0, 1] != 0:
        raise CameraError(f"camera_info: skew {matrix[0, 1]:g} is not supported")
    x0, y0, roi_width, roi_height = _checked_roi(width, height, roi)
    bin_x, bin_y = (max(1, int(value)) for value in binning)
    model, dist = _model(distortion_model, dist)
    # the binned image drops an incomplete last super-pixel
    return Camera(
        roi_width // bin_x,
        roi_height // bin_y,
        float(matrix[0, 0] / bin_x),
        float(matrix[1, 1] / bin_y),
        float((matrix[0, 2] - x0 + 0.5) / bin_x - 0.5),
        float((matrix[1, 2] - y0 + 0.5) / bin_y - 0.5),
        model,
        dist,
    )


def _matrix(name: str, values: Sequence[float] | None, count: int) -> NDArray[np.float64]:
    array = np.asarray([] if values is None else values, np.float64).ravel()
    if array.size != count:
        raise CameraError(f"camera_info: {name} has {array.size} values, {count} wanted")
    return array.reshape(3, count // 3)


def _checked_roi(width: int, height: int, roi: Roi) -> Roi:
    """The region with its true size, inside the sensor."""
    x0, y0, roi_width, roi_height = (int(value) for value in roi)
    if width <= 0 or height <= 0:
        raise CameraError(f"camera_info: size {width}x{height} is not positive")
    if roi_width == 0 and roi_height == 0:
        roi_width, roi_height = width - x0, height - y0
    inside = x0 >= 0 and y0 >= 0 and x0 + roi_width <= width and y0 + roi_height <= height
    if not inside or roi_width <= 0 or roi_height <= 0:
        raise CameraError(
            f"camera_info: region of interest {roi_width}x{roi_height} at ({x0}, {y0}) "
            f"is not inside {width}x{height}"
        )
    return x0, y0, roi_width, roi_height


def _model(name: str, dist: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """Distortion model and coefficients as Camera takes them."""
    # a fisheye without coefficients given is still a fisheye, other models are pinholes then
    if not any(dist) and not (name == "equidistant" and dist):
        return "plumb_bob", ()
    if name not in MODELS:
        raise CameraError(
            f"camera_info: distortion model '{name}' is not supported; "
            f"supported: {', '.join(MODELS)}"
        )
    return name, dist
