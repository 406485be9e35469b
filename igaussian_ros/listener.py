"""A node that listens to the localizer and keeps what it hears, for the demo, tests, benchmarks."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from igaussian_core.geometry import compose, inverse, pose_error, rotation_from_vector
from igaussian_core.geometry import vector_from_rotation as rotation_vector
from igaussian_ros.convert import pose_from_ros, stamp_to_ns


@dataclass(frozen=True)
class HeardPose:
    """A pose message: its stamp, T_frame_child, its frame_id, the wall time of its arrival."""

    stamp_ns: int
    T: NDArray[np.float64]
    frame: str
    received_ns: int

    @property
    def latency_ms(self) -> float:
        """From stamp to arrival; of use where stamps are wall time."""
        return (self.received_ns - self.stamp_ns) * 1e-6


@dataclass(frozen=True)
class HeardStatus:
    """A message of ~/status."""

    stamp_ns: int
    values: dict[str, str]
    received_ns: int


class Listener(Node):
    """Keeps the localizer's poses, statuses and diagnostics, and true poses.

    `covariances` are the poses' [6, 6], by stamp.

    Args:
        localizer: full name of the node.
        truth_topic: PoseStamped of the same frame as the localizer's poses; None: not heard.
    """

    def __init__(
        self,
        localizer: str = "/localizer",
        truth_topic: str | None = "/ground_truth/pose",
        name: str = "localizer_listener",
        **node_arguments: Any,
    ) -> None:
        super().__init__(name, **node_arguments)
        self.poses: list[HeardPose] = []
        self.covariances: dict[int, NDArray[np.float64]] = {}
        self.truth: list[HeardPose] = []
        self.statuses: list[HeardStatus] = []
        self.diagnostics: dict[str, str] = {}
        qos = QoSProfile(depth=100)
        self.create_subscription(PoseStamped, f"{localizer}/pose", self._on_pose, qos)
        self.create_subscription(
            PoseWithCovarianceStamped, f"{localizer}/pose_with_covariance", self._on_covariance, qos
        )
        self.create_subscription(DiagnosticArray, f"{localizer}/status", self._on_status, qos)
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, qos)
        if truth_topic is not None:
            self.create_subscription(PoseStamped, truth_topic, self._on_truth, qos)

    def errors(self, T_true_child: NDArray[np.float64] | None = None) -> list[tuple[float, float]]:
        """(degrees, metres) of each pose whose time the true poses cover.

        Args:
            T_true_child: from the frame that the localizer publishes to that of the true
                poses, where these differ.
        """
        result = []
        for pose in self.poses:
            T_true = interpolated(self.truth, pose.stamp_ns)
            if T_true is not None:
                T = T_true if T_true_child is None else T_true @ T_true_child
                result.append(pose_error(pose.T, T))
        return result

    def _on_pose(self, message: PoseStamped) -> None:
        self.poses.append(_heard(message))

    def _on_covariance(self, message: PoseWithCovarianceStamped) -> None:
        covariance = np.array(message.pose.covariance, np.float64).reshape(6, 6)
        self.covariances[stamp_to_ns(message.header.stamp)] = covariance

    def _on_truth(self, message: PoseStamped) -> None:
        self.truth.append(_heard(message))

    def _on_status(self, message: DiagnosticArray) -> None:
        values = {pair.key: pair.value for pair in message.status[0].values}
        stamp_ns = stamp_to_ns(message.header.stamp)
        self.statuses.append(HeardStatus(stamp_ns, values, time.time_ns()))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith(": localization"):
                self.diagnostics = {pair.key: pair.value for pair in status.values}


def interpolated(poses: list[HeardPose], stamp_ns: int) -> NDArray[np.float64] | None:
    """The pose at a stamp: the one of that stamp, else between its two neighbours within 0.5 s."""
    before: HeardPose | None = None
    after: HeardPose | None = None
    for pose in poses:
        if pose.stamp_ns == stamp_ns:
            return pose.T
        if pose.stamp_ns < stamp_ns and (before is None or pose.stamp_ns > before.stamp_ns):
            before = pose
        if pose.stamp_ns > stamp_ns and (after is None or pose.stamp_ns < after.stamp_ns):
            after = pose
    if before is None or after is None or after.stamp_ns - before.stamp_ns > 500_000_000:
        return None
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    motion = inverse(before.T) @ after.T
    turn = rotation_from_vector(share * rotation_vector(motion[:3, :3]))
    return np.asarray(before.T @ compose(turn, share * motion[:3, 3]))


def _heard(message: PoseStamped) -> HeardPose:
    return HeardPose(
        stamp_to_ns(message.header.stamp),
        pose_from_ros(message.pose),
        message.header.frame_id,
        time.time_ns(),
    )
