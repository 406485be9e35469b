"""Where source views are placed: the paper's sphere, and poses spread over known cameras."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.geometry import compose

Array = NDArray[np.float64]

KINDS = ("object", "scene")
# Section IV of the paper: elevation +-[30, 60] degrees; read as polar angles they would give
# only 8 distinct positions, all above the centre
ELEVATIONS_DEG = (-60.0, -30.0, 30.0, 60.0)
AZIMUTHS_DEG = (0.0, 90.0, 180.0, 270.0)


def look_at(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """T_scene_cam [4, 4] of a camera at `position` that looks at `target` (paper, eq. 2).

    Optical axes: x right, y down, z forward. Where the view is along `up`, any horizontal
    direction is taken for the image's x axis.
    """
    position = np.asarray(position, np.float64)
    forward = np.asarray(target, np.float64) - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, np.float64))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right = right / np.linalg.norm(right)
    return compose(np.stack([right, np.cross(forward, right), forward], axis=1), position)


def sphere_point(radius: float, elevation_deg: float, azimuth_deg: float) -> Array:
    """Eq. 1 of the paper about the z axis, with the polar angle as 90 degrees - elevation."""
    polar, azimuth = np.radians(90.0 - elevation_deg), np.radians(azimuth_deg)
    return radius * np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )


def up_rotation(up: ArrayLike) -> Array:
    """Rotation [3, 3] that takes the z axis to `up`."""
    z = np.asarray(up, np.float64) / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def spherical_views(
    kind: str,
    radius: float,
    centre: ArrayLike = (0.0, 0.0, 0.0),
    up: ArrayLike = (0.0, 0.0, 1.0),
    elevations_deg: tuple[float, ...] = ELEVATIONS_DEG,
    azimuths_deg: tuple[float, ...] = AZIMUTHS_DEG,
) -> Array:
    """T_scene_cam [N, 4, 4] on a sphere: object looks at the centre, scene away from it."""
    centre = np.asarray(centre, np.float64)
    rotation = up_rotation(up)
    poses = []
    for elevation in elevations_deg:
        for azimuth in azimuths_deg:
            offset = rotation @ sphere_point(radius, elevation, azimuth)
            target = centre if kind == "object" else centre + 2 * offset
            poses.append(look_at(centre + offset, target, up))
    return np.array(poses)


def fibonacci_directions(count: int, lowest: float = -1.0, highest: float = 1.0) -> Array:
    """Unit vectors [count, 3] evenly spread over the sphere's zone lowest <= z <= highest."""
    index = np.arange(count) + 0.5
    z = highest - (highest - lowest) * index / count
    azimuth = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    r = np.sqrt(np.maximum(0, 1 - z * z))
    return np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)


def spread_indices(T_scene_cam: ArrayLike, count: int, length: float) -> NDArray[np.int64]:
    """Indices of at most `count` poses [N, 4, 4] spread by farthest-point sampling.

    The distance of two cameras is that of their positions, plus `length` a radian of viewing
    direction.
    """
    T = np.asarray(T_scene_cam, np.float64)
    if len(T) <= count:
        return np.arange(len(T))
    chosen = [0]
    nearest = np.full(len(T), np.inf)
    while len(chosen) < count:
        last = T[chosen[-1]]
        cosine = np.clip(T[:, :3, 2] @ last[:3, 2], -1, 1)
        distance = np.linalg.norm(T[:, :3, 3] - last[:3, 3], axis=1) + length * np.arccos(cosine)
        nearest = np.minimum(nearest, distance)
        chosen.append(int(np.argmax(nearest)))
    return np.sort(np.array(chosen))
