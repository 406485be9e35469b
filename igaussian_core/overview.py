"""A look at a map that nobody described: which way is up, from where to see it, an orbit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.camera_traces import likely_camera_positions, size_distance_correlation
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import inverse
from igaussian_core.lifting import trusted_depth
from igaussian_core.views import look_at, up_rotation

Array = NDArray[np.float64]

# trained maps of rooms and landscapes reach 0.33 to 0.63 from their best place, objects seen
# from all around 0.15 to 0.21
_SCENE_CORRELATION = 0.28
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "-y": (0.0, -1.0, 0.0)}


@dataclass(frozen=True)
class UpAxis:
    """A scene's likely up direction.

    Attributes:
        label: "x", "y", "z" or "-y".
        confidence: "stated" by the file, "likely", or "guess".
        reason: one line for people.
    """

    label: str
    confidence: str
    reason: str

    @property
    def vector(self) -> Array:
        return np.array(_AXES[self.label])


@dataclass(frozen=True)
class Overview:
    """What the Gaussians alone tell of a map, and a view that shows it.

    Attributes:
        kind: "object" (seen from outside) or "scene" (seen from where its cameras were).
        up: the up axis.
        camera: pinhole camera of the view.
        T_scene_cam: [4, 4] pose of the view.
        target: [3] the scene point that the view looks at.
    """

    kind: str
    up: UpAxis
    camera: Camera
    T_scene_cam: Array
    target: Array


def overview(
    gmap: GaussianMap, width: int = 960, height: int = 720, kind: str | None = None
) -> Overview:
    """Find the kind of map where it is not known, its up axis and a camera that shows it.

    Raises:
        MapError: the map is empty.
    """
    low, high = gmap.bounds()
    camera = _camera_of(width, height)
    kind = kind or kind_of(gmap)
    up = likely_up(gmap, kind)
    centre = 0.5 * (low + high)
    if kind == "object":
        half_view = np.arctan(0.5 * min(height / camera.fy, width / camera.fx))
        radius = 0.55 * float(np.linalg.norm(high - low)) / np.sin(half_view)
        T = _around(centre, radius, up.vector, azimuth_deg=35.0, elevation_deg=20.0)
        return Overview(kind, up, camera, T, centre)
    T = _best_scene_view(gmap, low, high, up.vector, camera)
    return Overview(kind, up, camera, T, view_target(gmap, camera, T))


def kind_of(gmap: GaussianMap) -> str:
    """"scene" where the Gaussians' sizes point at a place that they were seen from, or where
    they are the floor, the ceiling and the walls of a box; else "object".

    Raises:
        MapError: the map is empty.
    """
    low, high = gmap.bounds()
    if best_correlation(gmap) > _SCENE_CORRELATION or _is_hollow(gmap, low, high):
        return "scene"
    return "object"


def best_correlation(gmap: GaussianMap, samples: int = 800) -> float:
    """Highest correlation of the Gaussians' log size and log distance from random places.

    Raises:
        MapError: the map is empty.
    """
    low, high = gmap.bounds()
    unit = np.random.default_rng(0).random((samples, 3))
    positions = low - 0.75 * (high - low) + unit * 2.5 * (high - low)
    return float(size_distance_correlation(gmap, positions, low, high).max())


def likely_up(gmap: GaussianMap, kind: str) -> UpAxis:
    """z (robotics, Blender), -y (COLMAP), or what the file says.

    Raises:
        MapError: the map is empty.
    """
    if gmap.vertical_axis:
        return UpAxis(gmap.vertical_axis, "stated", "the file names its vertical axis")
    low, high = gmap.bounds()
    return _up_of_object(gmap, low, high) if kind == "object" else _up_of_scene(gmap, low, high)


def view_target(gmap: GaussianMap, camera: Camera, T_scene_cam: Array) -> Array:
    """The scene point [3] at median depth along the view's axis."""
    small = camera.scaled_to_fit(160)
    _, depth, alpha = gmap.render(small, inverse(T_scene_cam))
    low, high = gmap.bounds()
    seen = depth[alpha > 0.5]
    distance = float(np.median(seen)) if len(seen) else 0.5 * float(np.linalg.norm(high - low))
    return np.asarray(T_scene_cam[:3, 3] + distance * T_scene_cam[:3, 2])


def orbit(kind: str, T_scene_cam: Array, target: Array, up: Array, count: int) -> Array:
    """Poses [count, 4, 4]: once around an object, or a small circle that keeps a scene in view."""
    angles = 2 * np.pi * np.arange(count) / count
    position, distance = T_scene_cam[:3, 3], float(np.linalg.norm(T_scene_cam[:3, 3] - target))
    if kind == "object":
        frame = up_rotation(up)
        offset = frame.T @ (position - target)
        cos, sin = np.cos(angles), np.sin(angles)
        turned = np.stack([cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1],
                           np.full(count, offset[2])], axis=1)  # fmt: skip
        positions = target + turned @ frame.T
    else:
        right, down = T_scene_cam[:3, 0], T_scene_cam[:3, 1]
        positions = position + 0.12 * distance * (
            np.sin(angles)[:, None] * right + 0.4 * np.cos(angles)[:, None] * down
        )
    return np.array([look_at(p, target, up) for p in positions])


def _is_hollow(gmap: GaussianMap, low: Array, high: Array) -> bool:
    """A room: most Gaussians lie at the bounding box's sides, and the middle is free."""
    unit = (gmap.means - low) / np.maximum(high - low, 1e-12)
    at_side = (np.minimum(unit, 1 - unit).min(axis=1) < 0.05)[gmap.opacities > 0.1]
    if at_side.size == 0 or at_side.mean() < 0.6:
        return False
    cube = Camera(48, 48, 24.0, 24.0, 23.5, 23.5)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    depths, alphas = [], []
    for direction in (*np.eye(3), *-np.eye(3)):
        T = look_at(centre, centre + direction)
        _, depth, alpha = gmap.render(cube, inverse(T))
        depths.append(depth)
        alphas.append(alpha)
    solid = np.array(alphas) > 0.5
    return bool(solid.mean() > 0.8 and np.median(np.array(depths)[solid]) > 0.12 * size)


def _camera_of(width: int, height: int) -> Camera:
    focal = 0.5 * max(width, height) / np.tan(np.radians(65) / 2)
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _around(
    centre: Array, radius: float, up: Array, azimuth_deg: float, elevation_deg: float
) -> Array:
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    direction = np.array([
        np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth),
        np.sin(elevation),
    ])  # fmt: skip
    return look_at(centre + radius * (up_rotation(up) @ direction), centre, up)


def _up_of_object(gmap: GaussianMap, low: Array, high: Array) -> UpAxis:
    """The side on which flat Gaussians gather (a ground), else the one that ends at the origin."""
    ground = {name: _ground(gmap, low, high, np.array(_AXES[name])) for name in ("z", "-y", "y")}
    best = max(ground, key=lambda name: ground[name])
    others = max(value for name, value in ground.items() if name != best)
    if ground[best] > 0.15 and ground[best] > 2 * others:
        return UpAxis(best, "likely", f"{ground[best]:.0%} of the surface is flat and at its foot")
    extent = float(np.max(high - low))
    for name in ("-y", "z", "y"):
        axis = np.array(_AXES[name])
        heights = sorted((float(low @ axis), float(high @ axis)))
        if abs(heights[0]) < 0.05 * extent and heights[1] > 0.3 * extent:
            return UpAxis(name, "likely", "the object stands on the origin's plane")
    return UpAxis("z", "guess", "nothing in the map tells; z is the usual axis of objects")


def _ground(gmap: GaussianMap, low: Array, high: Array, up: Array) -> float:
    """Share of the flat Gaussians' area that is level and within the lowest tenth."""
    order = np.sort(gmap.scales, axis=1)
    axis = int(np.argmax(np.abs(up)))
    flat = (order[:, 0] < 0.5 * order[:, 1]) & (gmap.opacities > 0.3)
    # a flat ground may lie exactly at the lowest percentile
    margin = 1e-3 * (high - low)
    flat &= ((gmap.means > low - margin) & (gmap.means < high + margin)).all(axis=1)
    if not flat.any():
        return 0.0
    area = order[flat, 1] * order[flat, 2]
    area = np.minimum(area, np.percentile(area, 99))
    level = np.abs(_thin_axes(gmap, flat)[:, axis]) > 0.9
    height = (gmap.means[flat, axis] - low[axis]) / max(high[axis] - low[axis], 1e-12)
    at_foot = (height if up[axis] > 0 else 1 - height) < 0.1
    return float(area[level & at_foot].sum() / area.sum())


def _thin_axes(gmap: GaussianMap, mask: NDArray[np.bool_]) -> Array:
    """Unit normals [M, 3]: the axis of each chosen Gaussian's smallest scale."""
    w, x, y, z = gmap.quats_wxyz[mask].astype(np.float64).T
    columns = np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], axis=1),
        np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1),
    ])  # fmt: skip
    return np.asarray(columns[gmap.scales[mask].argmin(axis=1), np.arange(int(mask.sum()))])


def _up_of_scene(gmap: GaussianMap, low: Array, high: Array) -> UpAxis:
    """Rooms are lower than wide; cameras look about level, so up is not along their view."""
    if (shortest := int(np.argmin(high - low))) != 0 and _is_hollow(gmap, low, high):
        return UpAxis(("-y", "z")[shortest - 1], "likely", "a closed room, lower than it is wide")
    centre = np.median(likely_camera_positions(gmap, low, high, samples=1500), axis=0)
    towards = 0.5 * (low + high) - centre
    towards = np.abs(towards) / max(float(np.linalg.norm(towards)), 1e-12)
    if towards[2] > 0.8:
        return UpAxis("-y", "likely", "the cameras looked along z, as in frames of photogrammetry")
    if towards[1] > 0.8:
        return UpAxis("z", "likely", "the cameras looked along y, so y is not vertical")
    if high[1] - low[1] < 0.6 * (high[2] - low[2]):
        return UpAxis("-y", "guess", "the map is flattest along y")
    return UpAxis("z", "guess", "nothing in the map tells; z is the usual axis in robotics")


def _best_scene_view(
    gmap: GaussianMap, low: Array, high: Array, up: Array, camera: Camera
) -> Array:
    """Of poses where the training cameras probably were, the one whose small render is clearest."""
    rng = np.random.default_rng(0)
    likely = likely_camera_positions(gmap, low, high, samples=1500)
    positions: list[Array] = [np.median(likely, axis=0), *likely[:: max(1, len(likely) // 11)]]
    # the middle of a room, and where the first camera of many trackers stood
    positions += [0.5 * (low + high), np.zeros(3)]
    small = camera.scaled_to_fit(128)
    best, best_score = look_at(positions[0], 0.5 * (low + high), up), -1.0
    for position in positions:
        targets = low + (0.25 + 0.5 * rng.random((3, 3))) * (high - low)
        for target in (0.5 * (low + high), *targets):
            if np.allclose(target, position):
                continue
            T = look_at(position, target, up)
            score = _clarity(gmap, small, T, 0.06 * float(np.linalg.norm(high - low)))
            if score > best_score:
                best, best_score = T, score
    return best


def _clarity(gmap: GaussianMap, camera: Camera, T_scene_cam: Array, clearance: float) -> float:
    """Share of pixels with a surface, times its detail; less where things are right ahead."""
    rgb, depth, alpha = gmap.render(camera, inverse(T_scene_cam))
    solid = alpha > 0.5
    if not solid.any():
        return 0.0
    near = float(np.percentile(depth[solid], 5))
    grey = np.clip(rgb, 0, 1).mean(axis=2)
    detail = float(np.abs(np.diff(grey, axis=0)).mean() + np.abs(np.diff(grey, axis=1)).mean())
    surface = float(trusted_depth(depth, alpha, 0.8, 0.1).mean())
    return surface * min(1.0, near / clearance) * min(detail, 0.05)
