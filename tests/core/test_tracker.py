"""What the tracker gives the localizer as prior, frame after frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.config import Config
from igaussian_core.frame import Frame
from igaussian_core.geometry import compose, inverse, rotation_from_vector
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.tracker import Tracker

CAMERA = Camera(4, 3, 5.0, 5.0, 1.5, 1.0)
IMAGE = np.zeros((3, 4, 3), np.uint8)
START = 1_700_000_000_000_000_000
STEP_S = 0.1


class FakeLocalizer:
    """Says where the camera is, or None, and remembers the priors it was given."""

    def __init__(self) -> None:
        self.answer: np.ndarray | None = None
        self.priors: list[np.ndarray | None] = []

    def localize(self, image: Any, camera: Any, prior: Any = None) -> LocalizationResult:
        assert image is IMAGE and camera is CAMERA
        self.priors.append(prior)
        status = Status.NO_HYPOTHESIS if self.answer is None else Status.OK
        return LocalizationResult(status, T_map_cam=self.answer)


class Drive:
    """A tracker with its fake localizer and a clock in seconds."""

    def __init__(self, **settings: Any) -> None:
        self.localizer = FakeLocalizer()
        config = Config.from_flat({f"tracking.{key}": value for key, value in settings.items()})
        self.tracker = Tracker(self.localizer, config)  # type: ignore[arg-type]

    def frame(self, seconds: float, answer: np.ndarray | None) -> np.ndarray | None:
        """Process a frame that is localized at `answer`; the prior that was tried."""
        self.localizer.answer = answer
        self.tracker.process(Frame(stamp(seconds), IMAGE, CAMERA))
        return self.localizer.priors[-1]

    def odometry(self, seconds: float, T_odom_cam: np.ndarray) -> None:
        self.tracker.add_odometry(stamp(seconds), T_odom_cam)


def stamp(seconds: float) -> int:
    return START + round(seconds * 1e9)


def at(x: float, y: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    return compose(rotation_from_vector([0, 0, yaw]), [x, y, 0.0])


def motion(t: float) -> np.ndarray:
    """A camera that turns and walks on at constant speed in its own frame."""
    angle = 0.5 * t
    return compose(
        rotation_from_vector([0, angle, 0]), [2 * np.sin(angle), 0.0, 2 * (np.cos(angle) - 1)]
    )


def test_the_first_frame_has_no_prior() -> None:
    drive = Drive()
    assert not drive.tracker.tracking
    assert drive.frame(0, at(1)) is None
    assert drive.tracker.tracking and drive.tracker.localizer is drive.localizer


def test_the_last_pose_is_the_prior() -> None:
    drive = Drive()
    drive.frame(0, at(1, 2, 0.3))
    assert np.allclose(drive.frame(0.1, at(1.1)), at(1, 2, 0.3))  # type: ignore[arg-type]


def test_odometry_moves_the_prior() -> None:
    """Odometry lives in a frame of its own: only its motion counts."""
    drive = Drive()
    T_odom_map = compose(rotation_from_vector([0.1, 0.2, 2.0]), [100.0, -50.0, 3.0])
    poses = [motion(0.0), motion(0.7)]
    for t, T in zip((0.0, 0.1), poses, strict=True):
        drive.odometry(t, T_odom_map @ T)
    drive.frame(0.0, poses[0])
    assert np.allclose(drive.frame(0.1, None), poses[1])  # type: ignore[arg-type]


def test_odometry_bridges_frames_that_failed() -> None:
    drive = Drive()
    for i in range(11):
        drive.odometry(i * STEP_S, at(5 + i * 0.2))
    drive.frame(0.0, at(0))
    for i in range(1, 10):
        assert np.allclose(drive.frame(i * STEP_S, None), at(i * 0.2))  # type: ignore[arg-type]
    assert drive.tracker.tracking


def test_odometry_nearest_in_time_is_taken() -> None:
    drive = Drive()
    for t, x in ((0.0, 0.0), (0.09, 1.0), (0.14, 2.0)):
        drive.odometry(t, at(x))
    drive.frame(0.02, at(0))
    assert np.allclose(drive.frame(0.11, None), at(1.0))  # type: ignore[arg-type]
    assert np.allclose(drive.frame(0.13, None), at(2.0))  # type: ignore[arg-type]


def test_odometry_from_another_time_is_not_used() -> None:
    drive = Drive()
    drive.odometry(0.0, at(0))
    drive.frame(0.0, at(1))
    drive.odometry(1.0, at(7))
    assert np.allclose(drive.frame(0.5, None), at(1))  # type: ignore[arg-type]


def test_odometry_whose_stamps_jump_back_starts_anew() -> None:
    drive = Drive()
    drive.odometry(10.0, at(50))
    drive.odometry(0.0, at(0))
    drive.odometry(0.1, at(1))
    drive.frame(0.0, at(0))
    assert np.allclose(drive.frame(0.1, None), at(1))  # type: ignore[arg-type]


def test_without_odometry_the_motion_goes_on() -> None:
    drive = Drive()
    drive.frame(0.0, motion(0.0))
    drive.frame(0.1, motion(0.1))
    prior = drive.frame(0.2, motion(0.2))
    step = inverse(motion(0.0)) @ motion(0.1)
    assert np.allclose(prior, motion(0.1) @ step)  # type: ignore[arg-type]
    assert np.allclose(prior, motion(0.2), atol=5e-3)  # type: ignore[arg-type]


def test_motion_is_scaled_to_the_time_that_passed() -> None:
    drive = Drive()
    drive.frame(0.0, at(0))
    drive.frame(0.2, at(1, 0, 0.2))
    prior = drive.frame(0.3, None)
    assert prior is not None
    assert np.allclose(prior, at(1, 0, 0.2) @ at(0.5, 0, 0.1))


def test_motion_is_not_carried_far() -> None:
    drive = Drive()
    drive.frame(0.0, at(0))
    drive.frame(0.1, at(1))
    assert np.allclose(drive.frame(0.9, None), at(1))  # type: ignore[arg-type]


def test_two_frames_of_one_stamp_do_no_harm() -> None:
    drive = Drive()
    drive.frame(0.0, at(0))
    drive.frame(0.0, at(1))
    prior = drive.frame(0.0, at(1))
    assert prior is not None and np.isfinite(prior).all()
    assert np.allclose(drive.frame(0.1, None), at(1))  # type: ignore[arg-type]


def test_an_old_pose_is_no_prior() -> None:
    drive = Drive(max_gap_s=1.0)
    drive.frame(0.0, at(0))
    assert drive.frame(0.9, None) is not None
    assert drive.tracker.tracking
    assert drive.frame(1.1, None) is None
    assert not drive.tracker.tracking
    drive.frame(1.2, at(3))
    assert np.allclose(drive.frame(1.3, None), at(3))  # type: ignore[arg-type]


def test_a_failure_keeps_the_pose_but_never_makes_one() -> None:
    drive = Drive()
    drive.frame(0.0, None)
    assert drive.frame(0.1, None) is None and not drive.tracker.tracking


@pytest.mark.parametrize("back", [0.1, 30.0])
def test_stamps_that_jump_back_reset(back: float) -> None:
    """A bag that plays in a loop: the last pose belongs to its end."""
    drive = Drive()
    drive.odometry(40.0, at(0))
    drive.frame(40.0, at(9))
    assert drive.frame(40.0 - back, at(0)) is None
    assert np.allclose(drive.frame(40.1 - back, None), at(0))  # type: ignore[arg-type]


def test_reset_forgets() -> None:
    drive = Drive()
    drive.frame(0.0, at(9))
    drive.tracker.reset()
    assert not drive.tracker.tracking and drive.frame(0.1, None) is None


def test_a_users_pose_is_the_next_prior() -> None:
    drive = Drive()
    drive.frame(0.0, at(0))
    drive.frame(0.1, at(1))
    drive.tracker.set_prior(at(7, 7), stamp(0.15))
    assert np.allclose(drive.frame(0.2, None), at(7, 7))  # type: ignore[arg-type]
    fresh = Drive()
    fresh.tracker.set_prior(at(3), stamp(0.0))
    assert fresh.tracker.tracking
    assert np.allclose(fresh.frame(0.1, None), at(3))  # type: ignore[arg-type]


def test_tracking_can_be_switched_off() -> None:
    drive = Drive(enabled=False)
    drive.frame(0.0, at(0))
    assert drive.frame(0.1, at(0)) is None
