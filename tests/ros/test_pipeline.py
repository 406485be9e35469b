"""What becomes of each image message, with a tracker that only remembers what it was asked."""

from __future__ import annotations

import numpy as np
import pytest
from scene import FRAME, header, info_message, jpeg_message
from sensor_msgs.msg import Image

from igaussian_core.result import LocalizationResult, Status
from igaussian_ros.camera_cache import CameraCache
from igaussian_ros.parameters import all_options, settings_from
from igaussian_ros.pipeline import FramePipeline

NOW = 1_700_000_000_000_000_000
S = 1_000_000_000
GREY = np.full((360, 480, 3), 90, np.uint8)


class RecordingTracker:
    """Stands for igaussian_core.tracker.Tracker: plumbing is tested here, not localization."""

    def __init__(self, status: Status = Status.OK) -> None:
        self.status = status
        self.frames, self.priors, self.odometry = [], [], []
        self.resets = 0

    def process(self, frame):
        self.frames.append(frame)
        T = np.eye(4) if self.status.ok else None
        return LocalizationResult(self.status, "said so", T_map_cam=T)

    def set_prior(self, T_map_cam, stamp_ns):
        self.priors.append((T_map_cam, stamp_ns))

    def add_odometry(self, stamp_ns, T_odom_cam):
        self.odometry.append(stamp_ns)

    def reset(self):
        self.resets += 1


@pytest.fixture
def make():
    def pipeline(tracker=None, **values):
        defaults = {name: option.default for name, option in all_options().items()}
        cameras = CameraCache()
        cameras.update(info_message(1), FRAME)
        result = FramePipeline(settings_from({**defaults, **values}), cameras)
        result.use(tracker or RecordingTracker())
        return result

    return pipeline


def test_a_good_frame_reaches_the_tracker_with_camera_and_stamp(make):
    tracker = RecordingTracker()
    outcome = make(tracker).process(jpeg_message(NOW, GREY), NOW + S // 20)
    assert (outcome.name, outcome.warning) == ("localized", "")
    assert outcome.age_ms == pytest.approx(50)
    (frame,) = tracker.frames
    assert (frame.stamp_ns, frame.camera.fx, frame.image.shape) == (NOW, 400, (360, 480, 3))


def test_a_lost_frame_says_why(make):
    outcome = make(RecordingTracker(Status.NO_HYPOTHESIS)).process(jpeg_message(NOW, GREY), NOW)
    assert (outcome.name, outcome.reason) == ("lost", "said so")


def test_nothing_is_localized_without_a_map(make):
    settings = settings_from({n: o.default for n, o in all_options().items()})
    outcome = FramePipeline(settings, CameraCache()).process(jpeg_message(NOW, GREY), NOW)
    assert outcome.name == "no_map"


def test_old_frames_are_dropped_and_a_bag_without_sim_time_is_guessed(make):
    tracker = RecordingTracker()
    pipeline = make(tracker)
    old = pipeline.process(jpeg_message(NOW, GREY), NOW + 2 * S)
    assert (old.name, old.key) == ("stale", "stale")
    assert "2.0 s old" in old.reason and "use_sim_time" not in old.reason
    years = pipeline.process(jpeg_message(NOW, GREY), NOW + 10**8 * S)
    assert years.name == "stale" and "use_sim_time:=true" in years.reason
    assert tracker.frames == []


def test_age_has_no_limit_at_zero_nor_without_a_clock(make):
    unlimited = make(**{"runtime.max_image_age_s": 0.0})
    assert unlimited.process(jpeg_message(NOW, GREY), NOW + 10**8 * S).name == "localized"
    outcome = make().process(jpeg_message(NOW, GREY), None)
    assert (outcome.name, outcome.age_ms) == ("localized", None)


def test_stamp_zero_is_refused(make):
    outcome = make().process(jpeg_message(0, GREY), NOW)
    assert outcome.name == "rejected" and "stamp is 0" in outcome.reason


def test_stamps_of_the_future_are_warned_of_and_used(make):
    outcome = make().process(jpeg_message(NOW, GREY), NOW - 5 * S)
    assert outcome.name == "localized" and "5.0 s ahead" in outcome.warning


def test_time_that_goes_back_is_said_once(make):
    pipeline = make()
    pipeline.process(jpeg_message(NOW + 9 * S, GREY), None)
    assert "went back by 9.000 s" in pipeline.process(jpeg_message(NOW, GREY), None).warning
    assert pipeline.process(jpeg_message(NOW + S, GREY), None).warning == ""


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (jpeg_message(NOW, GREY[:100]), "images of 480x100"),
        (jpeg_message(NOW, GREY, "other"), "frame 'other'"),
        (Image(header=header(NOW), height=1, width=1, encoding="64FC9", step=9), "64FC9"),
    ],
)
def test_messages_that_cannot_be_used_are_rejected_with_the_reason(make, message, text):
    tracker = RecordingTracker()
    outcome = make(tracker).process(message, NOW)
    assert outcome.name == "rejected" and text in outcome.reason
    assert tracker.frames == []


def test_the_frame_parameter_overrides_the_message(make):
    pipeline = make(camera_optical_frame=FRAME)
    message = jpeg_message(NOW, GREY, "wrong_name")
    assert pipeline.camera_frame(message) == FRAME
    assert pipeline.process(message, NOW).name == "localized"


def test_an_initial_pose_is_used_once_and_stamped_for_the_frame(make):
    tracker = RecordingTracker()
    pipeline = make(tracker)
    for stamp_ns, expected in ((0, NOW), (NOW - S, NOW - S), (NOW + S, NOW), (5, NOW)):
        pipeline.set_initial_pose(np.eye(4), stamp_ns)
        pipeline.process(jpeg_message(NOW, GREY), None)
        pipeline.process(jpeg_message(NOW, GREY), None)
        assert [stamp for _, stamp in tracker.priors] == [expected]
        tracker.priors.clear()


def test_reset_forgets_the_track_and_a_waiting_initial_pose(make):
    tracker = RecordingTracker()
    pipeline = make(tracker)
    pipeline.set_initial_pose(np.eye(4), 0)
    pipeline.process(jpeg_message(NOW + S, GREY), None)
    pipeline.set_initial_pose(np.eye(4), 0)
    pipeline.reset()
    assert tracker.resets == 1
    assert pipeline.process(jpeg_message(NOW, GREY), None).warning == ""
    assert len(tracker.priors) == 1
