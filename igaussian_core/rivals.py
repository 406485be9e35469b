"""Other places that an image may show as well: two aisles of a warehouse look alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from igaussian_core.geometry import pose_error
from igaussian_core.hypothesis import Hypothesis
from igaussian_core.query import Query
from igaussian_core.refine.refiner import Refinement, Refiner
from igaussian_core.result import LocalizationResult, Status

Array = NDArray[np.float64]

_SAME_PLACE = 0.1  # image widths between poses that are no rivals
_ELSEWHERE = 0.5  # image widths beyond which a view is hardly one of the same place
_VIEWS, _APPROACHED = 100, 8  # that are looked through


@dataclass(frozen=True)
class Rivals:
    """Looks for a second place that convinces as an accepted one does.

    Attributes:
        share: of the stronger place's inliers by which the weaker one makes it ambiguous; above 1
            nothing is looked for.
        refiner: approaches views.
        attempt: refines and judges a hypothesis from nothing.
    """

    share: float
    refiner: Refiner
    attempt: Callable[[Query, Hypothesis], tuple[Refinement, LocalizationResult]]

    def settled(
        self, query: Query, hypothesis: Hypothesis, found: Refinement, result: LocalizationResult
    ) -> LocalizationResult:
        """An accepted pose; a rival where that convinces more, neither where both do alike."""
        for T_scene_cam in self._places(query, hypothesis, found):
            rival = replace(hypothesis, T_scene_cam=T_scene_cam, align=True)
            other_found, other = self.attempt(query, rival)
            if not other.ok or other_found.T_scene_cam is None:
                continue
            if not _apart(query, found, other_found.T_scene_cam, _SAME_PLACE):
                continue
            weaker, stronger = sorted((result, other), key=lambda r: r.inliers)
            if weaker.inliers >= self.share * stronger.inliers:
                return _ambiguous(stronger, weaker)
            if stronger is other:
                return other
        return result

    def _places(
        self, query: Query, hypothesis: Hypothesis, found: Refinement
    ) -> Iterator[Array]:
        """Places that are not on the way to the accepted one.

        Of the network's, views that resemble the image: those nearby lead to the accepted place,
        and so do most of the others, which one round of the approach tells.
        """
        if self.share > 1:
            return
        if hypothesis.source != "network":
            yield from (T for T in hypothesis.others if _apart(query, found, T, _SAME_PLACE))
            return
        views = islice(hypothesis.others, _VIEWS)
        far = (T for T in views if _apart(query, found, T, _ELSEWHERE))
        for T_scene_cam in islice(far, _APPROACHED):
            nearer = self.refiner.approach(query, T_scene_cam, rounds=1)
            if nearer is not None and _apart(query, found, nearer, 0.5 * _ELSEWHERE):
                yield nearer


def _apart(query: Query, found: Refinement, T_scene_cam: Array, least: float) -> bool:
    return found.shift(query.camera, T_scene_cam) >= least


def _ambiguous(result: LocalizationResult, other: LocalizationResult) -> LocalizationResult:
    """Neither of two accepted poses; the more alike they are, the less confident."""
    assert result.T_map_cam is not None and other.T_map_cam is not None
    angle, distance = pose_error(result.T_map_cam, other.T_map_cam)
    return replace(
        result,
        status=Status.INCONSISTENT,
        reason=f"two places fit alike, {distance:.2g} m and {angle:.0f} degrees apart: "
        f"{result.inliers} and {other.inliers} inliers",
        T_map_cam=None,
        covariance=None,
        confidence=min(result.confidence, 0.5 * (1 - other.inliers / result.inliers)),
    )
