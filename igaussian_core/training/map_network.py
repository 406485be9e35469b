"""A pose network for one compiled map: source views, training views, training, its report."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.attention import PoseNetwork
from igaussian_core.coarse.canonical import OVERSAMPLING, canonical_camera, cell_rays
from igaussian_core.coarse.memory import Recall, ViewMemory, fit_memory, raw_keys
from igaussian_core.coarse.network import MapNetwork, load_checkpoint, shipped_checkpoint
from igaussian_core.coarse.pose_scale import PoseScale
from igaussian_core.map_package import MapPackage, open_package, with_network
from igaussian_core.sphere import Sphere, sphere_of
from igaussian_core.torch_cpu import has_native_bfloat16
from igaussian_core.training.augment import augmented, composite, unchanged
from igaussian_core.training.bank import Bank, ViewRenderer, draw_views
from igaussian_core.training.episodes import EpisodeMap, EpisodeOptions, MemoryTrainer
from igaussian_core.training.pose_network import (
    MapTrainer,
    TrainingMap,
    TrainOptions,
    held_out_errors,
    lambda_t,
    rotation_error_deg,
    source_views,
)
from igaussian_core.training.poses import PoseSampler
from igaussian_core.training.trainer import Curve, Trainer
from igaussian_core.views import spherical_views, spread_indices

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_STEPS = 400 if has_native_bfloat16() else 180  # six to ten minutes on two cores
FOR_MEMORY = EpisodeOptions(steps=_STEPS, views=96, learning_rate=1e-3, validate_every=60)
FOR_HEADS = TrainOptions(steps=2000)  # from random weights
FOR_HEADS_FROM_WEIGHTS = TrainOptions(steps=1000, learning_rate=1e-3)  # of a joint training
BANK = 6000  # views that heads are trained on at a time
MEMORY = 12000
HELD_OUT = 256
UNTRAINED_MEMORY = 2000  # a sixth of the time, half as far off again
UNTRAINED_HELD_OUT = 64
_MIN_COVERED = 0.6  # of a scene's view; an object may fill little of one
_NEAR_KNOWN = {"object": 0.3, "scene": 0.55}
_CHUNK = 64
_HELD_OUT_SEED = 1_000_003


class Setting(NamedTuple):
    """What training needs to know of a map."""

    renderer: ViewRenderer
    sampler: PoseSampler
    source_poses: Array
    background: torch.Tensor


def setting_of(package: MapPackage, sources: int = 16, threads: int = 2) -> Setting:
    """Of a compiled map.

    Args:
        sources: how many source views; an object's are the paper's on its sphere, a scene's
            are spread over the compiled source views, since the paper's sphere of R = 0.1 sees
            a room from one place only.
    """
    sphere, known = sphere_of(package), package.landmarks.T_scene_cam
    scale = _scale_of(sphere, known)
    width, height, fx, fy, cx, cy = map(float, package.landmarks.intrinsics[0])
    camera = canonical_camera(Camera(int(width), int(height), fx, fy, cx, cy))
    is_object = sphere.kind == "object"
    renderer = ViewRenderer(
        package.gaussians, camera, scale, 0.0 if is_object else _MIN_COVERED, threads,
        OVERSAMPLING,
    )  # fmt: skip
    sampler = PoseSampler(sphere, scale.length, known, _NEAR_KNOWN[sphere.kind])
    if is_object:
        poses = object_sources(sphere, sources)
    else:
        poses = known[spread_indices(known, sources, 2 * scale.length)]
    background = torch.tensor(package.manifest.background, dtype=torch.float32)
    return Setting(renderer, sampler, poses, background)


def object_sources(sphere: Sphere, count: int) -> Array:
    """The paper's 8, 12, 16 or 20 views: four azimuths at each of several elevations."""
    elevations = {
        4: (0.0,), 8: (-30.0, 30.0), 12: (-45.0, 0.0, 45.0), 16: (-60.0, -30.0, 30.0, 60.0),
        20: (-60.0, -30.0, 0.0, 30.0, 60.0),
    }  # fmt: skip
    nearest = min(elevations, key=lambda views: abs(views - count))
    poses = spherical_views(
        "object", sphere.radius, sphere.centre, sphere.up, elevations_deg=elevations[nearest]
    )
    return poses[:count]


def training_map(
    name: str,
    setting: Setting,
    bank: int,
    seed: int,
    progress: Progress = lambda stage, done, of: None,
    held_out: int = HELD_OUT,
) -> TrainingMap:
    """A map's source views, its bank, and views that are never trained on.

    Raises:
        MapError: the map shows next to nothing from where views are drawn.
    """
    renderer, sampler = setting.renderer, setting.sampler
    sources, _ = renderer.render(setting.source_poses)
    aside = draw_views(renderer, sampler, np.random.default_rng(_HELD_OUT_SEED + seed), held_out)
    views = Bank(
        renderer, sampler, bank, seed, lambda done, of: progress("training views", done, of)
    )
    return TrainingMap(
        name, views, sources, aside, setting.background, cell_rays(renderer.camera),
        lambda_t(sampler.sphere.kind),
    )  # fmt: skip


def train_map_network(
    package: MapPackage,
    start: PoseNetwork,
    options: EpisodeOptions | TrainOptions,
    *,
    sources: int = 16,
    bank: int | None = None,
    memory: int | None = None,
    threads: int = 2,
    checkpoint: Path | None = None,
    progress: Progress = lambda stage, done, of: None,
) -> tuple[MapNetwork, Curve]:
    """Train a network, from `start`'s weights, on views that a compiled map renders of itself.

    Args:
        options: of episodes, to train for the memory, or of the heads' training.
        bank: views to train on; None: as many as are remembered, for the heads BANK.
        memory: views whose poses are kept to predict by; 0: none, the network's heads do; None:
            MEMORY.

    Raises:
        MapError: the map shows next to nothing from where views are drawn.
    """
    setting = setting_of(package, sources, threads)
    count = MEMORY if memory is None else memory
    if bank is None:
        bank = count if isinstance(options, EpisodeOptions) else BANK
    data = training_map(package.manifest.name, setting, bank, options.seed, progress)
    return train_on(data, setting, start, options, count, threads, checkpoint, progress)


def train_on(
    data: TrainingMap, setting: Setting, start: PoseNetwork,
    options: EpisodeOptions | TrainOptions, memory: int, threads: int = 2,
    checkpoint: Path | None = None, progress: Progress = lambda stage, done, of: None,
) -> tuple[MapNetwork, Curve]:  # fmt: skip
    """As `train_map_network`, on views that are there already."""
    torch.manual_seed(options.seed)
    torch.set_num_threads(threads)
    trainer: Trainer
    if isinstance(options, EpisodeOptions):
        views = EpisodeMap(data.bank.views, data.background, data.lambda_t)
        trainer = MemoryTrainer(start, views, data.held_out, options, checkpoint, threads)
    else:
        trainer = MapTrainer(start, data, options, checkpoint, threads)
    curve = trainer.run(progress)
    remembered = remember(trainer.network, data, setting, memory, options.seed, progress)
    return trained_network(trainer.network, data, setting, options, remembered), curve


def add_untrained_network(
    path: Path, threads: int = 2, progress: Progress = lambda stage, done, of: None
) -> dict[str, Any]:
    """Give a compiled map the shipped joint weights and a memory of its views: half a minute.

    Returns:
        What they reach on views held out.

    Raises:
        MapError: no compiled map, or one that shows next to nothing from where views are drawn;
            it stays as it was.
    """
    torch.set_num_threads(threads)
    package, count, seed = open_package(path), UNTRAINED_MEMORY, 0
    network = load_checkpoint(shipped_checkpoint()).eval()
    setting = setting_of(package, threads=threads)
    data = training_map(
        package.manifest.name, setting, count, seed, progress, UNTRAINED_HELD_OUT
    )
    views = remember(network, data, setting, count, seed, progress)
    found = trained_network(network, data, setting, EpisodeOptions(steps=0, seed=seed), views)
    with_network(path, found.data())
    return found.report


@torch.no_grad()
def remember(
    network: PoseNetwork, data: TrainingMap, setting: Setting, count: int, seed: int,
    progress: Progress = lambda stage, done, of: None,
) -> ViewMemory | None:  # fmt: skip
    """A memory of `count` views: those of the bank, and new ones; None of none.

    Every other is changed as in training, so that the regression knows how much that does, and
    what is seen unchanged too.
    """
    if count == 0:
        return None
    network.eval()
    random, rng = torch.Generator().manual_seed(seed + 1), np.random.default_rng([seed, 99])
    keys, rotations, positions = [], [], []
    done = 0
    while done < count:
        kept = min(_CHUNK, count - done, max(len(data.bank) - done, 0))
        if kept:
            views = data.bank.views.at(np.arange(done, done + kept))
        else:
            views = draw_views(
                setting.renderer, setting.sampler, rng, min(_CHUNK, count - done)
            )
        images = unchanged(views.rgba, setting.background)
        images[::2] = augmented(views.rgba[::2], setting.background, random)
        keys.append(raw_keys(network.backbone(images)))
        rotations.append(views.rotation)
        positions.append(views.position)
        done += len(views.rgba)
        progress("remembered views", done, count)
    return fit_memory(torch.cat(keys), torch.cat(rotations), torch.cat(positions))


def remembered_errors(
    network: PoseNetwork, memory: ViewMemory, data: TrainingMap, camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """As `held_out_errors`, of the memory's regression."""
    held_out = data.held_out
    images = (composite(held_out.rgba, data.background[None]) * 255).round().clamp(0, 255)
    recall = Recall(memory, network.backbone, camera)
    found = [recall(image) for image in images.byte().numpy()]
    rotations = torch.from_numpy(np.array([f.rotation for f in found])).float()
    positions = torch.from_numpy(np.array([f.position for f in found])).float()
    degrees = rotation_error_deg(rotations, held_out.rotation)
    return degrees.numpy(), (positions - held_out.position).norm(dim=-1).numpy()


def trained_network(
    network: PoseNetwork, data: TrainingMap, setting: Setting,
    options: EpisodeOptions | TrainOptions, memory: ViewMemory | None = None,
) -> MapNetwork:  # fmt: skip
    """A network in evaluation mode with a map's source views and a report on held-out views."""
    network.eval()
    if memory is None:
        degrees, lengths = held_out_errors(network, data)
    else:
        degrees, lengths = remembered_errors(network, memory, data, setting.renderer.camera)
    scale = setting.renderer.scale
    report = {
        "options": asdict(options),
        "heads": isinstance(options, TrainOptions) and options.steps > 0,
        "memory": 0 if memory is None else len(memory.keys),
        "held_out_views": len(degrees),
        "median_deg": float(np.median(degrees)),
        "median_distance": float(np.median(lengths)) * scale.length,
        "length": scale.length,
        "within_15_deg": float((degrees < 15).mean()),
    }
    return MapNetwork(
        network, source_views(network, data), setting.renderer.camera, scale, report, memory
    )


def _scale_of(sphere: Sphere, known: Array) -> PoseScale:
    """An object's sphere; a scene's cameras, their mean and their largest distance from it."""
    if sphere.kind == "object":
        return PoseScale(sphere.centre, sphere.radius)
    centre = known[:, :3, 3].mean(axis=0)
    extent = float(np.linalg.norm(known[:, :3, 3] - centre, axis=1).max())
    return PoseScale(tuple(map(float, centre)), max(extent, sphere.radius))  # type: ignore[arg-type]


