"""Joint training over many procedural maps: the weights that every compiled map starts with, and
that the project ships."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.attention import NetworkConfig, PoseNetwork
from igaussian_core.coarse.pose_scale import PoseScale
from igaussian_core.procedural import ProceduralMap, make_object, make_room
from igaussian_core.sphere import Sphere
from igaussian_core.training.bank import ViewRenderer, Views, draw_views
from igaussian_core.training.episodes import (
    EpisodeMap,
    EpisodeOptions,
    EpisodeTrainer,
    pose_differences,
)
from igaussian_core.training.pose_network import lambda_t
from igaussian_core.training.poses import PoseSampler
from igaussian_core.training.trainer import Curve
from igaussian_core.views import look_at

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
_Parts = tuple[list[NDArray[Any]], float]

OPTIONS = EpisodeOptions()
_SIDE = 128
_FIELD_DEG = {"object": (35, 50), "scene": (50, 75)}
_VIEWS = 384  # of each map: a third anywhere, as many in each neighbourhood
_NEIGHBOURHOODS = 2
_POSES = 3000  # among which views are near one another
_AMONG = 2  # those of a neighbourhood are drawn among so many times as many
_ONE_HELD_OUT_OF = 25  # maps
_MOST_HELD_OUT = 12
_AT_FIRST = 64  # maps that a training starts with; all are there after half of its steps


def train_jointly(
    maps: int = 140,
    options: EpisodeOptions = OPTIONS,
    config: NetworkConfig | None = None,
    threads: int = 2,
    checkpoint: Path | None = None,
    progress: Progress = lambda stage, done, of: None,
    device: str = "cpu",
) -> tuple[PoseNetwork, Curve]:
    """A network trained on `maps` procedural rooms and objects alike.

    Some more are made for the curve. A map's views take 25 MB of the device's memory.

    Args:
        options: its seed is that of the first map too.
        threads: that render maps while the training goes on, and of the network on a CPU.
        device: of the network: cpu or cuda.
    """
    torch.manual_seed(options.seed)
    torch.set_num_threads(threads)
    held_out = min(1 + maps // _ONE_HELD_OUT_OF, _MOST_HELD_OUT)
    seeds = range(options.seed, options.seed + held_out + maps)
    with ProcessPoolExecutor(threads, get_context("spawn")) as workers:
        coming = ComingMaps([workers.submit(_made, seed) for seed in seeds], device)
        try:
            at_first = held_out + min(_AT_FIRST, maps)
            for count in range(1, at_first + 1):
                coming.first(count)
                progress("maps", count, at_first)
            trainer = JointTrainer(
                PoseNetwork(config or NetworkConfig()), coming, held_out, options, checkpoint,
                threads, device,
            )  # fmt: skip
            curve = trainer.run(progress)
        finally:  # an interrupted training waits for no more maps
            workers.shutdown(cancel_futures=True)
    return trainer.network.cpu(), curve


def _made(seed: int, count: int = _VIEWS) -> _Parts:
    """Of `procedural_views`: as arrays, since tensors would keep files open between processes."""
    made = procedural_views(seed, count)
    return [part.numpy() for part in (*made.views, made.background)], made.lambda_t


class ComingMaps:
    """Maps that other processes are still making, in the order of their seeds.

    Args:
        futures: of what `_made` makes.
        device: that the views are brought to.
    """

    def __init__(self, futures: list[Future[_Parts]], device: str) -> None:
        self._futures, self._device = futures[::-1], torch.device(device)
        self._there: list[EpisodeMap] = []

    def __len__(self) -> int:
        return len(self._there) + len(self._futures)

    def first(self, count: int) -> list[EpisodeMap]:
        """So many of them, as soon as they are there."""
        while len(self._there) < count:
            parts, weight_t = self._futures.pop().result()
            *views, background = (torch.from_numpy(part).to(self._device) for part in parts)
            self._there.append(EpisodeMap(Views(*views), background, weight_t))
        return self._there[:count]


class JointTrainer(EpisodeTrainer):
    """Trains a network on maps some of which are still being made.

    Which map is used from what step on does not depend on how soon it is there.

    Args:
        maps: the first `held_out` of them are those that the curve is measured on.
    """

    def __init__(
        self, network: PoseNetwork, maps: ComingMaps, held_out: int, options: EpisodeOptions,
        checkpoint: Path | None, threads: int, device: str,
    ) -> None:  # fmt: skip
        super().__init__(
            network, [], maps.first(held_out), options, checkpoint, threads, device
        )
        self._coming, self._aside = maps, held_out

    def _known(self) -> Sequence[EpisodeMap]:
        total = len(self._coming) - self._aside
        later = max(total - _AT_FIRST, 0) * min(1.0, 2 * self.step / self._options.steps)
        count = min(total, _AT_FIRST + int(later))
        return self._coming.first(self._aside + count)[self._aside :]


def procedural_views(seed: int, count: int = _VIEWS) -> EpisodeMap:
    """Views of one procedural map, a room for even seeds and an object for odd ones.

    Rendered by one thread.
    """
    rng = np.random.default_rng([seed, 77])
    made = make_object(seed) if seed % 2 else make_room(seed)
    is_object = made.kind == "object"
    sampler = _object_poses(made) if is_object else _room_poses(made, rng)
    background = rng.random(3) if is_object else np.zeros(3)
    x, y, z = map(float, sampler.sphere.centre)
    renderer = ViewRenderer(
        made.gmap.for_small_images(), _camera(rng.uniform(*_FIELD_DEG[made.kind])),
        PoseScale((x, y, z), sampler.length), 0.0 if is_object else 0.6, threads=1,
    )  # fmt: skip
    weight, draws = lambda_t(made.kind), np.random.default_rng(seed)
    near = count // (1 + _NEIGHBOURHOODS)
    pool = _Pool(sampler.draw(draws, _POSES), weight / sampler.length)
    parts = [draw_views(renderer, pool, draws, count - near * _NEIGHBOURHOODS)]
    for _ in range(_NEIGHBOURHOODS):
        pool.gather(near, draws)
        parts.append(draw_views(renderer, pool, draws, near))
    views = Views(*(torch.cat(part) for part in zip(*parts, strict=True)))
    return EpisodeMap(views, torch.tensor(background, dtype=torch.float32), weight)


class _Pool:
    """Poses [N, 4, 4], each of which is drawn once."""

    def __init__(self, poses: Array, weight_t: float) -> None:
        self._poses, self._weight_t = poses, weight_t

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        drawn, self._poses = self._poses[:count], self._poses[count:]
        return drawn

    def gather(self, count: int, rng: np.random.Generator) -> None:
        """Have those drawn next that are like one of them: `count` among `_AMONG` times as many."""
        poses = torch.from_numpy(self._poses)
        unlike = pose_differences(
            poses[:, :3, :3], poses[:, :3, 3], int(rng.integers(len(poses))), self._weight_t
        )
        order = unlike.argsort().numpy()
        order[: _AMONG * count] = rng.permutation(order[: _AMONG * count])
        self._poses = self._poses[order]


def _object_poses(made: ProceduralMap) -> PoseSampler:
    x, y, z = map(float, made.centre)
    sphere = Sphere(made.kind, made.radius, (x, y, z), made.up)
    return PoseSampler(sphere, made.radius, np.zeros((0, 4, 4)), 0.0)


def _room_poses(made: ProceduralMap, rng: np.random.Generator) -> PoseSampler:
    free = made.free_positions(rng, _POSES)
    places = free[:200]
    looks = np.array([_look(place, rng) for place in places])
    x, y, z = map(float, places.mean(0))
    length = float(np.linalg.norm(places - (x, y, z), axis=1).max())
    sphere = Sphere(made.kind, made.radius, (x, y, z), made.up)
    return PoseSampler(sphere, length, looks, 0.3, lambda rng: free[rng.integers(len(free))])


def _camera(degrees: float) -> Camera:
    focal = 0.5 * _SIDE / np.tan(0.5 * np.radians(degrees))
    return Camera(_SIDE, _SIDE, focal, focal, 0.5 * (_SIDE - 1), 0.5 * (_SIDE - 1))


def _look(place: Array, rng: np.random.Generator) -> Array:
    azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5)
    return look_at(place, place + (np.cos(azimuth), np.sin(azimuth), rise))
