"""Replay without ROS: which frames are processed, when, and with what prior."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from bag_messages import START, STEP, H, Messages, W

from igaussian_core.bags import CAMERA_INFO, IMAGE, ODOMETRY, TF, Bag, BagWriter
from igaussian_core.config import Config
from igaussian_core.geometry import compose, inverse, rotation_from_vector
from igaussian_core.replay import ReplayedFrame, camera_odometry, replay
from igaussian_core.result import LocalizationResult, Status

T_BASE_CAM = compose(rotation_from_vector([-1.2, 1.2, -1.2]), [0.2, 0.0, 0.3])


def _T_map_cam(i: int) -> np.ndarray:
    return compose(rotation_from_vector([0, 0, 0.1 * i]), [0.3 * i, 0.0, 1.0]) @ T_BASE_CAM


class FakeLocalizer:
    """Knows the pose of a frame by its grey level; keeps the priors it was given."""

    def __init__(self, work_s: float = 0.0) -> None:
        self.work_s = work_s
        self.priors: list[np.ndarray | None] = []

    def localize(self, image, camera, prior=None) -> LocalizationResult:
        self.priors.append(prior)
        time.sleep(self.work_s)
        return LocalizationResult(Status.OK, T_map_cam=_T_map_cam(int(image[0, 0, 0])))


@pytest.fixture
def bag(tmp_path: Path):
    with BagWriter(tmp_path / "bag") as writer:
        make = Messages(writer)
        for topic, kind in (
            ("/c/image_raw", IMAGE), ("/c/camera_info", CAMERA_INFO), ("/odom", ODOMETRY),
            ("/tf_static", TF),
        ):  # fmt: skip
            writer.add_topic(topic, kind)
        static = writer.typestore.types[TF](
            transforms=[make.transform("base_link", "camera", T_BASE_CAM)]
        )
        writer.write("/tf_static", START, static)
        start_of_odometry = compose(np.eye(3), [5.0, 6.0, 0.0])
        for i in range(10):
            stamp = START + i * STEP
            T_map_base = _T_map_cam(i) @ inverse(T_BASE_CAM)
            writer.write("/odom", stamp, make.odometry(stamp, start_of_odometry @ T_map_base))
            writer.write("/c/camera_info", stamp, make.info(stamp))
            grey = np.full((H, W, 3), i, np.uint8)
            writer.write("/c/image_raw", stamp, make.image(stamp, grey))
    with Bag(tmp_path / "bag") as opened:
        yield opened


def _play(bag: Bag, localizer: FakeLocalizer, **arguments):
    frames: list[ReplayedFrame] = []
    stats = replay(bag, localizer, Config(), frames.append, **arguments)  # type: ignore[arg-type]
    return frames, stats


def test_every_frame_in_order(bag):
    frames, stats = _play(bag, FakeLocalizer(0.02), every_frame=True)
    assert [f.frame.stamp_ns for f in frames] == [START + i * STEP for i in range(10)]
    assert (stats.processed, stats.dropped) == (10, 0)


def test_a_slow_localizer_gets_the_newest_frame(bag):
    """0.35 s of work a frame, 10 frames a second: the rest is dropped, nothing queues up."""
    frames, stats = _play(bag, FakeLocalizer(0.35))
    assert stats.processed + stats.dropped == stats.received == 10
    assert stats.processed == len(frames) < 10
    stamps = [f.frame.stamp_ns for f in frames]
    assert stamps == sorted(set(stamps)) and stamps[-1] == START + 9 * STEP
    assert all(f.latency_ms >= 350 for f in frames)


def test_odometry_predicts_the_next_pose_exactly(bag):
    localizer = FakeLocalizer()
    frames, _ = _play(bag, localizer, every_frame=True)
    assert localizer.priors[0] is None
    for frame, prior in list(zip(frames, localizer.priors, strict=True))[1:]:
        np.testing.assert_allclose(prior, frame.result.T_map_cam, atol=1e-9)


def test_camera_odometry_uses_the_mounting(bag):
    odometry = camera_odometry(bag)
    first, second = odometry[0][1], odometry[1][1]
    expected = inverse(_T_map_cam(0)) @ _T_map_cam(1)
    np.testing.assert_allclose(inverse(first) @ second, expected, atol=1e-9)


def test_a_part_only(bag):
    frames, _ = _play(bag, FakeLocalizer(), duration_s=0.45, every_frame=True)
    assert len(frames) == 5


def test_stop_ends_the_replay(bag):
    stop = threading.Event()
    frames: list[ReplayedFrame] = []

    def one(frame: ReplayedFrame) -> None:
        frames.append(frame)
        stop.set()

    replay(bag, FakeLocalizer(), Config(), one, rate=0.01, stop=stop)  # type: ignore[arg-type]
    assert len(frames) == 1
