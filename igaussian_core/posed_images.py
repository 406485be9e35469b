"""Files of images with known camera poses, in the formats that mapping tools write.

All of them count pixels from the image's corner; they become OpenCV's rule here (0.5 less).
"""

from __future__ import annotations

import json
import struct
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError, DatasetError
from igaussian_core.geometry import (
    Sim3,
    compose,
    interpolate_pose,
    inverse,
    is_rigid,
    rotation_from_quaternion,
)
from igaussian_core.tum import read_tum, read_tum_list

SUPPORTED = (
    "poses.json, NeRF transforms.json, INRIA cameras.json, "
    "a COLMAP model's folder (cameras and images as .bin or .txt), "
    "a TUM folder (rgb.txt, groundtruth.txt, and camera.json with the intrinsics)"
)

# of a TUM trajectory: stamps further apart are not interpolated over
_MAX_TUM_GAP_S = 0.1
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
# COLMAP's camera models: id, number of parameters, our model
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": (0, 3, "plumb_bob"),
    "PINHOLE": (1, 4, "plumb_bob"),
    "SIMPLE_RADIAL": (2, 4, "plumb_bob"),
    "RADIAL": (3, 5, "plumb_bob"),
    "OPENCV": (4, 8, "plumb_bob"),
    "OPENCV_FISHEYE": (5, 8, "equidistant"),
    "FULL_OPENCV": (6, 12, "rational_polynomial"),
}


@dataclass(frozen=True)
class PosedImage:
    """One image's name, path (which may not exist), camera and pose in the scene."""

    name: str
    path: Path
    camera: Camera
    T_scene_cam: NDArray[np.float64]

    def read(self, background: tuple[int, int, int] = (0, 0, 0)) -> NDArray[np.uint8]:
        """uint8 RGB [H, W, 3]; an alpha channel is composed over `background`.

        Raises:
            DatasetError: unreadable, or not of the camera's size.
        """
        image = read_image(self.path, background)
        if image.shape[:2] != (self.camera.height, self.camera.width):
            raise DatasetError(
                f"{self.path}: {image.shape[1]}x{image.shape[0]}, its pose file says "
                f"{self.camera.width}x{self.camera.height}"
            )
        return image


def read_image(
    path: str | Path, background: tuple[int, int, int] = (0, 0, 0)
) -> NDArray[np.uint8]:
    """uint8 RGB [H, W, 3] of an image file as it is stored (no EXIF rotation).

    Raises:
        DatasetError: missing or no image.
    """
    raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if Path(path).is_file() else None
    if raw is None:
        raise DatasetError(f"{path}: no such file" if not Path(path).is_file() else
                           f"{path}: not a readable image")  # fmt: skip
    if raw.dtype == np.uint16:
        raw = np.right_shift(raw, 8).astype(np.uint8)
    if raw.ndim == 2:
        return np.asarray(cv2.cvtColor(raw, cv2.COLOR_GRAY2RGB), np.uint8)
    if raw.shape[2] == 3:
        return np.asarray(cv2.cvtColor(raw, cv2.COLOR_BGR2RGB), np.uint8)
    rgba = cv2.cvtColor(raw, cv2.COLOR_BGRA2RGBA).astype(np.float32)
    alpha = rgba[..., 3:] / 255
    blended = rgba[..., :3] * alpha + np.array(background, np.float32) * (1 - alpha)
    return np.asarray(np.rint(blended), np.uint8)


def read_posed_images(path: str | Path) -> list[PosedImage]:
    """Cameras and poses of a file or folder, ordered as in it.

    Raises:
        DatasetError: missing, of no supported format, or with values that make no sense.
    """
    file = Path(path)
    try:
        frames = list(_read(file))
    except DatasetError:
        raise
    except CameraError as error:
        raise DatasetError(f"{file}: {error}") from error
    except (OSError, LookupError, ValueError, TypeError, AttributeError, struct.error) as error:
        cause = f"{type(error).__name__}: {error}"
        raise DatasetError(f"{file}: no camera poses ({cause}); supported: {SUPPORTED}") from error
    if not frames:
        raise DatasetError(f"{file}: holds no camera poses; supported: {SUPPORTED}")
    for frame in frames:
        if not is_rigid(frame.T_scene_cam, tolerance=1e-3):
            raise DatasetError(f"{file}: the pose of '{frame.name}' is no rigid transform")
    return frames


def _read(file: Path) -> Iterator[PosedImage]:
    if file.is_dir():
        yield from _read_folder(file)
        return
    if not file.is_file():
        raise DatasetError(f"{file}: no such file; supported: {SUPPORTED}")
    data = json.loads(file.read_text())
    if isinstance(data, list):
        yield from (_inria_frame(file, entry) for entry in data)
    elif "frames" in data and data["frames"] and "T_world_cam" in data["frames"][0]:
        yield from (_poses_frame(file, entry) for entry in data["frames"])
    elif "frames" in data:
        normalize = _nerfstudio_normalization(file, data)
        for entry in data["frames"]:
            frame = _nerf_frame(file, data, entry)
            yield replace(frame, T_scene_cam=normalize.camera(frame.T_scene_cam))
    else:
        raise DatasetError(f"{file}: JSON without 'frames'; supported: {SUPPORTED}")


def _read_folder(folder: Path) -> Iterator[PosedImage]:
    for sub in (".", "sparse/0", "sparse", "colmap/sparse/0"):
        for suffix in ("bin", "txt"):
            if (folder / sub / f"images.{suffix}").is_file():
                yield from _read_colmap(folder / sub, suffix, folder)
                return
    for name in ("poses.json", "transforms.json", "transforms_train.json", "cameras.json"):
        if (folder / name).is_file():
            yield from _read(folder / name)
            return
    if (folder / "groundtruth.txt").is_file() and (folder / "rgb.txt").is_file():
        yield from _read_tum_folder(folder)
        return
    raise DatasetError(f"{folder}: no camera poses in this folder; supported: {SUPPORTED}")


def _read_tum_folder(folder: Path) -> Iterator[PosedImage]:
    """Images that the trajectory covers, each at the pose interpolated to its stamp."""
    note = folder / "camera.json"
    if not note.is_file():
        raise DatasetError(
            f"{note}: missing; a TUM folder does not say its intrinsics: write width, height, "
            "fx, fy, cx, cy (first pixel's centre at 0) and perhaps model, dist there"
        )
    values = json.loads(note.read_text())
    camera = Camera(**{**values, "dist": tuple(values.get("dist", ()))})
    trajectory = sorted(read_tum(folder / "groundtruth.txt"), key=lambda item: item[0])
    stamps = [stamp for stamp, _ in trajectory]
    for stamp, name in read_tum_list(folder / "rgb.txt"):
        after = bisect_left(stamps, stamp)
        if after < len(stamps) and stamps[after] == stamp:
            yield PosedImage(name, folder / name, camera, trajectory[after][1])
        elif 0 < after < len(stamps) and stamps[after] - stamps[after - 1] <= _MAX_TUM_GAP_S:
            share = (stamp - stamps[after - 1]) / (stamps[after] - stamps[after - 1])
            T = interpolate_pose(trajectory[after - 1][1], trajectory[after][1], share)
            yield PosedImage(name, folder / name, camera, T)


def _corner_camera(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float,
    model: str = "plumb_bob", dist: tuple[float, ...] = (),
) -> Camera:  # fmt: skip
    """Camera of intrinsics that count pixels from the image's corner."""
    dist = dist if any(dist) or model == "equidistant" else ()
    return Camera(int(width), int(height), fx, fy, cx - 0.5, cy - 0.5, model, dist)


def _poses_frame(file: Path, e: dict[str, Any]) -> PosedImage:
    camera = _corner_camera(
        e["width"], e["height"], e["fx"], e["fy"], e["cx"], e["cy"], dist=tuple(e.get("dist", ()))
    )
    return PosedImage(e["file"], file.parent / e["file"], camera, np.array(e["T_world_cam"], float))


def _nerf_frame(file: Path, data: dict[str, Any], e: dict[str, Any]) -> PosedImage:
    path = file.parent / e["file_path"]
    if not path.suffix or not path.is_file():
        found = [path.parent / (path.name + s) for s in (".png", ".jpg", ".jpeg", ".JPG")]
        path = next((p for p in found if p.is_file()), path)

    def value(key: str, default: float | None = None) -> float | None:
        return e.get(key, data.get(key, default))

    width, height = value("w"), value("h")
    if width is None or height is None:
        height, width = read_image(path).shape[:2]
    fx = value("fl_x")
    if fx is None:
        angle = value("camera_angle_x")
        if angle is None:
            raise DatasetError(f"{file}: neither 'fl_x' nor 'camera_angle_x'")
        fx = 0.5 * width / np.tan(0.5 * angle)
    model, names = _nerf_lens(file, e.get("camera_model", data.get("camera_model", "OPENCV")),
                              bool(value("is_fisheye")))  # fmt: skip
    dist = tuple(float(value(k, 0.0) or 0) for k in names)
    camera = _corner_camera(
        int(width), int(height), float(fx), float(value("fl_y", fx) or fx),
        float(value("cx", width / 2) or 0), float(value("cy", height / 2) or 0), model,
        dist if model == "equidistant" or dist[-1] else dist[:-1],
    )  # fmt: skip
    T_scene_cam = np.array(e["transform_matrix"], float) @ _OPENCV_FROM_OPENGL
    return PosedImage(e["file_path"], path, camera, T_scene_cam)


def _nerfstudio_normalization(file: Path, data: dict[str, Any]) -> Sim3:
    """From the poses of transforms.json into the frame that nerfstudio trained in.

    `dataparser_transforms.json`, which nerfstudio writes into its output folder, tells where a
    copy lies beside the poses; identity without. Its transform takes the frame before
    `applied_transform`, the poses are after it.
    """
    note = file.parent / "dataparser_transforms.json"
    if not note.is_file():
        return Sim3.identity()
    saved = json.loads(note.read_text())
    transform = np.vstack([np.array(saved["transform"], float), [0, 0, 0, 1]])
    applied = np.vstack([np.array(data.get("applied_transform", np.eye(4)[:3]), float),
                         [0, 0, 0, 1]])  # fmt: skip
    scale = float(saved["scale"]) / float(data.get("applied_scale", 1.0))
    motion = transform @ np.linalg.inv(applied)
    return Sim3(scale, motion[:3, :3], scale * motion[:3, 3])


def _nerf_lens(file: Path, name: str, is_fisheye: bool) -> tuple[str, tuple[str, ...]]:
    """Our model and the keys of its coefficients for nerfstudio's or instant-ngp's lens."""
    if is_fisheye or name == "OPENCV_FISHEYE":
        return "equidistant", ("k1", "k2", "k3", "k4")
    if name in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
        return "plumb_bob", ("k1", "k2", "p1", "p2", "k3")
    raise DatasetError(f"{file}: camera_model {name} is not supported; supported: OPENCV, "
                       "OPENCV_FISHEYE, PINHOLE, SIMPLE_PINHOLE")  # fmt: skip


def _inria_frame(file: Path, e: dict[str, Any]) -> PosedImage:
    camera = _corner_camera(
        e["width"], e["height"], e["fx"], e["fy"], e["width"] / 2, e["height"] / 2
    )
    T_scene_cam = compose(np.array(e["rotation"], float), np.array(e["position"], float))
    return PosedImage(e["img_name"], file.parent / "images" / e["img_name"], camera, T_scene_cam)


def _read_colmap(model: Path, suffix: str, root: Path) -> Iterator[PosedImage]:
    binary = suffix == "bin"
    cameras = _colmap_cameras_bin(model) if binary else _colmap_cameras_txt(model)
    images = _colmap_images_bin(model) if binary else _colmap_images_txt(model)
    for name, camera_id, q_wxyz, t in sorted(images, key=lambda image: image[0]):
        T_cam_scene = compose(rotation_from_quaternion(q_wxyz), np.array(t))
        yield PosedImage(name, root / "images" / name, cameras[camera_id], inverse(T_cam_scene))


def _colmap_camera(model: str, width: int, height: int, p: tuple[float, ...]) -> Camera:
    if model not in _COLMAP_MODELS:
        raise CameraError(
            f"COLMAP camera model {model} is not supported; supported: {', '.join(_COLMAP_MODELS)}"
        )
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        p = (p[0], p[0], *p[1:])
    dist = p[4:]
    if model in ("SIMPLE_RADIAL", "RADIAL"):
        dist = (*dist, 0.0, 0.0, 0.0)[:4]
    fx, fy, cx, cy = p[:4]
    return _corner_camera(width, height, fx, fy, cx, cy, _COLMAP_MODELS[model][2], dist)


def _unpack(stream: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack("<" + layout, stream.read(struct.calcsize("<" + layout)))


def _unpack_name(stream: BinaryIO) -> str:
    name = b""
    while (letter := stream.read(1)) != b"\0":
        if not letter:
            raise ValueError("the file ends inside an image's name")
        name += letter
    return name.decode()


def _colmap_cameras_bin(model: Path) -> dict[int, Camera]:
    by_id = {number: (name, count) for name, (number, count, _) in _COLMAP_MODELS.items()}
    cameras = {}
    with open(model / "cameras.bin", "rb") as stream:
        for _ in range(_unpack(stream, "Q")[0]):
            camera_id, model_id, width, height = _unpack(stream, "iiQQ")
            if model_id not in by_id:
                raise CameraError(f"COLMAP camera model number {model_id} is not supported")
            name, count = by_id[model_id]
            cameras[camera_id] = _colmap_camera(name, width, height, _unpack(stream, f"{count}d"))
    return cameras


def _colmap_images_bin(model: Path) -> Iterator[tuple[str, int, Any, Any]]:
    with open(model / "images.bin", "rb") as stream:
        for _ in range(_unpack(stream, "Q")[0]):
            _, *pose, camera_id = _unpack(stream, "i7di")
            name = _unpack_name(stream)
            stream.seek(24 * _unpack(stream, "Q")[0], 1)
            yield name, camera_id, pose[:4], pose[4:]


def _colmap_cameras_txt(model: Path) -> dict[int, Camera]:
    cameras = {}
    for line in (model / "cameras.txt").read_text().splitlines():
        if line.strip() and not line.startswith("#"):
            camera_id, name, width, height, *p = line.split()
            parameters = tuple(map(float, p))
            cameras[int(camera_id)] = _colmap_camera(name, int(width), int(height), parameters)
    return cameras


def _colmap_images_txt(model: Path) -> Iterator[tuple[str, int, Any, Any]]:
    lines = (model / "images.txt").read_text().splitlines()
    rows = [line for line in lines if not line.startswith("#")]
    while rows and not rows[0].strip():
        rows.pop(0)
    for line in rows[::2]:  # every second line lists the image's points
        if line.strip():
            _, *pose, camera_id, name = line.split(maxsplit=9)
            values = [float(v) for v in pose]
            yield name, int(camera_id), values[:4], values[4:]
