"""Stage one alone as an estimator: its first hypothesis, unverified."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.landmarks import LandmarkLocalizer
from igaussian_core.config import Config
from igaussian_core.features import make_matcher
from igaussian_core.hypothesis import Hypothesis
from igaussian_core.localizer import network_of
from igaussian_core.map_package import MapPackage
from igaussian_core.query import Query
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.timing import StageTimer

Image = NDArray[np.uint8]


class CoarseOnly:
    """The first hypothesis of `coarse.method`, as a Localizer would get it.

    Raises:
        MapError: the network is asked for and the map has none.
    """

    def __init__(self, package: MapPackage, config: Config) -> None:
        self._package, self._config = package, config
        self._network = network_of(package, config)
        if self._network is None:
            self._matcher = make_matcher(config.features)
            self._landmarks = LandmarkLocalizer(
                package.landmarks, config.coarse, self._matcher.min_similarity
            )

    def localize(
        self, image: Image, camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        """As Localizer.localize; the prior is not used."""
        timer = StageTimer()
        small = camera.scaled_to_fit(self._config.image.max_side)
        image, camera = small.undistort(small.shrunk(image))
        hypothesis = self._first(image, camera, timer)
        if hypothesis is None:
            return LocalizationResult(
                Status.NO_HYPOTHESIS, "stage one found nothing", timings_ms=timer.timings_ms()
            )
        return LocalizationResult(
            Status.OK, "stage one alone", self._package.T_map_scene.camera(hypothesis.T_scene_cam),
            source=hypothesis.source, timings_ms=timer.timings_ms(),
        )  # fmt: skip

    def _first(self, image: Image, camera: Camera, timer: StageTimer) -> Hypothesis | None:
        if self._network is not None:
            with timer("coarse"):
                return next(self._network.hypotheses(image, camera), None)
        query = Query(image, camera, self._matcher, self._config.features.keypoints, timer)
        features = query.features
        with timer("coarse"):
            return next(self._landmarks.hypotheses(features, camera), None)
