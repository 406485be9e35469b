"""The rendered track: the paper's protocol, targets rendered from a map of the scene.

Section IV of the paper: per scene 100 targets in each of three bins of angular distance from a
source pose, translation offset within +-0.2. What the paper leaves open is fixed here: the
camera stays upright, an object's target moves about its centre and looks at it, a scene's
target turns on the spot; elevations stay within +-75 degrees. Of a scene only targets that the
map covers and that show an edge somewhere are taken: real maps are not closed all around, and
a bare ceiling tells nobody where he is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import ConfigError
from igaussian_core.evaluate.image_changes import Change, changed
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import Sim3, inverse
from igaussian_core.map_package import MapPackage
from igaussian_core.sphere import Sphere
from igaussian_core.views import look_at, spherical_views, up_rotation

Array = NDArray[np.float64]

BINS_DEG = ((20.0, 40.0), (40.0, 80.0), (80.0, 180.0))
_MAX_ELEVATION = np.radians(75.0)
_MIN_COVERED = 0.6  # share of a scene's target that the map must cover
_MIN_EDGES = 0.05  # share of its cells of 10x10 pixels that must hold an edge
_EDGE = 6.0  # grey levels a pixel, at 160 pixels
_TRIES = 200


@dataclass(frozen=True)
class Target:
    """One query: its bin, its true pose, the source pose it was drawn from, and a seed for
    changes of the image."""

    name: str
    bin: str
    T_scene_cam: Array
    T_scene_source: Array
    seed: int


def targets(
    sphere: Sphere,
    each: int = 100,
    translation: float = 0.2,
    seed: int = 0,
    usable: Callable[[Array], bool] = lambda T_scene_cam: True,
) -> list[Target]:
    """`each` targets a bin; `translation` 0 is the pure-rotation test.

    Args:
        translation: largest offset along each axis, scene units.
        usable: whether a T_scene_cam shows enough of the map; another is drawn where not.

    Raises:
        ConfigError: nothing usable is found in a bin.
    """
    rng = np.random.default_rng(seed)
    sources = spherical_views(sphere.kind, sphere.radius, sphere.centre, sphere.up)
    result = []
    for low, high in BINS_DEG:
        name = f"{low:g}-{high:g}"
        for index in range(each):
            for _ in range(_TRIES):
                source = sources[rng.integers(len(sources))]
                angle = np.radians(rng.uniform(low, high))
                T_scene_cam = _offset(sphere, source, angle, rng)
                T_scene_cam[:3, 3] += rng.uniform(-translation, translation, 3)
                if usable(T_scene_cam):
                    break
            else:
                raise ConfigError(
                    f"targets {name} degrees away: the map shows nothing in {_TRIES} of them; "
                    "another --centre, or --bin without this one"
                )
            image_seed = int(rng.integers(2**31))
            result.append(Target(f"{name}/{index:03d}", name, T_scene_cam, source, image_seed))
    return result


def shows_enough(gmap: GaussianMap, camera: Camera) -> Callable[[Array], bool]:
    """Whether a map covers most of a view and shows any edge there; for `targets` in scenes."""
    small = camera.scaled_to_fit(160)

    def enough(T_scene_cam: Array) -> bool:
        rgb, _, alpha = gmap.render(small, inverse(T_scene_cam))
        covered = (alpha > 0.5).mean() >= _MIN_COVERED
        return bool(covered and _edges(rgb) >= _MIN_EDGES)

    return enough


def _edges(rgb: NDArray[np.float32]) -> float:
    """Share of cells of 10x10 pixels that hold an edge."""
    gray = 255 * cv2.cvtColor(np.clip(rgb, 0, 1), cv2.COLOR_RGB2GRAY)
    slope = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)) / 4
    rows, columns = (n // 10 for n in slope.shape)
    cells = slope[: 10 * rows, : 10 * columns].reshape(rows, 10, columns, 10)
    return float((cells.max(axis=(1, 3)) > _EDGE).mean())


def camera_of(package: MapPackage) -> Camera:
    """The camera of the map's first source view: the training camera where one was known."""
    width, height, fx, fy, cx, cy = map(float, package.landmarks.intrinsics[0])
    return Camera(int(width), int(height), fx, fy, cx, cy)


@dataclass(frozen=True)
class RenderedQueries:
    """Targets, rendered when asked for.

    Attributes:
        gmap: what the targets are rendered from: the map's own Gaussians, or another map of
            the same scene in the same frame.
        camera: pinhole, of every target.
        background: RGB in [0, 1].
        changes: of the images.
        with_source_prior: give the source pose as prior, as iNeRF and iComMa are started.
    """

    targets: tuple[Target, ...]
    gmap: GaussianMap
    camera: Camera
    background: tuple[float, float, float]
    T_map_scene: Sim3
    changes: tuple[Change, ...] = ()
    with_source_prior: bool = False

    def __len__(self) -> int:
        return len(self.targets)

    def __getstate__(self) -> dict[str, object]:
        # a packed map stays in its process
        return {**self.__dict__, "gmap": dataclasses.replace(self.gmap, _rasterizer=None)}

    def name(self, index: int) -> str:
        return self.targets[index].name

    def group(self, index: int) -> str:
        return self.targets[index].bin

    def image(self, index: int) -> tuple[NDArray[np.uint8], Camera]:
        target = self.targets[index]
        rgb, _, _ = self.gmap.render(self.camera, inverse(target.T_scene_cam), self.background)
        image = np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8)
        return changed(image, self.changes, target.seed), self.camera

    def prior(self, index: int) -> Array | None:
        if not self.with_source_prior:
            return None
        return self.T_map_scene.camera(self.targets[index].T_scene_source)

    def truth(self, index: int) -> Array:
        return self.T_map_scene.camera(self.targets[index].T_scene_cam)


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
