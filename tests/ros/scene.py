"""A small room corner with textured walls: its Gaussian map, photos of it, a recording of a drive.

The photos are drawn from the planes' textures, not from the Gaussians.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage
from std_msgs.msg import Header

from igaussian_core.bags import BagWriter
from igaussian_core.camera import Camera
from igaussian_core.compile_map import CompileOptions, compile_map
from igaussian_core.gaussian_map import GaussianMap, save_ply
from igaussian_core.geometry import compose, inverse, quaternion_from_rotation
from igaussian_core.views import look_at
from igaussian_ros.convert import pose_to_ros, transform_from_numbers

CAMERA = Camera(480, 360, 400.0, 400.0, 239.5, 179.5)
FRAME = "camera_optical_frame"
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
IMAGE_TOPIC = "/camera/image_raw/compressed"
# camera 0.2 m ahead of and 0.3 m above the base, looking forward: optical z is the base's x
BASE_TO_CAMERA = [0.2, 0.0, 0.3, -0.5, 0.5, -0.5, 0.5]
_PIXELS_PER_M = 64


@dataclass(frozen=True)
class _Plane:
    """A textured rectangle: origin, two edges in metres, RGB texture [H, W, 3]."""

    origin: np.ndarray
    u: np.ndarray
    v: np.ndarray
    texture: np.ndarray


class Scene:
    """Walls y = 3 and x = 3 and floor z = 0 of a room corner, metres."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)

        def plane(origin: list[float], u: list[float], v: list[float]) -> _Plane:
            width, height = np.linalg.norm(u), np.linalg.norm(v)
            size = (int(height * _PIXELS_PER_M), int(width * _PIXELS_PER_M))
            return _Plane(np.array(origin), np.array(u), np.array(v), _texture(rng, *size))

        self.planes = [
            plane([-3, 3, 0], [6, 0, 0], [0, 0, 2.5]),
            plane([3, 3, 0], [0, -6, 0], [0, 0, 2.5]),
            plane([-3, -3, 0], [6, 0, 0], [0, 6, 0]),
        ]

    def gaussians(self, per_m: int = 40) -> GaussianMap:
        """Flat Gaussians on the planes."""
        means, quats, colours = [], [], []
        for plane in self.planes:
            u_length, v_length = np.linalg.norm(plane.u), np.linalg.norm(plane.v)
            n, m = int(u_length * per_m), int(v_length * per_m)
            s, t = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(m) + 0.5) / m)
            means.append(plane.origin + s.reshape(-1, 1) * plane.u + t.reshape(-1, 1) * plane.v)
            x, y = plane.u / u_length, plane.v / v_length
            rotation = np.stack([x, y, np.cross(x, y)], 1)
            quats.append(np.tile(quaternion_from_rotation(rotation), (n * m, 1)))
            # rows of a texture count from the top, v from the bottom
            small = cv2.resize(plane.texture, (n, m), interpolation=cv2.INTER_AREA)
            colours.append(small[::-1].reshape(-1, 3) / 255.0)
        count = sum(len(part) for part in means)
        sigma = 0.45 / per_m
        return GaussianMap(
            np.concatenate(means).astype(np.float32),
            np.concatenate(quats).astype(np.float32),
            np.tile(np.array([sigma, sigma, 1e-3], np.float32), (count, 1)),
            np.full(count, 0.97, np.float32),
            ((np.concatenate(colours) - 0.5) / 0.28209479)[:, None].astype(np.float32),
        )

    def photo(self, T_map_cam: np.ndarray, camera: Camera = CAMERA) -> np.ndarray:
        """uint8 RGB of the planes, each warped by its homography, the farthest first."""
        image = np.full((camera.height, camera.width, 3), 20, np.uint8)
        T_cam_map = inverse(T_map_cam)
        order = sorted(self.planes, key=lambda p: -_distance(p, T_map_cam))
        for plane in order:
            image = _draw(image, plane, T_cam_map, camera)
        return image


def _texture(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Blocks of several sizes, so that there is structure at every distance."""
    picture = np.full((height, width, 3), 128.0)
    for cells, strength in ((4, 50), (12, 50), (36, 40)):
        shape = (max(2, height * cells // width), cells, 3)
        noise = rng.uniform(-strength, strength, shape)
        picture += cv2.resize(noise, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.clip(cv2.GaussianBlur(picture, (0, 0), 0.8), 0, 255).astype(np.uint8)


def _distance(plane: _Plane, T_map_cam: np.ndarray) -> float:
    normal = np.cross(plane.u, plane.v)
    return abs((T_map_cam[:3, 3] - plane.origin) @ normal / np.linalg.norm(normal))


def _draw(
    image: np.ndarray, plane: _Plane, T_cam_map: np.ndarray, camera: Camera
) -> np.ndarray:
    """The image with a plane drawn over it: for each pixel, where its ray hits the plane."""
    R, t = T_cam_map[:3, :3], T_cam_map[:3, 3]
    H = camera.K @ np.stack([R @ plane.u, R @ plane.v, R @ plane.origin + t], 1)
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    st = np.linalg.solve(H, np.stack([u.ravel(), v.ravel(), np.ones(u.size)]))
    with np.errstate(divide="ignore", invalid="ignore"):
        s, q = st[0] / st[2], st[1] / st[2]
    hit = (st[2] > 0) & (s >= 0) & (s <= 1) & (q >= 0) & (q <= 1)
    height, width = plane.texture.shape[:2]
    x = np.where(hit, s * width - 0.5, -1).reshape(u.shape).astype(np.float32)
    y = np.where(hit, (1 - q) * height - 0.5, -1).reshape(u.shape).astype(np.float32)
    drawn = cv2.remap(plane.texture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.where(hit.reshape(u.shape)[..., None], drawn, image)


def drive(count: int) -> list[np.ndarray]:
    """Camera poses T_map_cam of a slow arc that looks into the corner."""
    angles = np.linspace(0.0, 0.9, count)
    poses = []
    for a in angles:
        position = [-1.2 + 1.6 * np.sin(a), -1.4 + 0.8 * a, 1.1 + 0.1 * np.sin(6 * a)]
        poses.append(look_at(position, [1.8 - a, 2.4 - 0.4 * a, 0.9]))
    return poses


def compiled(scene: Scene, folder: Path) -> Path:
    """The scene's compiled map, source views near the drive."""
    ply, target, cameras = folder / "corner.ply", folder / "corner.igmap", folder / "poses.json"
    save_ply(scene.gaussians(), ply)
    poses = [look_at([x, y, 1.1], [tx, 2.4, 0.9]) for x in (-1.2, -0.2) for y in (-1.4, -0.7)
             for tx in (0.6, 1.8)]  # fmt: skip
    cameras.write_text(_poses_json(poses))
    compile_map(ply, target, cameras, CompileOptions(kind="scene", views=8))
    return target


def _poses_json(poses: list[np.ndarray]) -> str:
    c = CAMERA
    # files of poses count pixels from the image's corner
    common = {"width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy,
              "cx": c.cx + 0.5, "cy": c.cy + 0.5}  # fmt: skip
    frames = [
        {"file": f"{i}.jpg", **common, "T_world_cam": T.tolist()} for i, T in enumerate(poses)
    ]
    return json.dumps({"frames": frames})


def header(stamp_ns: int, frame: str = FRAME) -> Header:
    stamp = Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return Header(stamp=stamp, frame_id=frame)


def info_message(stamp_ns: int, camera: Camera = CAMERA, frame: str = FRAME) -> CameraInfo:
    message = CameraInfo(header=header(stamp_ns, frame), width=camera.width, height=camera.height)
    message.distortion_model = "plumb_bob"
    message.d = [0.0] * 5
    message.k = camera.K.ravel()
    message.r = np.eye(3).ravel()
    message.p = np.hstack([camera.K, np.zeros((3, 1))]).ravel()
    return message


def jpeg_message(stamp_ns: int, rgb: np.ndarray, frame: str = FRAME) -> CompressedImage:
    data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()
    return CompressedImage(header=header(stamp_ns, frame), format="rgb8; jpeg compressed bgr8",
                           data=data)  # fmt: skip


def write_bag(scene: Scene, path: Path, count: int = 40) -> list[np.ndarray]:
    """Record the drive at 10 Hz with calibration, odometry and truth; its poses T_map_cam."""
    poses = drive(count)
    rng = np.random.default_rng(0)
    T_base_cam = transform_from_numbers(BASE_TO_CAMERA)
    T_odom_map = compose(np.eye(3), [5.0, -2.0, 0.0])  # odometry starts elsewhere
    with BagWriter(path) as writer:
        writer.add_topic(IMAGE_TOPIC, "sensor_msgs/msg/CompressedImage")
        writer.add_topic("/camera/camera_info", "sensor_msgs/msg/CameraInfo")
        writer.add_topic("/odom", "nav_msgs/msg/Odometry")
        writer.add_topic("/ground_truth/pose", "geometry_msgs/msg/PoseStamped")
        for index, T_map_cam in enumerate(poses):
            stamp_ns = START_NS + index * STEP_NS
            gain = 1 + 0.08 * np.sin(index / 5)  # exposure drifts
            photo = scene.photo(T_map_cam)
            rgb = np.clip(photo * gain + rng.normal(0, 3, photo.shape), 0, 255).astype(np.uint8)
            truth = PoseStamped(header=header(stamp_ns, "map"), pose=pose_to_ros(T_map_cam))
            odometry = Odometry(header=header(stamp_ns, "odom"), child_frame_id="base_link")
            odometry.pose.pose = pose_to_ros(T_odom_map @ T_map_cam @ inverse(T_base_cam))
            for offset, (topic, message) in enumerate((
                ("/odom", odometry),
                ("/camera/camera_info", info_message(stamp_ns)),
                (IMAGE_TOPIC, jpeg_message(stamp_ns, rgb)),
                ("/ground_truth/pose", truth),
            )):  # fmt: skip
                writer.write(topic, stamp_ns + offset * 1000, serialize_message(message))
    return poses
