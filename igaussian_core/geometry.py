"""Rigid and similarity transforms, quaternions, pose errors. float64 throughout.

T_a_b is a 4x4 matrix that maps points of frame b into frame a. Quaternions are wxyz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def compose(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """4x4 transform of a rotation [3, 3] and a translation [3]."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(T_a_b: ArrayLike) -> Array:
    """T_b_a [..., 4, 4] of rigid transforms T_a_b [..., 4, 4]."""
    T = np.asarray(T_a_b, np.float64)
    result = np.zeros_like(T)
    rotation_t = np.swapaxes(T[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -(rotation_t @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def transform_points(T_a_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Points [N, 3] of frame b in frame a."""
    T = np.asarray(T_a_b, np.float64)
    return np.asarray(points_b, np.float64) @ T[:3, :3].T + T[:3, 3]


def is_rigid(T: ArrayLike, tolerance: float = 1e-4) -> bool:
    """True for a finite 4x4 matrix with a proper rotation and the last row 0 0 0 1."""
    T = np.asarray(T, np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(
        np.allclose(R @ R.T, np.eye(3), atol=tolerance)
        and np.linalg.det(R) > 0
        and np.allclose(T[3], [0, 0, 0, 1], atol=tolerance)
    )


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotation closest to a 3x3 matrix (Frobenius norm, by SVD)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def skew(v: ArrayLike) -> Array:
    """Cross-product matrices [..., 3, 3] of vectors [..., 3]."""
    v = np.asarray(v, np.float64)
    zero = np.zeros_like(v[..., 0])
    rows = [zero, -v[..., 2], v[..., 1], v[..., 2], zero, -v[..., 0], -v[..., 1], v[..., 0], zero]
    return np.stack(rows, -1).reshape(*v.shape[:-1], 3, 3)


def rotation_from_vector(rotvec: ArrayLike) -> Array:
    """Rotation matrix [3, 3] of a rotation vector [3] in radians (Rodrigues' formula)."""
    v = np.asarray(rotvec, np.float64)
    angle = float(np.linalg.norm(v))
    K = skew(v)
    if angle < 1e-8:
        return np.eye(3) + K + 0.5 * K @ K
    return np.eye(3) + np.sin(angle) / angle * K + (1 - np.cos(angle)) / angle**2 * K @ K


def vector_from_rotation(rotation: ArrayLike) -> Array:
    """Rotation vector [3] in radians, angle in [0, pi], of a rotation matrix [3, 3]."""
    q = quaternion_from_rotation(rotation)
    norm = float(np.linalg.norm(q[1:]))
    if norm < 1e-12:
        return np.asarray(2.0 * q[1:])
    # atan2 stays exact near 0 and pi, where acos of the trace does not
    return np.asarray(q[1:] / norm * 2.0 * np.arctan2(norm, q[0]))


def rotation_from_quaternion(q_wxyz: ArrayLike) -> Array:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4], normalised first."""
    q = np.asarray(q_wxyz, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, -1).reshape(*q.shape[:-1], 3, 3)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Unit quaternion wxyz with w >= 0 of a rotation matrix [3, 3] (Bar-Itzhack's method)."""
    R = np.asarray(rotation, np.float64)
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], 0, 0, 0],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], 0, 0],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], 0],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
        ]
    )
    _, vectors = np.linalg.eigh(K / 3.0)  # reads the lower triangle
    x, y, z, w = vectors[:, -1]
    q = np.array([w, x, y, z])
    return -q if q[0] < 0 else q


def mean_rotation(rotations: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Weighted mean [3, 3] of rotations [N, 3, 3].

    The chordal L2 mean of Markley et al., "Averaging Quaternions", 2007: signs of the
    quaternions do not matter.
    """
    R = np.asarray(rotations, np.float64)
    w = np.ones(len(R)) if weights is None else np.asarray(weights, np.float64)
    return nearest_rotation(np.einsum("n,nij->ij", w / w.sum(), R))


def rotation_angle_deg(rotation: ArrayLike) -> float:
    """Angle of a rotation matrix in degrees, in [0, 180]."""
    return float(np.degrees(np.linalg.norm(vector_from_rotation(rotation))))


def pose_error(T_a_estimate: ArrayLike, T_a_true: ArrayLike) -> tuple[float, float]:
    """Rotation error in degrees and distance of the origins in units of frame a."""
    E, T = np.asarray(T_a_estimate, np.float64), np.asarray(T_a_true, np.float64)
    angle = rotation_angle_deg(E[:3, :3].T @ T[:3, :3])
    return angle, float(np.linalg.norm(E[:3, 3] - T[:3, 3]))


def interpolate_pose(T_a_start: ArrayLike, T_a_end: ArrayLike, share: float) -> Array:
    """The pose after `share` of the motion between two poses, at constant body velocity of
    rotation and translation each; outside [0, 1] it goes on likewise."""
    start = np.asarray(T_a_start, np.float64)
    motion = inverse(start) @ np.asarray(T_a_end, np.float64)
    turn = rotation_from_vector(share * vector_from_rotation(motion[:3, :3]))
    return np.asarray(start @ compose(turn, share * motion[:3, 3]))


@dataclass(frozen=True)
class Sim3:
    """Similarity x_a = scale * rotation @ x_b + translation, e.g. `T_map_scene` of a map."""

    scale: float
    rotation: Array  # [3, 3]
    translation: Array  # [3]

    @staticmethod
    def identity() -> Sim3:
        return Sim3(1.0, np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Sim3:
        """From a 4x4 matrix with scale * rotation in its upper left.

        Raises:
            ValueError: no similarity.
        """
        M = np.asarray(matrix, np.float64)
        if M.shape != (4, 4) or not np.isfinite(M).all() or np.linalg.det(M[:3, :3]) <= 0:
            raise ValueError("no similarity transform: 4x4, finite, positive determinant wanted")
        scale = float(np.cbrt(np.linalg.det(M[:3, :3])))
        if not is_rigid(np.vstack([np.hstack([M[:3, :3] / scale, M[:3, 3:]]), M[3]])):
            raise ValueError(
                "no similarity transform: a scaled rotation and a last row 0 0 0 1 wanted"
            )
        return Sim3(scale, M[:3, :3] / scale, M[:3, 3].copy())

    def matrix(self) -> Array:
        """The 4x4 matrix."""
        return compose(self.scale * self.rotation, self.translation)

    def inverse(self) -> Sim3:
        rotation = self.rotation.T
        return Sim3(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def points(self, points_b: ArrayLike) -> Array:
        """Points [N, 3] of frame b in frame a."""
        return transform_points(self.matrix(), points_b)

    def camera(self, T_b_cam: ArrayLike) -> Array:
        """T_a_cam of a camera pose T_b_cam: the axes rotate, the position scales too."""
        T = np.asarray(T_b_cam, np.float64)
        position = self.scale * (self.rotation @ T[:3, 3]) + self.translation
        return compose(self.rotation @ T[:3, :3], position)
