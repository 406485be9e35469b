"""Live images next to renders at the poses that were found for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from igaussian_core.bags import Bag
from igaussian_core.evaluate.drive import DriveFrame
from igaussian_core.evaluate.overlays import Pair, make_pair
from igaussian_core.localizer import Localizer


@dataclass(frozen=True)
class Overlay(Pair):
    """A frame of a drive, and what the map shows at its pose."""

    frame: DriveFrame


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
        pair = make_pair(localizer, image.image, image.camera, frame.T_map_cam, max_side)
        overlays.append(Overlay(pair.live, pair.render, frame))
    return overlays
