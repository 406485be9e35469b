"""From lit patches to flat Gaussians: small where the texture varies, large where it does not.

Each texture is cut into cells by a quadtree; a cell is halved both ways where its squared colour
error times its area is above a threshold, and the threshold is chosen for the wanted number of
Gaussians. A cell becomes one Gaussian of its mean colour, lying in the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import quaternion_from_rotation
from igaussian_core.procedural.patches import Patch
from igaussian_core.procedural.textures import Image

Array = NDArray[np.float64]

SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
SH_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
_EDGE_WEIGHT = 0.5  # how much contrast a free edge counts as
_SHARPEN = 0.8  # undoes part of the blur of overlapping Gaussians


@dataclass(frozen=True)
class Finish:
    """How a map departs from a perfect one.

    Attributes:
        sigma: standard deviation of a Gaussian in cell sizes.
        jitter: of places, in cell sizes.
        scale_noise: deviation of log scales.
        opacity: least and largest.
        floaters: share of Gaussians that hang in the air.
        gloss: strength of the view-dependent part; 0 leaves SH degree 0.
        light: unit vector towards the light that gloss mirrors.
    """

    sigma: float
    jitter: float
    scale_noise: float
    opacity: tuple[float, float]
    floaters: float
    gloss: float
    light: Array


def random_finish(rng: np.random.Generator) -> Finish:
    """Between a clean map and one of a mediocre training."""
    light = rng.normal(size=3) + [0, 0, 2.0]
    low = rng.uniform(0.88, 0.98)
    return Finish(
        rng.uniform(0.54, 0.66), rng.uniform(0, 0.1), rng.uniform(0, 0.2), (low, 0.99),
        rng.uniform(0, 0.004), float(rng.random() < 0.5) * rng.uniform(0.02, 0.12),
        light / np.linalg.norm(light),
    )  # fmt: skip


@dataclass(frozen=True)
class _Level:
    """One level of a patch's quadtree: sharpened means, error, visible share; [rows, cols, ..]"""

    colours: Image
    error: Image
    share: Image


def lay(
    patches: list[Patch], budget: int, detail: Array, finish: Finish, rng: np.random.Generator
) -> GaussianMap:
    """Gaussians of all patches, about `budget` of them.

    Args:
        detail: [len(patches)] weights: below one blurs a patch.
    """
    trees = [_tree(patch, weight) for patch, weight in zip(patches, detail, strict=True)]
    roots = sum(tree[-1].error.size for tree in trees)
    errors = np.concatenate(
        [level.error.ravel() for tree in trees for level in tree[1:]] or [np.zeros(1, np.float32)]
    )
    splits = int(np.clip((budget - roots) / 3, 1, len(errors) - 1))
    threshold = float(np.partition(errors, len(errors) - splits)[len(errors) - splits])
    parts = [
        _gaussians(patch, tree, max(threshold, 1e-12))
        for patch, tree in zip(patches, trees, strict=True)
    ]
    means, axes, cells, colours = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _finished(means, axes, cells, colours, finish, rng)


def _tree(patch: Patch, weight: float) -> list[_Level]:
    """Levels from single texels to the largest cells."""
    rows, cols = patch.texture.shape[:2]
    mask = np.ones((rows, cols), np.float32) if patch.mask is None else patch.mask.astype("f4")
    border = mask.copy()
    if patch.free_edges and min(rows, cols) > 4:
        border[[0, -1]], border[:, [0, -1]] = 0, 0
    area = patch.size[0] * patch.size[1] / (rows * cols) * weight
    seen = np.concatenate([patch.texture, border[..., None] * _EDGE_WEIGHT], axis=2)
    sums, squares, share = seen, (seen**2).sum(axis=2), mask
    colour_sums = patch.texture * mask[..., None]
    levels = []
    for level in range(patch.levels + 1):
        if level:
            sums, squares, share, colour_sums = (
                _pool(a) for a in (sums, squares, share, colour_sums)
            )
        n = 4.0**level
        error = (squares - (sums**2).sum(axis=2) / n) * area
        visible = colour_sums / np.maximum(share, 0.5)[..., None]
        means = np.where(share[..., None] > 0.5, visible, sums[..., :3] / n)
        sharp = np.clip(means + _SHARPEN * (means - _box3(means)), 0, 1).astype(np.float32)
        levels.append(_Level(sharp, np.maximum(error, 0), (share / n).astype(np.float32)))
    return levels


def _pool(a: Image) -> Image:
    return a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]


def _box3(a: Image) -> Image:
    """Means over 3x3 neighbours."""
    p = np.pad(a, [(1, 1), (1, 1), (0, 0)], mode="edge")
    rows = p[:-2] + p[1:-1] + p[2:]
    return np.asarray((rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9)


def _gaussians(
    patch: Patch, tree: list[_Level], threshold: float
) -> tuple[Array, Array, Array, Image]:
    """Means [N, 3], axes [N, 3, 3] as columns, cell sizes [N, 2], colours [N, 3]."""
    rows, cols = patch.texture.shape[:2]
    reached = np.ones(tree[-1].error.shape, bool)
    s, t, side, colours = [], [], [], []
    for level in range(len(tree) - 1, -1, -1):
        split = reached & (tree[level].error > threshold) if level else np.zeros_like(reached)
        r, c = np.nonzero(reached & ~split & (tree[level].share > 0.3))
        s.append((c + 0.5) * 2**level / cols)
        t.append((r + 0.5) * 2**level / rows)
        side.append(np.full(len(r), float(2**level)))
        colours.append(tree[level].colours[r, c])
        reached = split.repeat(2, 0).repeat(2, 1)
    return *_frames(patch, *map(np.concatenate, (s, t, side))), np.concatenate(colours)


def _frames(patch: Patch, s: Array, t: Array, side: Array) -> tuple[Array, Array, Array]:
    """Middles, axes and sizes of cells at (s, t), `side` texels wide."""
    rows, cols = patch.texture.shape[:2]
    ds, dt = 0.5 * side / cols, 0.5 * side / rows
    u = patch.at(s + ds, t) - patch.at(s - ds, t)
    v = patch.at(s, t + dt) - patch.at(s, t - dt)
    size = np.stack([np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)], 1)
    # a pole's cells have no width: then any direction does
    u = np.where(size[:, :1] > 1e-9, u, np.roll(v, 1, axis=1))
    u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-12)
    n = np.cross(u, v)
    small = np.linalg.norm(n, axis=1, keepdims=True) < 1e-12
    n = np.where(small, np.cross(u, [0.36, 0.48, 0.8]), n)
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    return patch.at(s, t), np.stack([u, np.cross(n, u), n], axis=2), size


def _finished(
    means: Array, axes: Array, cells: Array, colours: Image, finish: Finish,
    rng: np.random.Generator,
) -> GaussianMap:  # fmt: skip
    count = len(means)
    floor = 0.25 * np.median(cells)
    cells = np.maximum(cells, 0.2 * floor)
    shift = rng.normal(0, finish.jitter, (count, 2)) * cells
    means = means + np.einsum("nij,nj->ni", axes[:, :, :2], shift)
    noise = np.exp(rng.normal(0, finish.scale_noise, (count, 2)))
    flat = 0.12 * cells.min(axis=1, keepdims=True) * rng.uniform(0.3, 1.5, (count, 1))
    scales = np.concatenate([finish.sigma * cells * noise, flat], axis=1)
    opacities = rng.uniform(*finish.opacity, count)
    sh = _harmonics(colours, axes[:, :, 2], finish)
    arrays = [means, _quaternions(axes), scales, opacities, sh]
    arrays = _with_floaters(arrays, int(finish.floaters * count), floor, rng)
    m, q, s, o, h = (np.ascontiguousarray(a, np.float32) for a in arrays)
    return GaussianMap(means=m, quats_wxyz=q, scales=s, opacities=o, sh=h)


def _harmonics(colours: Image, away: Array, finish: Finish) -> Array:
    """[N, 1 or 4, 3]; the linear part brightens towards the mirrored light."""
    base = (colours[:, None].astype(np.float64) - 0.5) / SH_C0
    if finish.gloss == 0:
        return base
    normal = -away
    mirrored = 2 * (normal @ finish.light)[:, None] * normal - finish.light
    # seen along d, the colour gains -gloss d . mirrored
    x, y, z = (finish.gloss / SH_C1 * mirrored).T
    linear = np.stack([y, -z, x], axis=1)[..., None].repeat(3, axis=2)
    return np.concatenate([base, linear], axis=1)


def _with_floaters(
    arrays: list[Array], count: int, size: float, rng: np.random.Generator
) -> list[Array]:
    """Some Gaussians once more, moved off their surface: small, round, half transparent."""
    which = rng.integers(0, len(arrays[0]), count)
    means, quats, scales, opacities, sh = (a[which].copy() for a in arrays)
    middle = arrays[0].mean(axis=0)
    means += (middle - means) * rng.uniform(0.02, 0.4, (count, 1))
    scales[:] = size * rng.uniform(0.5, 3, (count, 1))
    opacities[:] = rng.uniform(0.1, 0.6, count)
    return [
        np.concatenate([a, b])
        for a, b in zip(arrays, (means, quats, scales, opacities, sh), strict=True)
    ]


def _quaternions(rotations: Array) -> Array:
    """wxyz [N, 4] of rotations [N, 3, 3] (Shepperd 1978); few differ, as surfaces are flat."""
    flat = np.round(rotations.reshape(-1, 9), 7)
    distinct, where = np.unique(flat, axis=0, return_inverse=True)
    if len(distinct) < 2000:
        table = np.array([quaternion_from_rotation(r.reshape(3, 3)) for r in distinct])
        return np.asarray(table[where.ravel()])
    return _shepperd(rotations)


def _shepperd(R: Array) -> Array:
    d = np.einsum("nii->ni", R)
    squares = np.stack(
        [1 + d.sum(1), 1 + 2 * d[:, 0] - d.sum(1), 1 + 2 * d[:, 1] - d.sum(1),
         1 + 2 * d[:, 2] - d.sum(1)], 1,
    )  # fmt: skip
    a, b, c = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    e, f, g = R[:, 1, 0] + R[:, 0, 1], R[:, 0, 2] + R[:, 2, 0], R[:, 2, 1] + R[:, 1, 2]
    w, x, y, z = squares.T
    candidates = np.stack(
        [np.stack([w, a, b, c], 1), np.stack([a, x, e, f], 1), np.stack([b, e, y, g], 1),
         np.stack([c, f, g, z], 1)], 1,
    )  # fmt: skip
    q = candidates[np.arange(len(R)), squares.argmax(axis=1)]
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))
