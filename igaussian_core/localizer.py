"""The pipeline: one image in, one pose with its evidence out."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.landmarks import LandmarkLocalizer
from igaussian_core.coarse.network import MapNetwork, NetworkLocalizer
from igaussian_core.config import Config
from igaussian_core.errors import CameraError, MapError
from igaussian_core.features import Matcher, make_matcher
from igaussian_core.geometry import Sim3, compose, is_rigid, nearest_rotation
from igaussian_core.hypothesis import Hypothesis
from igaussian_core.map_package import Manifest, MapPackage, open_package
from igaussian_core.query import Query
from igaussian_core.refine.refiner import Refinement, Refiner
from igaussian_core.refine.resemblance import most_alike
from igaussian_core.refine.verify import Evidence, confidence, judge, thresholds
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.rivals import Rivals
from igaussian_core.timing import StageTimer

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_TRACKS_SHARE = 0.5  # of the time limit, for a frame that has a prior


class Localizer:
    """Localizes images in one compiled map. For one thread at a time.

    Args:
        package: the compiled map.
        config: the whole configuration; its defaults where None.
    """

    def __init__(self, package: MapPackage, config: Config | None = None) -> None:
        self._config = config or Config()
        self._package = package
        self._T_map_scene = package.T_map_scene
        self._matcher = _matcher_of(package, self._config)
        torch.set_num_threads(self._config.runtime.threads)
        self._landmarks = LandmarkLocalizer(
            package.landmarks, self._config.coarse, self._matcher.min_similarity
        )
        self._network = network_of(package, self._config)
        self._refiner = Refiner(
            self._render_scene, self._matcher, self._config.features.keypoints,
            self._config.refine, self._config.verify,
        )  # fmt: skip
        self._rivals = Rivals(self._config.coarse.rival_share, self._refiner, self._tried)

    @staticmethod
    def open(path: str | os.PathLike[str], config: Config | None = None) -> Localizer:
        """Localizer of a compiled map directory.

        Raises:
            MapError: no compiled map, of a newer version, or altered.
        """
        return Localizer(open_package(path), config)

    @property
    def manifest(self) -> Manifest:
        return self._package.manifest

    @property
    def T_map_scene(self) -> Sim3:
        return self._T_map_scene

    def localize(
        self, image: NDArray[np.uint8], camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        """Where is the camera?

        Args:
            image: uint8 RGB [H, W, 3].
            camera: of that size, distortion included.
            prior: T_map_cam [4, 4] where the camera probably is; it is tried first, the
                landmarks after it. None: from nothing.

        Returns:
            A pose, or a status that says why there is none. Never the prior itself.

        Raises:
            CameraError: the image is not uint8 RGB of the camera's size; a prior that is no
                rigid transform.
        """
        timer = StageTimer()
        with timer("prepare"):
            image, camera = self._prepare(image, camera)
        if (contrast := _contrast(image)) < self._config.image.min_contrast:
            reason = f"contrast {contrast:.1f} grey levels"
            return LocalizationResult(
                Status.TOO_DARK_OR_BLURRED, reason, timings_ms=timer.timings_ms()
            )
        query = Query(image, camera, self._matcher, self._config.features.keypoints, timer)
        failure = LocalizationResult(
            Status.NO_HYPOTHESIS, "no place in the map resembles the image", source="landmarks"
        )
        budget_ms = limit_ms = self._config.runtime.budget_ms
        over = False
        for hypothesis in self._hypotheses(query, prior):
            if over:
                failure = _out_of_time(failure, limit_ms)
                break
            late = (
                hypothesis.source != "prior" and hypothesis.describe and self._late(query, prior)
            )
            tried = replace(hypothesis, describe=False) if late else hypothesis
            refinement = self._refine(query, tried, prior)
            result = self._result(hypothesis, refinement)
            if result.ok:
                if timer.elapsed_ms() <= budget_ms:
                    result = self._rivals.settled(query, hypothesis, refinement, result)
                return _timed(result, timer)
            if result.inliers >= failure.inliers:
                failure = result
            over = late or timer.elapsed_ms() > budget_ms
            limit_ms = _TRACKS_SHARE * budget_ms if late else budget_ms
            if over and hypothesis.source != "landmarks":  # whose search would take longer still
                failure = _out_of_time(failure, limit_ms)
                break
        return _timed(failure, timer)

    def warm_up(self) -> None:
        """Run every network once, so that the first frame takes no longer than the others."""
        rng = np.random.default_rng(0)
        image = rng.integers(0, 255, (480, 640, 3), dtype=np.uint8)
        features = self._matcher.extract(image, self._config.features.keypoints)
        self._landmarks.rank_views(features)
        self._matcher.match(features, features)
        if self._network is not None:
            camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
            next(self._network.hypotheses(image, camera))

    def render(self, camera: Camera, T_map_cam: ArrayLike) -> tuple[Image, Image, Image]:
        """RGB [H, W, 3], depth [H, W] in metres and alpha [H, W] of the map at a pose.

        Raises:
            CameraError: the camera has distortion.
        """
        T_scene_cam = self._T_map_scene.inverse().camera(T_map_cam)
        rgb, depth, alpha = self._render_scene(camera, T_scene_cam)
        return rgb, depth * np.float32(self._T_map_scene.scale), alpha

    def _prepare(
        self, image: NDArray[np.uint8], camera: Camera
    ) -> tuple[NDArray[np.uint8], Camera]:
        """The frame without distortion, no larger than configured."""
        camera.check_image(image)
        small = camera.scaled_to_fit(self._config.image.max_side)
        return small.undistort(small.shrunk(image))

    def _hypotheses(self, query: Query, prior: ArrayLike | None) -> Iterator[Hypothesis]:
        """Stage one: the prior, then what the network says, then places that the landmarks know;
        found as asked for.

        In the cascade the network's places, and those that few landmarks speak for, are only
        aligned at first: matching descriptors at wrong places costs more than all else. Those
        that resemble the image come again at last, with descriptors.
        """
        if prior is not None:
            if not is_rigid(prior):
                raise CameraError("prior: expected a rigid 4x4 transform T_map_cam")
            yield Hypothesis(self._T_map_scene.inverse().camera(prior), 0.0, "prior")
        method, network = self._config.coarse.method, self._network
        wanted, _ = thresholds(Evidence(self._matcher.name), self._config.verify)
        unsure = []
        if network is not None:
            said = network.hypotheses(query.image, query.camera)
            for hypothesis in _timed_each(query, said):
                unsure.append(replace(hypothesis, align=False))
                yield replace(hypothesis, describe=method == "network")
        if method != "network":
            known = self._landmarks.hypotheses(query.features, query.camera)
            for hypothesis in _timed_each(query, known):
                sure = method == "landmarks" or hypothesis.score >= wanted
                if not sure:
                    unsure.append(replace(hypothesis, align=False))
                yield replace(hypothesis, describe=sure)
        if method == "cascade" and self._late(query, prior):
            yield from unsure
        elif method == "cascade":
            yield from most_alike(
                query, unsure, self._render_scene, self._matcher,
                self._config.features.keypoints, wanted,
            )  # fmt: skip

    def _late(self, query: Query, prior: ArrayLike | None) -> bool:
        """Whether matching descriptors would end so late that a track's next frame, which is
        worth more than the last place of this one, waits for it."""
        end_ms = query.timer.elapsed_ms() + self._refiner.match_ms
        return prior is not None and end_ms > _TRACKS_SHARE * self._config.runtime.budget_ms

    def _tried(
        self, query: Query, hypothesis: Hypothesis
    ) -> tuple[Refinement, LocalizationResult]:
        refinement = self._refine(query, hypothesis, None)
        return refinement, self._result(hypothesis, refinement)

    def _refine(
        self, query: Query, hypothesis: Hypothesis, prior: ArrayLike | None
    ) -> Refinement:
        return self._refiner.refine(
            query,
            hypothesis.T_scene_cam,
            near=hypothesis.source == "prior",
            prior=None if prior is None else self._T_map_scene.inverse().camera(prior),
            align=hypothesis.align,
            describe=hypothesis.describe,
        )

    def _result(self, hypothesis: Hypothesis, refinement: Refinement) -> LocalizationResult:
        evidence = refinement.evidence
        status, reason = judge(evidence, self._config.verify)
        T_map_cam = covariance = None
        if status.ok and refinement.T_scene_cam is not None:
            T = self._T_map_scene.camera(refinement.T_scene_cam)
            # rounding would double from each tracked frame to the next
            T_map_cam = compose(nearest_rotation(T[:3, :3]), T[:3, 3])
            scale = self._package.manifest.covariance_scale
            covariance = _covariance_in_map(refinement, self._T_map_scene, scale)
        return LocalizationResult(
            status=status,
            reason=reason,
            T_map_cam=T_map_cam,
            covariance=covariance,
            inliers=evidence.inliers,
            matches=evidence.matches,
            inlier_ratio=evidence.ratio,
            residual_px=evidence.residual_px,
            coverage=evidence.coverage,
            agreement=evidence.agreement,
            sharpness=evidence.sharpness,
            confidence=confidence(evidence, self._config.verify),
            matcher=evidence.method,
            source=hypothesis.source,
            T_map_cam_coarse=self._T_map_scene.camera(hypothesis.T_scene_cam),
        )

    def _render_scene(self, camera: Camera, T_scene_cam: Array) -> tuple[Image, Image, Image]:
        return render_scene(self._package, camera, T_scene_cam, self._config.runtime.threads)


def render_scene(
    package: MapPackage, camera: Camera, T_scene_cam: Array, threads: int
) -> tuple[Image, Image, Image]:
    """RGB, depth and alpha of a compiled map over its own background, scene units."""
    red, green, blue = package.manifest.background
    return package.gaussians.render(
        camera, np.linalg.inv(T_scene_cam), (red, green, blue), threads
    )


def _matcher_of(package: MapPackage, config: Config) -> Matcher:
    matcher = make_matcher(config.features)
    made_with = package.manifest.matcher
    if matcher.name != made_with:
        raise MapError(
            f"the map '{package.manifest.name}' was compiled with {made_with} features, but "
            f"{matcher.name} is configured or the only one installed; compile it again"
        )
    return matcher


def network_of(package: MapPackage, config: Config) -> NetworkLocalizer | None:
    """The map's network where the configuration asks for it and the map has one.

    In the cascade it corrects nothing: stage two's approach does as much in less time.
    """
    name, method = package.manifest.name, config.coarse.method
    if method == "landmarks":
        return None
    if package.network is None:
        if method == "network":
            raise MapError(
                f"the map '{name}' has no pose network, which coarse.method=network needs: "
                "'igaussian train map' trains one"
            )
        return None
    trained = MapNetwork.from_data(package.network, f"map '{name}'")
    if config.coarse.network_head == "attention" and not trained.report.get("heads", True):
        raise MapError(
            f"the map '{name}' has no trained heads, which coarse.network_head=attention needs: "
            "'igaussian train map --head attention' trains them"
        )

    def render(camera: Camera, T_scene_cam: Array) -> tuple[Image, Image, Image]:
        return render_scene(package, camera, T_scene_cam, config.runtime.threads)

    return NetworkLocalizer(
        trained, config.coarse.network_hypotheses, config.coarse.network_head, render,
        config.coarse.network_renders if method == "network" else 0,
    )  # fmt: skip


def _timed_each(query: Query, candidates: Iterator[Hypothesis]) -> Iterator[Hypothesis]:
    """Hypotheses one by one; the frame's timer counts what each takes to be found."""
    while True:
        with query.timer("coarse"):
            hypothesis = next(candidates, None)
        if hypothesis is None:
            return
        yield hypothesis


def _covariance_in_map(
    refinement: Refinement, T_map_scene: Sim3, scale: float
) -> Array | None:
    """The scene's covariance in the map's axes and metres, times the map's own factor."""
    if refinement.covariance_scene is None:
        return None
    turn = np.zeros((6, 6))
    turn[:3, :3] = T_map_scene.scale * T_map_scene.rotation
    turn[3:, 3:] = T_map_scene.rotation
    covariance = scale * turn @ refinement.covariance_scene @ turn.T
    return np.asarray(0.5 * (covariance + covariance.T))


def _contrast(image: NDArray[np.uint8]) -> float:
    """Standard deviation of grey levels at low resolution, where noise is no contrast."""
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return float(np.std(cv2.resize(gray, (64, 48), interpolation=cv2.INTER_AREA)))


def _out_of_time(best: LocalizationResult, budget_ms: float) -> LocalizationResult:
    reason = f"not all places could be tried in {budget_ms:.0f} ms; the best: {best.reason}"
    return replace(best, status=Status.TIMEOUT, reason=reason)


def _timed(result: LocalizationResult, timer: StageTimer) -> LocalizationResult:
    # frozen like the rest, yet complete only now
    object.__setattr__(result, "timings_ms", timer.timings_ms())
    return result
