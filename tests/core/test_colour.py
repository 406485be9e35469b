"""The affine colour fit: known gains, outliers, masks, and images that tell nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from igaussian_core.camera import Camera
from igaussian_core.colour import ColourFit, fit_colour, match_colours
from igaussian_core.errors import ImageError
from igaussian_core.evaluate.overlays import make_pair

GAIN, OFFSET = np.array([1.25, 0.9, 0.65]), np.array([-0.04, 0.05, 0.12])


def picture(seed: int = 0, shape: tuple[int, int] = (90, 120)) -> np.ndarray:
    """Smooth colours in [0.1, 0.7] with some texture."""
    rng = np.random.default_rng(seed)
    coarse = rng.random((6, 8, 3))
    rows = np.linspace(0, 5, shape[0])[:, None].astype(int)
    columns = np.linspace(0, 7, shape[1])[None].astype(int)
    return 0.1 + 0.6 * (0.8 * coarse[rows, columns] + 0.2 * rng.random((*shape, 3)))


def test_known_gains_are_found_exactly() -> None:
    render = picture()
    fit = fit_colour(render * GAIN + OFFSET, render)
    assert np.allclose(fit.gain, GAIN, atol=1e-6)
    assert np.allclose(fit.offset, OFFSET, atol=1e-6)
    assert fit.inliers == 1.0
    assert (fit.residual < 1e-6).all()


@pytest.mark.parametrize("kind", ["random", "white", "dark", "shifted"])
def test_three_of_ten_pixels_may_be_outliers(kind: str) -> None:
    rng = np.random.default_rng(1)
    render = picture()
    image = render * GAIN + OFFSET + rng.normal(0, 0.01, render.shape)
    bad = rng.random(render.shape[:2]) < 0.3
    image[bad] = {
        "random": rng.random((int(bad.sum()), 3)),
        "white": 0.95,
        "dark": 0.05,
        "shifted": image[bad] + 0.3,
    }[kind]
    fit = fit_colour(image, render)
    assert np.allclose(fit.gain, GAIN, atol=0.02)
    assert np.allclose(fit.offset, OFFSET, atol=0.01)
    assert (fit.residual > 0.008).all() and (fit.residual < 0.02).all()
    assert 0.6 < fit.inliers < 0.95
    plain = np.polyfit(render[..., 0].ravel(), image[..., 0].ravel(), 1)
    assert abs(fit.gain[0] - GAIN[0]) < 0.2 * abs(plain[0] - GAIN[0])


def test_bytes_and_floats_give_the_same_fit() -> None:
    render = picture()
    image = np.clip(render * GAIN + OFFSET, 0, 1)
    as_bytes = fit_colour(np.rint(image * 255).astype(np.uint8), render.astype(np.float32))
    assert np.allclose(as_bytes.gain, GAIN, atol=0.01)
    applied = as_bytes.apply(np.rint(render * 255).astype(np.uint8))
    assert applied.dtype == np.float32
    assert np.abs(applied - image).max() < 0.02


def test_the_mask_leaves_pixels_out() -> None:
    render = picture()
    image = render * GAIN + OFFSET
    mask = np.zeros(render.shape[:2], bool)
    mask[:, :40] = True
    image[:, 40:] = 0.5 * render[:, 40:] + 0.2
    fit = fit_colour(image, render, mask)
    assert np.allclose(fit.gain, GAIN, atol=1e-6)
    assert fit.pixels <= 90 * 40


def test_saturated_and_missing_pixels_are_left_out() -> None:
    render = picture()
    image = np.clip(render * 2.5 - 0.3, 0, 1)  # much of it is black or white
    image[0, 0] = np.nan
    fit = fit_colour(image, render)
    assert np.allclose(fit.gain, 2.5, atol=0.01)
    assert np.allclose(fit.offset, -0.3, atol=0.01)


def test_a_flat_render_shifts_and_does_not_scale() -> None:
    rng = np.random.default_rng(2)
    render = np.full((60, 60, 3), 0.4) + rng.normal(0, 0.001, (60, 60, 3))
    fit = fit_colour(render + 0.1 + rng.normal(0, 0.05, render.shape), render)
    assert np.array_equal(fit.gain, np.ones(3))
    assert np.allclose(fit.offset, 0.1, atol=0.01)


def test_gains_stay_within_bounds() -> None:
    render = picture()
    low = fit_colour(0.5 + 0.01 * render, render, max_gain=3.0)
    assert np.allclose(low.gain, 1 / 3)
    inverted = fit_colour(0.9 - render, render)
    assert (inverted.gain == 0.25).all()


def test_too_few_pixels_change_nothing() -> None:
    render = picture()
    fit = fit_colour(render, render, np.zeros(render.shape[:2], bool))
    assert fit.pixels == 0
    assert np.array_equal(fit.apply(render), render.astype(np.float32))
    assert np.array_equal(ColourFit.identity().gain, np.ones(3))


def test_a_fit_of_another_scene_is_not_plausible() -> None:
    render = picture()
    noise = np.random.default_rng(3).normal(0, 0.02, render.shape)
    assert fit_colour(render * GAIN + OFFSET + noise, render).plausible
    assert not fit_colour(picture(1), render).plausible
    assert not fit_colour(0.5 + 0.01 * render, render).plausible  # gain at its bound
    assert not ColourFit.identity().plausible


def test_colours_are_matched_where_that_is_plausible() -> None:
    render = picture()
    image = render * GAIN + OFFSET
    assert np.abs(match_colours(render, image) - image).max() < 1e-3
    unchanged = match_colours(render, picture(1))
    assert unchanged.dtype == np.float32
    np.testing.assert_array_equal(unchanged, render.astype(np.float32))


def test_reports_show_the_map_in_the_exposure_of_the_photo() -> None:
    render = picture().astype(np.float32)
    photo = np.rint((render * 0.6 + 0.05) * 255).astype(np.uint8)
    camera = Camera(render.shape[1], render.shape[0], 100, 100, 60, 45)

    class OneView:
        def render(self, camera: Camera, T_map_cam: np.ndarray) -> tuple[np.ndarray, ...]:
            depth = np.ones(render.shape[:2], np.float32)
            return render, depth, depth

    pair = make_pair(OneView(), photo, camera, np.eye(4))  # type: ignore[arg-type]
    assert np.abs(pair.render.astype(int) - photo).max() <= 2


def test_sizes_that_differ_are_refused() -> None:
    with pytest.raises(ImageError, match="image is"):
        fit_colour(np.zeros((4, 4, 3)), np.zeros((5, 4, 3)))
    with pytest.raises(ImageError, match="mask is"):
        fit_colour(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((3, 4), bool))


@settings(max_examples=25)
@given(
    st.tuples(*[st.floats(0.5, 1.6)] * 3),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    st.integers(0, 1000),
)
def test_any_fit_is_undone(
    gain: tuple[float, ...], offset: tuple[float, ...], seed: int
) -> None:
    render = picture(seed, (40, 50))
    image = render * gain + offset
    inside = (image > 0.02) & (image < 0.98)
    if inside.all(axis=2).sum() < 200:
        return
    fit = fit_colour(image, render)
    assert np.abs(fit.apply(render) - image).max() < 1e-3
