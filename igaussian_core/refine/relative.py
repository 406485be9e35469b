"""The paper's solver: the essential matrix's relative pose, and its scale from elsewhere.

Two images tell rotation and the direction of translation; how far it goes must come from a
`ScaleEstimator`. The usual solver, `pnp`, needs none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.geometry import compose, inverse, nearest_rotation, transform_points
from igaussian_core.lifting import unproject
from igaussian_core.pnp import PnpSolution, reprojection_errors

Array = NDArray[np.float64]
Pixels = NDArray[np.float32]

_MIN_MATCHES = 8
_MIN_INLIERS = 6
_ROTATION_SHARE = 0.95  # of the essential matrix's inliers, that a rotation alone explains
_MIN_IN_FRONT = 0.75  # of the inliers; a right pose has all but the noisy far ones there


@dataclass(frozen=True)
class RelativePose:
    """Camera b seen from camera a, without scale: x_b = rotation @ x_a + length * direction.

    Attributes:
        rotation: [3, 3].
        direction: unit vector [3]; zero where the pair shows no parallax.
        inliers: mask [N] of the given matches.
    """

    rotation: Array
    direction: Array
    inliers: NDArray[np.bool_]

    @property
    def rotation_only(self) -> bool:
        return not self.direction.any()


# (relative pose, bearings of a [M, 3], bearings of b [M, 3], depths in a [M]), all of inliers
# -> length of the translation in the depths' unit; not positive or NaN: none can be given
ScaleEstimator = Callable[[RelativePose, Array, Array, Array], float]


def relative_pose(
    camera: Camera, uv_a: Pixels, uv_b: Pixels, max_sampson_px: float
) -> RelativePose | None:
    """Relative pose by RANSAC over five-point essential matrices (Nister 2004).

    OpenCV's plain RANSAC does what the paper's equation says: a match is an inlier where its
    Sampson error is below a threshold, and the matrix with most inliers wins. (PoseLib's sums
    truncated errors and optimizes locally.) Where a rotation alone explains the inliers, the
    matrix is arbitrary and the rotation is returned.

    Args:
        camera: pinhole, of both images.
        uv_a, uv_b: matching pixels [N, 2].
        max_sampson_px: inlier threshold.

    Returns:
        None with too few matches or where no decomposition has its points in front of both
        cameras. Deterministic.
    """
    if len(uv_a) < _MIN_MATCHES:
        return None
    a, b = bearings(camera, uv_a), bearings(camera, uv_b)
    matrix, mask = cv2.findEssentialMat(
        np.asarray(uv_a, np.float64), np.asarray(uv_b, np.float64), camera.K,
        method=cv2.RANSAC, prob=0.9999, threshold=max_sampson_px, maxIters=2000,
    )  # fmt: skip
    turn = _rotation_only(camera, a, b, uv_b, max_sampson_px)
    essential = None
    if matrix is not None and matrix.shape[0] >= 3:
        essential = _decompose(np.asarray(matrix[:3], np.float64), a, b, mask.ravel().astype(bool))
    wanted = _MIN_INLIERS
    if mask is not None:
        wanted = max(wanted, int(np.ceil(_ROTATION_SHARE * int(np.count_nonzero(mask)))))
    return turn if turn.inliers.sum() >= wanted else essential


def solve_relative(
    camera: Camera,
    uv_render: Pixels,
    uv_image: Pixels,
    depth: NDArray[np.float32],
    T_scene_render: Array,
    max_sampson_px: float,
    max_error_px: float,
    scale: ScaleEstimator,
) -> PnpSolution | None:
    """The image's pose by composing the render's with the scaled relative pose (T_fine).

    Args:
        uv_render, uv_image: matching pixels [N, 2].
        depth: of the render at its pixels [N]; judges the result, and feeds the scale.
        T_scene_render: where the render was taken, T_coarse.
        max_error_px: reprojection error of the result's inliers.

    Returns:
        None where there is no relative pose, no positive scale (a translation of the wrong
        sign gives a negative one), or hardly a point agrees with the result.
    """
    pair = relative_pose(camera, uv_render, uv_image, max_sampson_px)
    if pair is None:
        return None
    length = 0.0
    if not pair.rotation_only:
        a, b = bearings(camera, uv_render), bearings(camera, uv_image)
        keep = pair.inliers
        length = scale(pair, a[keep], b[keep], depth[keep].astype(np.float64))
        if not (np.isfinite(length) and length > 0):
            return None
    T_image_render = compose(pair.rotation, length * pair.direction)
    T_scene_image = T_scene_render @ inverse(T_image_render)
    points = transform_points(T_scene_render, unproject(camera, uv_render, depth))
    residuals = reprojection_errors(camera, T_scene_image, uv_image, points)
    inliers = residuals < max_error_px
    if int(inliers.sum()) < _MIN_INLIERS:
        return None
    return PnpSolution(T_scene_image, inliers, residuals)


def depth_scale(pair: RelativePose, a: Array, b: Array, depth: Array) -> float:
    """Median ratio of rendered depth to the depth triangulated over a baseline of one.

    Computed with inverse depths: noise of a match makes these too large as often as too small,
    also across zero, while depths of far points would fly off.
    """
    return float(np.median(depth * inverse_depths(pair.rotation, pair.direction, a, b)))


def bearings(camera: Camera, uv: Pixels) -> Array:
    """Rays [N, 3] with z = 1 of pixels [N, 2]."""
    x = (np.asarray(uv[:, 0], np.float64) - camera.cx) / camera.fx
    y = (np.asarray(uv[:, 1], np.float64) - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=1)


def inverse_depths(rotation: Array, direction: Array, a: Array, b: Array) -> Array:
    """1 / z in a of matches, baseline one, by least squares on b x (R a + direction / z) = 0."""
    across = np.cross(b, direction)
    square = np.maximum(np.sum(across**2, axis=1), 1e-18)
    return np.asarray(-np.sum(across * np.cross(b, a @ rotation.T), axis=1) / square)


def _decompose(
    matrix: Array, a: Array, b: Array, inliers: NDArray[np.bool_]
) -> RelativePose | None:
    """Of the four poses of an essential matrix, the one with points in front of both cameras."""
    first, second, direction = cv2.decomposeEssentialMat(matrix)
    direction = np.asarray(direction, np.float64).ravel()
    best, most = None, 0
    for rotation in (np.asarray(first, np.float64), np.asarray(second, np.float64)):
        for sign in (1.0, -1.0):
            count = _in_front(rotation, sign * direction, a[inliers], b[inliers])
            if count > most:
                best, most = RelativePose(rotation, sign * direction, inliers), count
    return best if most >= max(_MIN_INLIERS, _MIN_IN_FRONT * inliers.sum()) else None


def _in_front(rotation: Array, direction: Array, a: Array, b: Array) -> int:
    """How many matches lie in front of both cameras (cheirality)."""
    inverse_z = inverse_depths(rotation, direction, a, b)
    z_in_b = (a @ rotation.T)[:, 2] + inverse_z * direction[2]
    return int(((inverse_z > 0) & (z_in_b > 0)).sum())


def _rotation_only(
    camera: Camera, a: Array, b: Array, uv_b: Pixels, max_error_px: float
) -> RelativePose:
    """The rotation that takes most bearings to their matches, by RANSAC over pairs of them."""
    a_unit = a / np.linalg.norm(a, axis=1, keepdims=True)
    b_unit = b / np.linalg.norm(b, axis=1, keepdims=True)
    rng = np.random.default_rng(0)
    best = np.zeros(len(a), bool)
    rotation = np.eye(3)
    for _ in range(100):
        pair = rng.choice(len(a), 2, replace=False)
        candidate = _align(a_unit[pair], b_unit[pair])
        inliers = _turned_errors(camera, candidate, a, uv_b) < max_error_px
        if inliers.sum() > best.sum():
            rotation, best = candidate, inliers
    for _ in range(5):  # over all inliers, which then change a little
        if best.sum() < 2:
            break
        rotation = _align(a_unit[best], b_unit[best])
        best = _turned_errors(camera, rotation, a, uv_b) < max_error_px
    return RelativePose(rotation, np.zeros(3), best)


def _align(a: Array, b: Array) -> Array:
    """Rotation with b = R a in least squares (Kabsch 1976)."""
    return nearest_rotation(b.T @ a)


def _turned_errors(camera: Camera, rotation: Array, a: Array, uv_b: Pixels) -> Array:
    """Distances [N] in pixels between b's pixels and a's points at infinity, turned."""
    x, y, z = (a @ rotation.T).T
    z = np.where(z > 1e-6, z, np.nan)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return np.nan_to_num(np.hypot(u - uv_b[:, 0], v - uv_b[:, 1]), nan=np.inf)

