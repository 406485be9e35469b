"""Light, baked into the textures: lamps, window and two diffuse bounces with soft shadows.

A grid of light texels ("lumels") covers every surface. Each sends cosine-weighted rays into the
room and some to the large emitters; what the rays hit gives the light of the next bounce
(a gathering form of radiosity). Only + - * / and sqrt touch the geometry, in float32, which
every CPU rounds alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .surfaces import Array, Image, Room, Surface

Array32 = NDArray[np.float32]
LUMEL = 0.08  # metres
SIDE = 8  # SIDE^2 gathering rays a lumel
EMITTER_SIDE = 4  # EMITTER_SIDE^2 shadow rays a lumel and emitter
EXPOSURE = 0.88
GAMMA = 2.2
_CHUNK = 1 << 15


@dataclass(frozen=True)
class Lumels:
    """All lumels in one list. first[i], shape[i]: where surface i's grid starts, its size."""

    points: Array
    normals: Array
    tangents: Array
    first: list[int]
    shape: list[tuple[int, int]]
    hidden: NDArray[np.bool_]


def bake(room: Room) -> None:
    """Replace every surface's albedo texture by its lit appearance, gamma-encoded uint8."""
    lumels = _lumels(room)
    direct = _direct(room, lumels)
    hit_lumel, hit_surface = _gather_hits(room, lumels)
    albedo = np.array([_linear(s.texture).mean((0, 1)) for s in room.surfaces])
    owner = np.repeat(np.arange(len(room.surfaces)), [r * c for r, c in lumels.shape])
    glow = np.array([s.emission for s in room.surfaces])
    large = [i for i, s in enumerate(room.surfaces) if _is_large_emitter(s)]
    glow_gathered = glow.copy()
    glow_gathered[large] = 0  # these came with the shadow rays
    irradiance = direct
    for _ in range(2):
        leaving = glow_gathered[owner] + albedo[owner] * _smooth(irradiance, lumels)
        incoming = np.where((hit_surface >= 0)[..., None], leaving[hit_lumel], 0.0)
        irradiance = direct + incoming.mean(1)
    irradiance = _smooth(irradiance, lumels)
    for i, surface in enumerate(room.surfaces):
        if any(surface.emission):
            continue
        rows, cols = lumels.shape[i]
        grid = irradiance[lumels.first[i] : lumels.first[i] + rows * cols].reshape(rows, cols, 3)
        surface.texture = _lit(surface.texture, np.round(grid, 5))


def _lit(texture: Image, irradiance: Array) -> Image:
    size = (texture.shape[1], texture.shape[0])
    light = cv2.resize(irradiance, size, interpolation=cv2.INTER_LINEAR)
    linear = _linear(texture) * np.maximum(light, 0) * EXPOSURE
    # a soft shoulder instead of hard clipping near the lamps
    shoulder = np.where(linear < 0.7, linear, 0.7 + 0.3 * (1 - 1 / (1 + (linear - 0.7) / 0.3)))
    return np.clip(np.rint(255 * shoulder ** (1 / GAMMA)), 0, 255).astype(np.uint8)


def _linear(texture: Image) -> Array:
    table = (np.arange(256) / 255) ** GAMMA
    return table[texture]


def _is_large_emitter(surface: Surface) -> bool:
    width, height = surface.size
    return any(surface.emission) and width * height > 0.2


def _lumels(room: Room) -> Lumels:
    points, normals, tangents, first, shape = [], [], [], [], []
    count = 0
    for surface in room.surfaces:
        width, height = surface.size
        rows, cols = max(2, round(height / LUMEL)), max(2, round(width / LUMEL))
        s, t = np.meshgrid((np.arange(cols) + 0.5) / cols, (np.arange(rows) + 0.5) / rows)
        points.append(surface.points(s, t).reshape(-1, 3))
        normals.append(np.broadcast_to(surface.normal, (rows * cols, 3)))
        tangents.append(np.broadcast_to(surface.edge_u / width, (rows * cols, 3)))
        first.append(count)
        shape.append((rows, cols))
        count += rows * cols
    everything = np.concatenate(points)
    facing = np.concatenate(normals)
    hidden = room.hidden(everything + facing * 0.002)
    return Lumels(everything, facing, np.concatenate(tangents), first, shape, hidden)


def _smooth(values: Array, lumels: Lumels) -> Array:
    """Blur each surface's grid over 3x3 lumels, leaving out the hidden ones and filling them."""
    result = values.copy()
    for first, (rows, cols) in zip(lumels.first, lumels.shape, strict=True):
        part = slice(first, first + rows * cols)
        weight = np.where(lumels.hidden[part], 1e-6, 1.0).reshape(rows, cols)
        grid = values[part].reshape(rows, cols, 3) * weight[..., None]
        for _ in range(2):
            grid, weight = _box3(grid), _box3(weight)
        result[part] = (grid / weight[..., None]).reshape(-1, 3)
    return result


def _box3(values: Array) -> Array:
    pad = [(1, 1), (1, 1)] + [(0, 0)] * (values.ndim - 2)
    p = np.pad(values, pad, mode="edge")
    rows = p[:-2] + 2 * p[1:-1] + p[2:]
    return np.asarray((rows[:, :-2] + 2 * rows[:, 1:-1] + rows[:, 2:]) / 16)


def _direct(room: Room, lumels: Lumels) -> Array:
    """Irradiance / pi from the large emitters, by shadow rays."""
    total = np.zeros((len(lumels.points), 3))
    rng = np.random.default_rng(11)
    for index, emitter in enumerate(room.surfaces):
        if not _is_large_emitter(emitter):
            continue
        n, side = len(lumels.points), EMITTER_SIDE
        cell = np.arange(side * side)
        s = (cell % side + rng.random((n, side * side))) / side
        t = (cell // side + rng.random((n, side * side))) / side
        to = emitter.points(s, t) - lumels.points[:, None]
        square = np.sum(to * to, -1)
        distance = np.sqrt(square)
        direction = to / distance[..., None]
        cos_here = np.maximum(np.sum(direction * lumels.normals[:, None], -1), 0)
        cos_there = np.maximum(-np.sum(direction * emitter.normal, -1), 0)
        near, who, _, _ = _trace(room, lumels, direction)
        seen = (who == index) | (near > distance - 0.01)
        area = emitter.size[0] * emitter.size[1]
        gain = (cos_here * cos_there / np.maximum(square, 0.02) * seen).mean(1) * area / np.pi
        total += gain[:, None] * np.array(emitter.emission)
    return total


def _gather_hits(room: Room, lumels: Lumels) -> tuple[NDArray[np.intp], NDArray[np.int16]]:
    """Which lumel and which surface each gathering ray meets, both [lumels, rays]."""
    rng = np.random.default_rng(12)
    n, cell = len(lumels.points), np.arange(SIDE * SIDE)
    radius = np.sqrt((cell // SIDE + 0.5) / SIDE)
    angle = 2 * np.pi * (cell % SIDE + 0.5) / SIDE + np.pi / SIDE * (cell // SIDE)
    x0, y0 = np.round(radius * np.cos(angle), 9), np.round(radius * np.sin(angle), 9)
    z0 = np.sqrt(1 - radius * radius)
    turn = 2 * np.pi * rng.random(n)
    c, s = np.round(np.cos(turn), 9)[:, None], np.round(np.sin(turn), 9)[:, None]
    x, y = c * x0 - s * y0, s * x0 + c * y0
    bitangents = np.cross(lumels.normals, lumels.tangents)
    direction = (
        x[..., None] * lumels.tangents[:, None]
        + y[..., None] * bitangents[:, None]
        + z0[:, None] * lumels.normals[:, None]
    )
    _, who, s_hit, t_hit = _trace(room, lumels, direction)
    rows = np.array([shape[0] for shape in lumels.shape])[who]
    cols = np.array([shape[1] for shape in lumels.shape])[who]
    row = np.clip((t_hit * rows).astype(int), 0, rows - 1)
    col = np.clip((s_hit * cols).astype(int), 0, cols - 1)
    return np.array(lumels.first)[who] + row * cols + col, who


def _trace(
    room: Room, lumels: Lumels, direction: Array
) -> tuple[Array32, NDArray[np.int16], Array32, Array32]:
    """Nearest hits of rays [lumels, rays, 3]: distance, surface or -1, place (s, t) on it."""
    n, count = direction.shape[:2]
    origin = (lumels.points + lumels.normals * 0.003).astype(np.float32)
    d = direction.astype(np.float32)
    near = np.full((n, count), np.inf, np.float32)
    who = np.full((n, count), -1, np.int16)
    s_hit, t_hit = np.zeros((n, count), np.float32), np.zeros((n, count), np.float32)
    step = max(1, _CHUNK // count)
    frames = [_frame(surface) for surface in room.surfaces]
    for start in range(0, n, step):
        part = slice(start, start + step)
        axes = np.ascontiguousarray(np.moveaxis(d[part], -1, 0))
        for index, frame in enumerate(frames):
            _meet(
                index, frame, origin[part], axes, (near[part], who[part], s_hit[part], t_hit[part])
            )
    return near, who, s_hit, t_hit


def _frame(surface: Surface) -> tuple[Array32, Array32]:
    """Corner, and the rows that give (s, t, height) from an offset."""
    u, v = surface.edge_u, surface.edge_v
    rows = np.stack([u / np.sum(u * u), v / np.sum(v * v), surface.normal])
    return surface.corner.astype(np.float32), rows.astype(np.float32)


def _meet(
    index: int,
    frame: tuple[Array32, Array32],
    origin: Array32,
    axes: Array32,
    best: tuple[Array32, NDArray[np.int16], Array32, Array32],
) -> None:
    near, who, s_hit, t_hit = best
    corner, rows = frame
    o = origin - corner
    so, to, ho = (o[:, 0] * r[0] + o[:, 1] * r[1] + o[:, 2] * r[2] for r in rows)
    su, tv, hn = (axes[0] * r[0] + axes[1] * r[1] + axes[2] * r[2] for r in rows)
    hn = np.where(np.abs(hn) < 1e-9, np.float32(1e-9), hn)
    distance = -ho[:, None] / hn
    hit = (distance > 0) & (distance < near)
    s = so[:, None] + distance * su
    t = to[:, None] + distance * tv
    hit &= (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    np.copyto(near, distance, where=hit)
    np.copyto(who, np.int16(index), where=hit)
    np.copyto(s_hit, s, where=hit)
    np.copyto(t_hit, t, where=hit)
