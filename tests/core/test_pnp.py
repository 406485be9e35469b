"""Pose from 2D-3D matches: exact, with outliers, and a covariance that is true."""

from __future__ import annotations

import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.geometry import (
    compose,
    inverse,
    pose_error,
    rotation_from_vector,
    transform_points,
    vector_from_rotation,
)
from igaussian_core.pnp import pose_covariance, reprojection_errors, solve_pnp

CAMERA = Camera(640, 480, 500.0, 510.0, 322.0, 236.0)
T_TRUE = compose(rotation_from_vector([0.4, -1.1, 0.3]), [2.0, -1.0, 0.5])


def matches(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and the scene points they show from T_TRUE, without noise."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([0, 0], [639, 479], (count, 2))
    z = rng.uniform(1, 6, count)
    points = np.stack(
        [(uv[:, 0] - CAMERA.cx) / CAMERA.fx * z, (uv[:, 1] - CAMERA.cy) / CAMERA.fy * z, z], 1
    )
    return uv.astype(np.float32), transform_points(T_TRUE, points)


@pytest.mark.parametrize("count", [4, 5, 8, 100])
def test_exact_matches_give_the_exact_pose(count: int) -> None:
    uv, points = matches(count)
    solution = solve_pnp(CAMERA, uv, points, 2.0)
    assert solution is not None
    angle, distance = pose_error(solution.T_scene_cam, T_TRUE)
    assert angle < 1e-3 and distance < 1e-4
    assert solution.inliers.all() and solution.residuals_px.max() < 1e-2


@pytest.mark.parametrize("share", [0.3, 0.6, 0.8])
def test_outliers_are_found(share: float) -> None:
    uv, points = matches(200)
    rng = np.random.default_rng(1)
    wrong = rng.permutation(200)[: int(share * 200)]
    uv = uv + rng.normal(0, 0.5, uv.shape).astype(np.float32)
    uv[wrong] = rng.uniform([0, 0], [639, 479], (len(wrong), 2))
    solution = solve_pnp(CAMERA, uv, points, 3.0)
    assert solution is not None
    angle, distance = pose_error(solution.T_scene_cam, T_TRUE)
    assert angle < 0.2 and distance < 0.02
    good = np.setdiff1d(np.arange(200), wrong)
    assert solution.inliers[good].mean() > 0.97
    assert solution.inliers[wrong].mean() < 0.03
    assert (solution.residuals_px[solution.inliers] < 3.0).all()


def test_the_same_matches_give_the_same_pose() -> None:
    uv, points = matches(80)
    uv += np.random.default_rng(0).normal(0, 1, uv.shape).astype(np.float32)
    poses = [solve_pnp(CAMERA, uv, points, 3.0) for _ in range(3)]
    assert all(p is not None and np.array_equal(p.T_scene_cam, poses[0].T_scene_cam) for p in poses)  # type: ignore[union-attr]


def test_a_good_start_is_kept_and_a_bad_one_left() -> None:
    uv, points = matches(60)
    for start in (T_TRUE, np.eye(4)):
        solution = solve_pnp(CAMERA, uv, points, 2.0, start)
        assert solution is not None and pose_error(solution.T_scene_cam, T_TRUE)[0] < 1e-3


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_matches_give_no_pose(count: int) -> None:
    uv, points = matches(4)
    assert solve_pnp(CAMERA, uv[:count], points[:count], 2.0) is None


def test_nonsense_gives_no_confident_pose() -> None:
    rng = np.random.default_rng(0)
    uv = rng.uniform([0, 0], [639, 479], (100, 2)).astype(np.float32)
    solution = solve_pnp(CAMERA, uv, rng.normal(size=(100, 3)) * 3, 2.0)
    assert solution is None or solution.inliers.sum() < 15


@pytest.mark.parametrize("place", ["one point", "one line"])
def test_degenerate_points_do_not_raise(place: str) -> None:
    uv, points = matches(20)
    points[:] = points[0]
    if place == "one line":
        points[:, 0] += np.linspace(0, 1, 20)
        uv = CAMERA.project(transform_points(inverse(T_TRUE), points)).astype(np.float32)
    solution = solve_pnp(CAMERA, uv, points, 1.0)
    assert solution is None or np.isfinite(solution.T_scene_cam).all()


def test_reprojection_errors() -> None:
    uv, points = matches(10)
    shifted = uv + np.array([3, -4], np.float32)
    assert np.allclose(reprojection_errors(CAMERA, T_TRUE, uv, points), 0, atol=1e-3)
    assert np.allclose(reprojection_errors(CAMERA, T_TRUE, shifted, points), 5, atol=1e-3)
    behind = transform_points(T_TRUE, np.array([[0.1, 0.1, -2.0], [0, 0, 0]]))
    assert np.isinf(reprojection_errors(CAMERA, T_TRUE, uv[:2], behind)).all()


def estimate_many(
    noise_px: float, runs: int, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors [runs, 6] of estimates, their covariances, and the points."""
    rng = np.random.default_rng(0)
    uv, points = matches(count)
    errors, covariances = [], []
    for _ in range(runs):
        noisy = (uv + rng.normal(0, noise_px, uv.shape)).astype(np.float32)
        solution = solve_pnp(CAMERA, noisy, points, 12 * noise_px, T_TRUE)
        assert solution is not None
        T, keep = solution.T_scene_cam, solution.inliers
        turn = vector_from_rotation(T[:3, :3] @ T_TRUE[:3, :3].T)
        errors.append(np.concatenate([T[:3, 3] - T_TRUE[:3, 3], turn]))
        covariances.append(pose_covariance(CAMERA, T, points[keep], noisy[keep]))
    return np.array(errors), np.array(covariances), points


@pytest.mark.parametrize("noise_px", [0.6, 1.5])
def test_covariance_is_that_of_repeated_estimates(noise_px: float) -> None:
    """Monte Carlo: each direction's spread is what the covariance says, and no axis is swapped."""
    errors, covariances, _ = estimate_many(noise_px, runs=250, count=60)
    sample, predicted = np.cov(errors.T), covariances.mean(axis=0)
    # along the eigenvectors of the prediction, which whiten it, every variance should be one
    values, vectors = np.linalg.eigh(predicted)
    whitened = vectors.T @ sample @ vectors / np.sqrt(np.outer(values, values))
    # the estimator is robust, thus a little noisier than least squares
    assert np.diag(whitened).min() > 0.6
    assert np.diag(whitened).max() < 2.2
    assert np.abs(whitened - np.diag(np.diag(whitened))).max() < 0.6


def noisy_matches(count: int, noise_px: float) -> tuple[np.ndarray, np.ndarray]:
    uv, points = matches(count)
    return uv + noise_px * np.random.default_rng(1).normal(0, 1, uv.shape), points


def test_covariance_scales_as_it_should() -> None:
    uv, points = noisy_matches(100, 2.0)
    one = pose_covariance(CAMERA, T_TRUE, points, uv)
    assert np.allclose(one, one.T) and np.linalg.eigvalsh(one).min() > 0
    twice, _ = noisy_matches(100, 4.0)
    assert np.allclose(pose_covariance(CAMERA, T_TRUE, points, twice), 4 * one, rtol=1e-3)
    far = T_TRUE[:3, 3] + 10 * (points - T_TRUE[:3, 3])  # the same picture, ten times larger
    tenfold = np.diag([10.0] * 3 + [1.0] * 3)
    assert np.allclose(pose_covariance(CAMERA, T_TRUE, far, uv), tenfold @ one @ tenfold, rtol=1e-3)


def test_covariance_turns_with_the_scene() -> None:
    uv, points = noisy_matches(100, 1.0)
    R = rotation_from_vector([0.3, 0.8, -0.4])
    T_new_scene = compose(R, [5, 6, 7])
    turned = pose_covariance(
        CAMERA, T_new_scene @ T_TRUE, transform_points(T_new_scene, points), uv
    )
    block = np.kron(np.eye(2), R)
    expected = block @ pose_covariance(CAMERA, T_TRUE, points, uv) @ block.T
    assert np.allclose(turned, expected, rtol=1e-6, atol=1e-12)


def test_covariance_knows_of_errors_that_neighbours_share() -> None:
    """Monte Carlo: errors alike within cells, and larger in one half of the image."""
    rng = np.random.default_rng(3)
    uv, points = matches(400)
    cells = np.floor(uv / 64).astype(int)
    shared, alone = [], []
    for _ in range(150):
        by_cell = rng.normal(0, 0.5, (*(cells.max(0) + 1), 2))
        by_cell[: len(by_cell) // 2] *= 3
        noisy = uv + by_cell[cells[:, 0], cells[:, 1]] + rng.normal(0, 0.1, uv.shape)
        solution = solve_pnp(CAMERA, noisy.astype(np.float32), points, 20, T_TRUE)
        assert solution is not None
        T = solution.T_scene_cam
        turn = vector_from_rotation(T_TRUE[:3, :3] @ T[:3, :3].T)
        error = np.concatenate([T_TRUE[:3, 3] - T[:3, 3], turn])
        for cell_px, nees in ((64.0, shared), (0.0, alone)):
            covariance = pose_covariance(CAMERA, T, points, noisy, cell_px)
            nees.append(error @ np.linalg.solve(covariance, error))
    assert 4 < np.mean(shared) < 12
    assert np.mean(alone) > 2 * np.mean(shared)


def test_covariance_never_claims_perfection() -> None:
    uv, points = matches(100)
    covariance = pose_covariance(CAMERA, T_TRUE, points, uv)
    assert np.sqrt(np.diag(covariance)).min() > 1e-6


def test_covariance_of_few_or_degenerate_points_is_large_but_finite() -> None:
    uv, points = noisy_matches(4, 1.0)
    points[:] = points[0]
    covariance = pose_covariance(CAMERA, T_TRUE, points, uv[:1] + np.zeros((4, 1)))
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance).max() > 1.0


def test_a_crowd_of_points_makes_no_pose_certain() -> None:
    uv, points = noisy_matches(40, 1.0)
    one = pose_covariance(CAMERA, T_TRUE, points, uv, cell_px=1.0)
    assert np.allclose(one, pose_covariance(CAMERA, T_TRUE, points, uv), rtol=1e-6)
    # a point a hundred times over pulls the pose as hard as its own error is large
    crowd = np.concatenate([points, np.repeat(points[:1], 99, axis=0)])
    crowd_uv = np.concatenate([uv, np.repeat(uv[:1], 99, axis=0)])
    crowded = pose_covariance(CAMERA, T_TRUE, crowd, crowd_uv, cell_px=1.0)
    by_itself = pose_covariance(CAMERA, T_TRUE, crowd, crowd_uv)
    assert np.trace(crowded) > 0.8 * np.trace(one)
    assert np.trace(crowded) > 1.2 * np.trace(by_itself)
