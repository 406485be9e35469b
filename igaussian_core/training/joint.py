"""Joint training over many procedural maps: the weights that every compiled map starts with, and
that the project ships."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.attention import NetworkConfig, PoseNetwork
from igaussian_core.coarse.pose_scale import PoseScale
from igaussian_core.procedural import ProceduralMap, make_object, make_room
from igaussian_core.sphere import Sphere
from igaussian_core.training.bank import ViewRenderer, draw_views
from igaussian_core.training.episodes import (
    EpisodeMap,
    EpisodeOptions,
    EpisodeTrainer,
)
from igaussian_core.training.pose_network import lambda_t
from igaussian_core.training.poses import PoseSampler
from igaussian_core.training.trainer import Curve
from igaussian_core.views import look_at

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

OPTIONS = EpisodeOptions()
_SIDE = 128
_FIELD_DEG = {"object": (35, 50), "scene": (50, 75)}
_VIEWS = 384  # of each map
_ONE_HELD_OUT_OF = 25  # maps


def train_jointly(
    maps: int = 140,
    options: EpisodeOptions = OPTIONS,
    config: NetworkConfig | None = None,
    threads: int = 2,
    checkpoint: Path | None = None,
    progress: Progress = lambda stage, done, of: None,
) -> tuple[PoseNetwork, Curve]:
    """A network trained on `maps` procedural rooms and objects alike.

    Some more are made for the curve. A map's views take 25 MB of memory.

    Args:
        options: its seed is that of the first map too.
    """
    torch.manual_seed(options.seed)
    torch.set_num_threads(threads)
    data, count = [], maps + 1 + maps // _ONE_HELD_OUT_OF
    for index in range(count):
        data.append(procedural_views(options.seed + index, threads))
        progress("maps", index + 1, count)
    trainer = EpisodeTrainer(
        PoseNetwork(config or NetworkConfig()), data[:maps], data[maps:], options, checkpoint,
        threads,
    )  # fmt: skip
    return trainer.network, trainer.run(progress)


def procedural_views(seed: int, threads: int = 2, count: int = _VIEWS) -> EpisodeMap:
    """Views of one procedural map, a room for even seeds and an object for odd ones."""
    rng = np.random.default_rng([seed, 77])
    made = make_object(seed) if seed % 2 else make_room(seed)
    is_object = made.kind == "object"
    sampler = _object_poses(made) if is_object else _room_poses(made, rng)
    background = rng.random(3) if is_object else np.zeros(3)
    x, y, z = map(float, sampler.sphere.centre)
    renderer = ViewRenderer(
        made.gmap.for_small_images(), _camera(rng.uniform(*_FIELD_DEG[made.kind])),
        PoseScale((x, y, z), sampler.length), 0.0 if is_object else 0.6, threads,
    )  # fmt: skip
    views = draw_views(renderer, sampler, np.random.default_rng(seed), count)
    return EpisodeMap(
        views, torch.tensor(background, dtype=torch.float32), lambda_t(made.kind)
    )


def _object_poses(made: ProceduralMap) -> PoseSampler:
    x, y, z = map(float, made.centre)
    sphere = Sphere(made.kind, made.radius, (x, y, z), made.up)
    return PoseSampler(sphere, made.radius, np.zeros((0, 4, 4)), 0.0)


def _room_poses(made: ProceduralMap, rng: np.random.Generator) -> PoseSampler:
    places = made.free_positions(rng, 200)
    looks = np.array([_look(place, rng) for place in places])
    x, y, z = map(float, places.mean(0))
    length = float(np.linalg.norm(places - (x, y, z), axis=1).max())
    sphere = Sphere(made.kind, made.radius, (x, y, z), made.up)
    return PoseSampler(sphere, length, looks, 0.3, lambda rng: made.free_positions(rng, 1)[0])


def _camera(degrees: float) -> Camera:
    focal = 0.5 * _SIDE / np.tan(0.5 * np.radians(degrees))
    return Camera(_SIDE, _SIDE, focal, focal, 0.5 * (_SIDE - 1), 0.5 * (_SIDE - 1))


def _look(place: Array, rng: np.random.Generator) -> Array:
    azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5)
    return look_at(place, place + (np.cos(azimuth), np.sin(azimuth), rise))
