"""Rendered depth to 3D points, and which pixels are trusted."""

from __future__ import annotations

import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.lifting import at_pixels, sample, trusted_depth, unproject

CAMERA = Camera(64, 48, 50.0, 52.0, 30.3, 24.1)


def test_unproject_undoes_project() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(-1, 1, 50), rng.uniform(-1, 1, 50), rng.uniform(1, 9, 50)], 1)
    uv = CAMERA.project(points)
    assert np.allclose(unproject(CAMERA, uv, points[:, 2]), points, atol=1e-9)


def test_unproject_takes_z_not_distance() -> None:
    (point,) = unproject(CAMERA, np.array([[80.3, 24.1]], np.float32), np.array([2.0], np.float32))
    assert np.allclose(point, [2.0, 0.0, 2.0], atol=1e-5)


def test_sample_is_bilinear_about_pixel_centres() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    uv = np.array([[1, 2], [0.5, 0], [0, 0.5], [2.25, 1.75], [-3, 0], [9, 9]], np.float32)
    assert np.allclose(sample(image, uv), [9, 0.5, 2, 9.25, 0, 11], atol=0.15)
    assert sample(image, uv[:4])[:3].tolist() == [9, 0.5, 2]
    assert sample(image, np.zeros((0, 2), np.float32)).shape == (0,)


def test_at_pixels_takes_the_nearest() -> None:
    mask = np.zeros((3, 4), bool)
    mask[1, 2] = True
    uv = np.array([[2, 1], [2.4, 0.6], [2.6, 1], [2, 1.6], [-5, 0], [9, 9]], np.float32)
    assert at_pixels(mask, uv).tolist() == [True, True, False, False, False, False]


def two_surfaces() -> tuple[np.ndarray, np.ndarray]:
    """Depth 1 on the left, 2 from column 20 on; opaque up to column 40."""
    depth = np.full((30, 50), 2.0, np.float32)
    depth[:, :20] = 1.0
    alpha = np.ones((30, 50), np.float32)
    alpha[:, 40:], depth[:, 40:] = 0.0, 0.0
    return depth, alpha


def test_depth_edges_and_clear_pixels_are_not_trusted() -> None:
    mask = trusted_depth(*two_surfaces(), min_alpha=0.8, max_step=0.1)
    expected = np.zeros(50, bool)
    expected[:18] = expected[22:38] = True  # two pixels beside each edge are left out
    assert (mask == expected).all()


def test_a_slope_is_trusted_as_far_as_it_is_gentle() -> None:
    alpha = np.ones((20, 20), np.float32)
    columns = np.arange(20, dtype=np.float32)
    gentle = np.tile(5 + 0.1 * columns, (20, 1)).astype(np.float32)  # 0.4 of 5 to 7 in 5 pixels
    steep = np.tile(5 + 0.4 * columns, (20, 1)).astype(np.float32)
    assert trusted_depth(gentle, alpha, 0.8, 0.1)[5:15, 5:15].all()
    assert not trusted_depth(steep, alpha, 0.8, 0.1)[5:15, 5:15].any()


@pytest.mark.parametrize(("alpha", "trusted"), [(0.79, False), (0.81, True)])
def test_alpha_threshold(alpha: float, trusted: bool) -> None:
    depth = np.full((9, 9), 3.0, np.float32)
    mask = trusted_depth(depth, np.full((9, 9), alpha, np.float32), 0.8, 0.1)
    assert mask[4, 4] == trusted


def test_depth_of_nothing_is_not_trusted() -> None:
    zero = np.zeros((9, 9), np.float32)
    assert not trusted_depth(zero, np.ones((9, 9), np.float32), 0.8, 0.1).any()
