from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError, IGaussianError, MapError
from igaussian_core.render import Rasterizer, available_simd
from igaussian_core.render.reference import ReferenceRender, render_reference

ALL_OUTPUTS = ("rgb", "depth", "alpha", "median_depth", "ids")
CAMERA = Camera(150, 101, 120.0, 125.0, 70.3, 49.1)  # no multiple of a tile, centre off the middle
EVERY_SIMD = pytest.mark.parametrize("simd", available_simd())

Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def random_gaussians(seed: int, count: int = 2000, sh_count: int = 16) -> Arrays:
    rng = np.random.default_rng(seed)
    means = rng.uniform(-2, 2, (count, 3)) + [0, 0, 3]
    quats = rng.normal(size=(count, 4))
    scales = np.exp(rng.normal(-3, 1, (count, 3)))
    opacities = rng.uniform(0, 1, count)
    sh = rng.normal(size=(count, sh_count, 3)) * 0.3
    return tuple(a.astype(np.float32) for a in (means, quats, scales, opacities, sh))  # type: ignore[return-value]


def one_gaussian(
    mean: tuple[float, float, float], scale: float = 0.01, opacity: float = 0.9
) -> Arrays:
    return (
        np.array([mean], np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), scale, np.float32),
        np.array([opacity], np.float32),
        np.full((1, 1, 3), 0.3, np.float32),
    )


def some_pose() -> np.ndarray:
    """A rotated, shifted camera that still sees most of random_gaussians."""
    T = np.eye(4)
    angle = 0.2
    T[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    T[:3, 3] = [-0.3, 0.1, 0.2]
    return T


def oracle(gaussians: Arrays, camera: Camera, T: np.ndarray, **options: Any) -> ReferenceRender:
    tensors = [torch.tensor(a, dtype=torch.float64) for a in gaussians]
    result = render_reference(*tensors, camera, torch.tensor(T), **options)
    return ReferenceRender(*(part.numpy() for part in result))


@EVERY_SIMD
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_count", [1, 4, 9, 16])
def test_render_agrees_with_the_oracle(simd: str, antialiased: bool, sh_count: int) -> None:
    gaussians = random_gaussians(sh_count, sh_count=sh_count)
    background = (0.2, 0.4, 0.6)
    truth = oracle(
        gaussians, CAMERA, some_pose(), background=background, antialiased=antialiased
    )
    rasterizer = Rasterizer(*gaussians, antialiased=antialiased, simd=simd)
    render = rasterizer.render(CAMERA, some_pose(), background=background, outputs=ALL_OUTPUTS)
    error = np.abs(render.rgb - truth.rgb)
    assert truth.alpha.mean() > 0.3
    assert error.max() < 2e-3
    assert np.quantile(error, 0.99) < 3e-4
    assert np.abs(render.alpha - truth.alpha).max() < 2e-3
    solid = truth.alpha > 0.5
    assert (np.abs(render.depth - truth.depth)[solid] / truth.depth[solid]).max() < 1e-3
    # two Gaussians of nearly equal weight, or alpha at one half, may fall either way
    assert (render.ids != truth.ids).mean() < 1e-3
    assert (np.abs(render.median_depth - truth.median_depth) > 1e-4).mean() < 1e-3


@EVERY_SIMD
def test_one_gaussian_lies_where_the_camera_projects_it(simd: str) -> None:
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    mean = (10 * 2 / 60, -5 * 2 / 60, 2.0)  # projects to (41.5, 18.5)
    assert camera.project(np.array([mean]))[0] == pytest.approx([41.5, 18.5])
    alpha = Rasterizer(*one_gaussian(mean, 0.05), simd=simd).render(camera, np.eye(4)).alpha
    y, x = np.mgrid[:48, :64]
    centre = (alpha * x).sum() / alpha.sum(), (alpha * y).sum() / alpha.sum()
    assert centre == pytest.approx((41.5, 18.5), abs=1e-3)
    # between four pixel centres: those opposite are the same
    assert alpha[18, 41] == pytest.approx(alpha[19, 42], abs=1e-5)
    assert alpha[18, 42] == pytest.approx(alpha[19, 41], abs=1e-5)


@EVERY_SIMD
def test_the_pixel_at_the_principal_point_sees_the_full_opacity(simd: str) -> None:
    camera = Camera(33, 33, 50.0, 50.0, 16.0, 16.0)
    gaussians = one_gaussian((0, 0, 3), opacity=0.75)
    render = Rasterizer(*gaussians, simd=simd).render(camera, np.eye(4))
    colour = 0.5 + 0.3 * 0.28209479
    assert render.alpha[16, 16] == pytest.approx(0.75, abs=1e-4)
    assert render.depth[16, 16] == pytest.approx(3, rel=1e-6)
    assert render.rgb[16, 16] == pytest.approx(0.75 * colour, abs=1e-4)
    assert render.alpha[0, 0] == render.depth[0, 0] == 0


@EVERY_SIMD
@pytest.mark.parametrize("side", [1, -1])
def test_depths_that_float32_cannot_tell_apart_are_sorted(simd: str, side: int) -> None:
    x = 1e-7 * side
    first, second = one_gaussian((0, 0, 3), 0.2), one_gaussian((x, 0, 3), 0.2)
    gaussians = tuple(np.concatenate(pair) for pair in zip(first, second, strict=True))
    gaussians[4][1] = -1.0  # dark
    T = np.eye(4)
    angle = 0.05
    T[:3, :3] = [
        [np.cos(angle), 0, np.sin(angle)],
        [0, 1, 0],
        [-np.sin(angle), 0, np.cos(angle)],
    ]
    depths = gaussians[0].astype(np.float64) @ T[2, :3]
    assert np.float32(depths[0]) == np.float32(depths[1]) and depths[0] != depths[1]
    truth = oracle(gaussians, CAMERA, T)  # type: ignore[arg-type]
    render = Rasterizer(*gaussians, simd=simd).render(CAMERA, T)
    assert np.abs(render.rgb - truth.rgb).max() < 1e-3


def test_the_result_does_not_depend_on_threads_nor_on_the_frame_before() -> None:
    rasterizer = Rasterizer(*random_gaussians(1))
    first = rasterizer.render(CAMERA, some_pose(), threads=1, outputs=ALL_OUTPUTS)
    rasterizer.render(Camera(300, 200, 100, 100, 150, 100), np.eye(4), threads=3)
    for threads in (1, 2, 5):
        again = rasterizer.render(CAMERA, some_pose(), threads=threads, outputs=ALL_OUTPUTS)
        for one, other in zip(first, again, strict=True):
            np.testing.assert_array_equal(one, other)


def test_only_the_outputs_asked_for_are_made() -> None:
    rasterizer = Rasterizer(*random_gaussians(1, 100))
    assert rasterizer.render(CAMERA, np.eye(4)).median_depth is None
    render = rasterizer.render(CAMERA, np.eye(4), outputs=("depth",))
    assert render.rgb is None and render.alpha is None and render.depth.shape == (101, 150)
    with pytest.raises(IGaussianError, match="normals"):
        rasterizer.render(CAMERA, np.eye(4), outputs=("normals",))


def test_an_empty_map_shows_the_background() -> None:
    empty = [a[:0] for a in random_gaussians(0, 1)]
    render = Rasterizer(*empty).render(CAMERA, np.eye(4), background=(0.1, 0.2, 0.3))
    assert render.rgb.shape == (101, 150, 3)
    np.testing.assert_allclose(render.rgb, np.broadcast_to([0.1, 0.2, 0.3], (101, 150, 3)))
    assert not render.alpha.any() and not render.depth.any()


def test_a_distorted_camera_is_refused() -> None:
    camera = Camera(64, 48, 60, 60, 31, 23, "plumb_bob", (0.1, 0, 0, 0))
    with pytest.raises(CameraError, match="undistorted"):
        Rasterizer(*random_gaussians(0, 10)).render(camera, np.eye(4))


def test_a_near_plane_behind_the_camera_is_refused() -> None:
    with pytest.raises(CameraError, match="near is 0"):
        Rasterizer(*random_gaussians(0, 10)).render(CAMERA, np.eye(4), near=0.0)


@pytest.mark.parametrize(
    "T", [np.eye(3), np.diag([2.0, 2, 2, 1]), np.diag([-1.0, 1, 1, 1]), np.full((4, 4), np.nan)]
)
def test_a_transform_that_is_not_rigid_is_refused(T: np.ndarray) -> None:
    with pytest.raises(CameraError, match="T_cam_scene") as caught:
        Rasterizer(*random_gaussians(0, 10)).render(CAMERA, T)
    assert "\n" not in str(caught.value)


def test_arrays_that_do_not_fit_are_refused() -> None:
    means, quats, scales, opacities, sh = random_gaussians(0, 10)
    with pytest.raises(MapError, match="quats_wxyz"):
        Rasterizer(means, quats[:9], scales, opacities, sh)
    with pytest.raises(MapError, match="K in 1, 4, 9, 16"):
        Rasterizer(means, quats, scales, opacities, sh[:, :5])
    with pytest.raises(MapError, match="logits"):
        Rasterizer(means, quats, scales, opacities * 3, sh)
    means = means.copy()
    means[0, 0] = np.nan
    with pytest.raises(MapError, match="1 values of means"):
        Rasterizer(means, quats, scales, opacities, sh)


def test_an_unknown_instruction_set_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IGAUSSIAN_SIMD", "mmx")
    with pytest.raises(IGaussianError, match="IGAUSSIAN_SIMD=mmx.*portable"):
        Rasterizer(*random_gaussians(0, 10))
    monkeypatch.setenv("IGAUSSIAN_SIMD", "portable")
    assert Rasterizer(*random_gaussians(0, 10)).simd == "portable"
