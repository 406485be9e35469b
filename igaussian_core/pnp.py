"""Camera pose from 2D-3D matches, and the covariance of that pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.geometry import compose, inverse, skew, transform_points

Array = NDArray[np.float64]

_MIN_POINTS = 4
_LEAST_SIGMA_PX = 0.1


@dataclass(frozen=True)
class PnpSolution:
    """A pose and the matches that agree with it.

    Attributes:
        T_scene_cam: 4x4.
        inliers: mask [N] of the given matches.
        residuals_px: reprojection errors [N] in pixels, inf behind the camera.
    """

    T_scene_cam: Array
    inliers: NDArray[np.bool_]
    residuals_px: Array


def solve_pnp(
    camera: Camera,
    uv: NDArray[np.float32],
    points_scene: Array,
    max_error_px: float,
    T_scene_cam_start: Array | None = None,
) -> PnpSolution | None:
    """Pose by LO-RANSAC over P3P with a final robust refinement (PoseLib, Larsson 2020).

    Args:
        camera: pinhole.
        uv: pixels [N, 2].
        points_scene: [N, 3].
        max_error_px: inlier threshold.
        T_scene_cam_start: a pose to start from, scored along with the sampled ones.

    Returns:
        None with fewer than 4 matches or no pose with 4 inliers. Deterministic.
    """
    if len(uv) < _MIN_POINTS:
        return None
    start = None
    if T_scene_cam_start is not None:
        T_cam_scene = inverse(T_scene_cam_start)
        start = poselib.CameraPose()
        start.R, start.t = T_cam_scene[:3, :3], T_cam_scene[:3, 3]
    options = {"max_reproj_error": max_error_px, "max_iterations": 5000, "min_iterations": 200,
               "success_prob": 0.9999, "seed": 0}  # fmt: skip
    pose, info = poselib.estimate_absolute_pose(
        np.asarray(uv, np.float64), np.asarray(points_scene, np.float64),
        _poselib_camera(camera), options, {"loss_type": "CAUCHY", "loss_scale": max_error_px / 3},
        start,
    )  # fmt: skip
    T_scene_cam = inverse(compose(pose.R, pose.t))
    if int(info["num_inliers"]) < _MIN_POINTS or not np.isfinite(T_scene_cam).all():
        return None
    residuals = reprojection_errors(camera, T_scene_cam, uv, points_scene)
    inliers = residuals < max_error_px
    if int(inliers.sum()) < _MIN_POINTS:
        return None
    return PnpSolution(T_scene_cam, inliers, residuals)


def reprojection_errors(
    camera: Camera, T_scene_cam: Array, uv: NDArray[np.float32], points_scene: Array
) -> Array:
    """Distances [N] in pixels between pixels and projected points, inf behind the camera."""
    x, y, z = transform_points(inverse(T_scene_cam), points_scene).T
    with np.errstate(divide="ignore", invalid="ignore"):
        du = camera.fx * x / z + camera.cx - uv[:, 0]
        dv = camera.fy * y / z + camera.cy - uv[:, 1]
    return np.where(z > 1e-9, np.hypot(du, dv), np.inf)


def pose_covariance(
    camera: Camera,
    T_scene_cam: Array,
    points_scene: Array,
    uv: NDArray[np.float32],
    cell_px: float = 0.0,
) -> Array:
    """Covariance [6, 6] of a pose from its inliers, scene axes, order x y z rx ry rz.

    With respect to a shift of the camera's position and a rotation vector in the scene's axes that
    turns the estimate. Neighbouring matches share the map's errors, and some places have larger
    ones than others, so the errors are summed over cells of the image, and what these sums scatter
    counts (the cluster-robust estimate of White 1980 and Liang and Zeger 1986):

        H^-1 (sum over cells of g g^T) H^-1        H = sum of J^T J, g = sum of J^T r in a cell

    Of few cells, which may agree by chance, that says little. So sigma^2 (J^T J)^-1 is added, cells
    counting as one match each, with the weight of six numbers among that many cells; sigma is the
    residuals' root mean square and at least 0.1 px, which keeps the sum positive definite.

    Args:
        points_scene: inlier points [N, 3], in front of the camera.
        uv: the pixels [N, 2] where the image shows them.
        cell_px: side of the cells; 0: every point is one of its own.
    """
    rotation, position = T_scene_cam[:3, :3], T_scene_cam[:3, 3]
    offsets = np.asarray(points_scene, np.float64) - position
    x, y, z = (offsets @ rotation).T
    projected = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    residuals = uv - projected
    # units of the translation columns are scaled so that the inverse stays well conditioned
    scale = np.array([1 / np.median(z)] * 3 + [1.0] * 3)
    J = _pixel_by_pose(camera, rotation, offsets) / scale
    cell, counts = _cells(projected, cell_px)
    pulls = np.zeros((len(counts), 6))
    np.add.at(pulls, cell, (J * residuals[:, :, None]).sum(1))
    rows, share = J.reshape(-1, 6), np.repeat(1 / counts[cell], 2)[:, None]
    # steps of the pose by which each cell's matches alone would move it
    steps = pulls @ _inverse(rows.T @ rows)
    fitted = len(counts) / max(len(counts) - 6, 1)  # six numbers were
    robust = fitted * steps.T @ steps
    variance = max(float(np.square(residuals).mean()), _LEAST_SIGMA_PX**2)
    alike = variance * _inverse(rows.T @ (share * rows))
    covariance = robust + min(6 / len(counts), 1.0) * alike
    covariance /= np.outer(scale, scale)
    return np.asarray(0.5 * (covariance + covariance.T))


def _pixel_by_pose(camera: Camera, rotation: Array, offsets: Array) -> Array:
    """Derivatives [N, 2, 6] of projected points [N, 3], given relative to the camera's position
    in scene axes, by its position and rotation vector."""
    x, y, z = (offsets @ rotation).T
    zero = np.zeros_like(z)
    by_point = np.stack(
        [camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2], -1
    ).reshape(-1, 2, 3)
    by_position = np.broadcast_to(-rotation.T, (len(z), 3, 3))
    by_rotation = rotation.T @ skew(offsets)
    return np.asarray(by_point @ np.concatenate([by_position, by_rotation], axis=2))


def _inverse(information: Array) -> Array:
    """Of a matrix [6, 6] that may not determine all directions."""
    return np.linalg.inv(information + 1e-11 * np.trace(information) * np.eye(6))


def _cells(uv: Array, cell_px: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For pixels [N, 2] the number of their cell in a grid, and for each cell how many it has."""
    if cell_px <= 0:
        return np.arange(len(uv)), np.ones(len(uv), np.int64)
    corners = np.floor(uv / cell_px).astype(np.int64)
    _, index, counts = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    return index.ravel(), counts


def _poselib_camera(camera: Camera) -> dict[str, object]:
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [camera.fx, camera.fy, camera.cx, camera.cy],
    }
