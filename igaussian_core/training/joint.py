"""Joint training over many procedural maps: the weights that every map's own training starts
from, and that the project ships."""

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
from igaussian_core.training.bank import ViewRenderer
from igaussian_core.training.map_network import Setting, object_sources, training_map
from igaussian_core.training.pose_network import Curve, Trainer, TrainingMap, TrainOptions
from igaussian_core.training.poses import PoseSampler
from igaussian_core.views import look_at, spread_indices

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

OPTIONS = TrainOptions(
    steps=3000, batch=32, maps_per_batch=2, learning_rate=1.5e-3, refresh=0, validate_every=200
)
_SIDE = 128
_SOURCES = 16
_VIEWS = 128  # of each map
_HELD_OUT = 24


def train_jointly(
    maps: int = 150,
    first_seed: int = 0,
    options: TrainOptions = OPTIONS,
    config: NetworkConfig | None = None,
    threads: int = 2,
    checkpoint: Path | None = None,
    progress: Progress = lambda stage, done, of: None,
) -> tuple[PoseNetwork, Curve]:
    """A network trained on `maps` procedural rooms and objects alike.

    Args:
        first_seed: of the maps; others than those of a test.
    """
    torch.manual_seed(options.seed)
    torch.set_num_threads(threads)
    data = []
    for index in range(maps):
        data.append(procedural_training_map(first_seed + index, threads))
        progress("maps", index + 1, maps)
    trainer = Trainer(PoseNetwork(config or NetworkConfig()), data, options, checkpoint, threads)
    return trainer.network, trainer.run(progress)


def procedural_training_map(seed: int, threads: int = 2) -> TrainingMap:
    """Views of one procedural map, a room for even seeds and an object for odd ones."""
    rng = np.random.default_rng([seed, 77])
    made = make_object(seed) if seed % 2 else make_room(seed)
    setting = _setting(made, rng, threads)
    return training_map(f"procedural {seed}", setting, _VIEWS, seed, held_out=_HELD_OUT)


def _setting(made: ProceduralMap, rng: np.random.Generator, threads: int) -> Setting:
    x, y, z = map(float, made.centre)
    sphere = Sphere(made.kind, made.radius, (x, y, z), made.up)
    if made.kind == "object":
        sources, length, background = object_sources(sphere, _SOURCES), made.radius, rng.random(3)
        degrees, covered = rng.uniform(35, 50), 0.0
        centre = sphere.centre
        sampler = PoseSampler(sphere, length, sources, 0.0)
    else:
        places = made.free_positions(rng, 200)
        looks = np.array([_look(place, rng) for place in places])
        x, y, z = map(float, places.mean(0))
        centre = (x, y, z)
        length = float(np.linalg.norm(places - centre, axis=1).max())
        sources, background = looks[spread_indices(looks, _SOURCES, length)], np.zeros(3)
        degrees, covered = rng.uniform(50, 75), 0.6
        sampler = PoseSampler(
            sphere, length, looks, 0.3, lambda rng: made.free_positions(rng, 1)[0]
        )
    focal = 0.5 * _SIDE / np.tan(0.5 * np.radians(degrees))
    camera = Camera(_SIDE, _SIDE, focal, focal, 0.5 * (_SIDE - 1), 0.5 * (_SIDE - 1))
    gmap = made.gmap.for_small_images()
    renderer = ViewRenderer(gmap, camera, PoseScale(centre, length), covered, threads)
    return Setting(renderer, sampler, sources, torch.tensor(background, dtype=torch.float32))


def _look(place: Array, rng: np.random.Generator) -> Array:
    azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5)
    return look_at(place, place + (np.cos(azimuth), np.sin(azimuth), rise))
