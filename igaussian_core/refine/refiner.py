"""Render at a hypothesis, match with the image, PnP with the rendered depth, verify."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.config import RefineConfig
from igaussian_core.features import Features, Matcher
from igaussian_core.geometry import inverse, pose_error, transform_points
from igaussian_core.lifting import at_pixels, sample, trusted_depth, unproject
from igaussian_core.pnp import pose_covariance, solve_pnp
from igaussian_core.refine.verify import Evidence
from igaussian_core.timing import StageTimer

Array = NDArray[np.float64]
Image = NDArray[np.float32]
# (camera, T_scene_cam) -> RGB [H, W, 3], depth [H, W], alpha [H, W]
RenderFunction = Callable[[Camera, Array], tuple[Image, Image, Image]]


@dataclass(frozen=True)
class Refinement:
    """The outcome of stage two for one hypothesis.

    Attributes:
        T_scene_cam: the refined pose; None where no pose fits the matches.
        covariance_scene: [6, 6], scene axes and units; None with the pose.
        evidence: what the verdict rests on.
    """

    T_scene_cam: Array | None
    covariance_scene: Array | None
    evidence: Evidence


class Refiner:
    """Refines hypotheses against renders of one map.

    Args:
        render: renders the map.
        matcher: of the frame's features.
        config: stage two.
        keypoints: extracted on each render.
    """

    def __init__(
        self, render: RenderFunction, matcher: Matcher, config: RefineConfig, keypoints: int
    ) -> None:
        self._render = render
        self._matcher = matcher
        self._config = config
        self._keypoints = keypoints

    def refine(
        self, features: Features, camera: Camera, T_scene_cam: Array, timer: StageTimer
    ) -> Refinement:
        """Rounds of render, match and PnP until a round moves the camera little.

        Each round renders where the last one ended: matches between nearly equal views are
        many and exact.
        """
        best: Refinement | None = None
        for _ in range(self._config.rounds):
            result, depth = self._round(features, camera, T_scene_cam, timer)
            if best is None or result.evidence.inliers >= 0.8 * best.evidence.inliers:
                best = result
            if result.T_scene_cam is None or best is not result:
                break
            angle, distance = pose_error(result.T_scene_cam, T_scene_cam)
            T_scene_cam = result.T_scene_cam
            if angle < self._config.converged_deg and distance < self._config.converged_rel * depth:
                break
        assert best is not None
        return best

    def _round(
        self, features: Features, camera: Camera, T_scene_cam: Array, timer: StageTimer
    ) -> tuple[Refinement, float]:
        """One render, match and solve; also the median depth of the render's opaque part."""
        config = self._config
        with timer("render"):
            rgb, depth, alpha = self._render(camera, T_scene_cam)
            covered = alpha >= config.min_alpha
            coverage = float(covered.mean())
            median_depth = float(np.median(depth[covered])) if covered.any() else 0.0
        if coverage < 0.02:
            return Refinement(None, None, Evidence(coverage=coverage)), median_depth
        with timer("extract"):
            rendered = self._matcher.extract(_to_u8(rgb), self._keypoints)
        with timer("match"):
            pairs = self._matcher.match(features, rendered)
        with timer("solve"):
            trusted = trusted_depth(depth, alpha, config.min_alpha, config.max_depth_step)
            pairs = pairs[at_pixels(trusted, rendered.uv[pairs[:, 1]])]
            uv_render = rendered.uv[pairs[:, 1]]
            points_cam = unproject(camera, uv_render, sample(depth, uv_render))
            points_scene = transform_points(T_scene_cam, points_cam)
            return self._solve(
                camera, features.uv[pairs[:, 0]], points_scene, T_scene_cam, coverage
            ), median_depth

    def _solve(
        self,
        camera: Camera,
        uv: NDArray[np.float32],
        points_scene: Array,
        T_scene_cam: Array,
        coverage: float,
    ) -> Refinement:
        solution = solve_pnp(
            camera, uv, points_scene, self._config.max_reprojection_px, T_scene_cam
        )
        if solution is None:
            return Refinement(None, None, Evidence(matches=len(uv), coverage=coverage))
        inliers, residuals = solution.inliers, solution.residuals_px[solution.inliers]
        evidence = Evidence(
            matches=len(uv),
            inliers=int(inliers.sum()),
            residual_px=float(np.median(residuals)),
            coverage=coverage,
            spread=_spread(uv[inliers], camera),
        )
        points_inlier = points_scene[inliers]
        covariance = pose_covariance(camera, solution.T_scene_cam, points_inlier, residuals)
        depths = transform_points(inverse(solution.T_scene_cam), points_inlier)[:, 2]
        covariance = self._calibrated(covariance, float(np.median(depths)))
        return Refinement(solution.T_scene_cam, covariance, evidence)

    def _calibrated(self, covariance: Array, median_depth: float) -> Array:
        """The covariance with what the matches' scatter cannot show: the map's own errors."""
        config = self._config
        position = config.position_floor_rel * median_depth
        rotation = np.radians(config.rotation_floor_deg)
        floor = np.diag([position**2] * 3 + [rotation**2] * 3)
        return config.covariance_inflation * covariance + floor


def rendered_at(
    render: RenderFunction, camera: Camera, T_scene_cam: Array
) -> NDArray[np.uint8]:
    """The map's uint8 RGB image at a pose."""
    return _to_u8(render(camera, T_scene_cam)[0])


def _to_u8(rgb: Image) -> NDArray[np.uint8]:
    return np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8)


def _spread(uv: NDArray[np.float32], camera: Camera) -> float:
    """Share of the image that a box of +-2 standard deviations of the pixels covers."""
    if len(uv) < 2:
        return 0.0
    width, height = np.minimum(4 * uv.std(axis=0), (camera.width, camera.height))
    return float(width * height / (camera.width * camera.height))
