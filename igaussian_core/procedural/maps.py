"""A procedural map, with what training needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.gaussian_map import GaussianMap

Array = NDArray[np.float64]

_BATCH = 256


@dataclass(frozen=True)
class FreeSpace:
    """Room for cameras: a box without the boxes around solids, all in scene units.

    Attributes:
        low, high: [3], corners of what is inside the walls.
        solids_low, solids_high: [N, 3].
        clearance: least distance from walls and solids.
    """

    low: Array
    high: Array
    solids_low: Array
    solids_high: Array
    clearance: float

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Mask [M] of points [M, 3]."""
        inside = np.all(
            (points >= self.low + self.clearance) & (points <= self.high - self.clearance), axis=1
        )
        p = points[:, None]
        outside = np.maximum(np.maximum(self.solids_low - p, p - self.solids_high), 0)
        return np.asarray(inside & (np.linalg.norm(outside, axis=2) >= self.clearance).all(axis=1))

    def share(self, rng: np.random.Generator) -> float:
        """About how much of the box, less its clearance, is free."""
        return float(self.contains(self._draw(rng)).mean())

    def _draw(self, rng: np.random.Generator) -> Array:
        return rng.uniform(self.low + self.clearance, self.high - self.clearance, (_BATCH, 3))

    def draw(self, rng: np.random.Generator, count: int) -> Array:
        """Free points [count, 3], uniform."""
        found = np.zeros((0, 3))
        while len(found) < count:
            points = self._draw(rng)
            found = np.concatenate([found, points[self.contains(points)]])
        return found[:count]


@dataclass(frozen=True)
class ProceduralMap:
    """A generated map.

    Attributes:
        gmap: its Gaussians; rooms in metres, objects with cameras at 4 units.
        kind: "scene" for a room, seen from inside, or "object".
        up: unit vector.
        centre: [3], of the object, or a free place in the room's middle.
        radius: of an object the distance from which a camera with 39 degrees of view sees it
            whole; of a room the paper's 0.1.
        free: where cameras may be; None for an object.
    """

    gmap: GaussianMap
    kind: str
    up: tuple[float, float, float]
    centre: Array
    radius: float
    free: FreeSpace | None = None

    def free_positions(self, rng: np.random.Generator, count: int) -> Array:
        """Camera positions [count, 3] in a room's free space.

        Raises:
            ValueError: an object has no inside.
        """
        if self.free is None:
            raise ValueError("an object has no free space inside; place cameras on its sphere")
        return self.free.draw(rng, count)
