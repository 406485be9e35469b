"""Where source views stand and look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from igaussian_core.geometry import compose, is_rigid, rotation_from_vector
from igaussian_core.views import (
    fibonacci_directions,
    look_at,
    sphere_point,
    spherical_views,
    spread_indices,
    up_rotation,
)

numbers = st.floats(-5, 5)
points = st.tuples(numbers, numbers, numbers).map(np.array)


@given(points, points, points)
def test_look_at_axes(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> None:
    forward = target - position
    assume(np.linalg.norm(forward) > 1e-2 and np.linalg.norm(up) > 1e-2)
    forward, up = forward / np.linalg.norm(forward), up / np.linalg.norm(up)
    assume(np.linalg.norm(np.cross(forward, up)) > 1e-3)
    T = look_at(position, target, up)
    assert is_rigid(T, 1e-9)
    assert np.allclose(T[:3, 3], position)
    assert np.allclose(T[:3, 2], forward)  # z looks at the target
    assert abs(T[:3, 0] @ up) < 1e-6  # x is level
    assert T[:3, 1] @ up < 0  # y points down


def test_look_at_known() -> None:
    T = look_at([0, -2, 0], [0, 3, 0])
    assert np.allclose(T[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.mark.parametrize("height", [3.0, -3.0])
def test_look_at_from_a_pole(height: float) -> None:
    T = look_at([1, 2, height], [1, 2, 0])
    assert is_rigid(T, 1e-9)
    assert np.allclose(T[:3, 2], [0, 0, -np.sign(height)])


def test_sphere_point() -> None:
    assert np.allclose(sphere_point(2, 0, 0), [2, 0, 0])
    assert np.allclose(sphere_point(2, 0, 90), [0, 2, 0])
    assert np.allclose(sphere_point(2, 90, 77), [0, 0, 2])
    assert sphere_point(1, 30, 10)[2] == pytest.approx(0.5)


@pytest.mark.parametrize(
    "up", [[0, 0, 1], [0, 0, -1], [0, -1, 0], [0, 1, 0], [1, 0, 0], [1, 2, -3], [0, 0, 5]]
)
def test_up_rotation(up: list[float]) -> None:
    R = up_rotation(up)
    assert is_rigid(compose(R, [0, 0, 0]), 1e-9)
    assert np.allclose(R @ [0, 0, 1], np.array(up) / np.linalg.norm(up))


@pytest.mark.parametrize("kind", ["object", "scene"])
@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 1.0, 1.0)])
def test_the_papers_sixteen_views(kind: str, up: tuple[float, float, float]) -> None:
    centre = np.array([1.0, -2.0, 0.5])
    T = spherical_views(kind, 3.0, centre, up)
    assert T.shape == (16, 4, 4)
    offsets = T[:, :3, 3] - centre
    assert np.allclose(np.linalg.norm(offsets, axis=1), 3.0)
    gaps = np.linalg.norm(offsets[:, None] - offsets[None], axis=2) + 10 * np.eye(16)
    assert gaps.min() > 1.0  # sixteen distinct positions, not eight twice
    outward = np.einsum("ni,ni->n", T[:, :3, 2], offsets / 3.0)
    assert np.allclose(outward, -1 if kind == "object" else 1)
    axis = np.array(up) / np.linalg.norm(up)
    elevations = np.degrees(np.arcsin(offsets @ axis / 3.0))
    assert np.allclose(np.sort(elevations), np.repeat([-60, -30, 30, 60], 4))
    assert (T[:, :3, 1] @ axis < 0).all()  # no view is upside down
    assert all(is_rigid(t, 1e-9) for t in T)


def test_views_at_the_poles() -> None:
    T = spherical_views("object", 1.0, elevations_deg=(-90.0, 90.0), azimuths_deg=(0.0, 90.0))
    assert all(is_rigid(t, 1e-9) for t in T)
    assert np.allclose(T[0, :3, 2], [0, 0, 1]) and np.allclose(T[-1, :3, 2], [0, 0, -1])


@pytest.mark.parametrize("count", [1, 2, 48, 500])
def test_fibonacci_directions_are_even(count: int) -> None:
    d = fibonacci_directions(count)
    assert d.shape == (count, 3)
    assert np.allclose(np.linalg.norm(d, axis=1), 1)
    if count >= 48:
        assert np.linalg.norm(d.mean(axis=0)) < 2 / count
        cosine = d @ d.T - 2 * np.eye(count)
        nearest = np.arccos(np.clip(cosine.max(axis=1), -1, 1))
        ideal = np.sqrt(4 * np.pi / count)  # side of each point's share of the sphere
        assert nearest.min() > 0.6 * ideal and nearest.max() < 1.2 * ideal


def test_fibonacci_zone() -> None:
    z = fibonacci_directions(64, lowest=-0.2, highest=0.9)[:, 2]
    assert z.min() > -0.2 and z.max() < 0.9
    assert np.allclose(np.diff(np.sort(z)), 1.1 / 64)


def test_spread_takes_all_where_few() -> None:
    T = np.stack([np.eye(4)] * 3)
    assert spread_indices(T, 5, 1.0).tolist() == [0, 1, 2]


def test_spread_over_positions() -> None:
    T = np.stack([np.eye(4)] * 101)
    T[:, 0, 3] = np.r_[np.linspace(0, 0.5, 99), 5.0, 10.0]  # a crowd and two loners
    chosen = spread_indices(T, 3, 1.0)
    assert chosen.tolist() == [0, 99, 100]


def test_spread_over_directions() -> None:
    """Cameras that turn on the spot differ too."""
    T = np.stack(
        [compose(rotation_from_vector([0, a, 0]), [0, 0, 0]) for a in np.linspace(0, 3, 61)]
    )
    assert spread_indices(T, 3, 1.0).tolist() == [0, 30, 60]
    T[1, 0, 3] = 0.1
    assert 1 in spread_indices(T, 3, 1e-3)  # a short length: position counts


def test_spread_has_no_duplicates() -> None:
    rng = np.random.default_rng(0)
    T = np.stack(
        [compose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)) for _ in range(80)]
    )
    chosen = spread_indices(T, 20, 0.5)
    assert len(set(chosen.tolist())) == 20 and (np.diff(chosen) > 0).all()
