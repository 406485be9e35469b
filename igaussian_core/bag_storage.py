"""The storage formats of recordings: mcap files, and what the rosbags library reads."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.summary import Summary
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Qos
from rosbags.rosbag1 import Reader as Reader1
from rosbags.rosbag1 import ReaderError as Reader1Error
from rosbags.rosbag2 import Reader as Reader2
from rosbags.rosbag2 import ReaderError as Reader2Error
from rosbags.rosbag2.metadata import parse_qos
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from igaussian_core.errors import BagError

# what reading a broken file may raise inside the libraries
READ_ERRORS = (
    McapError, CRCValidationError, zstandard.ZstdError, Reader1Error, Reader2Error,
    struct.error, zlib.error, EOFError, ValueError, KeyError, IndexError, OSError,
    OverflowError, MemoryError, RuntimeError, AssertionError, TypeError,
)  # fmt: skip
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_RECORD_LIMIT = 2**30  # bytes; a larger record's length is a broken one


@dataclass(frozen=True)
class TopicQos:
    """Quality of service that a publisher offered, in rmw's lower-case names."""

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "keep_last"
    depth: int = 10


@dataclass(frozen=True)
class Topic:
    """One topic of a bag; `count` is -1 where only reading all would tell."""

    name: str
    type: str
    count: int = -1
    qos: tuple[TopicQos, ...] = ()


class RawMessage(NamedTuple):
    """A recorded message; `data` is encoded as `encoding` says: cdr, or ros1 in its bags."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    encoding: str = "cdr"


def cause_of(error: BaseException) -> str:
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text[:200]}" if text else type(error).__name__


class McapSource:
    """One mcap file."""

    def __init__(self, path: Path, recover: bool, problems: list[str]) -> None:
        self.path = path
        self._recover = recover
        self._problems = problems
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._counts: dict[int, int] = {}
        self._file: IO[bytes] = path.open("rb")
        try:
            self._indexed = self._scan()
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        self._file.close()

    def topics(self) -> list[Topic]:
        return [
            Topic(
                channel.topic,
                self._type(channel),
                self._counts.get(channel.id, 0) if self._counts else -1,
                _topic_qos(channel.metadata.get("offered_qos_profiles", "")),
            )
            for channel in self._channels.values()
        ]

    def definition(self, msgtype: str) -> MessageDefinition | None:
        formats = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
        for schema in self._schemas.values():
            if schema.name == msgtype and schema.encoding in formats and schema.data:
                text = schema.data.decode("utf-8", errors="replace")
                return MessageDefinition(formats[schema.encoding], text)
        return None

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        if self._indexed:
            self._file.seek(0)
            reader = SeekingReader(self._file, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
            for _, channel, message in reader.iter_messages(topics):
                yield self._raw(channel, message)
            return
        for record in self._records():
            if isinstance(record, Message):
                channel = self._channels[record.channel_id]
                if topics is None or channel.topic in topics:
                    yield self._raw(channel, record)

    def _raw(self, channel: Channel, message: Message) -> RawMessage:
        kind = self._type(channel)
        encoding = channel.message_encoding
        return RawMessage(channel.topic, kind, message.log_time, message.data, encoding)

    def _type(self, channel: Channel) -> str:
        schema = self._schemas.get(channel.schema_id)
        return schema.name if schema else ""

    def _scan(self) -> bool:
        """Learn the topics; True where the file's index can be used."""
        if self.path.stat().st_size == 0:
            raise BagError(f"{self.path}: the file is empty")
        if self._file.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise BagError(f"{self.path}: no mcap file, its first bytes are not those of one")
        if not self._has_end():
            return self._scan_damaged("its end is missing")
        try:
            summary = _summary(self._file)
        except READ_ERRORS as error:
            return self._scan_damaged(cause_of(error))
        if summary is not None and _complete(summary):
            self._schemas, self._channels = summary.schemas, summary.channels
            if summary.statistics:
                self._counts = dict(summary.statistics.channel_message_counts)
            return True
        try:
            self._count(self._all_records())
        except READ_ERRORS as error:
            return self._scan_damaged(cause_of(error))
        return False

    def _scan_damaged(self, cause: str) -> bool:
        """Count what is readable; an error that says so unless recovery was asked for."""
        self._schemas, self._channels, self._counts = {}, {}, {}
        count = self._count(self._records())
        size = self.path.stat().st_size
        text = (
            f"{self.path}: truncated or damaged mcap file of {size} bytes ({cause}); "
            f"{count} messages at its beginning are readable"
        )
        if not self._recover:
            raise BagError(text + (": open it with recover=True to use them" if count else ""))
        if count == 0:
            raise BagError(text)
        self._problems.append(text)
        return False

    def _has_end(self) -> bool:
        self._file.seek(max(0, self.path.stat().st_size - len(_MCAP_MAGIC)))
        return self._file.read() == _MCAP_MAGIC

    def _count(self, records: Iterator[Any]) -> int:
        for record in records:
            if isinstance(record, Schema):
                self._schemas[record.id] = record
            elif isinstance(record, Channel):
                self._channels[record.id] = record
                self._counts.setdefault(record.id, 0)
            elif isinstance(record, Message):
                self._counts[record.channel_id] = self._counts.get(record.channel_id, 0) + 1
        return sum(self._counts.values())

    def _all_records(self) -> Iterator[Any]:
        self._file.seek(0)
        reader = StreamReader(self._file, validate_crcs=True, record_size_limit=_RECORD_LIMIT)
        return reader.records

    def _records(self) -> Iterator[Any]:
        """Records from the front up to the first that is not whole."""
        with suppress(*READ_ERRORS):
            yield from self._all_records()


class RosbagsSource:
    """What the rosbags library reads: sqlite3, compressed rosbag2, ROS 1."""

    def __init__(self, path: Path) -> None:
        self.path = path
        is_ros1 = path.suffix == ".bag"
        self._encoding = "ros1" if is_ros1 else "cdr"
        if path.is_file() and path.stat().st_size == 0:
            raise BagError(f"{path}: the file is empty")
        try:
            self._reader: Any = Reader1(path) if is_ros1 else Reader2(path)
            self._reader.open()
        except Exception as error:  # whatever a broken database or index raises
            raise BagError(f"{path}: cannot be read: {cause_of(error)}") from error

    def close(self) -> None:
        with suppress(Exception):
            self._reader.close()

    def topics(self) -> list[Topic]:
        topics = []
        for connection in self._reader.connections:
            qos = getattr(connection.ext, "offered_qos_profiles", ())  # ROS 1 has none
            topics.append(
                Topic(
                    connection.topic, connection.msgtype, connection.msgcount, _from_rosbags(qos)
                )
            )
        return topics

    def definition(self, msgtype: str) -> MessageDefinition | None:
        for connection in self._reader.connections:
            known = connection.msgdef.format != MessageDefinitionFormat.NONE
            if connection.msgtype == msgtype and known:
                definition: MessageDefinition = connection.msgdef
                return definition
        return None

    def messages(self, topics: Collection[str] | None) -> Iterator[RawMessage]:
        connections = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if connections:  # an empty list would mean all
            for connection, stamp, data in self._reader.messages(connections=connections):
                kind = connection.msgtype
                yield RawMessage(connection.topic, kind, stamp, bytes(data), self._encoding)


Source = McapSource | RosbagsSource


def open_sources(path: Path, recover: bool, problems: list[str]) -> list[Source]:
    """The storage files of a recording, in order.

    Raises:
        BagError: see igaussian_core.bags.Bag.
    """
    if not path.exists():
        raise BagError(f"{path}: no such file or directory")
    if path.is_file():
        if path.suffix in (".db3", ".bag"):
            return [RosbagsSource(path)]
        if path.suffix == ".mcap":
            return [McapSource(path, recover, problems)]
        raise BagError(
            f"{path}: '{path.suffix}' is no recording; supported: .mcap, .db3, .bag (ROS 1) "
            "and rosbag2 directories"
        )
    files = _mcap_files(path)
    if files is None:
        return [RosbagsSource(path)]
    sources: list[Source] = []
    try:
        for file in files:
            sources.append(McapSource(file, recover, problems))
    except BagError:
        for source in sources:
            source.close()
        raise
    return sources


def _mcap_files(directory: Path) -> list[Path] | None:
    """The plain mcap files of a rosbag2 directory; None where rosbags must read it."""
    metadata = directory / "metadata.yaml"
    if not metadata.exists():
        files = sorted(directory.glob("*.mcap"), key=_split_number)
        if files:
            return files
        raise BagError(f"{directory}: no recording: neither metadata.yaml nor .mcap files in it")
    try:
        content = YAML(typ="safe").load(metadata.read_text(encoding="utf-8"))
        info = content["rosbag2_bagfile_information"]
        names = [Path(name).name for name in info["relative_file_paths"]]
        plain = info["storage_identifier"] == "mcap" and not info.get("compression_mode")
        formats = {
            topic["topic_metadata"]["serialization_format"]
            for topic in info["topics_with_message_count"]
        }
    except (YAMLError, KeyError, TypeError, ValueError, OSError) as error:
        raise BagError(f"{metadata}: cannot be understood: {cause_of(error)}") from error
    if formats - {"cdr"}:
        raise BagError(
            f"{metadata}: serialization {', '.join(map(repr, sorted(formats)))} is not supported; "
            "supported: 'cdr'"
        )
    missing = [name for name in names if not (directory / name).exists()]
    if missing:
        raise BagError(f"{directory}: metadata.yaml names files that are missing: {missing}")
    return [directory / name for name in names] if plain else None


def _split_number(path: Path) -> tuple[str, int]:
    """Sort key: bag_10.mcap after bag_9.mcap."""
    stem, _, number = path.stem.rpartition("_")
    return (stem, int(number)) if number.isdigit() else (path.stem, -1)


def _summary(file: IO[bytes]) -> Summary | None:
    file.seek(0)
    return SeekingReader(file, record_size_limit=_RECORD_LIMIT).get_summary()


def _complete(summary: Summary) -> bool:
    """True where the index alone leads to every message."""
    known = {channel_id for c in summary.chunk_indexes for channel_id in c.message_index_offsets}
    if not summary.chunk_indexes or not known <= set(summary.channels):
        return False
    schemas = {channel.schema_id for channel in summary.channels.values()} - {0}
    return bool(summary.channels) and schemas <= set(summary.schemas)


def _topic_qos(text: str) -> tuple[TopicQos, ...]:
    """QoS of mcap's channel metadata (YAML); nothing where it cannot be understood."""
    with suppress(Reader2Error, *READ_ERRORS):
        return _from_rosbags(parse_qos(text))
    return ()


def _from_rosbags(profiles: Sequence[Qos]) -> tuple[TopicQos, ...]:
    return tuple(
        TopicQos(
            qos.reliability.name.lower(),
            qos.durability.name.lower(),
            qos.history.name.lower(),
            qos.depth,
        )
        for qos in profiles
    )
