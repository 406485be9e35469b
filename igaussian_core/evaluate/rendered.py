"""The rendered track: the paper's protocol, targets rendered from the map itself.

Section IV of the paper: per scene 100 targets in each of three bins of angular distance from a
source pose, translation offset within +-0.2. What the paper leaves open is fixed here: the
camera stays upright, an object's target moves about its centre and looks at it, a scene's
target turns on the spot; elevations stay within +-75 degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.evaluate.metrics import QueryOutcome, outcome
from igaussian_core.geometry import Sim3
from igaussian_core.localizer import Localizer
from igaussian_core.views import look_at, spherical_views, up_rotation

Array = NDArray[np.float64]

BINS_DEG = ((20.0, 40.0), (40.0, 80.0), (80.0, 180.0))
_MAX_ELEVATION = np.radians(75.0)


@dataclass(frozen=True)
class Target:
    """One query: the bin it belongs to, its true pose and its seed for photometric changes."""

    name: str
    bin: str
    T_scene_cam: Array
    seed: int


@dataclass(frozen=True)
class Sphere:
    """The sphere of source poses that targets start from, scene units and axes."""

    kind: str
    radius: float
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


def targets(
    sphere: Sphere, each: int = 100, translation: float = 0.2, seed: int = 0
) -> list[Target]:
    """`each` targets a bin; `translation` 0 is the pure-rotation test."""
    rng = np.random.default_rng(seed)
    sources = spherical_views(sphere.kind, sphere.radius, sphere.centre, sphere.up)
    result = []
    for low, high in BINS_DEG:
        name = f"{low:g}-{high:g}"
        for index in range(each):
            source = sources[rng.integers(len(sources))]
            angle = np.radians(rng.uniform(low, high))
            T_scene_cam = _offset(sphere, source, angle, rng)
            T_scene_cam[:3, 3] += rng.uniform(-translation, translation, 3)
            result.append(
                Target(f"{name}/{index:03d}", name, T_scene_cam, int(rng.integers(2**31)))
            )
    return result


def evaluate_rendered(
    localizer: Localizer,
    queries: Sequence[Target],
    camera: Camera,
    photometric: bool = True,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[QueryOutcome]:
    """Render each target from the map, localize it from nothing, compare.

    Args:
        camera: pinhole, of the targets.
        photometric: change colour and brightness of the targets as the paper does.
    """
    outcomes = []
    T_map_scene: Sim3 = localizer.T_map_scene
    for index, query in enumerate(queries):
        truth = T_map_scene.camera(query.T_scene_cam)
        rgb, _, _ = localizer.render(camera, truth)
        image = changed_colours(rgb, query.seed) if photometric else _to_u8(rgb)
        outcomes.append(outcome(query.name, localizer.localize(image, camera), truth))
        progress(index + 1, len(queries))
    return outcomes


def changed_colours(rgb: NDArray[np.float32], seed: int) -> NDArray[np.uint8]:
    """uint8 image with another brightness (0.7 to 1.3), white balance (+-10 %), gamma, noise."""
    rng = np.random.default_rng(seed)
    gain = rng.uniform(0.7, 1.3) * rng.uniform(0.9, 1.1, 3)
    changed = np.clip(rgb, 0, 1) ** rng.uniform(0.85, 1.18) * gain
    noisy = changed + rng.normal(0, 0.01, rgb.shape)
    return _to_u8(noisy.astype(np.float32))


def _offset(sphere: Sphere, source: Array, angle: float, rng: np.random.Generator) -> Array:
    """A pose whose viewing direction is `angle` away from the source's, upright."""
    to_local = up_rotation(sphere.up).T
    forward = to_local @ source[:3, 2]
    while True:
        # a random great circle through the source's direction
        bearing = rng.normal(size=3)
        side = bearing - (bearing @ forward) * forward
        side /= np.linalg.norm(side)
        direction = np.cos(angle) * forward + np.sin(angle) * side
        if abs(np.arcsin(np.clip(direction[2], -1, 1))) <= _MAX_ELEVATION:
            break
    direction = to_local.T @ direction
    centre = np.asarray(sphere.centre)
    if sphere.kind == "object":
        return look_at(centre - sphere.radius * direction, centre, sphere.up)
    position = source[:3, 3]
    return look_at(position, position + direction, sphere.up)


def _to_u8(rgb: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8)
