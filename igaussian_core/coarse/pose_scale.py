"""Positions of a map in the units that the pose network computes in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_FAR = 2.0  # lengths, beyond which scene coordinates are contracted


@dataclass(frozen=True)
class PoseScale:
    """Normalised = (scene - centre) / length.

    Attributes:
        centre: [3], scene units: an object's middle, or that of a scene's cameras.
        length: scene units: an object's radius R, or the extent of a scene's cameras.
    """

    centre: tuple[float, float, float]
    length: float

    def normalized(self, points_scene: ArrayLike) -> Array:
        """Points [..., 3]."""
        return (np.asarray(points_scene, np.float64) - self.centre) / self.length

    def scene(self, points: ArrayLike) -> Array:
        """The inverse."""
        return np.asarray(points, np.float64) * self.length + self.centre


def contracted(points: Array) -> Array:
    """Points [..., 3] with the world beyond two lengths drawn into a shell of two more, so that
    far backgrounds stay finite (as in Mip-NeRF 360)."""
    norm = np.linalg.norm(points, axis=-1, keepdims=True) / _FAR
    safe = np.maximum(norm, 1.0)
    return np.asarray(points * (2 - 1 / safe) / safe)


def expanded(points: Array) -> Array:
    """The inverse of `contracted`; what lies outside its range is put far away."""
    norm = np.linalg.norm(points, axis=-1, keepdims=True) / _FAR
    inside = np.clip(norm, 1.0, 1.999)
    return np.asarray(points / np.where(norm > 1, norm * (2 - inside), 1.0))
