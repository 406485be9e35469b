"""Replay a recording over ROS 2: `python -m igaussian_ros.replay bag [--rate 1.0] ...`.

Recorded CDR bytes are published as they are, with the recording's QoS, next to /clock.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import re
import signal
import struct
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image

from igaussian_core.bag_storage import RawMessage, Topic
from igaussian_core.bags import Bag
from igaussian_core.errors import BagError, IGaussianError
from igaussian_core.image_decode import decode_compressed
from igaussian_ros.convert import image_to_ros, stamp_from_ns

_IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
_COMPRESSED = "sensor_msgs/msg/CompressedImage"
_CDR_HEADER = 4  # bytes; the second says the byte order


@dataclass(frozen=True)
class Options:
    """What to replay, and how.

    Attributes:
        rate: 2.0 is twice as fast.
        loops: how often; 0 means for ever.
        start_s, duration_s: the part of the recording, seconds; None: to its end.
        topics: these only; empty: all.
        remap: new names by old.
        raw: publish compressed images decoded, on their topic without /compressed.
        stamp_now: move header stamps to the present by a constant, and publish no /clock.
        wait_s: how long to wait until every image topic (every topic, where no image is
            replayed) has a subscriber.
        clock_hz: /clock messages a second of wall time.
    """

    rate: float = 1.0
    loops: int = 1
    start_s: float = 0.0
    duration_s: float | None = None
    topics: tuple[str, ...] = ()
    remap: tuple[tuple[str, str], ...] = ()
    raw: bool = False
    stamp_now: bool = False
    wait_s: float = 0.0
    clock_hz: float = 50.0


@dataclass(frozen=True)
class Channel:
    """One topic on its way out."""

    publisher: Publisher
    kind: type
    decode: bool  # compressed image in, raw image out
    stamped: bool  # its first field is a std_msgs/Header


class Replayer:
    """Publishes a recording on a node.

    Raises:
        BagError: a recording that cannot be read, or without any topic to publish.
    """

    def __init__(self, node: Node, bag_path: str, options: Options) -> None:
        self._node = node
        self._options = options
        self._bag = Bag(bag_path)
        self._over = threading.Event()
        self._channels = self._create_channels()
        self._clock: Publisher | None = None
        if not options.stamp_now:
            self._clock = node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
        self.published = 0

    def stop(self) -> None:
        """End `run` soon; may be called from a signal handler."""
        self._over.set()

    def run(self) -> int:
        """Publish until the end; the number of messages published.

        Raises:
            BagError: damaged data on the way.
        """
        self._wait_for_subscribers()
        for loop in itertools.count(1):
            self._run_once()
            if self._over.is_set() or loop == self._options.loops:
                break
        for channel in self._channels.values():
            # a reliable reader may still miss what was published last
            if channel.publisher.qos_profile.reliability == ReliabilityPolicy.RELIABLE:
                channel.publisher.wait_for_all_acked(Duration(seconds=1))
        return self.published

    def close(self) -> None:
        self._bag.close()

    def _create_channels(self) -> dict[str, Channel]:
        wanted = set(self._options.topics)
        if missing := sorted(wanted - set(self._bag.topics)):
            raise BagError(
                f"{self._bag.path}: no topic {', '.join(missing)}; "
                f"it has {', '.join(self._bag.topics) or 'none'}"
            )
        channels = {}
        for topic in self._bag.topics.values():
            if (wanted and topic.name not in wanted) or topic.name == "/clock":
                continue
            kind = message_class(topic.type)
            if kind is None:
                self._node.get_logger().warning(
                    f"{topic.name} is skipped: {topic.type} is not installed"
                )
                continue
            channels[topic.name] = self._channel(topic, kind)
        if not channels:
            raise BagError(f"{self._bag.path}: no topic that can be published")
        return channels

    def _channel(self, topic: Topic, kind: type) -> Channel:
        decode = self._options.raw and topic.type == _COMPRESSED
        name = re.sub("/compressed$", "", topic.name) if decode else topic.name
        name = dict(self._options.remap).get(name, name)
        publisher = self._node.create_publisher(Image if decode else kind, name, qos_of(topic))
        return Channel(publisher, kind, decode, is_stamped(kind))

    def _wait_for_subscribers(self) -> None:
        images = [name for name in self._bag.topics_of(*_IMAGES) if name in self._channels]
        awaited = [self._channels[name].publisher for name in images or self._channels]
        end = time.monotonic() + self._options.wait_s
        while time.monotonic() < end and not self._over.is_set():
            if all(publisher.get_subscription_count() > 0 for publisher in awaited):
                self._wait_for_the_rest(min(end, time.monotonic() + 2))
                return
            self._over.wait(0.02)
        if self._options.wait_s > 0 and not self._over.is_set():
            names = ", ".join(publisher.topic_name for publisher in awaited)
            self._node.get_logger().warning(
                f"no subscriber of {names} within {self._options.wait_s:g} s; starting all the same"
            )

    def _wait_for_the_rest(self, end: float) -> None:
        """Until every subscriber that is known of is connected."""
        publishers = [channel.publisher for channel in self._channels.values()]
        self._over.wait(0.3)  # the other side has to connect, too
        while time.monotonic() < end and not self._over.is_set():
            if all(
                self._node.count_subscribers(publisher.topic_name)
                <= publisher.get_subscription_count()
                for publisher in publishers
            ):
                return
            self._over.wait(0.02)

    def _run_once(self) -> None:
        """The chosen part of the recording once."""
        messages = self._messages()
        first = next(messages, None)
        if first is None:
            raise BagError(f"{self._bag.path}: no message in the chosen part")
        begin_ns, begin = first.log_time_ns, time.monotonic()
        wall_ns = time.time_ns()
        next_tick = begin
        for message in itertools.chain([first], messages):
            due = begin + (message.log_time_ns - begin_ns) * 1e-9 / self._options.rate
            while (now := time.monotonic()) < due and not self._over.is_set():
                next_tick = self._tick(now, next_tick, begin, begin_ns)
                self._over.wait(max(0.0, min(due, next_tick) - time.monotonic()))
            if self._over.is_set():
                return
            self._publish_clock(message.log_time_ns)
            self._publish(message, begin_ns, wall_ns)

    def _tick(self, now: float, next_tick: float, begin: float, begin_ns: int) -> float:
        """Publish /clock where it is time to; when it is next."""
        if now < next_tick:
            return next_tick
        self._publish_clock(begin_ns + int((now - begin) * self._options.rate * 1e9))
        return now + 1 / self._options.clock_hz

    def _publish_clock(self, time_ns: int) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp_from_ns(time_ns)))

    def _messages(self) -> Iterator[RawMessage]:
        options, first_ns = self._options, None
        for message in self._bag.messages(list(self._channels)):
            if message.encoding != "cdr":
                raise BagError(
                    f"{self._bag.path}: {message.topic} is encoded as '{message.encoding}'; "
                    "only CDR, ROS 2's encoding, can be replayed"
                )
            first_ns = message.log_time_ns if first_ns is None else first_ns
            elapsed_s = (message.log_time_ns - first_ns) * 1e-9
            if options.duration_s is not None and elapsed_s > options.start_s + options.duration_s:
                return
            if elapsed_s >= options.start_s:
                yield message

    def _publish(self, message: RawMessage, begin_ns: int, wall_ns: int) -> None:
        channel, data = self._channels[message.topic], bytes(message.data)
        if self._options.stamp_now and channel.stamped:
            data = restamped(data, begin_ns, wall_ns, self._options.rate)
        if not channel.decode:
            channel.publisher.publish(data)
        elif (image := decoded(data, message.topic, self._node)) is not None:
            channel.publisher.publish(image)
        self.published += 1


def decoded(data: bytes, topic: str, node: Node) -> Image | None:
    """Raw Image of a serialized CompressedImage; None, with a warning, where it is none."""
    compressed = deserialize_message(data, CompressedImage)
    try:
        rgb = decode_compressed(compressed.data, topic)
    except IGaussianError as error:
        node.get_logger().warning(str(error))
        return None
    return image_to_ros(rgb, compressed.header)


def restamped(data: bytes, begin_ns: int, wall_ns: int, rate: float) -> bytes:
    """Serialized message with its header's stamp moved: begin_ns becomes wall_ns.

    The stamp comes first in CDR, after the four bytes that say how it is encoded.
    """
    order = "<" if data[1] & 1 else ">"
    sec, nanosec = struct.unpack_from(order + "iI", data, _CDR_HEADER)
    stamp_ns = wall_ns + int((sec * 1_000_000_000 + nanosec - begin_ns) / rate)
    packed = struct.pack(order + "iI", *divmod(stamp_ns, 1_000_000_000))
    return data[:_CDR_HEADER] + packed + data[_CDR_HEADER + 8 :]


def message_class(name: str) -> Any | None:
    """The class of "package/msg/Type"; None where its package is not installed."""
    package, _, kind = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind, None)
    except ImportError:
        return None


def is_stamped(kind: Any) -> bool:
    """True for messages that begin with a std_msgs/Header."""
    return next(iter(kind.get_fields_and_field_types().values()), "") == "std_msgs/Header"


def qos_of(topic: Topic) -> QoSProfile:
    """QoS to publish with: what the recording says was offered, else reliable, depth 10."""
    latched = topic.name.endswith("/tf_static")
    if not topic.qos:
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        return QoSProfile(depth=10, durability=durability)
    offered = topic.qos[0]
    keep_all = offered.history == "keep_all"
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
        depth=max(1, offered.depth),
        reliability=ReliabilityPolicy.BEST_EFFORT
        if offered.reliability == "best_effort"
        else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL
        if latched or offered.durability == "transient_local"
        else DurabilityPolicy.VOLATILE,
    )


def parse(arguments: list[str] | None = None) -> tuple[str, Options]:
    """Path of the bag and the options; exits with a usage line on a wrong one."""
    parser = argparse.ArgumentParser(prog="replay", description="Replay a recording over ROS 2.")
    parser.add_argument("bag", help="an .mcap file or a rosbag2 directory")
    parser.add_argument("--rate", type=_positive, default=1.0, help="2.0 is twice as fast")
    parser.add_argument("--loop", type=_count, default=1, metavar="N", help="times; 0: for ever")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds to skip")
    parser.add_argument("--duration", type=_positive, metavar="S", help="seconds to play")
    parser.add_argument("--topics", nargs="+", default=[], help="these topics only")
    parser.add_argument(
        "--remap", action="append", type=_remap, default=[], metavar="OLD:=NEW", help="rename"
    )
    parser.add_argument("--raw", action="store_true", help="decode compressed images")
    parser.add_argument(
        "--stamp",
        choices=("bag", "now"),
        default="bag",
        help="bag: recorded stamps and /clock; now: stamps moved to the present, no /clock",
    )
    parser.add_argument(
        "--wait-for-subscribers", type=float, default=0.0, metavar="S", help="at most so long"
    )
    parser.add_argument("--clock-hz", type=_positive, default=50.0, help="rate of /clock")
    a = parser.parse_args(arguments)
    return a.bag, Options(
        rate=a.rate,
        loops=a.loop,
        start_s=a.start,
        duration_s=a.duration,
        topics=tuple(a.topics),
        remap=tuple(a.remap),
        raw=a.raw,
        stamp_now=a.stamp == "now",
        wait_s=a.wait_for_subscribers,
        clock_hz=a.clock_hz,
    )


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def _remap(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(":=")
    if not (separator and old and new):
        raise argparse.ArgumentTypeError(f"'{text}' is not OLD:=NEW")
    return old, new


def main(arguments: list[str] | None = None) -> int:
    """Replay; 0 at the end or on SIGINT and SIGTERM, 1 where the bag cannot be read."""
    bag_path, options = parse(arguments)
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = Node("replay")
    replayer: Replayer | None = None
    status = 0
    try:
        replayer = Replayer(node, bag_path, options)
        stopping = replayer.stop
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stopping())
        print(f"replay: {replayer.run()} messages published", flush=True)
    except IGaussianError as error:
        print(f"replay: {error}", file=sys.stderr)
        status = 1
    finally:
        if replayer is not None:
            replayer.close()
        node.destroy_node()
        rclpy.try_shutdown()
    return status


if __name__ == "__main__":
    sys.exit(main())
