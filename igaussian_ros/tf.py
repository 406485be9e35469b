"""Odometry at an image's time, and the transforms of /tf."""

from __future__ import annotations

import bisect
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from igaussian_core.geometry import (
    compose,
    inverse,
    rotation_from_vector,
    vector_from_rotation,
)

Matrix = NDArray[np.float64]


class OdometryBuffer:
    """The last poses T_odom_x with their stamps; thread-safe.

    Args:
        keep_ns: how far back poses are kept.
        hold_ns: how far before the first and after the last pose the nearest one is taken.
    """

    def __init__(self, keep_ns: int = 10_000_000_000, hold_ns: int = 200_000_000) -> None:
        self._keep_ns, self._hold_ns = keep_ns, hold_ns
        self._stamps: list[int] = []
        self._poses: list[Matrix] = []
        self._lock = threading.Lock()

    def add(self, stamp_ns: int, T_odom_x: Matrix) -> None:
        """Append a pose; one that is older than the last begins anew (a bag started again)."""
        with self._lock:
            if self._stamps and stamp_ns < self._stamps[-1]:
                self._stamps, self._poses = [], []
            self._stamps.append(stamp_ns)
            self._poses.append(T_odom_x)
            old = bisect.bisect_left(self._stamps, stamp_ns - self._keep_ns)
            del self._stamps[:old], self._poses[:old]

    def at(self, stamp_ns: int) -> Matrix | None:
        """T_odom_x at the stamp, interpolated; None where no pose is near."""
        with self._lock:
            if not self._stamps:
                return None
            after = bisect.bisect_left(self._stamps, stamp_ns)
            if 0 < after < len(self._stamps):
                return self._between(after, stamp_ns)
            nearest = min(after, len(self._stamps) - 1)
            near = abs(stamp_ns - self._stamps[nearest]) <= self._hold_ns
            return self._poses[nearest].copy() if near else None

    def clear(self) -> None:
        with self._lock:
            self._stamps, self._poses = [], []

    def _between(self, after: int, stamp_ns: int) -> Matrix:
        begin, end = self._stamps[after - 1], self._stamps[after]
        share = (stamp_ns - begin) / (end - begin)
        A, B = self._poses[after - 1], self._poses[after]
        turn = rotation_from_vector(share * vector_from_rotation(A[:3, :3].T @ B[:3, :3]))
        return compose(A[:3, :3] @ turn, (1 - share) * A[:3, 3] + share * B[:3, 3])


@dataclass(frozen=True)
class MapTransform:
    """What /tf says of the map: T_map_child."""

    child: str
    T_map_child: Matrix


@dataclass(frozen=True)
class Frames:
    """Names of the frames that may hang below the map."""

    odom: str
    base: str
    camera: str


def map_transform(
    T_map_cam: Matrix, frames: Frames, T_base_cam: Matrix | None, T_odom_cam: Matrix | None
) -> MapTransform:
    """map->odom where the odometry at the image's time is known, else map->base, else map->camera.

    REP 105: a frame has one parent; with odometry the base hangs below odom already.
    """
    if T_odom_cam is not None:
        return MapTransform(frames.odom, T_map_cam @ inverse(T_odom_cam))
    if T_base_cam is not None:
        return MapTransform(frames.base, T_map_cam @ inverse(T_base_cam))
    return MapTransform(frames.camera, T_map_cam)


def create_tf_publisher(node: Node) -> Any | None:
    """A publisher of tf2_msgs/TFMessage on /tf; None where that message is not installed."""
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        return None
    qos = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
    return node.create_publisher(TFMessage, "/tf", qos)
