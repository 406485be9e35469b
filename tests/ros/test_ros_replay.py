"""The replayer sends what was recorded, when it is due, and says what it cannot read."""

from __future__ import annotations

import struct
import time

import numpy as np
import pytest
import rclpy
from harness import Spinning, replay_process, wait_until
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message
from rosgraph_msgs.msg import Clock
from scene import IMAGE_TOPIC, START_NS, STEP_NS, info_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from igaussian_core.bag_storage import Topic, TopicQos
from igaussian_core.errors import BagError
from igaussian_ros import replay
from igaussian_ros.convert import image_from_ros, stamp_to_ns

S = 10**9


class Ear(Node):
    """Keeps what it hears: (wall time, stamp, message) by topic."""

    def __init__(self, **topics: type) -> None:
        super().__init__("ear")
        self.heard = {}
        for name, kind in topics.items():
            topic = "/" + name.replace("__", "/")
            self.heard[topic] = []
            qos = QoSProfile(depth=1000)
            self.create_subscription(kind, topic, self.heard[topic].append, qos)


def _stamps(messages):
    return [stamp_to_ns(m.header.stamp) for m in messages]


def test_a_recording_arrives_complete_with_its_clock(ros, corner, tmp_path):
    ear = Ear(camera__image_raw__compressed=CompressedImage, camera__camera_info=CameraInfo,
              odom=Odometry, clock=Clock)  # fmt: skip
    with Spinning(ear), replay_process(
        tmp_path, corner.bag, "--rate", "4", "--wait-for-subscribers", "10"
    ) as player:
        assert player.popen.wait(30) == 0, player.log
        assert "160 messages published" in player.log
        expected = [START_NS + i * STEP_NS for i in range(40)]
        assert wait_until(lambda: len(ear.heard[IMAGE_TOPIC]) == 40, 5)
        for topic in (IMAGE_TOPIC, "/camera/camera_info", "/odom"):
            assert _stamps(ear.heard[topic]) == expected
        ticks = [stamp_to_ns(m.clock) for m in ear.heard["/clock"]]
        assert ticks == sorted(ticks)
        assert ticks[0] == START_NS and ticks[-1] >= expected[-1]
        assert len(ticks) > 80  # between the messages, too


def test_bytes_are_those_recorded(ros, corner, tmp_path):
    ear = Ear(camera__camera_info=CameraInfo)
    with Spinning(ear), replay_process(
        tmp_path, corner.bag, "--rate", "4", "--topics", "/camera/camera_info",
        "--wait-for-subscribers", "10",
    ) as player:  # fmt: skip
        assert player.popen.wait(30) == 0, player.log
        assert wait_until(lambda: len(ear.heard["/camera/camera_info"]) == 40, 5)
        assert ear.heard["/camera/camera_info"][3] == info_message(START_NS + 3 * STEP_NS)


def test_part_loops_remapping_and_raw_images(ros, corner, tmp_path):
    ear = Ear(other=Image)
    arguments = ["--start", "1", "--duration", "0.55", "--loop", "2", "--rate", "4", "--raw",
                 "--remap=/camera/image_raw:=/other", "--wait-for-subscribers=10"]  # fmt: skip
    with Spinning(ear), replay_process(tmp_path, corner.bag, *arguments) as player:
        assert player.popen.wait(30) == 0, player.log
        assert wait_until(lambda: len(ear.heard["/other"]) == 12, 5)
        once = [START_NS + S + i * STEP_NS for i in range(6)]
        assert _stamps(ear.heard["/other"]) == once + once
        first = ear.heard["/other"][0]
        assert (first.encoding, first.width, first.step) == ("rgb8", 480, 1440)
        photo = corner.scene.photo(corner.poses[10]).astype(int)
        assert np.median(np.abs(image_from_ros(first) - photo)) < 20  # gain, noise and JPEG


def test_stamps_can_be_moved_to_the_present(ros, corner, tmp_path):
    ear = Ear(camera__image_raw__compressed=CompressedImage, clock=Clock)
    begin_ns = time.time_ns()
    with Spinning(ear), replay_process(
        tmp_path, corner.bag, "--stamp", "now", "--duration", "0.95", "--wait-for-subscribers", "10"
    ) as player:
        assert player.popen.wait(30) == 0, player.log
        assert wait_until(lambda: len(ear.heard[IMAGE_TOPIC]) == 10, 5)
        stamps = _stamps(ear.heard[IMAGE_TOPIC])
        assert begin_ns < stamps[0] < stamps[-1] < time.time_ns()
        assert np.diff(stamps).tolist() == [STEP_NS] * 9
        assert ear.heard["/clock"] == []


@pytest.mark.parametrize("rate", [1.0, 2.0])
def test_restamped_messages_differ_in_their_stamp_only(rate):
    message = info_message(START_NS + 3 * S + 7)
    data = replay.restamped(serialize_message(message), START_NS, 5000 * S, rate)
    found = deserialize_message(data, CameraInfo)
    assert stamp_to_ns(found.header.stamp) == 5000 * S + int((3 * S + 7) / rate)
    found.header.stamp = message.header.stamp
    assert found == message


def test_big_endian_messages_are_restamped_in_their_order():
    data = b"\x00\x00\x00\x00" + struct.pack(">iI", 10, 5) + b"rest"
    assert replay.restamped(data, 10 * S, 20 * S, 1.0) == (
        b"\x00\x00\x00\x00" + struct.pack(">iI", 20, 5) + b"rest"
    )


def test_only_messages_with_a_header_are_stamped():
    assert replay.is_stamped(CameraInfo) and replay.is_stamped(Odometry)
    assert not replay.is_stamped(Clock)
    assert replay.message_class("no_such_msgs/msg/Thing") is None
    assert replay.message_class("sensor_msgs/msg/NoSuchThing") is None
    assert replay.message_class("sensor_msgs/msg/Image") is Image


def test_qos_is_the_recordings():
    sensor = replay.qos_of(Topic("/i", "t", 1, (TopicQos("best_effort", "volatile", depth=3),)))
    assert (sensor.reliability, sensor.depth) == (qos_profile_sensor_data.reliability, 3)
    latched = replay.qos_of(Topic("/m", "t", 1, (TopicQos(durability="transient_local"),)))
    assert latched.durability == DurabilityPolicy.TRANSIENT_LOCAL
    unknown = replay.qos_of(Topic("/i", "t"))
    assert unknown.reliability == ReliabilityPolicy.RELIABLE
    assert unknown.durability == DurabilityPolicy.VOLATILE
    static = replay.qos_of(Topic("/tf_static", "t"))
    assert static.durability == DurabilityPolicy.TRANSIENT_LOCAL


@pytest.mark.parametrize(
    "arguments",
    [["--rate", "0"], ["--rate", "-1"], ["--loop", "-1"], ["--remap", "a=b"], ["--stamp", "then"]],
)
def test_wrong_arguments_end_with_a_usage_line(arguments, capsys):
    with pytest.raises(SystemExit) as caught:
        replay.parse(["bag", *arguments])
    assert caught.value.code == 2
    assert "usage:" in capsys.readouterr().err


@pytest.fixture
def player(ros):
    node = Node("player_test")
    yield lambda bag, **options: replay.Replayer(node, str(bag), replay.Options(**options))
    node.destroy_node()


def test_missing_and_broken_recordings_say_what_is_wrong(player, corner, tmp_path):
    with pytest.raises(BagError, match="nowhere"):
        player(tmp_path / "nowhere")
    text = tmp_path / "text.mcap"
    text.write_text("no recording")
    with pytest.raises(BagError, match=r"text\.mcap"):
        player(text)
    with pytest.raises(BagError, match="no topic /lidar"):
        player(corner.bag, topics=("/lidar",))


def test_a_truncated_recording_ends_with_one_line(ros, corner, tmp_path):
    whole = next(corner.bag.glob("*.mcap")).read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    with replay_process(tmp_path, tmp_path / "cut.mcap", "--rate", "20") as process:
        assert process.popen.wait(30) == 1
        lines = [line for line in process.log.splitlines() if line.strip()]
        assert len(lines) == 1 and lines[0].startswith("replay: ") and "cut.mcap" in lines[0]


def test_a_signal_ends_the_replay_with_status_0(ros, corner, tmp_path):
    with replay_process(tmp_path, corner.bag, "--loop", "0", "--rate", "4") as process:
        ear = Ear(clock=Clock)
        with Spinning(ear):
            assert wait_until(lambda: ear.heard["/clock"])
            assert process.end() == 0, process.log


def test_the_domain_is_this_runs_own(ros):
    assert rclpy.get_default_context().get_domain_id() in range(1, 101)
