"""Fewer Gaussians for the same views: level of detail by importance, and what it costs in PSNR."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import MapError
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import inverse
from igaussian_core.view_planning import SourceView

Array = NDArray[np.float64]

_BUDGET_STEPS = 6


@dataclass(frozen=True)
class Pruned:
    """A smaller map and its price.

    Attributes:
        gmap: the kept Gaussians, in their old order.
        psnr: [V] dB of its renders against the whole map's at the views it is judged on.
        milliseconds, milliseconds_before: time of one of these renders, median over the views.
    """

    gmap: GaussianMap
    psnr: Array
    milliseconds: float
    milliseconds_before: float


def importance(gmap: GaussianMap, views: Sequence[SourceView], threads: int | None = None) -> Array:
    """How much a map's renders would miss each Gaussian, [N], unit-free.

    opacity x area^(1/8) x (1 + pixels)^(1/4): the area of its two largest axes, and the pixels
    of all views in which it contributes most. The exponents are what kept most PSNR on four
    maps (`benchmarks/pruning.py`); with 1 in place of 1/8, giant faint Gaussians displace the
    rest, and hard tests of visibility lose what other views see.
    """
    pixels = np.zeros(len(gmap))
    for view in views:
        render = gmap.rasterizer().render(
            view.camera.undistorted(), inverse(view.T_scene_cam), threads=threads, outputs=("ids",)
        )
        assert render.ids is not None
        pixels += np.bincount(render.ids[render.ids >= 0], minlength=len(gmap))
    order = np.sort(gmap.scales, axis=1).astype(np.float64)
    area = order[:, 1] * order[:, 2]
    return np.asarray(gmap.opacities * area**0.125 * (1 + pixels) ** 0.25)


def pruned(gmap: GaussianMap, keep: int, importances: Array) -> GaussianMap:
    """The `keep` most important Gaussians, in their old order.

    Raises:
        MapError: `keep` is not positive.
    """
    if keep < 1:
        raise MapError(f"pruning to {keep} Gaussians leaves no map")
    if keep >= len(gmap):
        return dataclasses.replace(gmap)
    return gmap.subset(np.sort(np.argsort(-importances, kind="stable")[:keep]))


def prune(
    gmap: GaussianMap,
    views: Sequence[SourceView],
    keep: int | None = None,
    max_milliseconds: float | None = None,
    threads: int | None = None,
) -> Pruned:
    """Prune to a count, or to the most Gaussians whose renders keep within a time.

    Every fourth view is left out of the importances and judges the result.

    Args:
        views: places that the map will be seen from, four or more.
        keep: how many Gaussians to keep.
        max_milliseconds: budget of the median render, on this machine with these threads.

    Raises:
        MapError: fewer than four views, neither or both limits, or a budget that 1 % of the
            Gaussians exceed.
    """
    if len(views) < 4:
        raise MapError(f"pruning needs 4 views or more to judge by, not {len(views)}")
    if (keep is None) == (max_milliseconds is None):
        raise MapError("pruning: give the count to keep, or the milliseconds a render may take")
    judges = list(views[3::4])
    weights = importance(gmap, [v for i, v in enumerate(views) if i % 4 != 3], threads)
    before = _milliseconds(gmap, judges, threads)
    if keep is None:
        assert max_milliseconds is not None
        keep = _within_budget(gmap, weights, judges, max_milliseconds, before, threads)
    result = pruned(gmap, keep, weights)
    after = _milliseconds(result, judges, threads)
    return Pruned(result, measure(result, gmap, judges, threads), after, before)


def measure(
    gmap: GaussianMap, whole: GaussianMap, views: Sequence[SourceView], threads: int | None = None
) -> Array:
    """PSNR [V] in dB of one map's renders against another's, at most 99."""
    values = []
    for view in views:
        camera, T_cam_scene = view.camera.undistorted(), inverse(view.T_scene_cam)
        a, b = (
            np.clip(m.render(camera, T_cam_scene, threads=threads)[0], 0, 1) for m in (gmap, whole)
        )
        error = float(np.mean((a - b) ** 2, dtype=np.float64))
        values.append(-10 * np.log10(max(error, 10**-9.9)))
    return np.array(values)


def _within_budget(
    gmap: GaussianMap, weights: Array, judges: list[SourceView], budget: float, whole: float,
    threads: int | None,
) -> int:  # fmt: skip
    """The largest count, to a few per cent, whose median render takes at most `budget` ms."""
    if whole <= budget:
        return len(gmap)
    low, high = max(1, len(gmap) // 100), len(gmap)
    took = _milliseconds(pruned(gmap, low, weights), judges, threads)
    if took > budget:
        raise MapError(f"pruning: {low} Gaussians take {took:.1f} ms already, more than the "
                       f"budget of {budget:g} ms")  # fmt: skip
    for _ in range(_BUDGET_STEPS):
        middle = round(np.sqrt(low * high))
        fits = _milliseconds(pruned(gmap, middle, weights), judges, threads) <= budget
        low, high = (middle, high) if fits else (low, middle)
    return low


def _milliseconds(gmap: GaussianMap, views: list[SourceView], threads: int | None) -> float:
    """Median over the views of the fastest of five renders: other load only adds time."""
    fastest = []
    for view in views:
        camera, T_cam_scene = view.camera.undistorted(), inverse(view.T_scene_cam)
        times = []
        for _ in range(5):
            start = time.perf_counter()
            gmap.render(camera, T_cam_scene, threads=threads)
            times.append((time.perf_counter() - start) * 1e3)
        fastest.append(min(times))
    return float(np.median(fastest))
