"""Training of the pose network: on one map, or jointly on many."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from igaussian_core.coarse.attention import PoseNetwork, Prediction, SourceViews, orthonormal
from igaussian_core.coarse.memory import raw_keys
from igaussian_core.errors import ConfigError
from igaussian_core.torch_cpu import has_native_bfloat16, one_torch_thread
from igaussian_core.training.augment import augmented, composite
from igaussian_core.training.bank import Bank, Views
from igaussian_core.training.recent_views import RecentViews

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_LAMBDA_R = 1.0  # the paper's, on degrees
_LAMBDA_T = 30.0  # the paper's, on map units where an object's radius is 4
_CLIP = 50.0
_SAME_PLACE = 0.08  # lengths
_COMPARED = 24  # cells of an image, drawn anew each step


@dataclass(frozen=True)
class TrainOptions:
    """How long and how.

    Attributes:
        steps: of the optimiser; 0 leaves the weights as they are.
        batch: target views a step.
        maps_per_batch: of joint training.
        learning_rate: peak of one cycle.
        refresh: views a step that are rendered anew.
        points: weight of the error of the cells' scene coordinates (ours).
        candidates: weight of the candidates' own errors, each times its weight (ours).
        resemblance: weight of the cells' comparison with the source views' (ours).
        recall: weight of the error of a memory of the latest views (ours); of one map only.
        seed: of everything random.
        validate_every: steps.
        sources_every: steps after which the source views' features are computed anew.
    """

    steps: int = 3000
    batch: int = 32
    maps_per_batch: int = 1
    learning_rate: float = 2e-3
    refresh: int = 8
    points: float = 1.0
    candidates: float = 1.0
    resemblance: float = 20.0
    recall: float = 1.0
    seed: int = 0
    validate_every: int = 250
    sources_every: int = 10


class TrainingMap(NamedTuple):
    """A map to train on.

    Attributes:
        name: in messages.
        bank: of its training views.
        sources: its source views.
        held_out: views never trained on.
        background: [3] float32 in [0, 1].
        rays: [h, w, 2] of the cells.
        lambda_t: weight of positions in normalised units.
    """

    name: str
    bank: Bank
    sources: Views
    held_out: Views
    background: Tensor
    rays: Tensor
    lambda_t: float


@dataclass
class Curve:
    """What training wrote down: step, and figures by name."""

    steps: list[int] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=dict)

    def add(self, step: int, **values: float) -> None:
        self.steps.append(step)
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)


def lambda_t(kind: str) -> float:
    """The paper's weight of positions, for positions in units of `PoseScale.length`: R is 4 map
    units for its objects; a scene's extent of cameras is taken as one."""
    return _LAMBDA_T * (4.0 if kind == "object" else 1.0)


def rotation_error_deg(a: Tensor, b: Tensor) -> Tensor:
    """Angles [...] in degrees between rotations [..., 3, 3].

    By atan2 of the relative rotation's sine and cosine: arccos of the paper's equation has an
    infinite gradient at zero.
    """
    relative = (a[..., :, :, None] * b[..., :, None, :]).sum(-3)
    sine = torch.stack(
        [relative[..., i, j] - relative[..., j, i] for i, j in ((2, 1), (0, 2), (1, 0))], -1
    )
    cosine = relative.diagonal(dim1=-2, dim2=-1).sum(-1) - 1
    return torch.rad2deg(torch.atan2((sine.square().sum(-1) + 1e-9).sqrt(), cosine))


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return ((a - b).square().sum(-1) + 1e-8).sqrt()


def pose_loss(
    prediction: Prediction, truth: Views, views: SourceViews, weight_t: Tensor,
    options: TrainOptions, random: torch.Generator | None = None,
) -> Tensor:  # fmt: skip
    """Section III-C of the paper, with three terms of ours.

    lambda_r * degrees + lambda_t * distance of the weighted mean; the same of every candidate
    times its weight, so that each learns and the WPM learns whom to trust; the distance of
    the cells' scene coordinates; and the `resemblance_loss`.

    Args:
        weight_t: [B] of positions in normalised units.
    """
    pose = _LAMBDA_R * rotation_error_deg(prediction.rotation, truth.rotation)
    pose = pose + weight_t * _distance(prediction.position, truth.position)
    each = rotation_error_deg(prediction.candidate_rotations, truth.rotation[:, None])
    each = each + weight_t[:, None] * _distance(
        prediction.candidate_positions, truth.position[:, None]
    )
    candidates = (prediction.log_weights.exp() * each).sum(1)
    known = truth.known.float()
    points = (_distance(prediction.points, truth.points) * known).sum((1, 2))
    points = weight_t * points / known.sum((1, 2)).clamp(min=1)
    loss = (pose + options.candidates * candidates + options.points * points).mean()
    if prediction.resemblance is None:
        return loss
    resembles = resemblance_loss(prediction.resemblance, truth, views, random)
    return loss + options.resemblance * resembles


def recall_loss(poses: Tensor, truth: Views, weight_t: Tensor) -> Tensor:
    """lambda_r * degrees + lambda_t * distance of what `RecentViews` predicts, [B, 12]."""
    rotation = orthonormal(poses[:, :9].unflatten(1, (3, 3))[..., :2])
    loss = _LAMBDA_R * rotation_error_deg(rotation, truth.rotation)
    return (loss + weight_t * _distance(poses[:, 9:], truth.position)).mean()


def resemblance_loss(
    resemblance: Tensor, truth: Views, views: SourceViews, random: torch.Generator | None = None
) -> Tensor:
    """How little a cell is found to resemble the source views' cells that show the same place:
    minus the logarithm of their share, averaged over some of the cells that any of them shows.

    Args:
        resemblance: [B, U, N * h * w], logarithms of shares that sum to one.
        truth: of the B images.
        views: of M maps.
    """
    maps = len(views.points)
    cells = torch.randperm(resemblance.shape[1], generator=random)[:_COMPARED]
    ours = truth.points.flatten(1, 2)[:, cells].reshape(maps, -1, 3)
    near = torch.cdist(ours, views.points.reshape(maps, -1, 3)) < _SAME_PLACE
    near &= views.known.reshape(maps, 1, -1)
    shown = near.any(-1) & truth.known.flatten(1)[:, cells].reshape(maps, -1)
    shares = resemblance[:, cells].reshape(near.shape)[shown]
    found = torch.logsumexp(shares.masked_fill(~near[shown], -torch.inf), -1)
    return -found.mean() if len(found) else resemblance.sum() * 0


class Trainer:
    """Trains a network on maps; `run` may be called again after an interruption.

    Every thread takes its share of a step's images through a copy of the network that has the
    same parameters; the gradients are averaged. Two threads so take little more than half the
    time of one; sharing each operation among them gains next to nothing, networks being small.

    Args:
        network: starts from its weights.
        maps: with banks of the same image size.
        checkpoint: file that an interrupted training goes on from; None: none is written.
        threads: as many as divide a step's images of each map, and at most so many.
    """

    def __init__(
        self,
        network: PoseNetwork,
        maps: Sequence[TrainingMap],
        options: TrainOptions,
        checkpoint: Path | None = None,
        threads: int = 2,
    ) -> None:
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.maps, self.options = maps, options
        self.curve = Curve()
        self.save_every = 500  # steps
        self.step = 0
        self._rng = np.random.default_rng(options.seed)
        each = options.batch // min(options.maps_per_batch, len(maps))
        shares = max(n for n in range(1, threads + 1) if each % n == 0)
        self._copies = [network, *(_sharing_copy(network) for _ in range(shares - 1))]
        self._randoms = [
            torch.Generator().manual_seed(1000 * options.seed + i) for i in range(shares)
        ]
        self._optimizer = torch.optim.AdamW(
            network.parameters(), lr=options.learning_rate, weight_decay=0.02, fused=True
        )
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimizer, options.learning_rate, total_steps=max(options.steps, 1),
            pct_start=0.15,
        )
        self._sources: dict[int, SourceViews] = {}
        # keys of several maps cannot be compared
        self._recent = RecentViews() if options.recall and len(maps) == 1 else None
        self._checkpoint = checkpoint
        if checkpoint is not None and checkpoint.is_file():
            self._resume(checkpoint)

    def run(self, progress: Progress = lambda stage, done, of: None) -> Curve:
        """Train to the end; the network is in evaluation mode afterwards."""
        options = self.options
        for network in self._copies:
            network.train()
        with (
            one_torch_thread(), ThreadPoolExecutor(1) as renderer,
            ThreadPoolExecutor(len(self._copies), initializer=torch.set_num_threads,
                               initargs=(1,)) as workers,
        ):  # fmt: skip
            pending = renderer.submit(lambda: None)
            while self.step < options.steps:
                pending.result()
                chosen = self._rng.choice(
                    len(self.maps), min(options.maps_per_batch, len(self.maps)), replace=False
                )
                batches = [self.maps[i].bank.batch(options.batch // len(chosen)) for i in chosen]
                if options.refresh:
                    bank = self.maps[chosen[0]].bank
                    pending = renderer.submit(bank.refresh, options.refresh)
                loss = self._learn(list(chosen), batches, workers)
                self.step += 1
                if self.step % options.validate_every == 0 or self.step == options.steps:
                    self._note(loss)
                if self._checkpoint is not None and self.step % self.save_every == 0:
                    self._save(self._checkpoint)
                progress("training", self.step, options.steps)
            pending.result()
        self.network.eval()
        if self._checkpoint is not None:
            self._checkpoint.unlink(missing_ok=True)
        return self.curve

    def _learn(
        self, chosen: list[int], batches: list[Views], workers: ThreadPoolExecutor
    ) -> float:
        """One step of the optimiser; the mean loss."""
        maps, shares = [self.maps[i] for i in chosen], len(self._copies)
        sources = [self._source_views(i) for i in chosen]
        views = SourceViews(*(torch.cat(parts) for parts in zip(*sources, strict=True)))
        parts = [[b.at(np.arange(k, len(b.rgba), shares)) for b in batches] for k in range(shares)]
        results = list(workers.map(
            self._gradients, self._copies, self._randoms, parts, [maps] * shares, [views] * shares
        ))  # fmt: skip
        if self._recent is not None:
            for _, keys, truth in results:
                self._recent.add(keys, truth)
        for ours, *theirs in zip(*(n.parameters() for n in self._copies), strict=True):
            for parameter in theirs:
                if ours.grad is not None and parameter.grad is not None:
                    ours.grad += parameter.grad
            if ours.grad is not None:
                ours.grad /= shares
        nn.utils.clip_grad_norm_(self.network.parameters(), _CLIP)
        self._optimizer.step()
        self._schedule.step()
        return float(np.mean([loss for loss, *_ in results]))

    def _gradients(
        self, network: PoseNetwork, random: torch.Generator, batches: list[Views],
        maps: list[TrainingMap], views: SourceViews,
    ) -> tuple[float, Tensor, Views]:  # fmt: skip
        """Leaves the gradients of a share of a step's images in `network`; its `pose_loss`, and
        the images' raw keys and truth."""
        images = torch.cat(
            [augmented(b.rgba, m.background, random) for b, m in zip(batches, maps, strict=True)]
        )
        truth = Views(*(torch.cat(parts) for parts in zip(*batches, strict=True)))
        rays = torch.stack([m.rays for m in maps])
        weight_t = torch.tensor([m.lambda_t for m in maps]).repeat_interleave(len(batches[0].rgba))
        network.zero_grad(set_to_none=True)
        with _mixed_precision():
            features = network.backbone(images)
            prediction = network.predict(features, rays, views)
        loss = pose_loss(prediction, truth, views, weight_t, self.options, random)
        said = float(loss.detach())  # the same sum from the first step to the last
        keys = raw_keys(features)
        recalled = None if self._recent is None else self._recent.predict(keys)
        if recalled is not None:
            loss = loss + self.options.recall * recall_loss(recalled, truth, weight_t)
        loss.backward()  # type: ignore[no-untyped-call]
        return said, keys.detach(), truth

    def _source_views(self, index: int) -> SourceViews:
        """Features without gradients: the heads learn to compare, the backbone by the targets."""
        stale = len(self.maps) > 1 or self.step % self.options.sources_every == 0
        if stale or index not in self._sources:
            self._sources[index] = source_views(self.network, self.maps[index])
        return self._sources[index]

    def _note(self, loss: float) -> None:
        errors = [held_out_errors(self.network, m) for m in self.maps[:8]]
        degrees, lengths = (np.concatenate([e[i] for e in errors]) for i in range(2))
        self.curve.add(
            self.step, loss=loss, degrees=float(np.median(degrees)),
            lengths=float(np.median(lengths)), within_15=float((degrees < 15).mean()),
            learning_rate=float(self._schedule.get_last_lr()[0]),
        )  # fmt: skip

    def _save(self, path: Path) -> None:
        state = {
            "options": asdict(self.options), "step": self.step,
            "network": self.network.state_dict(), "optimizer": self._optimizer.state_dict(),
            "schedule": self._schedule.state_dict(), "curve": asdict(self.curve),
            "random": [random.get_state() for random in self._randoms],
        }  # fmt: skip
        temporary = path.with_name(path.name + ".new")
        torch.save(state, temporary)
        temporary.replace(path)

    def _resume(self, path: Path) -> None:
        try:
            state: dict[str, Any] = torch.load(path, weights_only=True)
        except Exception as error:  # pickle and zip raise types of their own
            raise ConfigError(f"{path}: unreadable checkpoint: {error}") from error
        if state["options"] != asdict(self.options):
            raise ConfigError(f"{path}: checkpoint of a training with other options; remove it")
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        for random, saved in zip(self._randoms, state["random"], strict=False):
            random.set_state(saved)
        self.step = int(state["step"])
        self._rng = np.random.default_rng([self.options.seed, self.step])
        self.curve = Curve(**state["curve"])


def _mixed_precision(enabled: bool = True) -> torch.autocast:
    """bfloat16 where the CPU computes in it. Without autocast's cache of weights, which is the
    process's: another thread would empty it halfway."""
    return torch.autocast(
        "cpu", torch.bfloat16, enabled=enabled and has_native_bfloat16(), cache_enabled=False
    )


def _sharing_copy(network: PoseNetwork) -> PoseNetwork:
    """The same parameters; gradients and statistics of its own."""
    other = copy.deepcopy(network)
    for ours, theirs in zip(network.parameters(), other.parameters(), strict=True):
        theirs.data = ours.data
    return other


def source_views(network: PoseNetwork, training_map: TrainingMap) -> SourceViews:
    """Features of a map's source views by the network as it is now; leaves it in its mode."""
    views, training = training_map.sources, network.training
    images = composite(views.rgba, training_map.background[None]).permute(0, 3, 1, 2)
    images = images.contiguous(memory_format=torch.channels_last)
    network.eval()
    with torch.no_grad(), _mixed_precision(training):
        features = network.backbone(images).float()
    network.train(training)
    return SourceViews(
        features[None], views.points[None], views.known[None], views.rotation[None],
        views.position[None],
    )  # fmt: skip


@torch.no_grad()
def held_out_errors(
    network: PoseNetwork, training_map: TrainingMap, chunk: int = 64
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Degrees [N] and distances [N] in lengths on the held-out views, their colours unchanged."""
    training = network.training
    sources = source_views(network, training_map)
    network.eval()
    held_out = training_map.held_out
    degrees, lengths = [], []
    for start in range(0, len(held_out.rgba), chunk):
        part = Views(*(field[start : start + chunk] for field in held_out))
        images = composite(part.rgba, training_map.background[None]).permute(0, 3, 1, 2)
        with _mixed_precision(training):
            prediction = network(
                images.contiguous(memory_format=torch.channels_last), training_map.rays[None],
                sources,
            )  # fmt: skip
        degrees.append(rotation_error_deg(prediction.rotation, part.rotation))
        lengths.append((prediction.position - part.position).norm(dim=-1))
    network.train(training)
    return torch.cat(degrees).numpy(), torch.cat(lengths).numpy()
