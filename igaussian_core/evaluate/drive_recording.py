"""A drive's outcome as an mcap recording that Foxglove, PlotJuggler and rosbag2 open."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.bag_storage import TopicQos
from igaussian_core.bags import COMPRESSED_IMAGE, POSE, TF, BagWriter
from igaussian_core.evaluate.drive import DriveFrame, Trajectory
from igaussian_core.evaluate.drive_overlays import Overlay
from igaussian_core.geometry import quaternion_from_rotation

_PATH = "nav_msgs/msg/Path"
_STATUS = "diagnostic_msgs/msg/DiagnosticArray"
_FRAME, _CAMERA = "map", "localized_camera"
_LATCHED = TopicQos(durability="transient_local", depth=1)


def write_recording(
    path: Path, frames: Sequence[DriveFrame], truth: Trajectory, overlays: Sequence[Overlay]
) -> None:
    """Write poses, path, status, truth, /tf and overlays, stamped as the images were.

    Raises:
        BagError: the path exists already or cannot be written.
    """
    with BagWriter(path) as writer:
        make = _Messages(writer)
        for topic, kind, qos in (
            ("/localizer/pose", POSE, TopicQos()),
            ("/localizer/path", _PATH, _LATCHED),
            ("/localizer/status", _STATUS, TopicQos()),
            ("/localizer/overlay/compressed", COMPRESSED_IMAGE, TopicQos()),
            ("/ground_truth/pose", POSE, TopicQos()),
            ("/ground_truth/path", _PATH, _LATCHED),
            ("/tf", TF, TopicQos(depth=100)),
        ):
            writer.add_topic(topic, kind, qos)
        accepted: list[tuple[int, NDArray[np.float64]]] = []
        for frame in frames:
            writer.write("/localizer/status", frame.stamp_ns, make.status(frame))
            if frame.T_map_cam is not None:
                accepted.append((frame.stamp_ns, frame.T_map_cam))
                writer.write("/localizer/pose", *make.pose(*accepted[-1]))
                writer.write("/tf", *make.transform(*accepted[-1]))
                writer.write("/localizer/path", *make.path(frame.stamp_ns, accepted))
        true = list(zip(truth.stamps_ns, truth.poses, strict=True))
        if true:
            writer.write("/ground_truth/path", *make.path(true[0][0], true))
        for stamp_ns, T_map_cam in true:
            writer.write("/ground_truth/pose", *make.pose(stamp_ns, T_map_cam))
        for overlay in overlays:
            topic = "/localizer/overlay/compressed"
            writer.write(topic, overlay.frame.stamp_ns, make.picture(overlay))


class _Messages:
    """Builds messages of a writer's types."""

    def __init__(self, writer: BagWriter) -> None:
        self._types: Any = writer.typestore.types

    def _new(self, kind: str, /, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _header(self, stamp_ns: int, frame: str = _FRAME) -> Any:
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        stamp = self._new("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _rotation(self, T: NDArray[np.float64]) -> Any:
        w, x, y, z = (float(v) for v in quaternion_from_rotation(T[:3, :3]))
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _vector(self, kind: str, T: NDArray[np.float64]) -> Any:
        x, y, z = (float(v) for v in T[:3, 3])
        return self._new(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _stamped(self, stamp_ns: int, T_map_cam: NDArray[np.float64]) -> Any:
        pose = self._new(
            "geometry_msgs/msg/Pose",
            position=self._vector("Point", T_map_cam),
            orientation=self._rotation(T_map_cam),
        )
        return self._new(POSE, header=self._header(stamp_ns), pose=pose)

    def pose(self, stamp_ns: int, T_map_cam: NDArray[np.float64]) -> tuple[int, Any]:
        return stamp_ns, self._stamped(stamp_ns, T_map_cam)

    def path(
        self, stamp_ns: int, poses: Sequence[tuple[int, NDArray[np.float64]]]
    ) -> tuple[int, Any]:
        stamped = [self._stamped(*item) for item in poses]
        return stamp_ns, self._new(_PATH, header=self._header(stamp_ns), poses=stamped)

    def transform(self, stamp_ns: int, T_map_cam: NDArray[np.float64]) -> tuple[int, Any]:
        transform = self._new(
            "geometry_msgs/msg/Transform",
            translation=self._vector("Vector3", T_map_cam),
            rotation=self._rotation(T_map_cam),
        )
        stamped = self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns),
            child_frame_id=_CAMERA,
            transform=transform,
        )
        return stamp_ns, self._new(TF, transforms=[stamped])

    def status(self, frame: DriveFrame) -> Any:
        angle_deg, distance_m = frame.error
        values: dict[str, Any] = {
            "status": frame.status,
            "inliers": frame.inliers,
            "latency_ms": f"{frame.latency_ms:.1f}",
            "error_m": f"{distance_m:.5f}",
            "error_deg": f"{angle_deg:.4f}",
        }
        values |= {f"timing.{stage}_ms": f"{ms:.1f}" for stage, ms in frame.timings_ms.items()}
        pairs = [
            self._new("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in values.items()
        ]
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=0 if frame.T_map_cam is not None else 1,
            name="localizer: frame",
            message=frame.reason or frame.status,
            hardware_id="",
            values=pairs,
        )
        return self._new(_STATUS, header=self._header(frame.stamp_ns), status=[status])

    def picture(self, overlay: Overlay) -> Any:
        _, jpeg = cv2.imencode(
            ".jpg", overlay.side_by_side()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80]
        )
        header = self._header(overlay.frame.stamp_ns, _CAMERA)
        return self._new(COMPRESSED_IMAGE, header=header, format="jpeg", data=jpeg.ravel())
