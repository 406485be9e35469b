"""Which source views a map is compiled from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room

from igaussian_core.camera import Camera
from igaussian_core.camera_traces import likely_camera_positions, size_distance_correlation
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import is_rigid
from igaussian_core.posed_images import PosedImage
from igaussian_core.view_planning import (
    ViewPlan,
    plan_views,
)
from igaussian_core.views import fibonacci_directions, look_at

CAMERA = Camera(1280, 960, 1000.0, 1000.0, 639.5, 479.5, "plumb_bob", (-0.1, 0.01, 0.0, 0.0))


def posed(poses: list[np.ndarray], camera: Camera = CAMERA) -> list[PosedImage]:
    return [PosedImage(f"{i}.png", Path(f"{i}.png"), camera, T) for i, T in enumerate(poses)]


def plan(gmap: GaussianMap, images: list[PosedImage], **said: Any) -> ViewPlan:
    options: dict[str, Any] = {"kind": None, "radius": None, "up": None, "count": 20}
    options |= {"max_side": 320, "threads": 2, "progress": lambda stage, done, of: None}
    return plan_views(gmap, images, **(options | said))


def ball(count: int = 3000) -> GaussianMap:
    """Gaussians in a unit ball about (5, 0, 1)."""
    rng = np.random.default_rng(0)
    means = rng.normal(size=(count, 3))
    means *= rng.uniform(0, 1, (count, 1)) / np.linalg.norm(means, axis=1, keepdims=True)
    return GaussianMap(
        (means + [5, 0, 1]).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        np.full((count, 3), 0.05, np.float32),
        np.full(count, 0.9, np.float32),
        rng.normal(size=(count, 1, 3)).astype(np.float32),
    )


def around(centre: np.ndarray, radius: float, count: int, up: np.ndarray) -> list[np.ndarray]:
    return [
        look_at(centre + radius * d, centre, up) for d in fibonacci_directions(count, -0.3, 0.9)
    ]


def up_of(result: ViewPlan) -> np.ndarray:
    """Mean of the views' up directions."""
    mean = -np.mean([view.T_scene_cam[:3, 1] for view in result.views], axis=0)
    return mean / np.linalg.norm(mean)


def test_cameras_around_the_bulk_mean_an_object() -> None:
    centre = np.array([5.0, 0.0, 1.0])
    result = plan(ball(), posed(around(centre, 4.0, 40, np.array([0, 0, 1.0]))))
    assert result.kind == "object"
    assert result.radius == pytest.approx(4.0, rel=0.05)
    assert len(result.views) == 20 + 16
    for view in result.views:
        towards = centre - view.T_scene_cam[:3, 3]
        assert view.T_scene_cam[:3, 2] @ towards / np.linalg.norm(towards) > 0.99
        assert view.camera.is_pinhole and max(view.camera.width, view.camera.height) == 320
        assert is_rigid(view.T_scene_cam)


def test_cameras_inside_mean_a_scene() -> None:
    gmap = room.room(0, per_metre=8)
    result = plan(gmap, posed(room.source_poses()))
    assert result.kind == "scene"
    assert len(result.views) == 18 + 16  # fewer known cameras than asked for: all of them
    low, high = gmap.bounds()
    for view in result.views:
        assert ((view.T_scene_cam[:3, 3] > low) & (view.T_scene_cam[:3, 3] < high)).all()


def test_a_forward_facing_set_is_a_scene() -> None:
    """Cameras outside the bulk that all stand on one side do not surround it."""
    poses = [look_at([1.0, 0.1 * y, 1.0], [5, 0.1 * y, 1.0]) for y in range(-5, 6)]
    assert plan(ball(), posed(poses)).kind == "scene"


def test_what_the_user_says_wins() -> None:
    images = posed(around(np.array([5.0, 0, 1]), 4.0, 30, np.array([0, 0, 1.0])))
    result = plan(ball(), images, kind="scene", radius=0.7, count=5)
    assert (result.kind, result.radius, len(result.views)) == ("scene", 0.7, 5 + 16)


def test_up_comes_from_the_cameras() -> None:
    tilted = np.array([0.0, -0.8, 0.6])
    images = posed(around(np.array([5.0, 0, 1]), 4.0, 60, tilted))
    sphere = plan(ball(), images).views[-16:]
    mean = -np.mean([view.T_scene_cam[:3, 1] for view in sphere], axis=0)
    assert mean @ tilted / np.linalg.norm(mean) > 0.97


def test_an_object_without_cameras() -> None:
    gmap = ball()
    result = plan(gmap, [], kind="object", up=(0.0, -1.0, 0.0))
    assert len(result.views) == 16 + 20
    assert up_of(result) @ [0, -1, 0] > 0.99
    for view in result.views:
        u, v = project(view.camera, view.T_scene_cam, gmap.means.astype(float)).T
        inside = (u > 0) & (v > 0) & (u < view.camera.width) & (v < view.camera.height)
        assert inside.mean() > 0.98  # the whole object is in view
    assert plan(gmap, [], kind="object", radius=9.0).radius == 9.0


def project(camera: Camera, T_scene_cam: np.ndarray, points: np.ndarray) -> np.ndarray:
    return camera.project((points - T_scene_cam[:3, 3]) @ T_scene_cam[:3, :3])


def test_a_scene_without_cameras() -> None:
    gmap = traced_room(CENTRES)
    seen: list[tuple[str, int, int]] = []
    result = plan(gmap, [], count=12, progress=lambda *step: seen.append(step))
    assert result.kind == "scene" and len(result.views) == 16 + 12
    assert up_of(result)[2] > 0.8
    for view in result.views[16:]:  # chosen for what they show
        _, depth, alpha = gmap.render(view.camera.resized(80, 60), np.linalg.inv(view.T_scene_cam))
        assert alpha.mean() > 0.6 and np.median(depth) > 0.1
    assert seen[-1][1] == seen[-1][2] == len(seen)


CENTRES = np.array([[0.8, 0.7, 0.9], [1.0, 0.8, 1.0], [1.1, 0.9, 1.0]])


def traced_room(cameras: np.ndarray) -> GaussianMap:
    """A room whose Gaussians are as large as training from these positions makes them."""
    gmap = room.room(0, per_metre=10)
    gmap.means[:] += np.random.default_rng(1).normal(0, 0.05, gmap.means.shape)
    distance = np.linalg.norm(gmap.means[:, None] - cameras[None], axis=2).min(axis=1)
    noise = np.exp(np.random.default_rng(2).normal(0, 0.2, (len(gmap), 1)))
    gmap.scales[:] = 0.06 * distance[:, None] * noise
    return gmap


@pytest.mark.parametrize("centre", [[0.8, 0.7, 0.9], [2.3, 2.0, 1.4], [1.5, 1.3, 0.5]])
def test_sizes_tell_where_the_cameras_were(centre: list[float]) -> None:
    cameras = np.array(centre) + np.random.default_rng(0).normal(0, 0.15, (10, 3))
    gmap = traced_room(cameras)
    low, high = gmap.bounds()
    found = likely_camera_positions(gmap, low, high)
    assert found.shape[0] >= 20 and found.shape[1] == 3
    assert np.linalg.norm(found[0] - centre) < 0.5  # best first, in a box 13 m across
    # among random places the true ones rank among the best few per cent
    rng = np.random.default_rng(3)
    anywhere = low - 0.75 * (high - low) + rng.random((1000, 3)) * 2.5 * (high - low)
    chance = size_distance_correlation(gmap, anywhere, low, high)
    true = size_distance_correlation(gmap, cameras, low, high)
    assert true.min() > np.quantile(chance, 0.95)
    assert true.max() < 1 and true.min() > 0.5


def test_sizes_without_a_trace_give_no_correlation() -> None:
    gmap = room.room(0, per_metre=10)
    rng = np.random.default_rng(0)
    gmap.means[:] += rng.normal(0, 0.05, gmap.means.shape)
    gmap.scales[:] = np.exp(rng.normal(-3, 0.3, (len(gmap), 1)))
    low, high = gmap.bounds()
    places = low + np.random.default_rng(1).random((50, 3)) * (high - low)
    assert np.abs(size_distance_correlation(gmap, places, low, high)).max() < 0.15


def test_few_gaussians_tell_nothing() -> None:
    gmap = ball(40)
    low, high = gmap.bounds()
    assert size_distance_correlation(gmap, np.zeros((3, 3)), low, high).tolist() == [0, 0, 0]
    assert likely_camera_positions(gmap, low, high, samples=10).shape == (15, 3)
