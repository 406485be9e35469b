"""A box room of coloured Gaussians with a procedural texture, and poses inside it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from igaussian_core.camera import Camera
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import inverse, quaternion_from_rotation
from igaussian_core.views import look_at

SIZE = np.array([3.0, 2.6, 2.0])  # from the origin, metres, z up
CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
SH0 = 0.28209479177387814


def room(seed: int, per_metre: float = 21.0) -> GaussianMap:
    """Flat Gaussians on floor, ceiling and four walls, and on a box that stands in the room."""
    rng = np.random.default_rng(seed)
    parts = [plane(rng, origin, u, v, per_metre) for origin, u, v in _planes()]
    means = np.concatenate([part[0] for part in parts])
    quats = np.concatenate([part[1] for part in parts])
    colours = np.concatenate([part[2] for part in parts])
    sigma = 0.5 / per_metre
    return GaussianMap(
        means.astype(np.float32),
        quats.astype(np.float32),
        np.tile(np.array([sigma, sigma, 2e-3], np.float32), (len(means), 1)),
        np.full(len(means), 0.96, np.float32),
        ((colours - 0.5) / SH0)[:, None].astype(np.float32),
    )


def _planes() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Origin and two edges of each rectangle."""
    x, y, z = np.diag(SIZE)
    o = np.zeros(3)
    sides = [(o, x, y), (z, x, y), (o, x, z), (y, x, z), (o, y, z), (x, y, z)]
    corner, edge = np.array([1.9, 1.7, 0.0]), 0.6
    a, b, c = edge * np.eye(3)
    box = [
        (corner, a, c),
        (corner + b, a, c),
        (corner, b, c),
        (corner + a, b, c),
        (corner + c, a, b),
    ]
    return sides + box


def plane(
    rng: np.random.Generator, origin: np.ndarray, u: np.ndarray, v: np.ndarray, per_metre: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lengths = np.linalg.norm(u), np.linalg.norm(v)
    n, m = (max(2, round(length * per_metre)) for length in lengths)
    s, t = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m)
    # a perfect lattice would look alike everywhere
    s = s + rng.uniform(-0.3, 0.3, s.shape) / n
    t = t + rng.uniform(-0.3, 0.3, t.shape) / m
    means = origin + s.reshape(-1, 1) * u + t.reshape(-1, 1) * v
    x, y = u / lengths[0], v / lengths[1]
    quat = quaternion_from_rotation(np.stack([x, y, np.cross(x, y)], 1))
    return means, np.tile(quat, (len(means), 1)), _texture(rng, s * lengths[0], t * lengths[1])


def _texture(rng: np.random.Generator, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Colours [N, 3]: blocks of three sizes, so that there is structure at every distance."""
    colour = np.full((*s.shape, 3), 0.5)
    for cell, strength in ((0.7, 0.18), (0.25, 0.18), (0.1, 0.22)):
        i, j = (s / cell).astype(int), (t / cell).astype(int)
        table = rng.uniform(-strength, strength, (i.max() + 1, j.max() + 1, 3))
        table += rng.uniform(-strength, strength, (*table.shape[:2], 1))
        colour += table[i, j]
    return np.clip(colour, 0.02, 0.98).reshape(-1, 3)


def source_poses() -> list[np.ndarray]:
    """T_scene_cam of cameras at two heights that look all around."""
    poses = []
    for x, y, z in ((0.9, 0.8, 0.8), (1.6, 1.1, 1.2), (0.8, 1.9, 1.0)):
        for azimuth in np.radians(np.arange(0, 360, 60) + 40 * x):
            target = [x + np.cos(azimuth), y + np.sin(azimuth), z - 0.15]
            poses.append(look_at([x, y, z], target))
    return poses


def query_poses(count: int = 6, seed: int = 5) -> list[np.ndarray]:
    """T_scene_cam of poses at which no source view was rendered."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(count):
        position = rng.uniform([0.7, 0.7, 0.7], [1.5, 1.6, 1.3])
        azimuth, rise = rng.uniform(0, 2 * np.pi), rng.uniform(-0.35, 0.1)
        target = position + [np.cos(azimuth), np.sin(azimuth), rise]
        up = [rng.normal(0, 0.08), rng.normal(0, 0.08), 1.0]
        poses.append(look_at(position, target, up))
    return poses


def photo(
    gmap: GaussianMap, T_scene_cam: np.ndarray, camera: Camera = CAMERA, seed: int = 0
) -> np.ndarray:
    """uint8 RGB as a camera would take it: another exposure, and noise."""
    rgb, _, _ = gmap.render(camera, inverse(T_scene_cam), threads=2)
    noise = np.random.default_rng(seed).normal(0, 3, rgb.shape)
    return np.clip(rgb * 235 + 8 + noise, 0, 255).astype(np.uint8)


def write_poses(file: Path, poses: list[np.ndarray], camera: Camera = CAMERA) -> Path:
    """poses.json, which counts pixels from the image's corner."""
    common = {
        "width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx + 0.5, "cy": camera.cy + 0.5,
    }  # fmt: skip
    frames = [
        {"file": f"{i}.png", **common, "T_world_cam": T.tolist()} for i, T in enumerate(poses)
    ]
    file.write_text(json.dumps({"frames": frames}))
    return file
