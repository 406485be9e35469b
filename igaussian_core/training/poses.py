"""Where training views are taken: the paper's sphere, near known cameras, between them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.geometry import compose, interpolate_pose, rotation_from_vector
from igaussian_core.sphere import Sphere
from igaussian_core.views import look_at, up_rotation

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], Array]

_MAX_ELEVATION = np.radians(80.0)
_NEIGHBOURS = 6


@dataclass(frozen=True)
class PoseSampler:
    """Draws T_scene_cam of training views.

    Attributes:
        sphere: the paper's, of source poses; targets lie on an object's, or about a scene's.
        length: what offsets are measured in: an object's radius, a scene's extent of cameras.
        known: [M, 4, 4] poses that see the map well, training cameras where there are some.
        near_known: share of the views drawn near and between `known`.
        free: draws positions [3] in free space, for rooms that have no known cameras.
    """

    sphere: Sphere
    length: float
    known: Array
    near_known: float
    free: Draw | None = None

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Poses [count, 4, 4]; whether they show anything is not asked."""
        return np.array([self._one(rng) for _ in range(count)]).reshape(-1, 4, 4)

    def _one(self, rng: np.random.Generator) -> Array:
        if len(self.known) and rng.random() < self.near_known:
            return self._near_known(rng)
        return self._on_sphere(rng) if self.sphere.kind == "object" else self._around(rng)

    def _on_sphere(self, rng: np.random.Generator) -> Array:
        """Towards an object's middle from all sides, at its radius."""
        centre = np.asarray(self.sphere.centre)
        radius = self.sphere.radius * rng.uniform(0.93, 1.07)
        direction = _direction(rng, self.sphere.up)
        target = centre + rng.uniform(-0.07, 0.07, 3) * self.sphere.radius
        return _rolled(look_at(centre - radius * direction, target, self.sphere.up), rng, 3.0)

    def _around(self, rng: np.random.Generator) -> Array:
        """From the sphere's middle in all directions, or from free space."""
        if self.free is not None:
            position = self.free(rng)
        elif len(self.known) and rng.random() < 0.4:
            a, b = self.known[rng.integers(len(self.known), size=2), :3, 3]
            position = a + rng.uniform(0, 1) * (b - a) + rng.normal(0, 0.05, 3) * self.length
        else:
            spread = 0.25 + self.sphere.radius
            position = np.asarray(self.sphere.centre) + rng.uniform(-spread, spread, 3)
        direction = _direction(rng, self.sphere.up)
        return _rolled(look_at(position, position + direction, self.sphere.up), rng, 3.0)

    def _near_known(self, rng: np.random.Generator) -> Array:
        """Between a known pose and one of its neighbours, and a little beside."""
        first = self.known[rng.integers(len(self.known))]
        cost = np.linalg.norm(self.known[:, :3, 3] - first[:3, 3], axis=1) / self.length
        cost += np.arccos(np.clip(self.known[:, :3, 2] @ first[:3, 2], -1, 1))
        near = np.argsort(cost, kind="stable")[1 : _NEIGHBOURS + 1]
        second = self.known[rng.choice(near)] if len(near) else first
        T = interpolate_pose(first, second, rng.uniform(-0.2, 1.2))
        wide = rng.random() < 0.3  # places that the map's cameras barely visited
        turn = np.radians(rng.normal(0, 14.0 if wide else 6.0, 3)) * (1, 1, 0.5)
        move = rng.normal(0, 0.18 if wide else 0.06, 3) * self.length
        return compose(T[:3, :3] @ rotation_from_vector(turn), T[:3, 3] + move)


def _direction(rng: np.random.Generator, up: tuple[float, float, float]) -> Array:
    """Unit vector evenly spread over the sphere without its polar caps."""
    z = rng.uniform(-np.sin(_MAX_ELEVATION), np.sin(_MAX_ELEVATION))
    azimuth = rng.uniform(0, 2 * np.pi)
    level = np.sqrt(1 - z * z)
    return _turned_up(up) @ np.array([level * np.cos(azimuth), level * np.sin(azimuth), z])


_turned_up = functools.cache(up_rotation)


def _rolled(T_scene_cam: Array, rng: np.random.Generator, sigma_deg: float) -> Array:
    roll = rotation_from_vector([0, 0, np.radians(rng.normal(0, sigma_deg))])
    return T_scene_cam @ compose(roll, np.zeros(3))
