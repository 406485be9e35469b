"""From a Gaussian map to a compiled map: source views, their landmarks, the package."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.config import Config
from igaussian_core.errors import MapError
from igaussian_core.features import Matcher, make_matcher
from igaussian_core.formats import map_file
from igaussian_core.gaussian_map import GaussianMap, file_sha256, load_map
from igaussian_core.geometry import Sim3, inverse, transform_points
from igaussian_core.lifting import at_pixels, sample, trusted_depth, unproject
from igaussian_core.map_package import (
    Landmarks,
    Manifest,
    MapPackage,
    check_target,
    save_package,
)
from igaussian_core.posed_images import PosedImage, read_posed_images
from igaussian_core.view_planning import SourceView, plan_views
from igaussian_core.views import KINDS

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]  # stage, done, of

_MIN_LANDMARKS = 24  # views with fewer tell nothing
_NEIGHBOURS = 8  # views that check a view's depth
_DEPTH_AGREEMENT = 0.04  # relative


@dataclass(frozen=True)
class CompileOptions:
    """What the user may say of a map; the rest is found from the map itself.

    Attributes:
        kind: "object" or "scene"; None: found from the cameras, else "scene".
        radius: of the spherical views in scene units; None: from the map.
        up: direction against gravity in the scene's frame; None: from cameras or bounds.
        views: most source views.
        T_map_scene: similarity into the `map` frame.
        background: RGB in [0, 1] behind the Gaussians; None: white for objects, else black.
    """

    kind: str | None = None
    radius: float | None = None
    up: tuple[float, float, float] | None = None
    views: int = 120
    T_map_scene: Sim3 | None = None
    background: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class _View:
    """One source view with its lifted keypoints."""

    source: SourceView
    points_scene: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    depth: NDArray[np.float32]
    alpha: NDArray[np.float32]


def compile_map(
    source: str | Path,
    target: str | Path,
    cameras: str | Path | None = None,
    options: CompileOptions | None = None,
    config: Config | None = None,
    progress: Progress = lambda stage, done, of: None,
) -> MapPackage:
    """Compile a Gaussian map file into a map directory at `target`.

    Args:
        source: a file of Gaussians, or a trainer's folder.
        cameras: poses of the training cameras, in any format of `posed_images`; where a
            `map.json` beside the source names the photos trained on, only those are used.

    Raises:
        MapError, DatasetError: unusable input; nothing at `target` is touched then.
    """
    source, options, config = map_file(source), options or CompileOptions(), config or Config()
    _check_options(options)
    check_target(target)
    gmap = load_map(source)
    if len(gmap) == 0:
        raise MapError(f"{source}: the map holds no Gaussian")
    posed = training_images(source, cameras) if cameras is not None else []
    plan = plan_views(
        gmap, posed, kind=options.kind, radius=options.radius, up=options.up,
        count=options.views, max_side=config.image.max_side, threads=config.runtime.threads,
        progress=progress,
    )  # fmt: skip
    background = options.background or ((1.0, 1.0, 1.0) if plan.kind == "object" else (0.0,) * 3)
    landmarks, matcher = lift_landmarks(gmap, plan.views, background, config, progress)
    low, high = gmap.bounds()
    manifest = Manifest(
        name=source.stem,
        kind=plan.kind,
        radius=plan.radius,
        bounds=[low.tolist(), high.tolist()],
        T_map_scene=(options.T_map_scene or Sim3.identity()).matrix().tolist(),
        matcher=matcher.name,
        background=list(background),
        source_file=source.name,
        source_sha256=file_sha256(source),
        gaussians_sha256="",  # of the copy, known when it is written
    )
    package = MapPackage(manifest, gmap, landmarks)
    save_package(package, target)
    return package


def _check_options(options: CompileOptions) -> None:
    if options.kind is not None and options.kind not in KINDS:
        raise MapError(f"kind '{options.kind}' is none of {', '.join(KINDS)}")
    if options.radius is not None and not 0 < options.radius < np.inf:
        raise MapError(f"radius {options.radius} is not positive")
    if options.up is not None and not 0 < np.linalg.norm(options.up) < np.inf:
        raise MapError(f"up {options.up} is no direction")


def training_images(source: Path, cameras: str | Path) -> list[PosedImage]:
    """The posed images that the map was trained on, as far as `map.json` tells."""
    posed = read_posed_images(cameras)
    note = source.parent / "map.json"
    if not note.is_file():
        return posed
    try:
        trained_on = set(json.loads(note.read_text()).get("trained_on", []))
    except (OSError, ValueError, AttributeError) as error:
        raise MapError(f"{note}: unreadable: {error}") from error
    return [image for image in posed if image.name in trained_on] or posed


def lift_landmarks(
    gmap: GaussianMap,
    sources: list[SourceView],
    background: tuple[float, ...],
    config: Config,
    progress: Progress,
) -> tuple[Landmarks, Matcher]:
    """Landmarks of the views that show enough, and the matcher they were made with.

    Raises:
        MapError: no view does.
    """
    matcher = make_matcher(config.features)
    views = []
    for index, source in enumerate(sources):
        views.append(_lifted(gmap, source, background, matcher, config))
        progress("source views", index + 1, len(sources))
    consistent = []
    for index, view in enumerate(views):
        keep = _depth_consistent(view, _nearest_views(views, index))
        consistent.append((view, keep))
        progress("depth check", index + 1, len(views))
    kept = [(view, keep) for view, keep in consistent if keep.sum() >= _MIN_LANDMARKS]
    if not kept:
        raise MapError(
            "no source view shows enough of the map: name the training cameras with --cameras, "
            "or another --kind, --radius or --up"
        )
    return _packed(kept), matcher


def _lifted(
    gmap: GaussianMap,
    source: SourceView,
    background: tuple[float, ...],
    matcher: Matcher,
    config: Config,
) -> _View:
    """Render RGB-D at a view, extract keypoints, lift those with trusted depth."""
    red, green, blue = background
    rgb, depth, alpha = gmap.render(
        source.camera, inverse(source.T_scene_cam), (red, green, blue), config.runtime.threads
    )
    image = np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8)
    features = matcher.extract(image, config.features.keypoints)
    refine = config.refine
    trusted = trusted_depth(depth, alpha, refine.min_alpha, refine.max_depth_step)
    keep = at_pixels(trusted, features.uv)
    uv = features.uv[keep]
    points_cam = unproject(source.camera, uv, sample(depth, uv))
    return _View(
        source, transform_points(source.T_scene_cam, points_cam), features.descriptors[keep],
        depth, alpha,
    )  # fmt: skip


def _nearest_views(views: list[_View], index: int) -> list[_View]:
    """The views most likely to see the same surfaces from elsewhere."""
    here = views[index].source.T_scene_cam
    median = float(np.median(views[index].depth)) or 1.0
    cost = [
        np.linalg.norm(v.source.T_scene_cam[:3, 3] - here[:3, 3]) / median
        + np.arccos(np.clip(v.source.T_scene_cam[:3, 2] @ here[:3, 2], -1, 1))
        for v in views
    ]
    return [views[i] for i in np.argsort(cost, kind="stable")[1 : _NEIGHBOURS + 1]]


def _depth_consistent(view: _View, others: Iterable[_View]) -> NDArray[np.bool_]:
    """Mask [N] of a view's points that other views see, or at least do not see through.

    A view that looks through a point onto something far behind it speaks against it: the
    point floats. A view with something in front says nothing.
    """
    support = np.zeros(len(view.points_scene))
    against = np.zeros(len(view.points_scene))
    for other in others:
        z, expected, seen = _depth_in(other, view.points_scene)
        with np.errstate(divide="ignore", invalid="ignore"):
            difference = (expected - z) / z
        support += seen & (np.abs(difference) < _DEPTH_AGREEMENT)
        against += seen & (difference > 2 * _DEPTH_AGREEMENT)
    return np.asarray(support >= against)


def _depth_in(
    other: _View, points_scene: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Depth of points in another view, that view's rendered depth there, and where it has one."""
    camera: Camera = other.source.camera
    x, y, z = transform_points(inverse(other.source.T_scene_cam), points_scene).T
    ahead = z > 1e-6
    safe = np.where(ahead, z, 1.0)
    uv = np.stack([camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy], 1)
    inside = ahead & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    uv = np.where(inside[:, None], uv, 0.0).astype(np.float32)
    opaque = at_pixels(other.alpha > 0.8, uv)
    return z, sample(other.depth, uv).astype(np.float64), inside & opaque


def _packed(kept: list[tuple[_View, NDArray[np.bool_]]]) -> Landmarks:
    points = [view.points_scene[keep] for view, keep in kept]
    descriptors = [view.descriptors[keep] for view, keep in kept]
    counts = [len(p) for p in points]
    cameras = [view.source.camera for view, _ in kept]
    return Landmarks(
        points=np.concatenate(points).astype(np.float32),
        descriptors=np.concatenate(descriptors).astype(np.float32),
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        T_scene_cam=np.stack([view.source.T_scene_cam for view, _ in kept]),
        intrinsics=np.array([[c.width, c.height, c.fx, c.fy, c.cx, c.cy] for c in cameras]),
    )
