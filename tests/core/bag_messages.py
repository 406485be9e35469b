"""Builds ROS messages without ROS, for bags that tests write."""

from __future__ import annotations

import cv2
import numpy as np

from igaussian_core.bags import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, ODOMETRY, POSE, BagWriter
from igaussian_core.camera import Camera
from igaussian_core.geometry import quaternion_from_rotation

H, W = 24, 32
START = 1_700_000_000_000_000_000
STEP = 100_000_000
CAMERA = Camera(W, H, 30.0, 31.0, 15.0, 12.0, "plumb_bob", (0.1, 0.0, 0.0, 0.0, 0.0))


class Messages:
    """Builds messages of a writer's typestore."""

    def __init__(self, writer: BagWriter) -> None:
        self.types = writer.typestore.types

    def header(self, stamp_ns: int, frame: str = "map"):
        stamp = self.types["builtin_interfaces/msg/Time"](
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def image(self, stamp_ns: int, rgb: np.ndarray, encoding: str = "rgb8"):
        return self.types[IMAGE](
            header=self.header(stamp_ns, "camera"),
            height=rgb.shape[0],
            width=rgb.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rgb.shape[1] * 3,
            data=rgb.ravel(),
        )

    def jpeg(self, stamp_ns: int, rgb: np.ndarray):
        data = cv2.imencode(".png", rgb[:, :, ::-1])[1].ravel()
        header = self.header(stamp_ns, "camera")
        return self.types[COMPRESSED_IMAGE](header=header, format="png", data=data)

    def info(self, stamp_ns: int, camera: Camera = CAMERA, fx: float | None = None):
        K = camera.K.ravel().copy()
        K[0] = camera.fx if fx is None else fx
        roi = self.types["sensor_msgs/msg/RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self.types[CAMERA_INFO](
            header=self.header(stamp_ns, "camera"),
            height=camera.height,
            width=camera.width,
            distortion_model=camera.model,
            d=np.array(camera.dist),
            k=K,
            r=np.eye(3).ravel(),
            p=np.zeros(12),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def pose(self, stamp_ns: int, T: np.ndarray):
        return self.types[POSE](header=self.header(stamp_ns), pose=self._pose(T))

    def odometry(self, stamp_ns: int, T: np.ndarray):
        zero = self.types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
        twist = self.types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
        return self.types[ODOMETRY](
            header=self.header(stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=self.types["geometry_msgs/msg/PoseWithCovariance"](
                pose=self._pose(T), covariance=np.zeros(36)
            ),
            twist=self.types["geometry_msgs/msg/TwistWithCovariance"](
                twist=twist, covariance=np.zeros(36)
            ),
        )

    def transform(self, parent: str, child: str, T: np.ndarray):
        pose = self._pose(T)
        t = self.types["geometry_msgs/msg/Vector3"](
            x=pose.position.x, y=pose.position.y, z=pose.position.z
        )
        value = self.types["geometry_msgs/msg/Transform"](
            translation=t, rotation=pose.orientation
        )
        return self.types["geometry_msgs/msg/TransformStamped"](
            header=self.header(START, parent), child_frame_id=child, transform=value
        )

    def _pose(self, T: np.ndarray):
        w, x, y, z = (float(v) for v in quaternion_from_rotation(T[:3, :3]))
        q = self.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
        px, py, pz = (float(v) for v in T[:3, 3])
        position = self.types["geometry_msgs/msg/Point"](x=px, y=py, z=pz)
        return self.types["geometry_msgs/msg/Pose"](position=position, orientation=q)
