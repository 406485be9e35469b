"""The paper's sphere of source poses in a compiled map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.map_package import MapPackage

Array = NDArray[np.float64]

SCENE_RADIUS = 0.1  # the paper's, map units
_FLOATERS = 20  # Gaussians that may be nearer than the nearest surface


@dataclass(frozen=True)
class Sphere:
    """The sphere of source poses that targets start from, scene units and axes."""

    kind: str
    radius: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


def sphere_of(package: MapPackage) -> Sphere:
    """The paper's sphere in a compiled map: about an object's middle with the map's radius; in
    a scene R = 0.1 about the source view with most room around it."""
    poses = package.landmarks.T_scene_cam
    mean_up = -poses[:, :3, 1].mean(axis=0)
    x, y, z = mean_up / np.linalg.norm(mean_up)
    kind = package.manifest.kind
    if kind == "object":
        low, high = np.array(package.manifest.bounds)
        centre, radius = 0.5 * (low + high), package.manifest.radius
    else:
        centre = _roomiest(package.gaussians, poses[:, :3, 3])
        radius = SCENE_RADIUS / package.T_map_scene.scale
    return Sphere(kind, radius, tuple(map(float, centre)), (float(x), float(y), float(z)))  # type: ignore[arg-type]


def _roomiest(gmap: GaussianMap, positions: Array) -> Array:
    """The position whose nearest solid Gaussians are farthest away; a few may float there."""
    solid = gmap.means[gmap.opacities > 0.5]
    if len(solid) <= _FLOATERS:
        return np.asarray(positions[0])
    clearance = [
        np.partition(np.linalg.norm(solid - p, axis=1), _FLOATERS)[_FLOATERS]
        for p in positions.astype(np.float32)
    ]
    return np.asarray(positions[int(np.argmax(clearance))])
