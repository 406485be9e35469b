"""An image next to the map's render at the pose that was found for it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.colour import match_colours
from igaussian_core.localizer import Localizer

Image = NDArray[np.uint8]
_SOLID = 0.9  # alpha of pixels whose colours are compared


@dataclass(frozen=True)
class Pair:
    """A live image and the map's render at its pose, both undistorted, uint8 RGB."""

    live: Image
    render: Image

    def side_by_side(self) -> Image:
        """Live left, render right, [H, 2W, 3]."""
        return np.concatenate([self.live, self.render], axis=1)

    def checkered(self, tiles: int = 8) -> Image:
        """Live and render in alternate tiles: edges go on across tiles where the pose is right."""
        height, width = self.live.shape[:2]
        size = max(1, width // tiles)
        rows, columns = np.indices((height, width)) // size
        return np.where(((rows + columns) % 2 == 0)[..., None], self.live, self.render)

    def labelled(self) -> list[tuple[str, Image]]:
        """The three pictures of a report."""
        return [
            ("camera", self.live), ("map at the pose found", self.render),
            ("both in alternate tiles", self.checkered()),
        ]  # fmt: skip


def make_pair(
    localizer: Localizer,
    image: Image,
    camera: Camera,
    T_map_cam: NDArray[np.float64],
    max_side: int = 640,
) -> Pair:
    """An image, shrunk and undistorted, and the map's render at a pose in the image's exposure."""
    small_camera = camera.scaled_to_fit(max_side)
    size = (small_camera.width, small_camera.height)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    live, pinhole = small_camera.undistort(np.asarray(small, np.uint8))
    rgb, _, alpha = localizer.render(pinhole, T_map_cam)
    matched = match_colours(rgb, live, alpha > _SOLID)
    return Pair(live, (np.clip(matched, 0, 1) * 255 + 0.5).astype(np.uint8))
