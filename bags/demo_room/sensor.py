"""The camera: lens, exposure, motion blur, noise and JPEG."""

from __future__ import annotations

import cv2
import numpy as np

from .drive import Drive, image_times
from .raycast import RayCaster, Rays
from .surfaces import Array, Image

WIDTH, HEIGHT = 640, 480
FX, FY, CX, CY = 462.4, 461.8, 321.7, 238.6  # first pixel's centre at (0, 0)
DISTORTION = (-0.055, 0.021, 0.0006, -0.0004, 0.0)  # plumb_bob: k1 k2 p1 p2 k3
EXPOSURE_TIME = 0.009  # seconds; the stamp is the middle of the exposure
SAMPLES = 6  # rays a pixel, each at its own time and place
READ_NOISE, SHOT_NOISE = 1.0, 0.11  # of 8-bit values: sigma^2 = read^2 + (shot^2) * value
VIGNETTE = 0.16  # loss in the corners
JPEG_QUALITY = 77


def camera_matrix() -> Array:
    """Intrinsic matrix [3, 3]."""
    return np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])


def make_rays(dx: float = 0.0, dy: float = 0.0, step: int = 1) -> Rays:
    """Rays of every step-th pixel, shifted by (dx, dy) pixels, lens distortion removed."""
    cols, rows = np.meshgrid(np.arange(0, WIDTH, step) + dx, np.arange(0, HEIGHT, step) + dy)
    pixels = np.stack([cols.ravel(), rows.ravel()], 1)[:, None]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-10)
    flat = cv2.undistortPoints(
        pixels, camera_matrix(), np.array(DISTORTION), None, None, criteria=criteria
    )
    grid = flat.reshape(*cols.shape, 2).astype(np.float32)
    return Rays(np.ascontiguousarray(grid[..., 0]), np.ascontiguousarray(grid[..., 1]))


def gain_at(time: float) -> float:
    """Exposure drift of the camera's slow automatic control, 0.78..1.28."""
    return float(1.03 + 0.17 * np.sin(2 * np.pi * time / 13.0 + 0.6) + 0.08 * np.sin(1.13 * time))


class CameraModel:
    """Takes the pictures of a drive."""

    def __init__(self, caster: RayCaster, drive: Drive) -> None:
        self.caster, self.drive = caster, drive
        # a rotated 2x3 pattern of places, and exposure times in shuffled order
        places = [((i % 3 + 0.5) / 3 - 0.5, (i // 3 + 0.5) / 2 - 0.5) for i in range(SAMPLES)]
        self.rays = [make_rays(x + 0.2 * y, y - 0.2 * x) for x, y in places]
        order = np.array([3, 0, 4, 1, 5, 2])
        self.offsets = ((order + 0.5) / SAMPLES - 0.5) * EXPOSURE_TIME
        cols, rows = np.meshgrid(np.arange(WIDTH) - CX, np.arange(HEIGHT) - CY)
        radius = (cols**2 + rows**2) / (CX**2 + CY**2)
        self.falloff = (1 - VIGNETTE * radius)[..., None]

    def clean(self, time: float) -> Array:
        """What falls on the sensor, float64 [H, W, 3] 0..255: blurred, neither gain nor noise."""
        total = np.zeros((HEIGHT, WIDTH, 3))
        for rays, offset in zip(self.rays, self.offsets, strict=True):
            total += self.caster.cast(rays, self.drive.T_map_cam(time + float(offset)))[0]
        return total / SAMPLES

    def photo(self, index: int) -> Image:
        """Image `index` of the drive, uint8 RGB [H, W, 3]."""
        time = float(image_times()[index])
        signal = self.clean(time) * self.falloff * gain_at(time)
        rng = np.random.default_rng([41, index])
        sigma = np.sqrt(READ_NOISE**2 + SHOT_NOISE**2 * signal)
        noisy = signal + rng.standard_normal(signal.shape, np.float32) * sigma
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def to_jpeg(image: Image) -> bytes:
    """JPEG file of an RGB image."""
    ok, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not ok:
        raise RuntimeError("cv2.imencode could not write a JPEG")
    return bytes(data.tobytes())
