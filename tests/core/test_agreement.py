"""Whether an image shows what a render shows around matched points."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from test_alignment import moved, texture

from igaussian_core.camera import Camera
from igaussian_core.contrast import normalize_contrast
from igaussian_core.geometry import compose, inverse, rotation_from_vector, transform_points
from igaussian_core.refine.agreement import (
    agreement,
    plane_homography,
    seen_through,
    sharpness,
)

KNOWN = np.ones((240, 320), bool)
GRID = np.stack(np.meshgrid(np.arange(12, 320, 24), np.arange(12, 240, 24)), -1).reshape(-1, 2)
UV = GRID.astype(np.float32)


def grey(image: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def both(image: np.ndarray, render: np.ndarray, uv: np.ndarray = UV) -> tuple[float, float]:
    """Agreement and sharpness."""
    a, b = normalize_contrast(image), normalize_contrast(render)
    return agreement(grey(image), grey(render), KNOWN, uv), sharpness(a, b, KNOWN, uv)


def test_an_image_agrees_with_itself() -> None:
    alike, sharp = both(texture(), texture())
    assert alike == pytest.approx(1, abs=1e-5) and sharp == pytest.approx(1, abs=1e-5)


def test_exposure_and_noise_do_not_matter() -> None:
    noise = np.random.default_rng(0).normal(0, 3, (240, 320, 3))
    image = np.clip(0.5 * texture() + 30 + noise, 0, 255).astype(np.uint8)
    alike, sharp = both(image, texture())
    assert alike > 0.97 and 0.8 < sharp < 1.1


def test_another_place_does_not_agree() -> None:
    for other in (texture(1), texture()[:, ::-1]):
        alike, _ = both(np.ascontiguousarray(other), texture())
        assert abs(alike) < 0.3


def test_a_pixel_off_is_no_disagreement() -> None:
    assert both(moved(texture(), 0.8, -0.6), texture())[0] > 0.85


def test_what_covers_the_view_says_nothing() -> None:
    """Cells without matched points are not looked at."""
    image = texture()
    image[:, :170] = texture(5)[:, :170]
    free = UV[UV[:, 0] > 192]
    assert both(image, texture(), free)[0] > 0.99
    assert both(image, texture())[0] < 0.7


def test_blur_takes_sharpness_first() -> None:
    values = []
    for sigma in (1, 2, 4, 8):
        image = np.asarray(cv2.GaussianBlur(texture(), (0, 0), sigma), np.uint8)
        values.append(both(image, texture())[1])
    assert values == sorted(values, reverse=True)
    assert values[0] > 0.6 and values[-1] < 0.1
    noise = np.random.default_rng(0).normal(0, 8, (240, 320, 3))
    noisy = np.clip(cv2.GaussianBlur(texture(), (0, 0), 8) + noise, 0, 255).astype(np.uint8)
    assert both(noisy, texture())[1] < 0.15  # noise is no detail of the scene


def test_too_little_to_compare() -> None:
    flat = np.full((240, 320, 3), 90, np.uint8)
    assert np.isnan(both(texture(), flat)[0])
    assert np.isnan(both(flat, texture())[0])
    nothing = both(texture(), texture(), np.zeros((0, 2), np.float32))
    assert np.isnan(nothing).all()
    unknown = np.zeros((240, 320), bool)
    assert np.isnan(agreement(grey(texture()), grey(texture()), unknown, UV))
    tiny = np.zeros((9, 12), np.uint8)
    assert np.isnan(agreement(tiny, tiny, tiny > 0, UV))
    assert np.isnan(sharpness(tiny, tiny, tiny > 0, UV))
    outside = both(texture(), texture(), UV + np.float32([1e4, -1e4]))
    assert np.isnan(outside).all()


@pytest.mark.parametrize("size", [(241, 323), (480, 640), (97, 130)])
def test_sizes_that_are_no_multiple_of_a_cell(size: tuple[int, int]) -> None:
    image = np.asarray(cv2.resize(texture(), size[::-1], interpolation=cv2.INTER_CUBIC), np.uint8)
    grid = np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), -1).reshape(-1, 2)
    gray, known = normalize_contrast(image), np.ones(size, bool)
    uv = grid.astype(np.float32)
    assert agreement(grey(image), grey(image), known, uv) == pytest.approx(1, abs=1e-5)
    assert sharpness(gray, gray, known, uv) == pytest.approx(1, abs=1e-5)


CAMERA = Camera(320, 240, 300.0, 290.0, 158.0, 121.0)


def test_a_homography_takes_the_plane_s_pixels_to_the_image() -> None:
    turn = rotation_from_vector([0.01, -0.02, 0.03])
    T_image_render = compose(turn, np.array([0.02, -0.01, 0.03]))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.8, 0.8, (30, 2)), np.full(30, 2.5)])
    H = plane_homography(CAMERA, T_image_render, 2.5)
    expected = CAMERA.project(transform_points(T_image_render, points))
    seen = cv2.perspectiveTransform(CAMERA.project(points)[None].astype(np.float64), H)[0]
    np.testing.assert_allclose(seen, expected, atol=1e-6)


def test_a_step_undone_is_no_blur() -> None:
    """An image that is three pixels off agrees as it would at the right pose, once shifted."""
    render = texture()
    T_image_render = compose(np.eye(3), np.array([3 * 2.0 / CAMERA.fx, 0, 0]))
    H = plane_homography(CAMERA, T_image_render, 2.0)
    image = cv2.warpPerspective(render, H, (320, 240), borderMode=cv2.BORDER_REPLICATE)
    unshifted, blurred = both(image, render)
    alike, sharp = both(seen_through(H, image), render)
    assert alike > unshifted and alike > 0.99
    assert sharp > 0.8 > blurred
    back = plane_homography(CAMERA, inverse(T_image_render), 2.0)
    np.testing.assert_allclose(H @ back, np.eye(3), atol=1e-9)
