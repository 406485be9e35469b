"""Hypotheses from the landmarks of a compiled map: 2D-3D matches against source views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.config import CoarseConfig
from igaussian_core.features import Features, mutual_matches
from igaussian_core.hypothesis import Hypothesis
from igaussian_core.map_package import Landmarks
from igaussian_core.pnp import solve_pnp

_RANKED_TOGETHER = 8  # source views in one product, which then stays in the cache
_MOST_MATCHES = 1500  # that one pose is solved from; more take time and make it no better


class LandmarkLocalizer:
    """Ranks the source views by mutual matches, then PnP over the best views' matches.

    Args:
        landmarks: of the compiled map.
        config: stage one.
        min_similarity: least cosine similarity of a match, the matcher's.
    """

    def __init__(self, landmarks: Landmarks, config: CoarseConfig, min_similarity: float) -> None:
        self._landmarks = landmarks
        self._config = config
        self._min_similarity = min_similarity
        self._rank_descriptors = _best_of_each_view(landmarks, config.rank_landmarks)

    def hypotheses(self, features: Features, camera: Camera) -> Iterator[Hypothesis]:
        """Poses in order of their inliers, at most `config.hypotheses`; found as asked for.

        Where the next place has `config.rival_share` of a place's inliers, the image may show
        that as well.

        Args:
            features: the frame's, best score first.
            camera: its pinhole camera.
        """
        places = self._places(features, camera)
        place = next(places, None)
        for _ in range(self._config.hypotheses):
            if place is None:
                return
            following = next(places, None)
            if following and following.score >= self._config.rival_share * place.score:
                place = replace(place, others=(following.T_scene_cam,))
            yield place
            place = following

    def _places(self, features: Features, camera: Camera) -> Iterator[Hypothesis]:
        views = self.rank_views(features)[: self._config.top_views]
        query, points = _thinned(*self._matches(features, views))
        while len(query) >= self._config.min_inliers:
            uv = features.uv[query]
            solution = solve_pnp(camera, uv, points, self._config.max_reprojection_px)
            if solution is None or solution.inliers.sum() < self._config.min_inliers:
                return
            yield Hypothesis(
                solution.T_scene_cam, float(solution.inliers.sum()), "landmarks"
            )
            # what the first pose does not explain may tell of another place
            query, points = query[~solution.inliers], points[~solution.inliers]

    def rank_views(self, features: Features) -> NDArray[np.int64]:
        """Source views by falling number of mutual matches with the frame's best keypoints."""
        query = torch.from_numpy(features.descriptors[: self._config.rank_keypoints])
        if len(query) == 0:
            return np.zeros(0, np.int64)
        counts = np.concatenate([
            _count_mutual(query, views, self._min_similarity)
            for views in self._rank_descriptors.split(_RANKED_TOGETHER)
        ])  # fmt: skip
        return np.argsort(-counts, kind="stable").astype(np.int64)

    def _matches(
        self, features: Features, views: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Query indices [M] and landmark points [M, 3] matched over several views."""
        query, points = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
        for view in views:
            part = slice(*self._landmarks.offsets[view : view + 2])
            pairs = mutual_matches(
                features.descriptors, self._landmarks.descriptors[part], self._min_similarity
            )
            query.append(pairs[:, 0])
            points.append(self._landmarks.points[part][pairs[:, 1]].astype(np.float64))
        return np.concatenate(query), np.concatenate(points)


def _thinned(
    query: NDArray[np.int64], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """At most so many matches as are of use, from all over the list."""
    if len(query) <= _MOST_MATCHES:
        return query, points
    kept = np.linspace(0, len(query) - 1, _MOST_MATCHES).astype(np.int64)
    return query[kept], points[kept]


def _best_of_each_view(landmarks: Landmarks, count: int) -> torch.Tensor:
    """Descriptors [V, count, D], zeros behind the landmarks of a view that has fewer."""
    best = torch.zeros(landmarks.view_count, count, landmarks.descriptors.shape[1])
    for view, (start, stop) in enumerate(pairwise(landmarks.offsets)):
        found = landmarks.descriptors[start : min(start + count, stop)]
        best[view, : len(found)] = torch.from_numpy(found)
    return best


def _count_mutual(
    query: torch.Tensor, views: torch.Tensor, min_similarity: float
) -> NDArray[np.int64]:
    """Numbers [V] of mutual nearest neighbours of [N, D] and [V, K, D] above a similarity."""
    all_views = views.flatten(0, 1)
    similarity = (query @ all_views.T).numpy().reshape(len(query), *views.shape[:2])
    # a second product takes less time than a search across the first one's rows
    back = (all_views @ query.T).numpy().argmax(1).reshape(views.shape[:2])
    best = similarity.argmax(2)
    value = np.take_along_axis(similarity, best[..., None], 2)[..., 0]
    mutual = back[np.arange(len(views)), best] == np.arange(len(query))[:, None]
    return (mutual & (value > min_similarity)).sum(0)
