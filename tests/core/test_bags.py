"""Bags written here and read back, and every recording among the real data."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from bag_messages import CAMERA, START, STEP, H, Messages, W
from mcap.writer import Writer as McapWriter

from igaussian_core.bag_storage import TopicQos
from igaussian_core.bags import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    IMAGE,
    ODOMETRY,
    POSE,
    TF,
    Bag,
    BagWriter,
    T_from_chain,
)
from igaussian_core.errors import BagError
from igaussian_core.geometry import compose, rotation_from_vector

SENSOR_QOS = TopicQos("best_effort", "volatile", "keep_last", 5)


def _T(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return compose(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3))


def _rgb(seed: int, height: int = H, width: int = W) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A small bag as a robot would record it."""
    path = tmp_path / "drive"
    with BagWriter(path) as writer:
        make = Messages(writer)
        writer.add_topic("/camera/image_raw", IMAGE, SENSOR_QOS)
        writer.add_topic("/camera/camera_info", CAMERA_INFO)
        writer.add_topic("/truth", POSE)
        writer.add_topic("/odom", ODOMETRY)
        writer.add_topic("/tf_static", TF, TopicQos(durability="transient_local"))
        static = writer.typestore.types[TF](
            transforms=[
                make.transform("base_link", "mast", _T(100)),
                make.transform("mast", "camera", _T(101)),
            ]
        )
        writer.write("/tf_static", START, static)
        for i in range(5):
            stamp = START + i * STEP
            writer.write("/camera/image_raw", stamp + 1000, make.image(stamp, _rgb(i)))
            writer.write("/camera/camera_info", stamp + 1000, make.info(stamp))
            writer.write("/truth", stamp + 1000, make.pose(stamp, _T(i)))
            writer.write("/odom", stamp + 1000, make.odometry(stamp, _T(50 + i)))
    return path


def test_topics_types_counts_and_qos(drive):
    for path in (drive, drive / "drive.mcap"):
        with Bag(path) as bag:
            assert list(bag.topics) == [
                "/camera/camera_info", "/camera/image_raw", "/odom", "/tf_static", "/truth"
            ]  # fmt: skip
            image = bag.topics["/camera/image_raw"]
            assert (image.type, image.count, image.qos) == (IMAGE, 5, (SENSOR_QOS,))
            assert bag.topics["/tf_static"].qos[0].durability == "transient_local"


def test_frames_survive_the_round_trip(drive):
    with Bag(drive) as bag:
        frames = list(bag.frames())
    # the images come before their camera_info in the bag
    assert [frame.stamp_ns for frame in frames] == [START + i * STEP for i in range(5)]
    for i, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.image, _rgb(i))
        assert frame.camera == CAMERA


def test_poses_odometry_and_transforms(drive):
    with Bag(drive) as bag:
        poses, odometry, static = bag.poses(), bag.odometry(), bag.static_transforms()
    for i, (stamp, T_map_cam) in enumerate(poses):
        assert stamp == START + i * STEP
        np.testing.assert_allclose(T_map_cam, _T(i), atol=1e-9)
    for i, item in enumerate(odometry):
        np.testing.assert_allclose(item.T_frame_child, _T(50 + i), atol=1e-9)
        assert (item.frame, item.child) == ("odom", "base_link")
    T_base_cam = T_from_chain(static, "base_link", "camera")
    np.testing.assert_allclose(T_base_cam, _T(100) @ _T(101), atol=1e-9)
    T_cam_base = T_from_chain(static, "camera", "base_link")
    np.testing.assert_allclose(T_cam_base, np.linalg.inv(_T(100) @ _T(101)), atol=1e-9)
    assert T_from_chain(static, "base_link", "elsewhere") is None


def test_raw_cdr_is_what_was_written(drive, tmp_path):
    with Bag(drive) as bag:
        raw = list(bag.messages(("/truth",)))
        again = tmp_path / "again"
        with BagWriter(again) as writer:
            writer.add_topic("/truth", POSE)
            for message in raw:
                writer.write("/truth", message.log_time_ns, message.data)
    with Bag(again) as bag:
        assert list(bag.messages()) == raw
        assert [m.log_time_ns for m in raw] == [START + i * STEP + 1000 for i in range(5)]


def test_compressed_images_and_stamp_zero(tmp_path):
    path = tmp_path / "jpeg"
    with BagWriter(path) as writer:
        make = Messages(writer)
        writer.add_topic("/cam/image_raw/compressed", COMPRESSED_IMAGE)
        writer.add_topic("/cam/camera_info", CAMERA_INFO)
        writer.write("/cam/camera_info", START, make.info(0))
        writer.write("/cam/image_raw/compressed", START + 7, make.jpeg(0, _rgb(1)))
    with Bag(path) as bag:
        (frame,) = bag.frames()
    assert frame.stamp_ns == START + 7
    np.testing.assert_array_equal(frame.image, _rgb(1))


def _two_cameras(path: Path) -> Path:
    with BagWriter(path) as writer:
        make = Messages(writer)
        for name in ("/left", "/right"):
            writer.add_topic(f"{name}/image_raw", IMAGE)
            writer.add_topic(f"{name}/camera_info", CAMERA_INFO)
            writer.write(f"{name}/camera_info", START, make.info(START))
            writer.write(f"{name}/image_raw", START, make.image(START, _rgb(2)))
        writer.add_topic("/a", POSE)
        writer.add_topic("/b", POSE)
    return path


def test_ambiguity_is_an_error_that_names_the_choices(tmp_path):
    with Bag(_two_cameras(tmp_path / "stereo")) as bag:
        with pytest.raises(BagError, match="/left/image_raw, /right/image_raw"):
            bag.image_topic()
        with pytest.raises(BagError, match="several pose topics.*/a, /b"):
            bag.pose_topic()
        assert len(list(bag.frames("/right/image_raw"))) == 1
        with pytest.raises(BagError, match="no topic /up/image.*it has /a"):
            list(bag.frames("/up/image"))
        with pytest.raises(BagError, match="wanted is sensor_msgs"):
            list(bag.frames("/a"))


def test_needed_topics_missing(tmp_path):
    with BagWriter(tmp_path / "bare") as writer:
        writer.add_topic("/chat", "std_msgs/msg/String")
    with Bag(tmp_path / "bare") as bag:
        for call in (bag.image_topic, bag.poses, bag.odometry, lambda: list(bag.frames())):
            with pytest.raises(BagError, match="bare: .*it has /chat"):
                call()
        with pytest.raises(BagError, match="no camera_info topic"):
            bag.camera_info_topic("/camera/image_raw")


@pytest.mark.parametrize(
    ("images", "fx", "cause"),
    [
        (["32FC1", "rgb8"], None, "'32FC1' is not supported"),
        (["rgb8"], 0.0, "fx=0"),
        (["small", "rgb8"], None, "image is 16x24, its camera is 32x24"),
    ],
)
def test_bad_frames_raise_or_are_skipped(tmp_path, images, fx, cause, caplog):
    path = tmp_path / "bad"
    with BagWriter(path) as writer:
        make = Messages(writer)
        writer.add_topic("/c/image_raw", IMAGE)
        writer.add_topic("/c/camera_info", CAMERA_INFO)
        writer.write("/c/camera_info", START, make.info(START, fx=fx))
        for i, kind in enumerate(images):
            rgb = _rgb(i, width=16 if kind == "small" else W)
            encoding = "rgb8" if kind == "small" else kind
            writer.write("/c/image_raw", START + i, make.image(START + i, rgb, encoding))
    with Bag(path) as bag:
        with pytest.raises(BagError, match=f"/c/image_raw.*{cause}"):
            list(bag.frames())
        if len(images) > 1:
            assert [f.stamp_ns for f in bag.frames(skip_bad=True)] == [START + 1]
            assert cause in caplog.text
        else:
            with pytest.raises(BagError, match="no usable frame"):
                list(bag.frames(skip_bad=True))


def test_no_camera_info_message(tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/c/image_raw", IMAGE)
        writer.add_topic("/c/camera_info", CAMERA_INFO)
        writer.write("/c/image_raw", START, Messages(writer).image(START, _rgb(0)))
    with Bag(path) as bag, pytest.raises(BagError, match="no message on /c/camera_info"):
        list(bag.frames())


def test_a_pose_that_is_none(tmp_path):
    path = tmp_path / "bag"
    with BagWriter(path) as writer:
        writer.add_topic("/truth", POSE)
        message = Messages(writer).pose(START, np.eye(4))
        message.pose.orientation.w = 0.0
        writer.write("/truth", START, message)
    with Bag(path) as bag, pytest.raises(BagError, match="/truth.*no pose"):
        bag.poses()


def test_truncated_and_flipped(drive, tmp_path):
    data = (drive / "drive.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:-300])
    with pytest.raises(BagError, match="its end is missing.*21 messages.*recover=True"):
        Bag(path)
    with Bag(path, recover=True) as bag:
        assert len(list(bag.frames())) == 5
        assert "its end is missing" in bag.problems[0]


def test_damaged_chunk(tmp_path):
    """A chunk whose checksum is wrong, in a file whose index is sound."""
    path = tmp_path / "crc.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chat", "cdr", schema)
        text = b"\x00\x01\x00\x00\x06\x00\x00\x00hello\x00"
        writer.add_message(channel, START, text * 100, START)
        writer.finish()
    with Bag(path) as bag:
        assert len(list(bag.messages())) == 1
    data = bytearray(path.read_bytes())
    at = data.find(b"\x28\xb5\x2f\xfd") + 20  # inside the zstd frame
    data[at] ^= 0xFF
    path.write_bytes(data)
    with Bag(path) as bag, pytest.raises(BagError, match="crc.mcap: damaged after 0 messages"):
        list(bag.messages())


@pytest.mark.parametrize(
    ("name", "content", "cause"),
    [
        ("none.mcap", None, "no such file"),
        ("empty.mcap", b"", "is empty"),
        ("empty.bag", b"", "is empty"),
        ("text.mcap", b"just some text, nothing else", "no mcap file"),
        ("text.bag", b"just some text, nothing else", "cannot be read"),
        ("text.db3", b"just some text, nothing else" * 99, "cannot be read"),
        ("clip.mp4", b"1234", "'.mp4' is no recording; supported: .mcap"),
    ],
)
def test_no_recording(tmp_path, name, content, cause):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BagError, match=cause) as error:
        Bag(path)
    assert str(path) in str(error.value)


def test_broken_directories(drive, tmp_path):
    with pytest.raises(BagError, match="neither metadata.yaml nor .mcap"):
        Bag(tmp_path / "drive" / "..")
    (drive / "metadata.yaml").write_text("just text")
    with pytest.raises(BagError, match="metadata.yaml: cannot be understood"):
        Bag(drive)
    (drive / "metadata.yaml").unlink()
    with Bag(drive) as bag:  # the file alone says everything
        assert len(list(bag.frames())) == 5


def test_directory_with_a_missing_file(drive):
    (drive / "drive.mcap").unlink()
    with pytest.raises(BagError, match="missing.*drive.mcap"):
        Bag(drive)


def test_writer_refuses(drive, tmp_path):
    with pytest.raises(BagError, match="exists already"):
        BagWriter(drive)
    with BagWriter(tmp_path / "new") as writer:
        with pytest.raises(BagError, match="not declared"):
            writer.write("/nowhere", START, b"")
        with pytest.raises(BagError, match="/x.*no_such"):
            writer.add_topic("/x", "no_such_msgs/msg/Thing")


def test_foxglove_reads_the_schema(drive):
    """Profile, schema encoding and definitions as other mcap readers want them."""
    from mcap.reader import make_reader

    with (drive / "drive.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        schemas = reader.get_summary().schemas.values()
    assert {s.encoding for s in schemas} == {"ros2msg"}
    assert any(s.name == POSE and b"MSG: geometry_msgs/Pose" in s.data for s in schemas)


# --- recordings of others ---------------------------------------------------------------------


def _recordings(root: Path) -> list[Path]:
    files = [p for p in root.rglob("*") if p.suffix in (".mcap", ".db3", ".bag")]
    return sorted(files + [p.parent for p in root.rglob("metadata.yaml")])


def test_every_recording_is_read_or_refused(data_dir):
    """Nothing but BagError, and messages as many as the conformance files say."""
    refused, read = [], 0
    for path in _recordings(data_dir / "bags"):
        try:
            with Bag(path) as bag:
                count = 0
                for message in bag.messages():
                    count += 1
                    try:
                        bag.deserialize(message)
                    except BagError as error:
                        assert message.topic in str(error)
        except BagError as error:
            assert str(path) in str(error)
            refused.append(path.name)
            continue
        read += 1
        expected = path.with_suffix(".json")
        if expected.exists():
            records = json.loads(expected.read_text())["records"]
            assert count == sum(r["type"] == "Message" for r in records), path
    assert read > 400
    assert sorted(refused) == [
        "empty-file.bag", "empty.mcap", "text_not_mcap.mcap", "trunc_half.mcap",
        "trunc_no_footer.mcap", "wrong_rmw_test", "wrong_rmw_test",
    ]  # fmt: skip


def test_recovery_of_a_truncated_recording(data_dir):
    path = data_dir / "bags" / "corrupt" / "trunc_half.mcap"
    with pytest.raises(BagError, match="71 messages.*recover=True"):
        Bag(path)
    with Bag(path, recover=True) as bag:
        assert len(list(bag.frames())) == 24
        assert len(bag.poses()) == 23


def test_real_camera_in_both_formats(data_dir):
    folder = data_dir / "bags" / "real_camera"
    frames = []
    for name in ("aruco_marker_mcap", "aruco_marker.bag"):
        with Bag(folder / name) as bag:
            frames += list(bag.frames())
    first, second = frames
    assert first.camera == second.camera and first.stamp_ns == second.stamp_ns
    assert first.camera.dist[0] == pytest.approx(0.1465, abs=1e-3)
    np.testing.assert_array_equal(first.image, second.image)
    assert first.image.shape == (720, 1280, 3) and first.image.std() > 20


def test_redkitchen(data_dir):
    with Bag(data_dir / "bags" / "redkitchen") as bag:
        frames = list(bag.frames())
        poses = dict(bag.poses())
    assert len(frames) == 120 and all(frame.stamp_ns in poses for frame in frames)
    assert {frame.camera for frame in frames} == {frames[0].camera}
