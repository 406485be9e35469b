"""Which source views a map is compiled from: known cameras, the paper's sphere, free space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.gaussian_map import GaussianMap
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
    kind = kind or (_kind_of(poses, low, high) if len(poses) else "scene")
    axis = np.array(up, float) if up else _up_of(poses, low, high)
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
    raise NotImplementedError


def _kind_of(poses: Array, low: Array, high: Array) -> str:
    """Object where the cameras stand around the map's bulk and look at it."""
    centre = 0.5 * (low + high)
    outside = ((poses[:, :3, 3] < low) | (poses[:, :3, 3] > high)).any(axis=1).mean()
    towards = centre - poses[:, :3, 3]
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    directions = towards.mean(axis=0)
    surround = np.linalg.norm(directions) < 0.8
    looking = (np.einsum("ni,ni->n", poses[:, :3, 2], towards) > 0.8).mean()
    return "object" if outside > 0.8 and looking > 0.8 and surround else "scene"


def _up_of(poses: Array, low: Array, high: Array) -> Array:
    """Against the cameras' mean y axis; without cameras z or -y, the usual conventions.

    Rooms and objects on a table are wider than high, so the shorter of the two is up.
    """
    if len(poses):
        up = -poses[:, :3, 1].mean(axis=0)
        if np.linalg.norm(up) > 0.2:
            return np.asarray(up / np.linalg.norm(up))
    extent = high - low
    return np.array([0.0, -1.0, 0.0]) if extent[1] < 0.9 * extent[2] else np.array([0.0, 0.0, 1.0])
