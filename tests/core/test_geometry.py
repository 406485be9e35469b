"""Group properties, round trips near 0 and pi, and values known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from igaussian_core.geometry import (
    Sim3,
    compose,
    inverse,
    is_rigid,
    mean_rotation,
    nearest_rotation,
    pose_error,
    quaternion_from_rotation,
    rotation_angle_deg,
    rotation_from_quaternion,
    rotation_from_vector,
    skew,
    transform_points,
    vector_from_rotation,
)

numbers = st.floats(-10, 10)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
unit_numbers = st.floats(-1, 1)


@st.composite
def axes(draw: st.DrawFn) -> np.ndarray:
    v = np.array(draw(st.tuples(unit_numbers, unit_numbers, unit_numbers)))
    assume(np.linalg.norm(v) > 1e-3)
    return v / np.linalg.norm(v)


# angles where formulas break: none, tiny, nearly and exactly half a turn
angles = st.one_of(
    st.floats(0, np.pi),
    st.sampled_from([0.0, 1e-12, 1e-9, 1e-8, 2e-8, 1e-6, 1e-4]),
    st.sampled_from([1e-12, 1e-9, 1e-8, 1e-6, 1e-4, 0.0]).map(lambda gap: np.pi - gap),
)


@st.composite
def rotation_vectors(draw: st.DrawFn) -> np.ndarray:
    return draw(axes()) * draw(angles)


rotations = rotation_vectors().map(rotation_from_vector)


@st.composite
def transforms(draw: st.DrawFn) -> np.ndarray:
    return compose(draw(rotations), draw(vectors))


@st.composite
def similarities(draw: st.DrawFn) -> Sim3:
    return Sim3(draw(st.floats(0.01, 100)), draw(rotations), draw(vectors))


def quaternion_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton's product of two quaternions wxyz, written out anew."""
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


@given(rotations)
def test_rotation_of_a_vector_is_a_proper_rotation(R: np.ndarray) -> None:
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(
    ("rotvec", "x_goes_to"),
    [
        ([0, 0, np.pi / 2], [0, 1, 0]),
        ([0, np.pi / 2, 0], [0, 0, -1]),
        ([np.pi / 2, 0, 0], [1, 0, 0]),
        ([0, 0, np.pi], [-1, 0, 0]),
    ],
)
def test_right_hand_rule(rotvec: list[float], x_goes_to: list[float]) -> None:
    assert np.allclose(rotation_from_vector(rotvec) @ [1, 0, 0], x_goes_to)


@given(rotation_vectors())
def test_rotation_vector_round_trip(v: np.ndarray) -> None:
    back = vector_from_rotation(rotation_from_vector(v))
    # near half a turn v and its opposite are one rotation
    opposite = np.linalg.norm(back + v) if np.linalg.norm(v) > np.pi - 1e-6 else np.inf
    assert min(np.linalg.norm(back - v), opposite) < 1e-6
    assert np.linalg.norm(back) <= np.pi + 1e-9


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-5, 1e-3, 1.0, np.pi - 1e-5, np.pi - 1e-7])
def test_small_and_large_angles_keep_their_digits(angle: float) -> None:
    axis = np.array([2, -3, 6]) / 7
    degrees = rotation_angle_deg(rotation_from_vector(axis * angle))
    # acos of the trace would lose everything below 1e-8 and near pi
    assert np.radians(degrees) == pytest.approx(angle, rel=1e-6, abs=2e-15)


@given(rotations)
def test_quaternion_round_trip(R: np.ndarray) -> None:
    q = quaternion_from_rotation(R)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-12)
    assert q[0] >= 0
    assert np.allclose(rotation_from_quaternion(q), R, atol=1e-9)
    assert np.allclose(rotation_from_quaternion(-3.5 * q), R, atol=1e-9)


@given(rotations, rotations)
def test_quaternion_product_is_the_matrix_product(A: np.ndarray, B: np.ndarray) -> None:
    q = quaternion_product(quaternion_from_rotation(A), quaternion_from_rotation(B))
    assert np.allclose(rotation_from_quaternion(q), A @ B, atol=1e-9)


def test_quaternions_are_wxyz() -> None:
    half = np.sqrt(0.5)
    quarter_turn_about_z = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    assert np.allclose(quaternion_from_rotation(quarter_turn_about_z), [half, 0, 0, half])
    assert np.allclose(rotation_from_quaternion([half, 0, 0, half]), quarter_turn_about_z)


def test_many_quaternions_at_once() -> None:
    q = np.random.default_rng(0).normal(size=(4, 5, 4))
    R = rotation_from_quaternion(q)
    assert R.shape == (4, 5, 3, 3)
    assert np.allclose(R[2, 3], rotation_from_quaternion(q[2, 3]))


@given(transforms(), transforms(), vectors)
def test_transforms_form_a_group(A: np.ndarray, B: np.ndarray, p: np.ndarray) -> None:
    assert np.allclose(A @ inverse(A), np.eye(4), atol=1e-9)
    assert np.allclose(inverse(A) @ A, np.eye(4), atol=1e-9)
    assert np.allclose(inverse(A @ B), inverse(B) @ inverse(A), atol=1e-9)
    chained = transform_points(A, transform_points(B, p[None]))
    assert np.allclose(transform_points(A @ B, p[None]), chained, atol=1e-9)
    assert is_rigid(A @ B)


def test_inverse_of_many() -> None:
    T = np.stack([compose(rotation_from_vector([0.1 * i, 0.2, -0.3]), [i, 2, 3]) for i in range(4)])
    assert np.allclose(inverse(T), np.linalg.inv(T))


def test_transform_points_maps_b_into_a() -> None:
    T_a_b = compose(rotation_from_vector([0, 0, np.pi / 2]), [10, 0, 0])
    assert np.allclose(transform_points(T_a_b, [[1, 0, 0], [0, 2, 5]]), [[10, 1, 0], [8, 0, 5]])


def test_is_rigid_rejects() -> None:
    good = compose(rotation_from_vector([0.3, 0.2, 0.1]), [1, 2, 3])
    assert is_rigid(good)
    scaled, mirrored, nan, last_row = good.copy(), good.copy(), good.copy(), good.copy()
    scaled[:3, :3] *= 1.01
    mirrored[:3, 0] *= -1
    nan[0, 3] = np.nan
    last_row[3, 0] = 0.1
    for bad in (scaled, mirrored, nan, last_row, np.eye(3), np.zeros((4, 4))):
        assert not is_rigid(bad)


@given(rotations, st.floats(0.1, 10))
def test_nearest_rotation(R: np.ndarray, scale: float) -> None:
    assert np.allclose(nearest_rotation(scale * R), R, atol=1e-9)
    improper = nearest_rotation(np.diag([1.0, 1.0, -0.1]))
    assert np.linalg.det(improper) == pytest.approx(1)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: np.ndarray, b: np.ndarray) -> None:
    assert np.allclose(skew(a) @ b, np.cross(a, b), atol=1e-9)
    assert np.allclose(skew(np.stack([a, b]))[1], skew(b))


def test_mean_rotation_ignores_the_signs_of_quaternions() -> None:
    # half a turn apart in sign, 2 degrees apart as rotations: a plain mean of q would vanish
    near_pi = [rotation_from_vector([0, 0, np.radians(a)]) for a in (179.0, 181.0)]
    mean = mean_rotation(near_pi)
    assert rotation_angle_deg(mean.T @ rotation_from_vector([0, 0, np.pi])) < 1e-6


def test_mean_rotation_weighs() -> None:
    R = [rotation_from_vector([0, 0, a]) for a in (0.0, 0.2)]
    angle = np.radians(rotation_angle_deg(mean_rotation(R, [3.0, 1.0])))
    assert angle == pytest.approx(0.05, abs=2e-3)
    assert rotation_angle_deg(mean_rotation(R, [1.0, 0.0])) < 1e-9


@given(transforms(), transforms(), transforms())
def test_pose_error(A: np.ndarray, B: np.ndarray, frame: np.ndarray) -> None:
    angle, distance = pose_error(A, B)
    assert 0 <= angle <= 180 + 1e-9
    assert pose_error(A, A)[1] == 0 and pose_error(A, A)[0] < 1e-5
    assert np.allclose(pose_error(B, A), (angle, distance), atol=1e-5)
    # the same poses seen from another frame are as far apart
    assert np.allclose(pose_error(frame @ A, frame @ B), (angle, distance), atol=1e-5)


def test_pose_error_known_values() -> None:
    true = compose(np.eye(3), [1, 2, 3])
    estimate = compose(rotation_from_vector([0, np.radians(30), 0]), [1, 2, 7])
    assert np.allclose(pose_error(estimate, true), (30, 4))
    # the distance is between camera positions: a mirrored translation is no small error
    assert pose_error(compose(np.eye(3), [-1, -2, -3]), true)[1] == pytest.approx(2 * np.sqrt(14))


@given(similarities(), similarities(), vectors)
def test_similarities_form_a_group(A: Sim3, B: Sim3, p: np.ndarray) -> None:
    tolerance = 1e-7 * max(1, A.scale, 1 / A.scale) * max(1, B.scale)
    assert np.allclose(A.matrix() @ A.inverse().matrix(), np.eye(4), atol=tolerance)
    assert np.allclose(A.inverse().points(A.points(p[None])), p[None], atol=tolerance)
    AB = Sim3.from_matrix(A.matrix() @ B.matrix())
    assert AB.scale == pytest.approx(A.scale * B.scale)
    assert np.allclose(AB.points(p[None]), A.points(B.points(p[None])), atol=tolerance)


@given(similarities(), transforms(), vectors)
def test_similarity_of_a_camera(S: Sim3, T_b_cam: np.ndarray, p_cam: np.ndarray) -> None:
    T_a_cam = S.camera(T_b_cam)
    assert is_rigid(T_a_cam)
    # a point the camera sees at p_cam is seen in the same direction, scaled
    in_a = S.points(transform_points(T_b_cam, p_cam[None]))
    assert np.allclose(transform_points(T_a_cam, S.scale * p_cam[None]), in_a, atol=1e-6)
    assert np.allclose(S.inverse().camera(T_a_cam), T_b_cam, atol=1e-6)


def test_identity_similarity() -> None:
    assert np.array_equal(Sim3.identity().matrix(), np.eye(4))


@pytest.mark.parametrize("case", ["shear", "mirror", "nan", "shape", "last row", "bottom", "zero"])
def test_from_matrix_refuses_what_is_no_similarity(case: str) -> None:
    M = Sim3(2.0, rotation_from_vector([0.1, 0.2, 0.3]), np.ones(3)).matrix()
    if case == "shear":
        M[0, 1] += 0.1
    elif case == "mirror":
        M[:3, 0] *= -1
    elif case == "nan":
        M[1, 3] = np.nan
    elif case == "shape":
        M = M[:3]
    elif case == "last row":
        M[3, 0] = 0.5
    elif case == "bottom":
        M[3, 3] = 2
    else:
        M[:3, :3] = 0
    with pytest.raises(ValueError, match="similarity"):
        Sim3.from_matrix(M)
