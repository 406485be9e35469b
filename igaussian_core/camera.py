"""Camera intrinsics, distortion and image resizing.

Pixel rule: as in OpenCV and ROS, the centre of the first pixel is (0, 0). Files that count
from the image's corner (COLMAP, 3DGS, NeRF transforms) are converted where they are read.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import CameraError

# number of coefficients that each model may carry
_DISTORTION_SIZES: dict[str, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (0, 8, 12, 14),
    "equidistant": (0, 4),
}
MODELS = tuple(_DISTORTION_SIZES)
# half the widest view of an undistorted image: beyond it a pinhole spends its pixels on the rim
_MAX_HALF_VIEW_DEG = 60.0


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one image size.

    Attributes:
        width, height: image size in pixels.
        fx, fy: focal lengths in pixels.
        cx, cy: principal point in pixels, first pixel's centre at (0, 0).
        model: distortion model: plumb_bob, rational_polynomial (OpenCV's order of
            coefficients) or equidistant (OpenCV's fisheye).
        dist: distortion coefficients, empty for a pinhole.

    Raises:
        CameraError: sizes or focal lengths not positive, values not finite, an unknown
            model or a wrong number of coefficients.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = "plumb_bob"
    dist: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "dist", tuple(float(value) for value in self.dist))
        if self.width <= 0 or self.height <= 0:
            raise CameraError(f"camera: image size {self.width}x{self.height} is not positive")
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.dist)
        if not all(np.isfinite(numbers)):
            raise CameraError(f"camera: intrinsics are not finite: {numbers}")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(
                f"camera: focal lengths fx={self.fx:g} fy={self.fy:g} must be positive"
                " (a camera_info with K of zeros means an uncalibrated camera)"
            )
        if self.model not in _DISTORTION_SIZES:
            raise CameraError(
                f"camera: distortion model '{self.model}' is not supported; "
                f"supported: {', '.join(MODELS)}"
            )
        if len(self.dist) not in _DISTORTION_SIZES[self.model]:
            raise CameraError(
                f"camera: {self.model} takes {_DISTORTION_SIZES[self.model]} distortion "
                f"coefficients, got {len(self.dist)}"
            )

    @property
    def K(self) -> NDArray[np.float64]:
        """Intrinsic matrix, 3x3 float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def is_pinhole(self) -> bool:
        """True where no distortion coefficient differs from zero."""
        # equidistant with zero coefficients still is a fisheye projection
        return not any(self.dist) and (self.model != "equidistant" or not self.dist)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera at another image size (pixel centres kept, see the pixel rule)."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.model,
            self.dist,
        )

    def scaled_to_fit(self, max_side: int) -> Camera:
        """The camera shrunk so that the longer side is at most max_side; never enlarged."""
        scale = max_side / max(self.width, self.height)
        if scale >= 1:
            return self
        return self.resized(
            max(1, round(self.width * scale)), max(1, round(self.height * scale))
        )

    def shrunk(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image [H, W, 3] of a larger camera in this one's size, by averaging pixels."""
        if image.shape[:2] == (self.height, self.width):
            return image
        size = (self.width, self.height)
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    def undistorted(self) -> Camera:
        """The pinhole camera of the undistorted image: same size, only valid pixels inside.

        Black borders cost matches and map quality, so the focal length is raised until no
        pixel of the result lies outside the source image.
        """
        return self if self.is_pinhole else _undistort_tables(self)[0]

    def undistort(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Camera]:
        """Image [H, W, C] without distortion, and its pinhole camera.

        Raises:
            CameraError: the image's size is not the camera's.
        """
        self.check_image(image)
        if self.is_pinhole:
            return image, self
        camera, map_x, map_y = _undistort_tables(self)
        return cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR), camera  # type: ignore[return-value]

    def check_image(self, image: NDArray[np.uint8]) -> None:
        """Raise CameraError unless image is uint8 RGB [height, width, 3] of this camera."""
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise CameraError(
                f"image: expected uint8 RGB [H, W, 3], got {image.dtype} {image.shape}"
            )
        if image.shape[:2] != (self.height, self.width):
            raise CameraError(
                f"image is {image.shape[1]}x{image.shape[0]}, "
                f"its camera is {self.width}x{self.height}"
            )

    def project(self, points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels [N, 2] of points [N, 3] in the camera's optical frame (z > 0)."""
        points = np.asarray(points_cam, np.float64).reshape(-1, 1, 3)
        if len(points) == 0:
            return np.zeros((0, 2))
        zero = np.zeros(3)
        if self.model == "equidistant" and self.dist:
            pixels, _ = cv2.fisheye.projectPoints(points, zero, zero, self.K, np.array(self.dist))
        else:
            pixels, _ = cv2.projectPoints(points, zero, zero, self.K, np.array(self.dist))
        return np.asarray(pixels, np.float64).reshape(-1, 2)

    def normalized(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Undistorted image-plane coordinates [N, 2] (x/z, y/z) of pixels [N, 2]."""
        points = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
        if len(points) == 0:
            return np.zeros((0, 2))
        if self.model == "equidistant" and self.dist:
            result = cv2.fisheye.undistortPoints(points, self.K, np.array(self.dist))
        else:
            result = _undistort_points(points, self.K, np.array(self.dist))
        return np.asarray(result, np.float64).reshape(-1, 2)


def _undistort_points(
    points: NDArray[np.float64], K: NDArray[np.float64], dist: NDArray[np.float64]
) -> NDArray[np.float64]:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        return np.asarray(cv2.undistortPointsIter(points, K, dist, None, None, criteria))
    return np.asarray(cv2.undistortPoints(points, K, dist, None, None, criteria=criteria))


@functools.lru_cache(maxsize=8)
def _undistort_tables(
    camera: Camera,
) -> tuple[Camera, NDArray[np.float32], NDArray[np.float32]]:
    """Pinhole camera and the remap tables from it into the distorted image."""
    size = (camera.width, camera.height)
    dist = np.array(camera.dist)
    target = _inscribed_pinhole(camera)
    if camera.model == "equidistant":
        map_x, map_y = cv2.fisheye.initUndistortRectifyMap(
            camera.K, dist, np.eye(3), target.K, size, cv2.CV_32FC1
        )
    else:
        map_x, map_y = cv2.initUndistortRectifyMap(
            camera.K, dist, np.eye(3), target.K, size, cv2.CV_32FC1
        )
    return target, np.asarray(map_x, np.float32), np.asarray(map_y, np.float32)


def _inscribed_pinhole(camera: Camera) -> Camera:
    """The widest pinhole of the same size and aspect whose whole image lies in the source.

    A fisheye may see 180 degrees and more, which no pinhole does: its view is cut there.
    """
    w, h = camera.width, camera.height
    top = np.stack([np.linspace(0, w - 1, 65), np.zeros(65)], 1)
    left = np.stack([np.zeros(65), np.linspace(0, h - 1, 65)], 1)
    limit = np.tan(np.radians(_MAX_HALF_VIEW_DEG))
    x_left = max(camera.normalized(left)[:, 0].max(), -limit)
    x_right = min(camera.normalized(left + [w - 1, 0])[:, 0].min(), limit)
    y_top = max(camera.normalized(top)[:, 1].max(), -limit)
    y_bottom = min(camera.normalized(top + [0, h - 1])[:, 1].min(), limit)
    if not (x_left < x_right and y_top < y_bottom):
        raise CameraError(
            f"camera: {camera.model} coefficients {camera.dist} leave no undistorted image"
        )
    # one factor for both axes: matchers were trained on square pixels
    zoom = max(
        (w - 1) / (x_right - x_left) / camera.fx, (h - 1) / (y_bottom - y_top) / camera.fy
    )
    fx, fy = float(camera.fx * zoom), float(camera.fy * zoom)
    x_mid, y_mid = float(x_left + x_right) / 2, float(y_top + y_bottom) / 2
    return Camera(w, h, fx, fy, (w - 1) / 2 - x_mid * fx, (h - 1) / 2 - y_mid * fy)
