"""The paper's solver against known answers: outliers, pure rotation, signs, scale."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import room as rooms

from igaussian_core.camera import Camera
from igaussian_core.config import Config, RefineConfig
from igaussian_core.geometry import (
    compose,
    inverse,
    pose_error,
    rotation_angle_deg,
    rotation_from_vector,
    transform_points,
)
from igaussian_core.localizer import Localizer
from igaussian_core.refine.relative import (
    RelativePose,
    bearings,
    depth_scale,
    inverse_depths,
    relative_pose,
    solve_relative,
)

CAMERA = Camera(640, 480, 500.0, 510.0, 322.0, 236.0)
T_RENDER = compose(rotation_from_vector([0.4, -1.1, 0.3]), [2.0, -1.0, 0.5])
TURN = rotation_from_vector([0.05, -0.08, 0.03])
MOTION = np.array([0.25, -0.1, 0.15])  # T_image_render's translation


def pair(
    motion: np.ndarray = MOTION, count: int = 300, noise_px: float = 0.0, outliers: float = 0.0,
    turn: np.ndarray = TURN,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Pixels of render and image, the render's depth, and the mask of right matches."""
    rng = np.random.default_rng(3)
    uv = rng.uniform([0, 0], [639, 479], (count, 2)).astype(np.float32)
    z = rng.uniform(1.5, 6, count)
    x = transform_points(compose(turn, motion), bearings(CAMERA, uv) * z[:, None])
    moved = np.stack(
        [CAMERA.fx * x[:, 0] / x[:, 2] + CAMERA.cx, CAMERA.fy * x[:, 1] / x[:, 2] + CAMERA.cy], 1
    )
    moved += rng.normal(0, noise_px, moved.shape)
    wrong = rng.permutation(count)[: int(outliers * count)]
    moved[wrong] = rng.uniform([0, 0], [639, 479], (len(wrong), 2))
    right = np.ones(count, bool)
    right[wrong] = False
    return uv, moved.astype(np.float32), z.astype(np.float32), right


def solved(uv: np.ndarray, moved: np.ndarray, z: np.ndarray) -> np.ndarray:
    solution = solve_relative(CAMERA, uv, moved, z, T_RENDER, 1.0, 3.0, depth_scale)
    assert solution is not None
    return solution.T_scene_cam


def truth(motion: np.ndarray = MOTION) -> np.ndarray:
    return T_RENDER @ inverse(compose(TURN, motion))


def test_the_exact_pose_from_exact_matches() -> None:
    uv, moved, z, _ = pair()
    relative = relative_pose(CAMERA, uv, moved, 1.0)
    assert relative is not None and not relative.rotation_only and relative.inliers.all()
    assert rotation_angle_deg(relative.rotation @ TURN.T) < 0.01
    assert relative.direction @ MOTION / np.linalg.norm(MOTION) > 0.99999
    angle, distance = pose_error(solved(uv, moved, z), truth())
    assert angle < 0.01 and distance < 1e-3


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_outliers_are_left_out(share: float) -> None:
    uv, moved, z, right = pair(noise_px=0.3, outliers=share)
    relative = relative_pose(CAMERA, uv, moved, 1.0)
    assert relative is not None and not relative.rotation_only
    assert relative.inliers[right].mean() > 0.85 and relative.inliers[~right].mean() < 0.1
    angle, distance = pose_error(solved(uv, moved, z), truth())
    assert angle < 0.3 and distance < 0.03


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_translations_sign_is_found(axis: int, sign: float) -> None:
    motion = np.zeros(3)
    motion[axis] = 0.3 * sign
    uv, moved, z, _ = pair(motion, noise_px=0.2)
    relative = relative_pose(CAMERA, uv, moved, 1.0)
    assert relative is not None
    assert relative.direction[axis] * sign > 0.99
    assert pose_error(solved(uv, moved, z), truth(motion))[1] < 0.02


@pytest.mark.parametrize("outliers", [0.0, 0.4])
@pytest.mark.parametrize("degrees", [0.0, 2.0, 15.0])
def test_a_pure_rotation_has_no_translation(degrees: float, outliers: float) -> None:
    turn = rotation_from_vector(np.radians(degrees) * np.array([0.6, -0.8, 0.0]))
    uv, moved, z, _ = pair(np.zeros(3), noise_px=0.3, outliers=outliers, turn=turn)
    relative = relative_pose(CAMERA, uv, moved, 1.0)
    assert relative is not None and relative.rotation_only
    assert rotation_angle_deg(relative.rotation @ turn.T) < 0.05
    angle, distance = pose_error(solved(uv, moved, z), T_RENDER @ inverse(compose(turn, [0, 0, 0])))
    assert angle < 0.05 and distance < 1e-9


def test_the_inlier_threshold_is_sampsons() -> None:
    """A match moved along its epipolar line stays an inlier, one moved across it does not."""
    uv, moved, _, _ = pair()
    relative = relative_pose(CAMERA, uv, moved, 1.0)
    assert relative is not None
    b = bearings(CAMERA, moved)
    epipole = MOTION / MOTION[2]
    along = (epipole - b)[:, :2] * [CAMERA.fx, CAMERA.fy]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], 1)
    for step, inlier in ((along, True), (across, False)):
        changed = moved.copy()
        changed[:20] += (6 * step[:20]).astype(np.float32)
        again = relative_pose(CAMERA, uv, changed, 1.0)
        assert again is not None
        assert bool(again.inliers[:20].mean() > 0.7) is inlier


def test_scale_from_depth() -> None:
    uv, moved, z, _ = pair()
    length = float(np.linalg.norm(MOTION))
    a, b = bearings(CAMERA, uv), bearings(CAMERA, moved)
    right = RelativePose(TURN, MOTION / length, np.ones(len(uv), bool))
    assert depth_scale(right, a, b, z) == pytest.approx(length, rel=1e-4)
    assert depth_scale(right, a, b, 2 * z) == pytest.approx(2 * length, rel=1e-4)
    wrong_sign = RelativePose(TURN, -MOTION / length, right.inliers)
    assert depth_scale(wrong_sign, a, b, z) == pytest.approx(-length, rel=1e-4)
    assert np.allclose(inverse_depths(TURN, right.direction, a, b), length / z, atol=1e-4)


@pytest.mark.parametrize("length", [-0.3, 0.0, float("nan"), float("inf")])
def test_a_scale_that_makes_no_sense_gives_no_pose(length: float) -> None:
    uv, moved, z, _ = pair()
    assert (
        solve_relative(CAMERA, uv, moved, z, T_RENDER, 1.0, 3.0, lambda *_: length) is None
    )


def test_the_length_comes_from_the_given_estimator() -> None:
    uv, moved, z, _ = pair()
    half = 0.5 * float(np.linalg.norm(MOTION))
    solution = solve_relative(CAMERA, uv, moved, z, T_RENDER, 1.0, 1e3, lambda *_: half)
    assert solution is not None
    T_image_render = inverse(solution.T_scene_cam) @ T_RENDER
    assert np.allclose(T_image_render[:3, 3], 0.5 * MOTION, atol=1e-3)


@pytest.mark.parametrize("count", [0, 3, 7])
def test_too_few_matches(count: int) -> None:
    uv, moved, z, _ = pair()
    assert relative_pose(CAMERA, uv[:count], moved[:count], 1.0) is None
    assert (
        solve_relative(
            CAMERA, uv[:count], moved[:count], z[:count], T_RENDER, 1.0, 3.0, depth_scale
        )
        is None
    )


def test_nonsense_gives_few_inliers() -> None:
    uv, moved, z, _ = pair(outliers=1.0)
    solution = solve_relative(CAMERA, uv, moved, z, T_RENDER, 1.0, 3.0, depth_scale)
    assert solution is None or solution.inliers.sum() < 30


def test_results_repeat_themselves() -> None:
    uv, moved, z, _ = pair(noise_px=0.5, outliers=0.4)
    assert np.array_equal(solved(uv, moved, z), solved(uv, moved, z))


def test_the_localizer_with_the_papers_solver(room_igmap: Path, localizer: Localizer) -> None:
    paper = Localizer.open(room_igmap, Config(refine=RefineConfig(solver="paper")))
    camera = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)
    T_true = paper.T_map_scene.camera(rooms.source_poses()[3])
    T_true[:3, 3] += [0.05, -0.04, 0.02]
    rgb, _, _ = localizer.render(camera, T_true)
    image = (255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    result = paper.localize(image, camera)
    assert result.ok and result.T_map_cam is not None, result.reason
    angle, distance = pose_error(result.T_map_cam, T_true)
    assert angle < 0.5 and distance < 0.03
