"""Between ROS messages and the core's types; the one place that makes ROS's xyzw quaternions.

Transforms are 4x4 float64, T_a_b maps points of frame b into frame a. A message says the pose
of frame b in frame a with the same numbers: `header.frame_id` is a.
"""

from __future__ import annotations

import array
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from numpy.typing import ArrayLike, NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from igaussian_core.camera import Camera
from igaussian_core.camera_info import camera_from_info
from igaussian_core.errors import IGaussianError, ImageError
from igaussian_core.geometry import (
    compose,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    skew,
)
from igaussian_core.image_decode import decode_compressed, decode_image

Matrix = NDArray[np.float64]


class MessageError(IGaussianError):
    """A message whose values cannot be used; the text says which and why."""


# --- time ---


def stamp_to_ns(stamp: Time) -> int:
    """Nanoseconds of a stamp."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_from_ns(ns: int) -> Time:
    """The stamp of nanoseconds."""
    return Time(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)


# --- quaternions and transforms ---


def quaternion_to_ros(rotation: ArrayLike) -> Quaternion:
    """ROS quaternion (fields x y z w) of a rotation matrix [3, 3]."""
    w, x, y, z = (float(value) for value in quaternion_from_rotation(rotation))
    return Quaternion(x=x, y=y, z=z, w=w)


def rotation_from_ros(q: Quaternion) -> Matrix:
    """Rotation matrix [3, 3] of a ROS quaternion.

    Raises:
        MessageError: not finite, or not of unit length within 1 %.
    """
    return _rotation([q.w, q.x, q.y, q.z])


def transform_from_numbers(numbers: Sequence[float]) -> Matrix:
    """T_parent_child of [x, y, z, qx, qy, qz, qw], the order of static_transform_publisher.

    Raises:
        MessageError: not seven finite numbers with a unit quaternion.
    """
    if len(numbers) != 7:
        raise MessageError(f"expected 7 numbers x y z qx qy qz qw, got {len(numbers)}")
    x, y, z, qx, qy, qz, qw = numbers
    if not np.isfinite([x, y, z]).all():
        raise MessageError(f"translation ({x}, {y}, {z}) is not finite")
    return compose(_rotation([qw, qx, qy, qz]), [x, y, z])


def pose_to_ros(T_a_b: ArrayLike) -> Pose:
    """Pose of frame b in frame a."""
    T = np.asarray(T_a_b, np.float64)
    x, y, z = (float(value) for value in T[:3, 3])
    return Pose(position=Point(x=x, y=y, z=z), orientation=quaternion_to_ros(T[:3, :3]))


def pose_from_ros(message: Pose) -> Matrix:
    """T_a_b of the pose of frame b in frame a.

    Raises:
        MessageError: not finite, or no unit quaternion.
    """
    p = message.position
    if not np.isfinite([p.x, p.y, p.z]).all():
        raise MessageError(f"position ({p.x}, {p.y}, {p.z}) is not finite")
    return compose(rotation_from_ros(message.orientation), [p.x, p.y, p.z])


def transform_to_ros(T_parent_child: ArrayLike, header: Header, child: str) -> TransformStamped:
    """TransformStamped from header.frame_id (the parent) to child."""
    T = np.asarray(T_parent_child, np.float64)
    x, y, z = (float(value) for value in T[:3, 3])
    rotation = quaternion_to_ros(T[:3, :3])
    transform = Transform(translation=Vector3(x=x, y=y, z=z), rotation=rotation)
    return TransformStamped(header=header, child_frame_id=child, transform=transform)


def pose_stamped(T_map_x: ArrayLike, header: Header) -> PoseStamped:
    return PoseStamped(header=header, pose=pose_to_ros(T_map_x))


def pose_with_covariance(
    T_map_x: ArrayLike, covariance: ArrayLike, header: Header
) -> PoseWithCovarianceStamped:
    """Pose with its 6x6 covariance, order x y z rx ry rz, axes of the header's frame."""
    message = PoseWithCovarianceStamped(header=header)
    message.pose.pose = pose_to_ros(T_map_x)
    message.pose.covariance = np.asarray(covariance, np.float64).reshape(36)
    return message


def moved_covariance(covariance: ArrayLike, T_map_a: ArrayLike, T_map_b: ArrayLike) -> Matrix:
    """Covariance [6, 6] of frame b's pose, rigidly fixed to frame a whose pose has `covariance`.

    Both in the map's axes, order x y z rx ry rz: a small turn of a by w moves the origin of b
    by w x (b - a).
    """
    lever = np.asarray(T_map_b, np.float64)[:3, 3] - np.asarray(T_map_a, np.float64)[:3, 3]
    J = np.eye(6)
    J[:3, 3:] = -skew(lever)
    moved = J @ np.asarray(covariance, np.float64) @ J.T
    return (moved + moved.T) / 2


def identity() -> Matrix:
    """T_a_a."""
    return np.eye(4)


def base_from_camera(T_map_cam: ArrayLike, T_base_cam: ArrayLike) -> Matrix:
    """T_map_base, the pose of the robot whose camera is at T_map_cam."""
    return np.asarray(T_map_cam, np.float64) @ inverse(T_base_cam)


def _rotation(q_wxyz: Sequence[float]) -> Matrix:
    norm = float(np.linalg.norm(q_wxyz))
    if not abs(norm - 1) < 0.01:  # also true for NaN
        w, x, y, z = q_wxyz
        raise MessageError(f"quaternion x={x:g} y={y:g} z={z:g} w={w:g} has not the length 1")
    return rotation_from_quaternion(q_wxyz)


# --- images ---


def image_from_ros(message: Image | CompressedImage) -> NDArray[np.uint8]:
    """uint8 RGB [H, W, 3] of a raw or compressed image.

    Raises:
        ImageError: an encoding, size, step or bytes that cannot be used.
    """
    if isinstance(message, CompressedImage):
        if "compressedDepth" in message.format:
            raise ImageError(f"compressed image: format '{message.format}' is a depth image")
        return decode_compressed(message.data, f"compressed image ({message.format})")
    return decode_image(
        message.encoding,
        message.height,
        message.width,
        message.step,
        bool(message.is_bigendian),
        message.data,
    )


def image_to_ros(image_rgb_u8: NDArray[np.uint8], header: Header) -> Image:
    """rgb8 Image of a uint8 RGB array [H, W, 3]."""
    height, width = image_rgb_u8.shape[:2]
    message = Image(header=header, height=height, width=width, encoding="rgb8", step=3 * width)
    # assigning an ndarray makes rclpy check each value, 100 times slower than an array.array
    message.data = array.array("B", np.ascontiguousarray(image_rgb_u8).tobytes())
    return message


def camera_from_ros(message: CameraInfo, rectified: bool = False) -> Camera:
    """The camera of the images that come with this camera_info (binning and ROI honoured).

    Raises:
        CameraError: an uncalibrated camera or values that cannot be used.
    """
    roi = message.roi
    return camera_from_info(
        message.width,
        message.height,
        [float(value) for value in message.k],
        [float(value) for value in message.d],
        message.distortion_model,
        (message.binning_x, message.binning_y),
        (roi.x_offset, roi.y_offset, roi.width, roi.height),
        [float(value) for value in message.p],
        rectified,
    )
