"""Live images next to renders at the poses that were found for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.bags import Bag
from igaussian_core.evaluate.drive import DriveFrame
from igaussian_core.localizer import Localizer

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Overlay:
    """A frame's live image and the map's render at its pose, both undistorted, uint8 RGB."""

    frame: DriveFrame
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


def make_overlays(
    bag: Bag,
    localizer: Localizer,
    frames: Sequence[DriveFrame],
    count: int,
    max_side: int = 640,
    topics: tuple[str | None, str | None] = (None, None),
) -> list[Overlay]:
    """Overlays of `count` accepted frames spread over the drive; fewer where there are fewer."""
    accepted = [frame for frame in frames if frame.T_map_cam is not None]
    if not accepted or count < 1:
        return []
    chosen = np.unique(np.linspace(0, len(accepted) - 1, count).round().astype(int))
    wanted = {accepted[i].stamp_ns: accepted[i] for i in chosen}
    overlays = []
    for image in bag.frames(*topics, skip_bad=True):
        frame = wanted.get(image.stamp_ns)
        if frame is None or frame.T_map_cam is None:
            continue
        camera = image.camera.scaled_to_fit(max_side)
        small = cv2.resize(image.image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        live, pinhole = camera.undistort(np.asarray(small, np.uint8))
        rgb, _, _ = localizer.render(pinhole, frame.T_map_cam)
        render = (np.clip(rgb, 0, 1) * 255 + 0.5).astype(np.uint8)
        overlays.append(Overlay(frame, live, render))
    return overlays
