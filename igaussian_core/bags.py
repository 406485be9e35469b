"""Recordings without ROS: read mcap, rosbag2 (mcap, sqlite3) and ROS 1 bags, write mcap.

An mcap file is read through its index where it has one, else from front to back; its profile
does not matter, only that channels hold CDR. Types come from the definitions in the bag and,
where these are missing or cannot be parsed, from ROS 2 Jazzy.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import (
    MessageDefinition,
    MessageDefinitionFormat,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from igaussian_core.bag_storage import (
    READ_ERRORS,
    RawMessage,
    Source,
    Topic,
    TopicQos,
    cause_of,
    open_sources,
)
from igaussian_core.camera import Camera
from igaussian_core.camera_info import camera_from_info
from igaussian_core.errors import BagError, CameraError, ImageError
from igaussian_core.frame import Frame
from igaussian_core.geometry import compose, inverse, rotation_from_quaternion
from igaussian_core.image_decode import decode_compressed, decode_image

log = logging.getLogger(__name__)
Array = NDArray[np.float64]

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMAGES = (IMAGE, COMPRESSED_IMAGE)
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"

_FRAMES_WITHOUT_INFO = 100  # images that wait for the first camera_info


class StampedTransform(NamedTuple):
    """T_frame_child at a header stamp."""

    stamp_ns: int
    T_frame_child: Array
    frame: str
    child: str


class Bag:
    """A recording, open for reading; a context manager.

    Args:
        path: an .mcap or .db3 file, a rosbag2 directory (with metadata.yaml, or without where
            it holds storage files), or a ROS 1 .bag file.
        recover: read what can be read of a truncated or damaged mcap file, which is an error
            otherwise.

    Attributes:
        topics: Topic by name, sorted.
        problems: what recovery had to leave out, one line each; empty for a sound bag.

    Raises:
        BagError: missing, empty, truncated, damaged, or no recording at all.
    """

    def __init__(self, path: str | Path, recover: bool = False) -> None:
        self.path = Path(path)
        self.problems: list[str] = []
        self._stores: dict[str, Typestore] = {}
        self._jazzy = get_typestore(Stores.ROS2_JAZZY)
        self._sources = open_sources(self.path, recover, self.problems)
        self.topics = _merged_topics(self._sources)

    def close(self) -> None:
        for source in self._sources:
            source.close()
        self._sources = []

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def topics_of(self, *types: str) -> list[str]:
        """Names of the topics of these message types."""
        return [topic.name for topic in self.topics.values() if topic.type in types]

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of their log time (file order where the file has no index).

        Raises:
            BagError: damaged data, with what was read up to there.
        """
        for source in self._sources:
            count = 0
            try:
                for message in source.messages(topics):
                    count += 1
                    yield message
            except READ_ERRORS as error:
                raise BagError(
                    f"{source.path}: damaged after {count} messages: {cause_of(error)}"
                ) from error

    def deserialize(self, message: RawMessage) -> Any:
        """The message as an object with ROS's field names.

        Raises:
            BagError: an unknown type, or bytes that are not of it.
        """
        if message.encoding not in ("cdr", "ros1"):
            raise BagError(
                f"{self.path}: topic {message.topic} is encoded as '{message.encoding}'; "
                "supported: cdr, ros1"
            )
        try:
            store = self._store(message.type)
            if message.encoding == "ros1":
                return store.deserialize_ros1(message.data, message.type)
            return store.deserialize_cdr(message.data, message.type)
        except (SerdeError, TypesysError, *READ_ERRORS) as error:
            raise BagError(
                f"{self.path}: topic {message.topic}: no {message.type} can be read "
                f"from {len(message.data)} bytes: {cause_of(error)}"
            ) from error

    def read(self, topics: Collection[str] | None = None) -> Iterator[tuple[RawMessage, Any]]:
        """Messages with their deserialized form."""
        for message in self.messages(topics):
            yield message, self.deserialize(message)

    def image_topic(self) -> str:
        """The one image topic; of several, the one camera with a camera_info.

        Raises:
            BagError: none, or several cameras.
        """
        names = [n for n in self.topics_of(IMAGE, COMPRESSED_IMAGE) if "depth" not in n.lower()]
        if not names:
            raise BagError(
                f"{self.path}: no image topic ({IMAGE} or {COMPRESSED_IMAGE}); {self._has()}"
            )
        with_info = [name for name in names if _sibling_info(name) in self.topics] or names
        # of one camera's topics the raw image says most, the rest are transports of it
        shortest = [n for n in with_info if not any(n.startswith(o + "/") for o in with_info)]
        if len(shortest) > 1:
            raise BagError(f"{self.path}: several image topics, name one: {', '.join(shortest)}")
        return shortest[0]

    def camera_info_topic(self, image_topic: str) -> str:
        """The camera_info topic of an image topic: its sibling, else the only one.

        Raises:
            BagError: none, or several and no sibling.
        """
        names = self.topics_of(CAMERA_INFO)
        sibling = _sibling_info(image_topic)
        if sibling in names:
            return sibling
        if len(names) == 1:
            return names[0]
        if not names:
            raise BagError(f"{self.path}: no camera_info topic ({CAMERA_INFO}); {self._has()}")
        raise BagError(
            f"{self.path}: no {sibling} for {image_topic}; name one of: {', '.join(names)}"
        )

    def frames(
        self,
        image_topic: str | None = None,
        camera_info_topic: str | None = None,
        skip_bad: bool = False,
    ) -> Iterator[Frame]:
        """Images with their cameras, stamped as in their headers (log time where that is 0).

        Args:
            image_topic, camera_info_topic: found by image_topic() and camera_info_topic()
                where not given.
            skip_bad: log a frame that cannot be used and go on, instead of raising.

        Raises:
            BagError: a needed topic is missing, an image or camera_info cannot be used.
        """
        images = image_topic or self.image_topic()
        self._require(images, (IMAGE, COMPRESSED_IMAGE))
        infos = camera_info_topic or self.camera_info_topic(images)
        self._require(infos, (CAMERA_INFO,))
        usable = 0
        cause = f"no message on {infos}"
        for message, camera in self._paired(images, infos):
            try:
                if isinstance(camera, CameraError):
                    raise camera
                frame = self._frame(message, camera)
            except (ImageError, CameraError, BagError) as error:
                cause = f"topic {message.topic} at {message.log_time_ns} ns: {error}"
                if not skip_bad:
                    raise BagError(f"{self.path}: {cause}") from error
                log.warning("%s: frame skipped: %s", self.path, cause)
                continue
            usable += 1
            yield frame
        if not usable:
            raise BagError(f"{self.path}: no usable frame on {images}: {cause}")

    def _paired(self, images: str, infos: str) -> Iterator[tuple[RawMessage, Camera | CameraError]]:
        """Image messages with the latest camera; those before the first wait for it."""
        camera: Camera | CameraError | None = None
        waiting: deque[RawMessage] = deque()
        for message in self.messages((images, infos)):
            if message.topic == images:
                waiting.append(message)
            else:
                try:
                    camera = _camera(self.deserialize(message), "image_rect" in images)
                except CameraError as error:
                    camera = error
            if camera is None and len(waiting) > _FRAMES_WITHOUT_INFO:
                raise BagError(
                    f"{self.path}: {len(waiting)} images on {images} before any message on {infos}"
                )
            while waiting and camera is not None:
                yield waiting.popleft(), camera

    def pose_topic(self) -> str:
        """The ground truth's topic: a PoseStamped with 'truth' in its name, else the only one.

        Raises:
            BagError: none, or several.
        """
        names = self.topics_of(POSE, POSE_WITH_COVARIANCE)
        named = [name for name in names if "truth" in name.lower() or "/gt" in name.lower()]
        candidates = named or names
        if not candidates:
            raise BagError(f"{self.path}: no topic of true poses ({POSE}); {self._has()}")
        if len(candidates) > 1:
            raise BagError(f"{self.path}: several pose topics, name one: {', '.join(candidates)}")
        return candidates[0]

    def poses(self, topic: str | None = None) -> list[tuple[int, Array]]:
        """(stamp_ns, T_map_cam) of a PoseStamped topic, by stamp.

        The child frame of such a message is not recorded: it must be the camera's optical frame.

        Raises:
            BagError: no such topic, or a pose that is none.
        """
        name = topic or self.pose_topic()
        self._require(name, (POSE, POSE_WITH_COVARIANCE))
        poses = []
        for raw, message in self.read((name,)):
            value = message.pose if raw.type == POSE else message.pose.pose
            poses.append((_stamp_ns(message.header, raw), self._transform(value, raw)))
        return sorted(poses, key=lambda item: item[0])

    def odometry(self, topic: str | None = None) -> list[StampedTransform]:
        """T_odom_base of an Odometry topic (the only one where not given), by stamp.

        Raises:
            BagError: no such topic, or a pose that is none.
        """
        names = self.topics_of(ODOMETRY)
        if topic is None and len(names) != 1:
            raise BagError(f"{self.path}: {len(names)} topics of {ODOMETRY}; {self._has()}")
        name = topic or names[0]
        self._require(name, (ODOMETRY,))
        result = []
        for raw, message in self.read((name,)):
            T = self._transform(message.pose.pose, raw)
            stamp = _stamp_ns(message.header, raw)
            frame, child = message.header.frame_id, message.child_frame_id
            result.append(StampedTransform(stamp, T, frame, child))
        return sorted(result, key=lambda item: item.stamp_ns)

    def static_transforms(self) -> dict[tuple[str, str], Array]:
        """T_parent_child by (parent, child) of all /tf_static messages."""
        result: dict[tuple[str, str], Array] = {}
        names = [name for name in self.topics_of(TF) if name.endswith("tf_static")]
        for raw, message in self.read(names) if names else ():
            for item in message.transforms:
                key = (item.header.frame_id, item.child_frame_id)
                result[key] = self._transform(item.transform, raw)
        return result

    def _frame(self, raw: RawMessage, camera: Camera) -> Frame:
        message = self.deserialize(raw)
        if raw.type == COMPRESSED_IMAGE:
            image = decode_compressed(message.data)
        else:
            image = decode_image(
                message.encoding,
                message.height,
                message.width,
                message.step,
                bool(message.is_bigendian),
                message.data,
            )
        camera.check_image(image)
        return Frame(_stamp_ns(message.header, raw), image, camera)

    def _transform(self, value: Any, raw: RawMessage) -> Array:
        """4x4 matrix of a Pose or a Transform."""
        position = value.position if hasattr(value, "position") else value.translation
        q = value.orientation if hasattr(value, "orientation") else value.rotation
        t = np.array([position.x, position.y, position.z])
        q_wxyz = np.array([q.w, q.x, q.y, q.z])
        norm = float(np.linalg.norm(q_wxyz))
        if not (np.isfinite(t).all() and np.isfinite(norm) and norm > 1e-6):
            raise BagError(
                f"{self.path}: topic {raw.topic} at {raw.log_time_ns} ns: no pose: "
                f"position {t}, quaternion wxyz {q_wxyz}"
            )
        return compose(rotation_from_quaternion(q_wxyz), t)

    def _require(self, name: str, types: Sequence[str]) -> None:
        topic = self.topics.get(name)
        if topic is None:
            raise BagError(f"{self.path}: no topic {name}; {self._has()}")
        if topic.type not in types:
            raise BagError(
                f"{self.path}: topic {name} is {topic.type}, wanted is {' or '.join(types)}"
            )

    def _has(self) -> str:
        names = [f"{topic.name} ({topic.type})" for topic in self.topics.values()]
        return "it has " + (", ".join(names) if names else "no topics")

    def _store(self, msgtype: str) -> Typestore:
        """Types for one message type: the bag's own definition, else ROS 2 Jazzy's."""
        if msgtype not in self._stores:
            self._stores[msgtype] = self._jazzy
            for source in self._sources:
                definition = source.definition(msgtype)
                if definition is None:
                    continue
                with suppress(TypesysError, *READ_ERRORS):
                    store = get_typestore(Stores.EMPTY)
                    store.register(_parse_types(definition, msgtype))
                    self._stores[msgtype] = store
                    break
        return self._stores[msgtype]


def T_from_chain(
    transforms: dict[tuple[str, str], Array], target: str, source: str
) -> Array | None:
    """T_target_source through a tree of transforms {(parent, child): T_parent_child}, or None."""
    seen = {target}
    queue: deque[tuple[str, Array]] = deque([(target, np.eye(4))])
    while queue:
        frame, T_target_frame = queue.popleft()
        if frame == source:
            return T_target_frame
        for (parent, child), T in transforms.items():
            if parent == frame and child not in seen:
                queue.append((child, T_target_frame @ T))
                seen.add(child)
            elif child == frame and parent not in seen:
                queue.append((parent, T_target_frame @ inverse(T)))
                seen.add(parent)
    return None


class BagWriter:
    """Writes a rosbag2 directory with one mcap file; a context manager.

    Messages are objects of `typestore.types[...]` or CDR bytes. An exception inside the `with`
    block leaves a bag without index behind.

    Raises:
        BagError: the path exists already or cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.typestore = get_typestore(Stores.ROS2_JAZZY)
        self._topics: dict[str, Any] = {}
        try:
            self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
            self._writer.open()
        except (WriterError, OSError) as error:
            raise BagError(f"{self.path}: cannot be written: {cause_of(error)}") from error

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._writer.abort()

    def add_topic(self, name: str, msgtype: str, qos: TopicQos | None = None) -> None:
        """Declare a topic; the QoS goes into the bag, for players that honour it.

        Raises:
            BagError: a type that ROS 2 Jazzy's common interfaces do not have.
        """
        try:
            self._topics[name] = self._writer.add_connection(
                name,
                msgtype,
                typestore=self.typestore,
                offered_qos_profiles=[_rosbags_qos(qos or TopicQos())],
            )
        except (WriterError, TypesysError, KeyError) as error:
            raise BagError(f"{self.path}: topic {name}: {cause_of(error)}") from error

    def write(self, topic: str, log_time_ns: int, message: Any) -> None:
        """Append a message to a declared topic."""
        connection = self._topics.get(topic)
        if connection is None:
            raise BagError(f"{self.path}: topic {topic} was not declared")
        if not isinstance(message, bytes | bytearray | memoryview):
            message = self.typestore.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, log_time_ns, message)

    def close(self) -> None:
        """Write index and metadata.yaml."""
        self._writer.close()


def _rosbags_qos(qos: TopicQos) -> Qos:
    infinite = QosTime(9223372036, 854775807)  # what rosbag2 writes for "no limit"
    return Qos(
        QosHistory[qos.history.upper()],
        qos.depth,
        QosReliability[qos.reliability.upper()],
        QosDurability[qos.durability.upper()],
        infinite,
        infinite,
        QosLiveliness.AUTOMATIC,
        infinite,
        False,
    )


def _sibling_info(image_topic: str) -> str:
    """/ns/image_raw[/compressed] -> /ns/camera_info."""
    base = image_topic.removesuffix("/compressed")
    return base.rpartition("/")[0] + "/camera_info"


def _camera(message: Any, rectified: bool) -> Camera:
    """Camera of a CameraInfo message, with ROS 2's or ROS 1's field names."""

    def matrix(name: str) -> Any:
        return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())

    roi = message.roi
    return camera_from_info(
        message.width,
        message.height,
        matrix("k"),
        matrix("d"),
        message.distortion_model,
        (message.binning_x, message.binning_y),
        (roi.x_offset, roi.y_offset, roi.width, roi.height),
        matrix("p"),
        rectified,
    )


def _stamp_ns(header: Any, raw: RawMessage) -> int:
    """The header's stamp; the log time where a driver left it at 0."""
    stamp = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    return stamp or raw.log_time_ns


def _merged_topics(sources: Sequence[Source]) -> dict[str, Topic]:
    merged: dict[str, Topic] = {}
    for source in sources:
        for topic in source.topics():
            old = merged.get(topic.name, Topic(topic.name, topic.type, 0))
            qos = old.qos + tuple(q for q in topic.qos if q not in old.qos)
            count = -1 if min(old.count, topic.count) < 0 else old.count + topic.count
            merged[topic.name] = Topic(topic.name, topic.type, count, qos)
    return dict(sorted(merged.items()))


def _parse_types(definition: MessageDefinition, msgtype: str) -> Any:
    if definition.format == MessageDefinitionFormat.MSG:
        return get_types_from_msg(definition.data, msgtype)
    line = "=" * 80 + "\n"
    if not definition.data.startswith(line + "IDL: "):
        return get_types_from_idl(definition.data)
    types: dict[str, Any] = {}
    for part in definition.data.split(line)[1:]:
        types.update(get_types_from_idl(part.split("\n", 1)[1]))
    return types
