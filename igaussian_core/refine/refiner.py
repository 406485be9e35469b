"""From a hypothesis to an exact pose: renders, correspondences, PnP with the rendered depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.config import RefineConfig, VerifyConfig
from igaussian_core.contrast import Gray, normalize_contrast
from igaussian_core.features import Matcher
from igaussian_core.geometry import inverse, pose_error, transform_points
from igaussian_core.lifting import at_pixels, sample, trusted_depth, unproject
from igaussian_core.pnp import pose_covariance, reprojection_errors, solve_pnp
from igaussian_core.query import Query
from igaussian_core.refine.agreement import (
    agreement,
    plane_homography,
    seen_through,
    sharpness,
)
from igaussian_core.refine.alignment import follow, follow_corners
from igaussian_core.refine.matchers import GuidedKeypoints, PairMatcher, make_pair_matcher
from igaussian_core.refine.photometric import align_photometric
from igaussian_core.refine.relative import solve_relative
from igaussian_core.refine.scales import SCALES, ImagePair
from igaussian_core.refine.verify import Evidence, judge
from igaussian_core.result import Status

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Pixels = NDArray[np.float32]
# (camera, T_scene_cam) -> RGB [H, W, 3], depth [H, W], alpha [H, W]
RenderFunction = Callable[[Camera, Array], tuple[Image, Image, Image]]

_MIN_COVERAGE = 0.02  # with less there is nothing to match
_MAX_SUBPIXEL_MOVE_PX = 4.0
_MAX_COMPARED_MOVE_PX = 5.0  # of a render that still shows what the image does, once shifted
_UNSHIFTED_PX = 0.5
_SOFT_PX = 1.0  # sigma that rids brightness of noise and of what the map shows sharper or softer
_MAX_LOST_INLIERS = 0.05  # share of the matches' inliers that photometric alignment may lose
_MAX_WORSE_PX = 0.1  # and by how much their median error may grow
# following points on images made small, where they may lie far from where they are looked for
_APPROACH_POINTS, _APPROACH_WINDOW, _APPROACH_LEVELS, _APPROACH_ROUNDS = 150, 11, 3, 3
_NOT_TRACKED = 0.5  # of refine.converged_px
_MIN_APPROACHED = 12  # points that must agree
_USUAL_MATCH_MS = 400.0  # on two cores, before it was measured


@dataclass(frozen=True)
class Refinement:
    """The outcome of stage two for one hypothesis.

    Attributes:
        T_scene_cam: the refined pose; None where no pose fits the correspondences.
        covariance_scene: [6, 6], scene axes and units; None with the pose.
        evidence: what the verdict rests on.
        support: the render and the matches of the last solve; None with the pose.
    """

    T_scene_cam: Array | None
    covariance_scene: Array | None
    evidence: Evidence
    support: _Support | None = field(default=None, repr=False, compare=False)

    def shift(self, camera: Camera, T_scene_cam: Array) -> float:
        """Roughly how far the image would move to another pose, in image widths; of a pose."""
        assert self.support is not None and self.T_scene_cam is not None
        depth = self.support.view.median_depth
        return _motion_px(camera, self.T_scene_cam, T_scene_cam, depth) / camera.width


@dataclass(frozen=True)
class _View:
    """The map as seen from a hypothesis."""

    image: NDArray[np.uint8]
    gray: Gray
    depth: Image
    covered: NDArray[np.bool_]
    trusted: NDArray[np.bool_]
    coverage: float
    median_depth: float


@dataclass(frozen=True)
class _Support:
    """What a solved pose rests on: a render, and the image's pixels of the points it shows."""

    view: _View
    T_scene_view: Array
    uv_image: Pixels
    points_scene: Array
    inliers: NDArray[np.bool_]


class Refiner:
    """Refines hypotheses against renders of one map.

    Args:
        render: renders the map.
        matcher: of the query's features.
        keypoints: extracted on each render that is matched by descriptors.

    Attributes:
        match_ms: what matching descriptors took lately where nothing guided it.
    """

    def __init__(
        self,
        render: RenderFunction,
        matcher: Matcher,
        keypoints: int,
        config: RefineConfig,
        verify: VerifyConfig,
    ) -> None:
        self._render = render
        self._matcher = make_pair_matcher(config, matcher, keypoints)
        self._guided: PairMatcher = self._matcher
        if config.guided_radius_px > 0 and config.matcher == "auto":
            self._guided = GuidedKeypoints(matcher, keypoints, config.guided_radius_px)
        self._scale = SCALES[config.scale]() if config.solver == "paper" else None
        self._config = config
        self._verify = verify
        self.match_ms = _USUAL_MATCH_MS

    def refine(
        self, query: Query, T_scene_cam: Array, near: bool = False, prior: Array | None = None,
        align: bool = True, describe: bool = True,
    ) -> Refinement:  # fmt: skip
        """The pose near a hypothesis, by alignment where that convinces, else by descriptors.

        Alignment costs a fifth of descriptor matching and is the more exact of the two, but
        only finds poses a few degrees away; an approach on small images comes before. A pose
        that has the matches for it is then polished, and image and render are compared there.

        Args:
            near: the hypothesis comes from the last frame: it is aligned at once and approached
                only where that finds little, and descriptors are compared only near where the
                render says the points should be.
            prior: T_scene_cam where the camera was expected, whatever the hypothesis is.
            align: try alignment first.
            describe: match descriptors where alignment does not convince.
        """
        found = self._found(query, T_scene_cam, near, align, describe)
        if not self._status(found).ok:
            return found
        return self._compared(query, self.polish(query, found), prior)

    def _found(
        self, query: Query, T_scene_cam: Array, near: bool, align: bool, describe: bool
    ) -> Refinement:
        aligned = Refinement(None, None, Evidence("align"))
        start = T_scene_cam if near or not align else self.approach(query, T_scene_cam)
        if align and start is not None:
            aligned = self.align(query, start, near)
        if near and align and aligned.evidence.inliers < self._verify.min_inliers_align:
            start = self.approach(query, T_scene_cam)  # the camera turned faster than expected
            if start is not None and start is not T_scene_cam:
                aligned = self.align(query, start)
        if self._status(aligned) is Status.OK or not describe:
            return aligned
        began_ms = query.timer.elapsed_ms()
        matched = self.match(query, T_scene_cam, near)
        if not near:
            self.match_ms = 0.5 * (self.match_ms + query.timer.elapsed_ms() - began_ms)
        if matched.T_scene_cam is None or not self._status(matched).ok:
            return matched
        polished = self.align(query, matched.T_scene_cam)
        return polished if self._status(polished) is Status.OK else matched

    def approach(
        self, query: Query, T_scene_cam: Array, rounds: int = _APPROACH_ROUNDS
    ) -> Array | None:
        """A hypothesis moved to where alignment finds on, by following points on small images;
        None where they do not agree."""
        small = query.camera.scaled_to_fit(self._config.approach_side)
        if self._config.solver != "pnp" or small == query.camera:
            return T_scene_cam
        with query.timer("approach"):
            gray = query.once("small", lambda: normalize_contrast(small.shrunk(query.image)))
            for _ in range(rounds):
                view = self._seen(small, T_scene_cam)
                uv_render, uv_image, _ = follow_corners(
                    view.gray, gray, view.trusted, _APPROACH_POINTS, _APPROACH_WINDOW,
                    _APPROACH_LEVELS,
                )  # fmt: skip
                points = _lifted(view, small, T_scene_cam, uv_render)
                solution = solve_pnp(
                    small, uv_image, points, self._config.max_reprojection_px, T_scene_cam
                )
                if solution is None or solution.inliers.sum() < _MIN_APPROACHED:
                    return None
                T_scene_cam = solution.T_scene_cam
        return T_scene_cam

    def align(self, query: Query, T_scene_cam: Array, near: bool = False) -> Refinement:
        """Follow points of the render into the image, PnP, again from there until it rests.

        A track's pose that convinces may rest after a step twice as long as others.
        """
        gray = query.gray
        result = Refinement(None, None, Evidence("align"))
        for _ in range(self._config.align_rounds):
            view = self._view(query, T_scene_cam)
            if view.coverage < _MIN_COVERAGE:
                return Refinement(None, None, Evidence("align", coverage=view.coverage))
            with query.timer("align"):
                followed = follow_corners(
                    view.gray, gray, view.trusted, self._config.align_points,
                    self._config.align_window, self._config.align_levels,
                )  # fmt: skip
            with query.timer("solve"):
                result = self._solve(query, view, T_scene_cam, "align", *followed)
            if result.T_scene_cam is None:
                return result
            step_px = _motion_px(query.camera, result.T_scene_cam, T_scene_cam, view.median_depth)
            T_scene_cam = result.T_scene_cam
            enough = near and self._status(result) is Status.OK
            if step_px < self._config.converged_px * (1.0 if enough else _NOT_TRACKED):
                break
        return result

    def match(self, query: Query, T_scene_cam: Array, near: bool = False) -> Refinement:
        """Match descriptors of image and render, PnP; once more where that moved far."""
        matcher = self._guided if near else self._matcher
        best: Refinement | None = None
        for _ in range(self._config.rounds):
            view = self._view(query, T_scene_cam)
            result = self._match_once(query, matcher, view, T_scene_cam)
            if best is None or result.evidence.inliers >= 0.8 * best.evidence.inliers:
                best = result
            if result.T_scene_cam is None or best is not result:
                break
            step_px = _motion_px(query.camera, result.T_scene_cam, T_scene_cam, view.median_depth)
            T_scene_cam = result.T_scene_cam
            if step_px < self._config.moved_px:
                break
        assert best is not None
        return best

    def polish(self, query: Query, found: Refinement) -> Refinement:
        """An aligned pose moved to where the image's and the render's brightness agree as well.

        Points and pixels weigh alike. What was found stays where brightness would not agree
        better, or where the points would agree worse.
        """
        config, support, T_scene_cam = self._config, found.support, found.T_scene_cam
        if (
            config.photometric == "off" or config.solver != "pnp" or support is None
            or T_scene_cam is None or found.covariance_scene is None
            or found.evidence.method != "align"
        ):  # fmt: skip
            return found
        view, to_view = support.view, inverse(support.T_scene_view)
        turn = np.kron(np.eye(2), to_view[:3, :3])
        with query.timer("polish"):
            moved = align_photometric(
                query.once("soft", lambda: _soft(query.gray)), _soft(view.gray), view.depth,
                view.trusted, query.camera, to_view @ T_scene_cam,
                turn @ found.covariance_scene @ turn.T, pixels=config.photometric_pixels,
            )  # fmt: skip
        if moved is None or not moved.lowered:
            return found
        return self._unless_worse(query, found, support.T_scene_view @ moved.T_render_cam)

    def _unless_worse(self, query: Query, found: Refinement, T_scene_cam: Array) -> Refinement:
        """The refinement at another pose, where its own points speak for that hardly less."""
        support, evidence = found.support, found.evidence
        assert support is not None
        errors = reprojection_errors(
            query.camera, T_scene_cam, support.uv_image, support.points_scene
        )
        inliers = errors < self._config.max_reprojection_px
        residual_px = float(np.median(errors[support.inliers]))
        if (
            inliers.sum() < (1 - _MAX_LOST_INLIERS) * evidence.inliers
            or residual_px > evidence.residual_px + _MAX_WORSE_PX
        ):
            return found
        evidence = replace(evidence, inliers=int(inliers.sum()), residual_px=residual_px)
        return replace(found, T_scene_cam=T_scene_cam, evidence=evidence)

    def _compared(self, query: Query, found: Refinement, prior: Array | None) -> Refinement:
        """With what a comparison of image and render, and of pose and prior, says."""
        support, T_scene_cam = found.support, found.T_scene_cam
        assert support is not None and T_scene_cam is not None
        camera, view = query.camera, support.view
        moved_px = _motion_px(camera, T_scene_cam, support.T_scene_view, view.median_depth)
        if moved_px > _MAX_COMPARED_MOVE_PX:
            view = self._view(query, T_scene_cam)
            moved_px = 0.0
        with query.timer("compare"):
            uv = support.uv_image[support.inliers]
            grey = query.once("grey", lambda: cv2.cvtColor(query.image, cv2.COLOR_RGB2GRAY))
            normal = query.gray
            if moved_px > _UNSHIFTED_PX:
                H = plane_homography(
                    camera, inverse(T_scene_cam) @ support.T_scene_view, view.median_depth
                )
                grey, normal = seen_through(H, grey), seen_through(H, normal)
                uv = cv2.perspectiveTransform(uv[None].astype(np.float32), np.linalg.inv(H))[0]
            render = np.asarray(cv2.cvtColor(view.image, cv2.COLOR_RGB2GRAY), np.uint8)
            shift = float("nan") if prior is None else found.shift(camera, prior)
            evidence = replace(
                found.evidence,
                agreement=agreement(grey, render, view.covered, uv),
                sharpness=sharpness(normal, view.gray, view.covered, uv),
                prior_shift=shift,
            )
        return replace(found, evidence=evidence)

    def _match_once(
        self, query: Query, matcher: PairMatcher, view: _View, T_scene_cam: Array
    ) -> Refinement:
        method = matcher.name
        if view.coverage < _MIN_COVERAGE:
            return Refinement(None, None, Evidence(method, coverage=view.coverage))
        uv_image, uv_render = matcher.match(query, view.image)
        gray = query.gray
        with query.timer("align"):
            known = at_pixels(view.trusted, uv_render)
            uv_image, uv_render = uv_image[known], uv_render[known]
            exact, good = follow(
                view.gray, gray, uv_render, uv_image, self._config.align_window, levels=0
            )
            good &= np.linalg.norm(exact - uv_image, axis=1) < _MAX_SUBPIXEL_MOVE_PX
            uv_image = np.where(good[:, None], exact, uv_image)
        with query.timer("solve"):
            return self._solve(
                query, view, T_scene_cam, method, uv_render, uv_image, looked_at=len(uv_image)
            )

    def _view(self, query: Query, T_scene_cam: Array) -> _View:
        with query.timer("render"):
            return self._seen(query.camera, T_scene_cam)

    def _seen(self, camera: Camera, T_scene_cam: Array) -> _View:
        config = self._config
        rgb, depth, alpha = self._render(camera, T_scene_cam)
        covered = alpha >= config.min_alpha
        image = to_u8(rgb)
        return _View(
            image=image,
            gray=normalize_contrast(image),
            depth=depth,
            covered=covered,
            trusted=trusted_depth(depth, alpha, config.min_alpha, config.max_depth_step),
            coverage=float(covered.mean()),
            median_depth=float(np.median(depth[covered])) if covered.any() else 0.0,
        )

    def _solve(
        self, query: Query, view: _View, T_scene_cam: Array, method: str,
        uv_render: Pixels, uv_image: Pixels, looked_at: int,
    ) -> Refinement:  # fmt: skip
        """The pose that the image's and the render's pixels tell, and what speaks for it."""
        camera, config = query.camera, self._config
        points = _lifted(view, camera, T_scene_cam, uv_render)
        if self._scale is not None:
            depth = sample(view.depth, uv_render)
            pair = ImagePair(camera, query.image, view.image, view.depth, view.covered)
            solution = solve_relative(
                camera, uv_render, uv_image, depth, T_scene_cam, config.max_sampson_px,
                config.max_reprojection_px, self._scale(pair),
            )  # fmt: skip
        else:
            solution = solve_pnp(
                camera, uv_image, points, config.max_reprojection_px, T_scene_cam
            )
        if solution is None:
            return Refinement(None, None, Evidence(method, looked_at, coverage=view.coverage))
        inliers, residuals = solution.inliers, solution.residuals_px[solution.inliers]
        covariance = config.covariance_inflation * pose_covariance(
            camera, solution.T_scene_cam, points[inliers], uv_image[inliers],
            config.covariance_cell_px,
        )  # fmt: skip
        evidence = Evidence(
            method=method,
            matches=looked_at,
            inliers=int(inliers.sum()),
            residual_px=float(np.median(residuals)),
            coverage=view.coverage,
            spread=_spread(uv_image[inliers], camera),
            sigma_deg=float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))),
        )
        support = _Support(view, T_scene_cam, uv_image, points, inliers)
        return Refinement(solution.T_scene_cam, covariance, evidence, support)

    def _status(self, refinement: Refinement) -> Status:
        return judge(refinement.evidence, self._verify)[0]


def to_u8(rgb: Image) -> NDArray[np.uint8]:
    """uint8 image of a render in [0, 1]."""
    return np.asarray(cv2.convertScaleAbs(rgb, alpha=255), np.uint8)  # rounds and saturates


def _lifted(view: _View, camera: Camera, T_scene_cam: Array, uv_render: Pixels) -> Array:
    """Scene points [N, 3] that a render from T_scene_cam shows at pixels."""
    depth = sample(view.depth, uv_render)
    return transform_points(T_scene_cam, unproject(camera, uv_render, depth))


def _soft(gray: Gray) -> Image:
    return np.asarray(cv2.GaussianBlur(gray.astype(np.float32), (0, 0), _SOFT_PX))


def _motion_px(camera: Camera, T_a: Array, T_b: Array, median_depth: float) -> float:
    """Roughly how far the image moves between two poses, in pixels."""
    angle_deg, distance = pose_error(T_a, T_b)
    return camera.fx * float(np.radians(angle_deg) + distance / max(median_depth, 1e-9))


def _spread(uv: Pixels, camera: Camera) -> float:
    """Share of the image that a box of +-2 standard deviations of the pixels covers."""
    if len(uv) < 2:
        return 0.0
    width, height = np.minimum(4 * uv.std(axis=0), (camera.width, camera.height))
    return float(width * height / (camera.width * camera.height))
