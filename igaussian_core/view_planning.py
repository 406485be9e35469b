"""Which source views a map is compiled from: known cameras, the paper's sphere, free space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.camera_traces import likely_camera_positions
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import inverse
from igaussian_core.lifting import trusted_depth
from igaussian_core.overview import kind_of, likely_up
from igaussian_core.posed_images import PosedImage
from igaussian_core.views import (
    fibonacci_directions,
    look_at,
    spherical_views,
    spread_indices,
    up_rotation,
)

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

# of views that the map itself has to suggest: 640x480 with 65 degrees across
_DEFAULT_CAMERA = Camera(640, 480, 502.0, 502.0, 319.5, 239.5)
_PLACES = 100  # tried for views of a scene, with 8 views each


@dataclass(frozen=True)
class SourceView:
    """A place to render from: a pinhole camera and T_scene_cam [4, 4]."""

    camera: Camera
    T_scene_cam: Array


@dataclass(frozen=True)
class ViewPlan:
    """The views, with what was found out about the map."""

    kind: str
    radius: float
    views: list[SourceView]


def plan_views(
    gmap: GaussianMap,
    posed: list[PosedImage],
    *,
    kind: str | None,
    radius: float | None,
    up: tuple[float, float, float] | None,
    count: int,
    max_side: int,
    threads: int,
    progress: Progress,
) -> ViewPlan:
    """The paper's spherical views, and those that make up for its lack of parallax.

    Args:
        posed: the training cameras, if known: up to `count` of them are taken, spread out.
        kind, radius, up: as the user said, None where the map or the cameras decide.
        count: most views beyond the paper's 16.
    """
    low, high = gmap.bounds()
    poses = np.array([image.T_scene_cam for image in posed]).reshape(-1, 4, 4)
    kind = kind or (_kind_of(poses, low, high) if len(poses) else kind_of(gmap))
    axis = np.array(up, float) / np.linalg.norm(up) if up else _up_of(poses)
    if axis is None:
        axis = likely_up(gmap, kind).vector
    if len(poses):
        return _plan_from_cameras(posed, poses, low, high, kind, radius, axis, count, max_side)
    if kind == "object":
        return _plan_object(low, high, radius, axis, count)
    return _plan_scene(gmap, low, high, radius, axis, count, threads, progress)


def _plan_from_cameras(
    posed: list[PosedImage], poses: Array, low: Array, high: Array, kind: str,
    radius: float | None, up: Array, count: int, max_side: int,
) -> ViewPlan:  # fmt: skip
    if kind == "object":
        centre = 0.5 * (low + high)
        radius = radius or float(np.median(np.linalg.norm(poses[:, :3, 3] - centre, axis=1)))
    else:
        centre = np.median(poses[:, :3, 3], axis=0)
        extent = float(np.linalg.norm(poses[:, :3, 3] - centre, axis=1).max())
        radius = radius or max(0.1 * extent, 1e-3)
    chosen = spread_indices(poses, count, length=float(np.linalg.norm(high - low)) / 4)
    views = [
        SourceView(posed[i].camera.scaled_to_fit(max_side).undistorted(), poses[i]) for i in chosen
    ]
    camera = views[0].camera
    views += [SourceView(camera, T) for T in spherical_views(kind, radius, centre, up)]
    return ViewPlan(kind, radius, views)


def _plan_object(
    low: Array, high: Array, radius: float | None, up: Array, count: int
) -> ViewPlan:
    """The paper's 16 views and evenly spread ones between them."""
    centre = 0.5 * (low + high)
    half_view = np.arctan(0.5 * _DEFAULT_CAMERA.height / _DEFAULT_CAMERA.fy)
    if radius is None:
        radius = 0.8 * float(np.linalg.norm(high - low)) / 2 / np.sin(half_view)
    rotation = up_rotation(up)
    directions = fibonacci_directions(min(count, 64), lowest=-0.85, highest=0.95) @ rotation.T
    poses = [*spherical_views("object", radius, centre, up)]
    poses += [look_at(centre + radius * d, centre, up) for d in directions]
    return ViewPlan("object", radius, [SourceView(_DEFAULT_CAMERA, T) for T in poses])


def _plan_scene(
    gmap: GaussianMap, low: Array, high: Array, radius: float | None, up: Array, count: int,
    threads: int, progress: Progress,
) -> ViewPlan:  # fmt: skip
    """The paper's sphere where the training cameras probably were, and views all around there.

    Closed rooms may bear no traces of cameras, so places inside the map are tried as well.
    """
    likely = likely_camera_positions(gmap, low, high)
    inside = low + np.random.default_rng(2).random((_PLACES, 3)) * (high - low)
    centre = np.median(likely, axis=0)
    radius = radius or 0.02 * float(np.linalg.norm(high - low))
    tried = [_look_around(places, low, high, up) for places in (likely[:_PLACES], inside)]
    clearness = _clearness(gmap, np.concatenate(tried), threads, progress)
    good = [
        _clear_half(poses, scores)
        for poses, scores in zip(tried, np.split(clearness, [len(tried[0])]), strict=True)
    ]
    poses = [*spherical_views("scene", radius, centre, up)]
    for part, share in zip(good, (count - count // 3, count // 3), strict=True):
        chosen = spread_indices(part, share, length=float(np.linalg.norm(high - low)) / 4)
        poses += [*part[chosen]]
    return ViewPlan("scene", radius, [SourceView(_DEFAULT_CAMERA, T) for T in poses])


def _look_around(positions: Array, low: Array, high: Array, up: Array, each: int = 8) -> Array:
    """Poses [N, 4, 4] from positions towards the map's bulk, kept near the horizontal."""
    rng = np.random.default_rng(1)
    poses = []
    for position in positions:
        for target in low + rng.random((each, 3)) * (high - low):
            forward = target - position
            rise = forward @ up
            level = forward - rise * up
            length = max(float(np.linalg.norm(level)), 1e-9)
            direction = level / length + np.clip(rise / length, -0.6, 0.6) * up
            poses.append(look_at(position, position + direction, up))
    return np.array(poses)


def _clearness(gmap: GaussianMap, poses: Array, threads: int, progress: Progress) -> Array:
    """Share [N] of each small render without gaps and depth edges; 0 with things right ahead."""
    small = _DEFAULT_CAMERA.resized(160, 120)
    low, high = gmap.bounds()
    clearance = 0.06 * float(np.linalg.norm(high - low))
    scores = np.zeros(len(poses))
    for i, T_scene_cam in enumerate(poses):
        _, depth, alpha = gmap.render(small, inverse(T_scene_cam), threads=threads)
        near = np.percentile(depth[alpha > 0.5], 5) if (alpha > 0.5).any() else 0.0
        if near > clearance:
            scores[i] = trusted_depth(depth, alpha, 0.8, 0.1).mean()
        progress("views tried", i + 1, len(poses))
    return scores


def _clear_half(poses: Array, scores: Array) -> Array:
    """The better half of the poses, as far as they show anything; at least one."""
    best = np.argsort(-scores, kind="stable")[: max(1, len(poses) // 2)]
    return poses[best[scores[best] > 0.1]] if (scores > 0.1).any() else poses[best[:1]]


def _kind_of(poses: Array, low: Array, high: Array) -> str:
    """Object where the cameras stand around the map's bulk and look at it, not from one side."""
    centre = 0.5 * (low + high)
    outside = ((poses[:, :3, 3] < low) | (poses[:, :3, 3] > high)).any(axis=1).mean()
    towards = centre - poses[:, :3, 3]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    directions = towards.mean(axis=0)
    surround = np.linalg.norm(directions) < 0.7
    looking = (np.einsum("ni,ni->n", poses[:, :3, 2], towards) > 0.8).mean()
    return "object" if outside > 0.8 and looking > 0.8 and surround else "scene"


def _up_of(poses: Array) -> Array | None:
    """Against the cameras' mean y axis; None without cameras or where they disagree."""
    if len(poses) == 0:
        return None
    up = -poses[:, :3, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    return np.asarray(up / length) if length > 0.2 else None
