"""Procedural maps: the same by seed, sound as maps, and good to place cameras in."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.geometry import inverse, transform_points
from igaussian_core.procedural import ProceduralMap, make_object, make_room
from igaussian_core.procedural.patches import Assembly
from igaussian_core.procedural.textures import ALL, Canvas, random_palette
from igaussian_core.views import look_at, spherical_views

MAKERS = [make_room, make_object]
SEEDS = (0, 7, 21)
AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1),
        "-z": (0, 0, -1)}  # fmt: skip


@cache
def made(make: Callable[[int], ProceduralMap], seed: int) -> ProceduralMap:
    return make(seed)


@pytest.mark.parametrize("make", MAKERS)
def test_the_same_seed_gives_the_same_map(make: Callable[[int], ProceduralMap]) -> None:
    first, second = make(3), make(3)
    for name in ("means", "quats_wxyz", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(first.gmap, name), getattr(second.gmap, name)), name
    assert np.array_equal(first.centre, second.centre)


@pytest.mark.parametrize("make", MAKERS)
def test_seeds_differ(make: Callable[[int], ProceduralMap]) -> None:
    colours = [made(make, seed).gmap.sh[:, 0].mean(axis=0) for seed in SEEDS]
    counts = {len(made(make, seed).gmap) for seed in SEEDS}
    assert len(counts) == len(SEEDS)
    assert np.ptp(np.array(colours), axis=0).max() > 0.02


@pytest.mark.parametrize("make", MAKERS)
@pytest.mark.parametrize("seed", SEEDS)
def test_what_a_map_holds(make: Callable[[int], ProceduralMap], seed: int) -> None:
    room = made(make, seed)
    gmap = room.gmap
    assert 10_000 <= len(gmap) <= 42_000 and gmap.sh_degree in (0, 1)
    for array in (gmap.means, gmap.quats_wxyz, gmap.scales, gmap.opacities, gmap.sh):
        assert array.dtype == np.float32 and np.isfinite(array).all()
    assert np.allclose(np.linalg.norm(gmap.quats_wxyz, axis=1), 1, atol=1e-5)
    assert (gmap.scales > 0).all() and gmap.opacities.min() > 0 and gmap.opacities.max() < 1
    assert np.allclose(room.up, [0, 0, 1]) and room.kind in ("scene", "object")


@pytest.mark.parametrize("make", MAKERS)
def test_it_is_quick(make: Callable[[int], ProceduralMap]) -> None:
    start = time.process_time()
    make(11)
    assert time.process_time() - start < 6  # usually 1


@pytest.mark.parametrize("seed", SEEDS)
def test_cameras_in_free_space_see_walls_on_all_sides(seed: int) -> None:
    room = made(make_room, seed)
    camera = Camera(48, 48, 40.0, 40.0, 23.5, 23.5)
    places = room.free_positions(np.random.default_rng(seed), 3)
    assert places.shape == (3, 3)
    for place in places:
        for direction in AXES.values():
            _, depth, alpha = room.gmap.render(
                camera, inverse(look_at(place, place + np.array(direction))), threads=1
            )
            assert alpha.mean() > 0.9
            # a Gaussian has its middle's depth everywhere, so a near wall looks nearer than it is
            assert np.percentile(depth, 5) > 0.15


@pytest.mark.parametrize("seed", SEEDS)
def test_free_places_keep_clear_of_everything(seed: int) -> None:
    room = made(make_room, seed)
    solid = room.gmap.means[room.gmap.opacities > 0.8]
    places = room.free_positions(np.random.default_rng(1), 20)
    nearest = [np.linalg.norm(solid - place, axis=1).min() for place in places]
    assert min(nearest) > 0.25
    low, high = room.gmap.bounds()
    assert (places > low).all() and (places < high).all()


def test_an_object_has_no_free_space() -> None:
    with pytest.raises(ValueError, match="no free space"):
        made(make_object, 0).free_positions(np.random.default_rng(0), 1)


@pytest.mark.parametrize("seed", SEEDS)
def test_an_object_is_seen_whole_and_large(seed: int) -> None:
    thing = made(make_object, seed)
    focal = 64 / np.tan(np.radians(19.5))
    camera = Camera(128, 128, focal, focal, 63.5, 63.5)
    for T in spherical_views("object", thing.radius, thing.centre)[::3]:
        _, _, alpha = thing.gmap.render(camera, inverse(T), threads=1)
        assert alpha.mean() > 0.06
        border = np.concatenate([alpha[[0, -1]].ravel(), alpha[:, [0, -1]].ravel()])
        assert border.mean() < 0.05
        x = transform_points(inverse(T), thing.gmap.means)
        assert (np.abs(x[:, :2] / x[:, 2:]).max()) < 1.03 * np.tan(np.radians(19.5))


@pytest.mark.parametrize("maker", ALL)
def test_every_texture_paints_any_rectangle(maker: Callable[..., Callable[..., object]]) -> None:
    rng = np.random.default_rng(5)
    painter = maker(rng, random_palette(rng), 1.0)
    for rows, cols in ((1, 1), (4, 64), (40, 3), (64, 64)):
        image = np.asarray(painter(Canvas(rows, cols, cols * 0.02, rows * 0.02, rng)))
        assert image.shape == (rows, cols, 3) and np.isfinite(image).all()
        assert -1 < image.mean() < 2


def _white(canvas: Canvas) -> np.ndarray:
    return np.ones((canvas.rows, canvas.cols, 3), np.float32)


def test_every_solid_faces_outwards() -> None:
    parts = Assembly(0.1, np.random.default_rng(0))
    turned = look_at([0, 0, 0], [1, 2, 0.5])[:3, :3]
    middle = np.array([0.3, -0.2, 0.5])
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1.0]])
    parts.box(middle, [0.5, 0.6, 0.7], [_white], turned)
    parts.blob(middle, [0.5, 0.6, 0.7], [_white], turned)
    parts.lathe(middle, [[0, 0.5], [0.5, 0.5], [0.5, -0.5], [0, -0.5]], _white, turned)
    parts.prism(middle, square, 1.0, [_white], turned)
    s, t = np.array([0.3, 0.6]), np.array([0.4, 0.7])
    for patch in parts.patches:
        right, down = patch.at(s + 1e-4, t) - patch.at(s, t), patch.at(s, t + 1e-4) - patch.at(s, t)
        outwards = patch.at(s, t) - middle
        assert (np.sum(np.cross(down, right) * outwards, axis=1) > 0).all()
