"""Training for the memory (`coarse/memory.py`): over many maps, so that it works on maps never
seen, or on one.

The heads are not trained. Each share of a step is an episode, as in few-shot learning: some views
of one map, a part of them near one another, and of each it is asked what pose the memory's
regression would tell from all the others. That leave-one-out prediction has a closed form
(Rasmussen and Williams 2006, equation 5.12)

    y_i - [K^-1 y]_i / [K^-1]_ii

through which gradients reach the keys of all views (deep kernel learning: Wilson et al. 2016, over
episodes: Patacchiola et al. 2020). Besides, cells of different views that show the same place are
to resemble each other more than others (the InfoNCE loss of van den Oord et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from igaussian_core.coarse.attention import PoseNetwork
from igaussian_core.coarse.memory import fit_regression, matern, raw_keys
from igaussian_core.training.augment import augmented, unchanged
from igaussian_core.training.bank import Views
from igaussian_core.training.pose_network import pose_errors
from igaussian_core.training.trainer import Trainer, mixed_precision

_RIDGE = 0.02
_NEAR = (0.3, 1.0)  # share of an episode's views that are near one another, drawn evenly
_AMONG = 2  # they are drawn among so many times as many
_HALF_LOST = 5.0  # degrees at which an error counts half as steeply as at zero
_SAME_PLACE = 0.08  # lengths
_CELLS = 640  # compared in an episode
_SHARPNESS = 1 / 0.07
_KNOWN = 2000  # views of one map that its curve is told by


@dataclass(frozen=True)
class EpisodeOptions:
    """How long and how.

    Attributes:
        steps: of the optimiser.
        views: of an episode.
        episodes: a step, each of another map where there are as many.
        learning_rate: peak of one cycle.
        places: weight of the comparison of cells.
        clip: longest gradient.
        seed: of everything random.
        validate_every: steps.
    """

    steps: int = 1500
    views: int = 48
    episodes: int = 2
    learning_rate: float = 1.5e-3
    places: float = 0.1
    clip: float = 1.0
    seed: int = 0
    validate_every: int = 100


class EpisodeMap(NamedTuple):
    """Views of a map.

    Attributes:
        views: rendered.
        background: [3] float32 in [0, 1].
        lambda_t: degrees that a unit of length counts.
    """

    views: Views
    background: Tensor
    lambda_t: float

    def nearest(self, index: int) -> NDArray[np.int64]:
        """All views [N], those first whose poses are the most like that of one of them."""
        views = self.views
        unlike = pose_differences(views.rotation, views.position, index, self.lambda_t)
        return np.asarray(unlike.argsort().cpu())


class Episode(NamedTuple):
    """Some views of a map, the first `near` of them near one another."""

    of: EpisodeMap
    views: Views
    near: int


def pose_differences(
    rotation: Tensor, position: Tensor, index: int, weight_t: float
) -> Tensor:
    """Degrees plus `weight_t` times distance [N] of poses, [N, 3, 3] and [N, 3], from one."""
    turns = (rotation - rotation[index]).flatten(1).norm(dim=1)
    angles = 2 * torch.arcsin((turns / 8**0.5).clamp(max=1))
    return torch.rad2deg(angles) + weight_t * (position - position[index]).norm(dim=1)


def leave_one_out(keys: Tensor, poses: Tensor) -> Tensor:
    """Of N views the poses [N, 12] that a regression by the keys [N, D] of the others tells."""
    keys = keys - keys.mean(0)
    squares = keys.square().sum(1)
    distances = (squares[:, None] + squares - 2 * keys @ keys.T).clamp(min=0).add(1e-6).sqrt()
    gram = matern(distances, distances.detach().median())
    inverse = torch.cholesky_inverse(
        torch.linalg.cholesky(gram + _RIDGE * torch.eye(len(keys), device=keys.device))
    )
    return poses - inverse @ (poses - poses.mean(0)) / inverse.diagonal()[:, None]


def place_loss(features: Tensor, views: Views, random: torch.Generator) -> Tensor:
    """How little cells [N, C, h, w] resemble those of other views that show the same place: minus
    the logarithm of their share of the resemblance to all other views' cells."""
    count, _, height, width = features.shape
    shown = torch.nonzero(views.known.flatten()).flatten()
    device = features.device
    chosen = shown[torch.randperm(len(shown), generator=random, device=device)[:_CELLS]]
    if len(chosen) < 2:
        return features.sum() * 0
    cells = features.permute(0, 2, 3, 1).flatten(0, 2)[chosen]
    cells = F.normalize(cells - cells.mean(0), dim=1)
    places = views.points.flatten(0, 2)[chosen]
    view = torch.arange(count, device=device).repeat_interleave(height * width)[chosen]
    other = view[:, None] != view
    same = other & (torch.cdist(places, places) < _SAME_PLACE)
    seen_again = same.any(1)
    if not seen_again.any():
        return features.sum() * 0
    shares = torch.log_softmax((_SHARPNESS * cells @ cells.T).masked_fill(~other, -1e4), 1)
    found = shares.masked_fill(~same, -torch.inf)[seen_again]
    return -torch.logsumexp(found, 1).mean()


class EpisodeTrainer(Trainer):
    """Trains a network's backbone on episodes of many maps.

    On a GPU all episodes of a step go through the network together.

    Args:
        maps: to train on.
        held_out: maps that the curve is measured on.
        checkpoint, threads, device: as of `Trainer`; the maps' views are on that device.
    """

    def __init__(
        self, network: PoseNetwork, maps: Sequence[EpisodeMap], held_out: Sequence[EpisodeMap],
        options: EpisodeOptions, checkpoint: Path | None = None, threads: int = 2,
        device: str = "cpu",
    ) -> None:  # fmt: skip
        shares = options.episodes if device == "cpu" else 1
        super().__init__(network, options, shares, checkpoint, threads, device)
        self._held_out, self._options = held_out, options
        self._maps = maps

    def _known(self) -> Sequence[EpisodeMap]:
        """The maps to draw from at the present step."""
        return self._maps

    def _draw(self) -> list[list[Episode]]:
        maps, episodes = self._known(), self._options.episodes
        chosen = self._rng.choice(len(maps), episodes, replace=len(maps) < episodes)
        drawn = [self._episode(maps[index]) for index in chosen]
        shares = len(self._copies)
        return [drawn[share::shares] for share in range(shares)]

    def _episode(self, of: EpisodeMap) -> Episode:
        total = len(of.views.rgba)
        count = min(self._options.views, total)
        near = int(count * self._rng.uniform(*_NEAR))
        around = of.nearest(int(self._rng.integers(total)))[: _AMONG * near]
        first = self._rng.choice(around, near, replace=False)
        rest = self._rng.choice(np.setdiff1d(np.arange(total), first), count - near, replace=False)
        return Episode(of, of.views.at(np.concatenate([first, rest])), near)

    def _gradients(
        self, network: PoseNetwork, random: torch.Generator, share: list[Episode]
    ) -> tuple[float, None]:
        images = torch.cat([augmented(e.views.rgba, e.of.background, random) for e in share])
        network.zero_grad(set_to_none=True)
        with mixed_precision(images.device.type):
            features = network.backbone(images)
        parts = features.float().split([len(e.views.rgba) for e in share])
        losses = [
            self._loss(part, episode, random) for part, episode in zip(parts, share, strict=True)
        ]
        loss = torch.stack(losses).mean()
        loss.backward()  # type: ignore[no-untyped-call]
        return float(loss.detach()), None

    def _loss(self, features: Tensor, episode: Episode, random: torch.Generator) -> Tensor:
        of, views, near = episode
        degrees, lengths = pose_errors(leave_one_out(raw_keys(features), views.poses), views)
        # those that nothing near tells of are past help
        loss = torch.log1p((degrees + of.lambda_t * lengths) / _HALF_LOST).mean()
        neighbours = views.at(np.arange(near))
        return loss + self._options.places * place_loss(features[:near], neighbours, random)

    def _errors(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        self.network.eval()
        found = [leave_one_out_errors(self.network, of) for of in self._held_out]
        self.network.train()
        degrees, lengths = (torch.cat(part).cpu().numpy() for part in zip(*found, strict=True))
        return degrees, lengths


class MemoryTrainer(EpisodeTrainer):
    """Trains a network's backbone on episodes of one map; the curve is of `held_out`, by the
    first views of the map.

    Args:
        views: of the map.
        held_out: views of it that are never trained on.
        options, checkpoint, threads: as of `Trainer`.
    """

    def __init__(
        self, network: PoseNetwork, views: EpisodeMap, held_out: Views, options: EpisodeOptions,
        checkpoint: Path | None = None, threads: int = 2,
    ) -> None:  # fmt: skip
        asked = EpisodeMap(held_out, views.background, views.lambda_t)
        super().__init__(network, [views], [asked], options, checkpoint, threads)

    @torch.no_grad()
    def _errors(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        (known,), (asked,) = self._maps, self._held_out
        known = known._replace(views=known.views.at(np.arange(min(_KNOWN, len(known.views.rgba)))))
        self.network.eval()
        keys, queries = _keys(self.network, known), _keys(self.network, asked)
        self.network.train()
        poses = fit_regression(keys, known.views.poses, _RIDGE).predict(queries)
        degrees, lengths = pose_errors(poses, asked.views)
        return degrees.numpy(), lengths.numpy()


@torch.no_grad()
def leave_one_out_errors(network: PoseNetwork, of: EpisodeMap) -> tuple[Tensor, Tensor]:
    """Degrees [N] and lengths [N] of a map's views, each by all of the others."""
    return pose_errors(leave_one_out(_keys(network, of), of.views.poses), of.views)


def _keys(network: PoseNetwork, of: EpisodeMap, chunk: int = 64) -> Tensor:
    """Raw keys [N, D] of a map's views, their colours unchanged."""
    return torch.cat([
        raw_keys(network.backbone(unchanged(rgba, of.background)))
        for rgba in of.views.rgba.split(chunk)
    ])  # fmt: skip
