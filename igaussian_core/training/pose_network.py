"""Training of the pose network on one map: its losses, its steps, its errors on held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igaussian_core.coarse.attention import PoseNetwork, Prediction, SourceViews, orthonormal
from igaussian_core.coarse.memory import raw_keys
from igaussian_core.training.augment import augmented, unchanged
from igaussian_core.training.bank import Bank, Views
from igaussian_core.training.recent_views import RecentViews
from igaussian_core.training.trainer import Trainer, mixed_precision

_LAMBDA_R = 1.0  # the paper's, on degrees
_LAMBDA_T = 30.0  # the paper's, on map units where an object's radius is 4
_SAME_PLACE = 0.08  # lengths
_COMPARED = 24  # cells of an image, drawn anew each step


@dataclass(frozen=True)
class TrainOptions:
    """How long and how.

    Attributes:
        steps: of the optimiser; 0 leaves the weights as they are.
        batch: target views a step.
        learning_rate: peak of one cycle.
        refresh: views a step that are rendered anew.
        points: weight of the error of the cells' scene coordinates (ours).
        candidates: weight of the candidates' own errors, each times its weight (ours).
        resemblance: weight of the cells' comparison with the source views' (ours).
        recall: weight of the error of a memory of the latest views (ours).
        clip: longest gradient.
        seed: of everything random.
        validate_every: steps.
        sources_every: steps after which the source views' features are computed anew.
    """

    steps: int = 3000
    batch: int = 32
    learning_rate: float = 2e-3
    refresh: int = 8
    points: float = 1.0
    candidates: float = 1.0
    resemblance: float = 20.0
    recall: float = 1.0
    clip: float = 50.0
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
    degrees, lengths = pose_errors(poses, truth)
    return (_LAMBDA_R * degrees + weight_t * lengths).mean()


def pose_errors(poses: Tensor, truth: Views) -> tuple[Tensor, Tensor]:
    """Degrees [B] and lengths [B] of predicted `Views.poses` [B, 12]."""
    rotation = orthonormal(poses[:, :9].unflatten(1, (3, 3))[..., :2])
    degrees = rotation_error_deg(rotation, truth.rotation)
    return degrees, _distance(poses[:, 9:], truth.position)


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


class MapTrainer(Trainer):
    """Trains a network on one map.

    Args:
        network: starts from its weights.
        checkpoint: file that an interrupted training goes on from; None: none is written.
        threads: as many as divide a step's images, and at most so many.
    """

    def __init__(
        self, network: PoseNetwork, training_map: TrainingMap, options: TrainOptions,
        checkpoint: Path | None = None, threads: int = 2,
    ) -> None:  # fmt: skip
        self._shares = max(n for n in range(1, threads + 1) if options.batch % n == 0)
        super().__init__(network, options, self._shares, checkpoint, threads)
        self.map, self.options = training_map, options
        self._sources: SourceViews | None = None
        self._recent = RecentViews() if options.recall else None

    def _draw(self) -> list[Views]:
        # features without gradients: the heads learn to compare, the backbone by the targets
        if self._sources is None or self.step % self.options.sources_every == 0:
            self._sources = source_views(self.network, self.map)
        batch = self.map.bank.batch(self.options.batch)
        return [
            batch.at(np.arange(k, len(batch.rgba), self._shares)) for k in range(self._shares)
        ]

    def _renew(self) -> None:
        if self.options.refresh:
            self.map.bank.refresh(self.options.refresh)

    def _gradients(
        self, network: PoseNetwork, random: torch.Generator, share: Views
    ) -> tuple[float, tuple[Tensor, Views]]:
        """Of `pose_loss`; besides that the images' raw keys and truth."""
        assert self._sources is not None
        data = self.map
        images = augmented(share.rgba, data.background, random)
        weight_t = torch.full((len(images),), data.lambda_t)
        network.zero_grad(set_to_none=True)
        with mixed_precision():
            features = network.backbone(images)
            prediction = network.predict(features, data.rays[None], self._sources)
        loss = pose_loss(prediction, share, self._sources, weight_t, self.options, random)
        said = float(loss.detach())  # the same sum from the first step to the last
        keys = raw_keys(features)
        recalled = None if self._recent is None else self._recent.predict(keys)
        if recalled is not None:
            loss = loss + self.options.recall * recall_loss(recalled, share, weight_t)
        loss.backward()  # type: ignore[no-untyped-call]
        return said, (keys.detach(), share)

    def _learned(self, results: Sequence[tuple[Tensor, Views]]) -> None:
        if self._recent is not None:
            for keys, truth in results:
                self._recent.add(keys, truth)

    def _errors(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return held_out_errors(self.network, self.map)


def source_views(network: PoseNetwork, training_map: TrainingMap) -> SourceViews:
    """Features of a map's source views by the network as it is now; leaves it in its mode."""
    views, training = training_map.sources, network.training
    images = unchanged(views.rgba, training_map.background)
    network.eval()
    with torch.no_grad(), mixed_precision(enabled=training):
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
        images = unchanged(part.rgba, training_map.background)
        with mixed_precision(enabled=training):
            prediction = network(images, training_map.rays[None], sources)
        degrees.append(rotation_error_deg(prediction.rotation, part.rotation))
        lengths.append((prediction.position - part.position).norm(dim=-1))
    network.train(training)
    return torch.cat(degrees).numpy(), torch.cat(lengths).numpy()
