"""The recording (a rosbag2 directory with mcap storage) and the mapping run's cameras."""

from __future__ import annotations

import json
import multiprocessing
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from . import sensor
from .drive import Drive, image_times, mapping_poses, planar, simulate_odometry
from .drive import T_base_cam as mounting
from .gaussians import quaternion
from .raycast import RayCaster
from .surfaces import Array, Room

START_NS = 1_717_236_000_000_000_000  # 2024-06-01 10:00 UTC
IMAGE_DELAY_NS, ODOM_DELAY_NS = 24_000_000, 1_500_000  # from stamp to arrival
CAMERA_FRAME, BASE_FRAME, ODOM_FRAME, MAP_FRAME = "camera_optical_frame", "base_link", "odom", "map"
TOPICS = {
    "/camera/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/camera/camera_info": "sensor_msgs/msg/CameraInfo",
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/ground_truth/pose": "geometry_msgs/msg/PoseStamped",
}
_SENSOR_DATA = {"/camera/image_raw/compressed", "/camera/camera_info"}
_STORE = get_typestore(Stores.ROS2_JAZZY)

Timed = tuple[int, str, Any]  # arrival in ns, topic, message


def write_recording(room: Room, folder: Path) -> None:
    """Write drive.mcap and metadata.yaml into folder, replacing what is there."""
    drive = Drive()
    messages = [*_camera_messages(room, drive), *_odometry_messages(drive), *_truth(drive)]
    messages.append((START_NS, "/tf_static", _static_transform()))
    messages.sort(key=lambda item: item[0])
    shutil.rmtree(folder, ignore_errors=True)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections = {
            topic: writer.add_connection(
                topic, kind, typestore=_STORE, offered_qos_profiles=[_qos(topic)]
            )
            for topic, kind in TOPICS.items()
        }
        for arrival, topic, message in messages:
            data = _STORE.serialize_cdr(message, TOPICS[topic])
            writer.write(connections[topic], arrival, data)


def _qos(topic: str) -> Qos:
    best_effort = topic in _SENSOR_DATA
    latched = topic == "/tf_static"
    forever = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        1 if latched else 5 if best_effort else 100,
        QosReliability.BEST_EFFORT if best_effort else QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )


# ---------------------------------------------------------------- messages
def _type(name: str) -> Any:
    return _STORE.types[name]


def _header(time_ns: int, frame: str) -> Any:
    stamp = _type("builtin_interfaces/msg/Time")(time_ns // 10**9, time_ns % 10**9)
    return _type("std_msgs/msg/Header")(stamp, frame)


def _ns(seconds: float) -> int:
    return START_NS + round(seconds * 1000) * 1_000_000


def _vector(x: float, y: float, z: float) -> Any:
    return _type("geometry_msgs/msg/Vector3")(float(x), float(y), float(z))


def _ros_quaternion(R: Array) -> Any:
    w, x, y, z = map(float, quaternion(R))
    return _type("geometry_msgs/msg/Quaternion")(x, y, z, w)


def _pose(T: Array) -> Any:
    point = _type("geometry_msgs/msg/Point")(*map(float, T[:3, 3]))
    return _type("geometry_msgs/msg/Pose")(point, _ros_quaternion(T[:3, :3]))


def _transform(time_ns: int, parent: str, child: str, T: Array) -> Any:
    body = _type("geometry_msgs/msg/Transform")(_vector(*T[:3, 3]), _ros_quaternion(T[:3, :3]))
    stamped = _type("geometry_msgs/msg/TransformStamped")
    message = stamped(_header(time_ns, parent), child, body)
    return _type("tf2_msgs/msg/TFMessage")([message])


def _static_transform() -> Any:
    return _transform(START_NS, BASE_FRAME, CAMERA_FRAME, mounting())


def _camera_messages(room: Room, drive: Drive) -> Iterator[Timed]:
    compressed = _type("sensor_msgs/msg/CompressedImage")
    for time, data in zip(image_times(), _photos(room, drive), strict=True):
        stamp = _ns(time)
        header = _header(stamp, CAMERA_FRAME)
        buffer = np.frombuffer(data, np.uint8)
        image = compressed(header, "rgb8; jpeg compressed bgr8", buffer)
        yield stamp + IMAGE_DELAY_NS, "/camera/image_raw/compressed", image
        yield stamp + IMAGE_DELAY_NS, "/camera/camera_info", _camera_info(header)


def _camera_info(header: Any) -> Any:
    K = sensor.camera_matrix()
    region = _type("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
    return _type("sensor_msgs/msg/CameraInfo")(
        header,
        sensor.HEIGHT,
        sensor.WIDTH,
        "plumb_bob",
        np.array(sensor.DISTORTION),
        K.ravel(),
        np.eye(3).ravel(),
        np.hstack([K, np.zeros((3, 1))]).ravel(),
        0,
        0,
        region,
    )


def _truth(drive: Drive) -> Iterator[Timed]:
    stamped = _type("geometry_msgs/msg/PoseStamped")
    for time in image_times():
        stamp = _ns(time)
        pose = _pose(drive.T_map_cam(float(time)))
        yield stamp, "/ground_truth/pose", stamped(_header(stamp, MAP_FRAME), pose)


def _odometry_messages(drive: Drive) -> Iterator[Timed]:
    readings = simulate_odometry(drive)
    for time, place, speed, turn in zip(
        readings.times, readings.x_y_yaw, readings.speed, readings.turn, strict=True
    ):
        stamp = _ns(time)
        T_odom_base = planar(*place)
        yield stamp + ODOM_DELAY_NS, "/odom", _odometry(stamp, T_odom_base, speed, turn)
        transform = _transform(stamp, ODOM_FRAME, BASE_FRAME, T_odom_base)
        yield stamp + ODOM_DELAY_NS, "/tf", transform


def _odometry(stamp: int, T_odom_base: Array, speed: float, turn: float) -> Any:
    held = 1e6  # what wheels do not measure
    pose_covariance = np.diag([0.02, 0.02, held, held, held, 0.03]).ravel()
    twist_covariance = np.diag([4e-4, 1e-4, held, held, held, 6e-4]).ravel()
    twist = _type("geometry_msgs/msg/Twist")(_vector(speed, 0, 0), _vector(0, 0, turn))
    return _type("nav_msgs/msg/Odometry")(
        _header(stamp, ODOM_FRAME),
        BASE_FRAME,
        _type("geometry_msgs/msg/PoseWithCovariance")(_pose(T_odom_base), pose_covariance),
        _type("geometry_msgs/msg/TwistWithCovariance")(twist, twist_covariance),
    )


# ---------------------------------------------------------------- pictures
_model: sensor.CameraModel | None = None  # each worker process has its own


def _start_worker(room: Room, drive: Drive) -> None:
    global _model
    cv2.setNumThreads(1)
    _model = sensor.CameraModel(RayCaster(room), drive)


def _take(index: int) -> bytes:
    assert _model is not None
    return sensor.to_jpeg(_model.photo(index))


def _photos(room: Room, drive: Drive) -> Iterator[bytes]:
    """JPEG files of all images, in order."""
    # spawned, since a fork of a process with OpenCV threads may hang
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, context, _start_worker, (room, drive)) as pool:
        yield from pool.map(_take, range(len(image_times())), chunksize=4)


def write_mapping_cameras(path: Path) -> None:
    """poses.json of the mapping run: a pinhole camera, corner-origin pixels, no image files."""
    intrinsics = {
        "width": sensor.WIDTH,
        "height": sensor.HEIGHT,
        "fx": sensor.FX,
        "fy": sensor.FY,
        "cx": sensor.CX + 0.5,
        "cy": sensor.CY + 0.5,
    }
    frames = [
        {"file": "", **intrinsics, "T_world_cam": np.round(T, 6).tolist()} for T in mapping_poses()
    ]
    lines = ",\n".join(json.dumps(frame) for frame in frames)
    head = {
        "name": "demo room, mapping run",
        "convention": "T_world_cam is camera to world, OpenCV axes; pixel coordinates count from "
        "the image's corner (first pixel's centre at 0.5)",
        "scale": "metric",
    }
    path.write_text(json.dumps(head)[:-1] + ', "frames": [\n' + lines + "\n]}\n")


def read_jpegs(folder: Path) -> list[bytes]:
    """The JPEG files of a recording made by write_recording(), in order."""
    with Reader(folder) as reader:
        wanted = [c for c in reader.connections if c.topic == "/camera/image_raw/compressed"]
        images = [_STORE.deserialize_cdr(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]
    return [bytes(image.data) for image in images]  # type: ignore[attr-defined]
