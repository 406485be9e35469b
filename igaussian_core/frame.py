"""One image with its stamp and its camera, as it travels from a topic or a bag to the tracker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera


@dataclass(frozen=True)
class Frame:
    """An image to localize.

    Attributes:
        stamp_ns: the image's own stamp in nanoseconds.
        image: uint8 RGB [camera.height, camera.width, 3].
        camera: its intrinsics.
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    camera: Camera
