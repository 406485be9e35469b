"""Light baked into textures: lamps with falloff and box shadows, ambient light, dark corners."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.procedural.patches import Assembly, Patch

Array = NDArray[np.float64]

_COARSER = 3  # light is computed on every third texel
_MAX_CASTERS = 16  # solids that cast shadows, the largest
# places on a lamp, whose shadows are averaged
_TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)


@dataclass(frozen=True)
class Lamp:
    """A point light.

    Attributes:
        position: [3]; far away it serves as a sun.
        colour: [3] light at `reach`, on a surface that faces the lamp.
        reach: distance in metres of half the strength at the lamp.
        size: the lamp's own, which softens shadows.
    """

    position: Array
    colour: Array
    reach: float
    size: float


@dataclass(frozen=True)
class Lighting:
    """All the light of a map; `room` [3] is the size of a room that darkens in its corners."""

    lamps: list[Lamp]
    ambient: Array
    room: Array | None = None


def random_lighting(
    rng: np.random.Generator, low: Array, high: Array, room: Array | None = None
) -> Lighting:
    """One to three lamps above the middle of a box low .. high, and ambient light."""
    extent = float(np.linalg.norm(high - low))
    tint = 1 + rng.normal(0, 0.06, 3)
    lamps = []
    for _ in range(rng.integers(1, 4)):
        place = low + (high - low) * rng.uniform([0.1, 0.1, 0.8], [0.9, 0.9, 0.97])
        if room is None:
            direction = rng.normal(size=3) + [0, 0, 1.2]
            place = (low + high) / 2 + 2 * extent * direction / np.linalg.norm(direction)
        colour = tint * (1 + rng.normal(0, 0.05, 3)) * rng.uniform(0.3, 0.8)
        lamps.append(Lamp(place, colour, extent * rng.uniform(0.4, 3), 0.05 * extent))
    return Lighting(lamps, rng.uniform(0.3, 0.6) * (1 + rng.normal(0, 0.05, 3)), room)


def bake(assembly: Assembly, lighting: Lighting) -> None:
    """Replace every patch's albedo by its lit appearance in 0..1."""
    grids = [_grid(patch) for patch in assembly.patches]
    points = np.concatenate([points for points, _, _ in grids])
    normals = np.concatenate([normals for _, normals, _ in grids])
    counts = [len(points) for points, _, _ in grids]
    solids = np.repeat([patch.solid for patch in assembly.patches], counts)
    light = _light(assembly, lighting, points, normals, solids)
    light *= _exposure(assembly, light, counts)
    ends = np.cumsum(counts)
    for patch, (_, _, shape), end, count in zip(
        assembly.patches, grids, ends, counts, strict=True
    ):
        rows, cols = patch.texture.shape[:2]
        part = light[end - count : end].reshape(*shape, 3).astype(np.float32)
        fine = cv2.resize(part, (cols, rows), interpolation=cv2.INTER_LINEAR)
        lit = patch.texture * (patch.glow + (1 - patch.glow) * fine)
        # a soft shoulder instead of clipping
        shoulder = np.where(lit < 0.75, lit, 1 - 0.25 * np.exp(-(lit - 0.75) / 0.25))
        patch.texture = np.clip(shoulder, 0, 1).astype(np.float32)


def _exposure(assembly: Assembly, light: Array, counts: list[int]) -> float:
    """The gain that gives the whole a brightness of about a photo's."""
    albedo = np.array([patch.texture.mean() for patch in assembly.patches])
    areas = np.array([patch.size[0] * patch.size[1] for patch in assembly.patches])
    levels = np.array([part.mean() for part in np.split(light, np.cumsum(counts)[:-1])])
    mean = float(np.average(albedo * levels, weights=areas))
    return float(assembly.rng.uniform(0.38, 0.58)) / max(mean, 1e-6)


def _grid(patch: Patch) -> tuple[Array, Array, tuple[int, int]]:
    """Points and outward normals [N, 3] of a patch's coarse grid, and the grid's shape."""
    rows, cols = (max(2, n // _COARSER) for n in patch.texture.shape[:2])
    s, t = np.meshgrid((np.arange(cols) + 0.5) / cols, (np.arange(rows) + 0.5) / rows)
    s, t = s.ravel(), t.ravel()
    e = 0.25 / max(rows, cols)
    n = np.cross(patch.at(s, t + e) - patch.at(s, t - e), patch.at(s + e, t) - patch.at(s - e, t))
    n = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-15)
    if patch.two_sided:
        n = np.where(n[:, 2:] < 0, -n, n)
    return patch.at(s, t), n, (rows, cols)


def _light(
    assembly: Assembly, lighting: Lighting, points: Array, normals: Array, solids: NDArray[np.int64]
) -> Array:
    total = np.broadcast_to(lighting.ambient, points.shape) * (0.8 + 0.2 * normals[:, 2:])
    if lighting.room is not None:
        total = total * _corners(points, lighting.room)[:, None]
    for lamp in lighting.lamps:
        to = lamp.position - points
        distance = np.linalg.norm(to, axis=1)
        facing = np.maximum(np.sum(to * normals, axis=1) / np.maximum(distance, 1e-9), 0)
        strength = facing * 2 / (1 + (distance / lamp.reach) ** 2)
        if lighting.room is None:  # a sun
            strength = facing
        seen = np.zeros(len(points))
        for offset in _TETRAHEDRON * lamp.size:
            place = lamp.position + offset
            seen += ~_shadowed(assembly, points + 1e-3 * normals, place, solids)
        strength *= 0.15 + 0.85 * seen / len(_TETRAHEDRON)
        total = total + strength[:, None] * lamp.colour
    return total


def _corners(points: Array, room: Array) -> Array:
    """Ambient occlusion of a room's edges: 1 in the middle, less where two walls are near."""
    near = np.sort(np.concatenate([points, room - points], axis=1), axis=1)
    # the nearest wall is usually the point's own
    darker = 1 - np.array([0.35, 0.2]) * np.exp(-near[:, 1:3] / 0.25)
    return np.asarray(darker.prod(axis=1))


def _shadowed(
    assembly: Assembly, points: Array, lamp: Array, solids: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Whether the box around another solid is between a point and the lamp at [3]."""
    shadow = np.zeros(len(points), bool)
    if not assembly.low:
        return shadow
    low, high = np.array(assembly.low), np.array(assembly.high)
    areas = np.sort(high - low, axis=1)[:, 1:].prod(axis=1)
    to = lamp - points
    inverse = 1 / np.where(np.abs(to) < 1e-9, 1e-9, to)
    for index in np.argsort(-areas)[:_MAX_CASTERS]:
        a, b = (low[index] - points) * inverse, (high[index] - points) * inverse
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        shadow |= (enter < leave) & (leave > 0) & (enter < 1) & (enter > -1e-6) & (solids != index)
    return shadow
