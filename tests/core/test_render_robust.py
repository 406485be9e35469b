"""The renderer on scenes that no trained map looks like, but that a broken one might."""

from __future__ import annotations

import multiprocessing
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError
from igaussian_core.render import Rasterizer, Render, available_simd
from igaussian_core.render.reference import render_reference

ALL_OUTPUTS = ("rgb", "depth", "alpha", "median_depth", "ids")
NEAR = 0.01
EVERY_SIMD = pytest.mark.parametrize("simd", available_simd())

# camera-frame depths around the near plane, behind, and far
depths = st.sampled_from([-1.0, 0.0, NEAR * 0.999, NEAR, NEAR * 1.001, 0.05, 0.5, 2.0, 50.0, 1e4])
sizes = st.sampled_from([0.0, 1e-7, 1e-3, 0.05, 1.0, 30.0, 1e4])
offsets = st.sampled_from([-1e3, -2.0, -0.3, 0.0, 0.1, 1.0, 40.0])
opacities = st.sampled_from([0.0, 1 / 256, 1 / 254, 0.3, 0.98, 0.995, 1.0])
quaternions = st.sampled_from([(1, 0, 0, 0), (0, 0, 0, 0), (0.5, -3, 0.2, 1), (1e-9, 1e-9, 0, 0)])
colours = st.sampled_from([-1e4, -2.0, 0.0, 1.0, 1e5])

gaussian = st.tuples(
    st.tuples(offsets, offsets, depths),
    quaternions,
    st.tuples(sizes, sizes, sizes),
    opacities,
    st.lists(colours, min_size=12, max_size=12),
)
cameras = st.builds(
    Camera,
    width=st.integers(1, 70),
    height=st.integers(1, 70),
    fx=st.sampled_from([3.0, 60.0, 900.0]),
    fy=st.sampled_from([5.0, 61.0]),
    cx=st.sampled_from([-20.0, 15.5, 33.0]),
    cy=st.sampled_from([0.0, 16.0, 90.0]),
)


def arrays(gaussians: list[tuple]) -> list[np.ndarray]:
    columns = list(zip(*gaussians, strict=True)) if gaussians else [(), (), (), (), ()]
    shapes = [(-1, 3), (-1, 4), (-1, 3), (-1,), (-1, 4, 3)]
    return [
        np.array(column, np.float32).reshape(shape if gaussians else (0, *shape[1:]))
        for column, shape in zip(columns, shapes, strict=True)
    ]


@EVERY_SIMD
@settings(max_examples=150, deadline=None)
@given(st.lists(gaussian, max_size=40), cameras, st.booleans())
def test_any_gaussians_give_finite_images(
    simd: str, gaussians: list[tuple], camera: Camera, antialiased: bool
) -> None:
    rasterizer = Rasterizer(*arrays(gaussians), antialiased=antialiased, simd=simd)
    render = rasterizer.render(camera, np.eye(4), near=NEAR, outputs=ALL_OUTPUTS, threads=1)
    for image in render:
        assert np.isfinite(image).all()
    assert render.alpha.min() >= 0 and render.alpha.max() <= 1
    assert render.rgb.min() >= 0
    assert ((render.depth > 0) == (render.alpha > 0)).all()
    assert ((render.ids >= 0) == (render.alpha > 0)).all()
    drawn = render.depth[render.alpha > 0]
    assert (drawn > NEAR * 0.99).all()
    for ids in render.ids[render.ids >= 0]:
        assert gaussians[ids][3] >= 1 / 255


placed = st.tuples(
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(0.05, 6)),
    st.tuples(*[st.floats(-1, 1)] * 4),
    st.tuples(*[st.floats(0.001, 0.6)] * 3),
    st.floats(0, 1),
    st.lists(st.floats(-2, 2), min_size=12, max_size=12),
)


@EVERY_SIMD
@settings(max_examples=60, deadline=None)
@given(st.lists(placed, min_size=1, max_size=30), st.integers(1, 45), st.integers(1, 45))
def test_any_sensible_gaussians_agree_with_the_oracle(
    simd: str, gaussians: list[tuple], width: int, height: int
) -> None:
    camera = Camera(width, height, 30.0, 33.0, width * 0.4, height * 0.6)
    scene = arrays(gaussians)
    # of equally deep ones either may come first
    scene[0][:, 2] += 1e-4 * np.arange(len(gaussians), dtype=np.float32)
    render = Rasterizer(*scene, simd=simd).render(camera, np.eye(4), threads=1)
    tensors = [torch.tensor(a, dtype=torch.float64) for a in scene]
    truth = render_reference(*tensors, camera, torch.eye(4, dtype=torch.float64))
    error = np.abs(render.alpha - truth.alpha.numpy())
    # where alpha comes to just 1/255, or the transmittance to just 1e-4, rounding decides
    assert (error > 2e-3).mean() <= 0.01 + 1.01 / error.size
    assert error.max() < 0.0101
    colour_error = np.abs(render.rgb - truth.rgb.numpy())
    assert np.quantile(colour_error, 0.98) < 4e-3 + 2e-3 * float(truth.rgb.max())


@EVERY_SIMD
def test_gaussians_behind_or_on_the_camera_plane_are_not_drawn(simd: str) -> None:
    camera = Camera(32, 32, 30, 30, 15.5, 15.5)
    behind = [((0.0, 0.0, z), (1, 0, 0, 0), (0.5,) * 3, 1.0, [1.0] * 12) for z in (-3, 0, NEAR)]
    alpha = Rasterizer(*arrays(behind), simd=simd).render(camera, np.eye(4), near=NEAR).alpha
    assert not alpha.any()
    front = [((0.0, 0.0, 1.01 * NEAR), (1, 0, 0, 0), (0.5,) * 3, 1.0, [1.0] * 12)]
    alpha = Rasterizer(*arrays(front), simd=simd).render(camera, np.eye(4), near=NEAR).alpha
    assert alpha.min() == pytest.approx(0.99)


@EVERY_SIMD
def test_a_camera_inside_a_wall_sees_what_the_oracle_sees(simd: str) -> None:
    rng = np.random.default_rng(0)
    count = 3000
    means = rng.uniform(-1, 1, (count, 3)) * [1, 1, 0.1]
    scene = [
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.04),
        rng.uniform(0.2, 1, count),
        rng.normal(0, 0.3, (count, 4, 3)),
    ]
    scene = [a.astype(np.float32) for a in scene]
    camera = Camera(80, 60, 60, 60, 40, 30)
    render = Rasterizer(*scene, simd=simd).render(camera, np.eye(4))
    tensors = [torch.tensor(a, dtype=torch.float64) for a in scene]
    truth = render_reference(*tensors, camera, torch.eye(4, dtype=torch.float64))
    assert truth.alpha.mean() > 0.3
    error = np.abs(render.rgb - truth.rgb.numpy())
    assert np.quantile(error, 0.999) < 2e-3 and error.max() < 0.02


def test_large_images_and_narrow_ones() -> None:
    scene = arrays([((0.0, 0.0, 2.0), (1, 0, 0, 0), (0.01,) * 3, 1.0, [0.0] * 12)])
    rasterizer = Rasterizer(*scene)
    for width, height in ((1, 1), (1, 300), (5000, 3), (3001, 2003)):
        camera = Camera(width, height, 500, 500, (width - 1) / 2, (height - 1) / 2)
        alpha = rasterizer.render(camera, np.eye(4), outputs=("alpha",)).alpha
        assert alpha[height // 2, width // 2] > 0.9
    with pytest.raises(CameraError, match="larger"):
        rasterizer.render(Camera(40000, 2, 500, 500, 0, 0), np.eye(4))


def test_a_batch_is_the_same_as_view_by_view() -> None:
    rng = np.random.default_rng(0)
    scene = arrays(
        [
            (tuple(rng.uniform(-1, 1, 3) + [0, 0, 3]), (1, 0, 0, 0), (0.1,) * 3, 0.7, [0.5] * 12)
            for _ in range(200)
        ]
    )
    rasterizer = Rasterizer(*scene)
    camera = Camera(40, 30, 30, 30, 20, 15)
    poses = np.tile(np.eye(4), (7, 1, 1))
    poses[:, 0, 3] = np.linspace(-0.5, 0.5, 7)
    batch = rasterizer.render_batch(camera, poses, outputs=ALL_OUTPUTS, threads=3)
    assert batch.rgb.shape == (7, 30, 40, 3)
    for i, pose in enumerate(poses):
        one = rasterizer.render(camera, pose, outputs=ALL_OUTPUTS)
        for name in ALL_OUTPUTS:
            np.testing.assert_array_equal(getattr(batch, name)[i], getattr(one, name))
    assert rasterizer.render_batch(camera, poses[:0]).rgb.shape == (0, 30, 40, 3)
    with pytest.raises(CameraError, match="B, 4, 4"):
        rasterizer.render_batch(camera, np.eye(4))


def _render_in_child(rasterizer: Rasterizer, camera: Camera, queue: object) -> None:
    queue.put(rasterizer.render(camera, np.eye(4), threads=2).alpha)  # type: ignore[attr-defined]


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_renders_though_the_threads_stayed_behind() -> None:
    rasterizer = Rasterizer(
        *arrays([((0.0, 0.0, 2.0), (1, 0, 0, 0), (0.2,) * 3, 1.0, [0.0] * 12)])
    )
    camera = Camera(64, 64, 50, 50, 32, 32)
    here = rasterizer.render(camera, np.eye(4), threads=2).alpha
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_render_in_child, args=(rasterizer, camera, queue))
    child.start()
    there = queue.get(timeout=30)
    child.join(30)
    assert child.exitcode == 0
    np.testing.assert_array_equal(here, there)


def test_render_is_a_named_tuple_in_the_documented_order() -> None:
    assert Render._fields == ALL_OUTPUTS


def run_script(name: str, *arguments: str) -> str:
    """Output of a script beside this file; status 77 skips the test with its reason."""
    script = Path(__file__).with_name(name)
    result = subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, timeout=600
    )
    if result.returncode == 77:
        pytest.skip(result.stdout.strip())
    assert result.returncode == 0, result.stdout[-1000:] + result.stderr[-3000:]
    return result.stdout


def test_no_invalid_memory_access_under_the_address_sanitizer(tmp_path: Path) -> None:
    if shutil.which("g++") is None:
        pytest.skip("no g++ to build the instrumented renderer with")
    assert "nothing found" in run_script("render_sanitizer.py", str(tmp_path))


def test_an_aarch64_build_renders_the_same() -> None:
    assert "rgb" in run_script("render_cross_check.py")
