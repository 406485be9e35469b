"""The paper's pose attention network and its Weight Predictor Module, and what it was made into.

Section III-A of the paper, with N source views of known pose rendered from the map:

    K^i, V^i = concat(phi_r(I), phi_r(x_s^i))       Q^i = MLP(pose of x_s^i), 128 numbers
    V^i_1 = FFN_1(softmax(Q K^T / sqrt(d)) V) + V   V^i_2 = FFN_2(V^i_1)   T_i = xi_D(V^i_2)
    w = softmax over i of g(V^i_2)                  T_coarse = sum of w^i T_i

The equations leave open over what the softmax runs. `PAPER` is their literal form: one feature
vector an image, so that it runs over the source views, and candidates relative to these.
"tokens" keeps the image's 16-pixel cells apart: each source pose asks the cells of the target,
with heads, for what tells its relative pose. `lookup` goes before it: every cell of the target
is compared with every cell of every source view, and is told where in the scene those that
resemble it lie (their rendered depth gives the scene coordinates). `direct` is a path from the
image alone to the pose. "none" asks nothing and averages the cells: with the direct path, plain
regression.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from igaussian_core.coarse.backbone import attend, make_backbone

ATTENTIONS = ("tokens", "views", "none")
_QUERY = 128  # the paper's
_HEADS = 4
_HIDDEN = 256
_LOOKUP = 64  # dimensions in which cells are compared
_HALF_WIDE = 2.0  # scene coordinates are clamped to so many lengths


@dataclass(frozen=True)
class NetworkConfig:
    """What the network is made of.

    Attributes:
        backbone: one of backbone.BACKBONES.
        attention: "tokens", "views" (the paper's literal form) or "none".
        lookup: compare the target's cells with the source views' and hand on their places.
        relative: candidates are predicted in their source camera's frame, else in the scene's.
        weights: combine candidates by the WPM, else by their plain mean.
        direct: a path from the image alone to the pose, which the candidates correct; the paper
            has none.
        width: features of a cell and of a source view.
    """

    backbone: str = "small"
    attention: str = "tokens"
    lookup: bool = True
    relative: bool = False
    weights: bool = True
    direct: bool = True
    width: int = 192


PAPER = NetworkConfig(attention="views", lookup=False, relative=True, direct=False)
PLAIN = NetworkConfig(attention="none", lookup=False, weights=False)  # regression


class SourceViews(NamedTuple):
    """N source views of each of M maps, in normalised units.

    Attributes:
        features: [M, N, C, h, w], the backbone's.
        points: [M, N, h, w, 3] scene coordinates of the cells' centres.
        known: [M, N, h, w] bool, where those mean something.
        rotation: [M, N, 3, 3] of T_scene_cam.
        position: [M, N, 3].
    """

    features: Tensor
    points: Tensor
    known: Tensor
    rotation: Tensor
    position: Tensor


class Prediction(NamedTuple):
    """What the network says of B images with N source views.

    Attributes:
        rotation: [B, 3, 3] of the weighted mean, T_scene_cam.
        position: [B, 3], normalised units.
        candidate_rotations: [B, N, 3, 3].
        candidate_positions: [B, N, 3].
        log_weights: [B, N], logarithms of weights that sum to one.
        points: [B, h, w, 3] scene coordinates of the cells' centres.
        resemblance: [B, h * w, N * h' * w'] log softmax of the comparison of the image's cells
            with all of the source views'; None without `lookup`.
    """

    rotation: Tensor
    position: Tensor
    candidate_rotations: Tensor
    candidate_positions: Tensor
    log_weights: Tensor
    points: Tensor
    resemblance: Tensor | None


class PoseNetwork(nn.Module):
    """Image and source views in, coarse pose out.

    Args:
        config: what it is made of.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = make_backbone(config.backbone)
        width, channels = config.width, self.backbone.channels
        self.target_cells = nn.Linear(channels, width)
        self.source_cells = nn.Linear(channels, width)
        self.rays = _mlp(2, 64, width)
        if config.lookup:
            self.compare_target = nn.Linear(channels, _LOOKUP)
            self.compare_source = nn.Linear(channels, _LOOKUP)
            self.log_sharpness = nn.Parameter(torch.tensor(2.5))
            self.places = _mlp(3 + 2, 128, width)
        self.cells = _Residual(width)
        self.points = nn.Linear(channels, 3)
        self.moved = _mlp(width, 128, 3)
        self.query = _mlp(9, _QUERY, _QUERY)
        self.key = nn.Linear(width, _QUERY)
        self.value = nn.Linear(width, 2 * width)
        self.pooled = nn.Linear(width, 2 * width)
        self.ffn1 = _mlp(2 * width, 2 * width, 2 * width)
        self.ffn2 = _mlp(2 * width + _QUERY, 2 * width, _HIDDEN)
        self.decode = nn.Linear(_HIDDEN, 9)
        self.weigh = nn.Linear(_HIDDEN, 1)
        starts_at_zero: list[nn.Module] = [self.weigh, self.moved]
        if config.direct:
            self.whole = nn.Linear(channels, _HIDDEN)
            starts_at_zero.append(self.ffn2)
        for layer in starts_at_zero:
            nn.init.zeros_(list(layer.parameters())[-2])

    def forward(self, images: Tensor, rays: Tensor, views: SourceViews) -> Prediction:
        """Poses of images.

        Args:
            images: float [B, 3, H, W] in [0, 1]; the first B / M are of the first map.
            rays: [M, h, w, 2] x/z and y/z of the cells' centres.
            views: of M maps.
        """
        return self.predict(self.backbone(images), rays, views)

    def predict(self, features: Tensor, rays: Tensor, views: SourceViews) -> Prediction:
        """As forward, of the backbone's features [B, C, h, w]."""
        batch, _, height, width = features.shape
        rays = _repeated(self.rays(rays).flatten(1, 2), batch)
        cells = self.target_cells(_flat(features)) + rays
        seen, resemblance = torch.zeros(batch, height * width, 3), None
        if self.config.lookup:
            seen, evidence, resemblance = self._look_up(features, views)
            cells = cells + self.places(torch.cat([seen, evidence], -1))
        cells = self.cells(cells)
        points = seen + self.points(_flat(features)).float() + self.moved(cells).float()
        points = points.view(batch, height, width, 3)
        hidden = self._candidates(cells, views)
        if self.config.direct:
            hidden = hidden + self.whole(_flat(features).mean(1))[:, None]
        hidden = F.relu(hidden)
        rotations, positions = self._decoded(hidden, views)
        log_weights = torch.log_softmax(self.weigh(hidden).float().squeeze(-1), 1)
        if not self.config.weights:
            log_weights = torch.full_like(log_weights, -float(torch.log(torch.tensor(
                float(log_weights.shape[1])))))  # fmt: skip
        weights = log_weights.exp()[..., None]
        return Prediction(
            rotation=orthonormal((weights[..., None] * rotations).sum(1)[..., :2]),
            position=(weights * positions).sum(1),
            candidate_rotations=rotations,
            candidate_positions=positions,
            log_weights=log_weights,
            points=points,
            resemblance=resemblance,
        )

    def _look_up(
        self, features: Tensor, views: SourceViews
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Where in the scene the target's cells probably are: [B, U, 3], evidence [B, U, 2], and
        the resemblance [B, U, N * h * w] that says so.

        Attention of every cell of the target over all cells of all source views; the values
        are scene coordinates.
        """
        maps, batch = len(views.features), len(features)
        ours = self.compare_target(_flat(features)).float().reshape(maps, -1, _LOOKUP)
        theirs = self.compare_source(_flat(views.features.flatten(0, 1)))
        theirs = theirs.float().reshape(maps, -1, _LOOKUP)
        # what all cells of a map share tells none from another
        common = theirs.mean(1, keepdim=True)
        ours, theirs = F.normalize(ours - common, dim=-1), F.normalize(theirs - common, dim=-1)
        # cells that show nothing are ruled out by one more dimension: cheaper than a mask
        ours = torch.cat([self.log_sharpness.exp() * ours, torch.ones_like(ours[..., :1])], -1)
        unknown = -1e4 * (~views.known.reshape(maps, -1, 1)).float()
        with torch.autocast("cpu", enabled=False):
            scores = ours @ torch.cat([theirs, unknown], -1).transpose(1, 2)
            resemblance = torch.log_softmax(scores, -1)
            share = resemblance.exp()
            points = views.points.reshape(maps, -1, 3)
            moments = share @ torch.cat([points, points.square()], -1)
        mean = moments[..., :3]
        variance = (moments[..., 3:] - mean.square()).clamp(min=0).sum(-1, keepdim=True)
        peak = resemblance.detach().amax(-1, keepdim=True)
        evidence = torch.cat([variance.add(1e-6).sqrt(), peak], -1)
        return (
            mean.reshape(batch, -1, 3), evidence.reshape(batch, -1, 2),
            resemblance.reshape(batch, -1, resemblance.shape[-1]),
        )  # fmt: skip

    def _candidates(self, cells: Tensor, views: SourceViews) -> Tensor:
        """One hidden vector [B, N, width] a source view: V^i_2 of the paper."""
        batch, maps, count = len(cells), *views.features.shape[:2]
        code = torch.cat([views.rotation[..., :2].flatten(2), views.position], -1)
        query = _repeated(self.query(code), batch)
        source = self.source_cells(_flat(views.features.flatten(0, 1)).mean(1))
        source = _repeated(source.view(maps, count, -1), batch)
        # the projection of a concatenation is the sum of two projections: the source views'
        # part is computed once
        value = self.value(cells)
        pooled = value.mean(1)[:, None] + self.pooled(source)
        if self.config.attention == "views":
            keys = self.key(cells.mean(1)[:, None] + source)
            found = attend(query.to(keys.dtype), keys, pooled)
        elif self.config.attention == "tokens":
            found = self._ask(query, self.key(cells), value) + self.pooled(source)
        else:
            found = pooled
        first = self.ffn1(found) + pooled
        return self.ffn2(torch.cat([first, query.to(first.dtype)], -1))

    def _ask(self, query: Tensor, keys: Tensor, value: Tensor) -> Tensor:
        """What each source pose [B, N, 128] finds among the target's cells."""
        def split(x: Tensor) -> Tensor:
            return x.unflatten(-1, (_HEADS, -1)).transpose(1, 2)

        query = split(query.to(keys.dtype))
        found = attend(query, split(keys), split(value))
        return found.transpose(1, 2).flatten(2)

    def _decoded(self, hidden: Tensor, views: SourceViews) -> tuple[Tensor, Tensor]:
        numbers = self.decode(hidden).float()
        base = numbers.new_tensor([1.0, 0, 0, 0, 1, 0])
        columns = numbers[..., :6] + base
        rotation = orthonormal(columns.unflatten(-1, (2, 3)).transpose(-1, -2))
        position = numbers[..., 6:]
        if not self.config.relative:
            return rotation, position
        turn = _repeated(views.rotation, len(position))
        # not as matrix products, which autocast would round to bfloat16
        turned = (turn[..., None] * rotation[..., None, :, :]).sum(-2)
        moved = (turn * position[..., None, :]).sum(-1)
        return turned, _repeated(views.position, len(position)) + moved


def _mlp(inside: int, middle: int, outside: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inside, middle), nn.GELU(), nn.Linear(middle, outside))


class _Residual(nn.Module):
    """A normalised two-layer perceptron and its shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.mlp = _mlp(width, 2 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.mlp(self.norm(x))


def _repeated(of_maps: Tensor, batch: int) -> Tensor:
    """[M, ...] as [batch, ...]: each map's for all of its images."""
    return of_maps.repeat_interleave(batch // len(of_maps), 0)


def _flat(features: Tensor) -> Tensor:
    """[B, C, h, w] as cells [B, h * w, C]."""
    return features.permute(0, 2, 3, 1).flatten(1, 2)


def orthonormal(columns: Tensor) -> Tensor:
    """Rotations [..., 3, 3] whose first two columns come from [..., 3, 2] by Gram and Schmidt
    (the continuous representation of Zhou et al. 2019)."""
    x = F.normalize(columns[..., 0], dim=-1)
    y = columns[..., 1]
    y = F.normalize(y - (x * y).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)
