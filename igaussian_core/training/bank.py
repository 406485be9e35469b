"""Training views of one map: rendered in the background, kept, replaced by new ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from igaussian_core.camera import Camera
from igaussian_core.coarse.canonical import cell_centres, cell_rays
from igaussian_core.coarse.pose_scale import PoseScale, contracted
from igaussian_core.errors import MapError
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import inverse

Array = NDArray[np.float64]

_MIN_COVERED = 0.6  # share of a scene's view that the map must cover
_MIN_CONTRAST = 6.0  # grey levels: a bare ceiling tells nobody where he is
_CHUNK = 64
_TOGETHER = 16  # views that are rendered at once
_TRIES = 60  # chunks without a usable view before a map is given up
_WORST_YIELD = 0.02  # share of usable views below which it is given up as well


class Sampler(Protocol):
    """Draws T_scene_cam [count, 4, 4]; whether they show anything is not asked."""

    def draw(self, rng: np.random.Generator, count: int) -> Array: ...


class Views(NamedTuple):
    """Rendered views with their truth, in normalised units.

    Attributes:
        rgba: uint8 [N, H, W, 4], colours premultiplied by alpha.
        points: float32 [N, h, w, 3], contracted scene coordinates of the cells' centres.
        known: bool [N, h, w], where the map covers them.
        rotation: float32 [N, 3, 3] of T_scene_cam.
        position: float32 [N, 3].
    """

    rgba: Tensor
    points: Tensor
    known: Tensor
    rotation: Tensor
    position: Tensor

    @property
    def poses(self) -> Tensor:
        """[N, 12], rotation by rows and position: what a regression predicts."""
        return torch.cat([self.rotation.flatten(1), self.position], 1)

    def at(self, index: NDArray[np.int64]) -> Views:
        """Some of them."""
        chosen = torch.from_numpy(index).to(self.rgba.device)
        return Views(*(part[chosen] for part in self))

    def to(self, device: torch.device) -> Views:
        """All on a device."""
        return Views(*(part.to(device) for part in self))


@dataclass(frozen=True)
class ViewRenderer:
    """Renders what the network sees of a map.

    Attributes:
        gmap: the map.
        camera: the network's canonical camera.
        scale: normalisation of positions.
        min_covered: share of a view that the map must cover for it to be used.
        oversampling: views are rendered so many times as large and made small by averaging, as
            images are: at 128 pixels the renderer's low-pass filter leaves them too soft.
    """

    gmap: GaussianMap
    camera: Camera
    scale: PoseScale
    min_covered: float
    threads: int = 2
    oversampling: int = 1

    def render(self, T_scene_cam: Array) -> tuple[Views, NDArray[np.bool_]]:
        """Views of poses [N, 4, 4], and which of them show enough."""
        T = np.asarray(T_scene_cam, np.float64)
        rgba, depth = self._images(T)
        alpha = rgba[..., 3]
        u, v = np.round(np.moveaxis(cell_centres(self.camera), -1, 0)).astype(int)
        rays = cell_rays(self.camera).numpy().astype(np.float64)
        ahead = np.concatenate([rays, np.ones_like(rays[..., :1])], -1)
        points = ahead * depth[:, v, u, None].astype(np.float64)
        points = np.einsum("nij,nhwj->nhwi", T[:, :3, :3], points) + T[:, None, None, :3, 3]
        views = Views(
            rgba=torch.from_numpy((rgba * 255 + 0.5).astype(np.uint8)),
            points=torch.from_numpy(contracted(self.scale.normalized(points)).astype(np.float32)),
            known=torch.from_numpy(alpha[:, v, u] > 0.5),
            rotation=torch.from_numpy(T[:, :3, :3].astype(np.float32)),
            position=torch.from_numpy(self.scale.normalized(T[:, :3, 3]).astype(np.float32)),
        )
        covered = (alpha > 0.5).mean(axis=(1, 2))
        contrast = 255 * rgba[..., :3].mean(-1).std(axis=(1, 2))
        return views, (covered >= self.min_covered) & (contrast >= _MIN_CONTRAST)

    def _images(self, T_scene_cam: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Premultiplied RGBA [N, H, W, 4] in [0, 1], and depth [N, H, W] where alpha allows."""
        k, small = self.oversampling, self.camera
        size = (small.width, small.height)
        camera = small.resized(k * small.width, k * small.height)
        rgba = np.empty((len(T_scene_cam), small.height, small.width, 4), np.float32)
        depth = np.empty(rgba.shape[:3], np.float32)
        for first in range(0, len(T_scene_cam), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            render = self.gmap.rasterizer().render_batch(
                camera, inverse(T_scene_cam[part]), threads=self.threads
            )
            assert render.rgb is not None and render.depth is not None
            assert render.alpha is not None
            for i, image in enumerate(render.rgb):
                image = np.dstack([np.clip(image, 0, 1), render.alpha[i]])
                rgba[first + i] = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            depth[part] = render.depth[:, k // 2 :: k, k // 2 :: k]
        return rgba, depth


def draw_views(
    renderer: ViewRenderer,
    sampler: Sampler,
    rng: np.random.Generator,
    count: int,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Views:
    """`count` usable views.

    Raises:
        MapError: the map shows next to nothing from where the sampler draws.
    """
    found: list[Views] = []
    total = failed = drawn = 0
    while total < count:
        views, usable = renderer.render(sampler.draw(rng, _CHUNK))
        index = np.flatnonzero(usable)[: count - total]
        drawn += _CHUNK
        failed = 0 if len(index) else failed + 1
        found.append(views.at(index))
        total += len(index)
        too_few = drawn > _TRIES * _CHUNK and total < min(count, _WORST_YIELD * drawn)
        if failed > _TRIES or too_few:
            raise MapError(
                f"training: the map shows too little from where views are drawn: {total} of "
                f"{drawn} views are of use"
            )
        progress(total, count)
    return Views(*(torch.cat(parts) for parts in zip(*found, strict=True)))


class Bank:
    """Views of one map, the oldest of which are replaced while training goes on.

    Args:
        size: how many are kept.
    """

    def __init__(
        self,
        renderer: ViewRenderer,
        sampler: Sampler,
        size: int,
        seed: int,
        progress: Callable[[int, int], None] = lambda done, of: None,
    ) -> None:
        self._renderer, self._sampler = renderer, sampler
        self._rng = np.random.default_rng(seed)
        self.views = draw_views(renderer, sampler, self._rng, size, progress)
        self._next = 0
        self._order = np.zeros(0, np.int64)

    def __len__(self) -> int:
        return len(self.views.rgba)

    def batch(self, count: int) -> Views:
        """`count` views, each of the bank's once before any again."""
        while len(self._order) < count:
            self._order = np.concatenate([self._order, self._rng.permutation(len(self))])
        index, self._order = self._order[:count], self._order[count:]
        return self.views.at(index)

    def refresh(self, count: int) -> None:
        """Replace the oldest views by up to `count` new ones."""
        count = min(count, len(self) - self._next)
        new, usable = self._renderer.render(self._sampler.draw(self._rng, count))
        index = np.flatnonzero(usable)
        for old, fresh in zip(self.views, new.at(index), strict=True):
            old[self._next : self._next + len(index)] = fresh
        self._next = (self._next + len(index)) % len(self)
