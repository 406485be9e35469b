"""The frame being localized, with what is computed from it once and only when asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.contrast import Gray, normalize_contrast
from igaussian_core.features import Features, Matcher
from igaussian_core.timing import StageTimer


class Query:
    """An undistorted frame.

    Args:
        image: uint8 RGB [H, W, 3].
        camera: its pinhole camera.
        matcher: extracts its features.
        keypoints: how many.
        timer: takes the time of the frame's stages.
    """

    def __init__(
        self,
        image: NDArray[np.uint8],
        camera: Camera,
        matcher: Matcher,
        keypoints: int,
        timer: StageTimer,
    ) -> None:
        self.image = image
        self.camera = camera
        self.timer = timer
        self._matcher = matcher
        self._keypoints = keypoints
        self._kept: dict[str, Any] = {}

    def once(self, name: str, compute: Callable[[], Any]) -> Any:
        """What `compute` gives for this frame, computed on the first call under that name."""
        if name not in self._kept:
            self._kept[name] = compute()
        return self._kept[name]

    @cached_property
    def features(self) -> Features:
        """Keypoints and descriptors, best score first."""
        with self.timer("extract"):
            return self._matcher.extract(self.image, self._keypoints)

    @cached_property
    def gray(self) -> Gray:
        """Locally normalised grey image [H, W], what points are followed in."""
        with self.timer("align"):
            return normalize_contrast(self.image)
