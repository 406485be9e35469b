"""From an image message to an outcome: what runs on the worker thread between two publishings."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image

from igaussian_core.errors import IGaussianError
from igaussian_core.frame import Frame
from igaussian_core.result import LocalizationResult
from igaussian_core.tracker import Tracker
from igaussian_ros.camera_cache import CameraCache
from igaussian_ros.convert import image_from_ros, stamp_to_ns
from igaussian_ros.parameters import Settings
from igaussian_ros.throttle import key_of

ImageMessage: TypeAlias = Image | CompressedImage


@dataclass(frozen=True)
class Outcome:
    """What became of one image message.

    Attributes:
        name: one of diagnostics.OUTCOMES.
        reason: a sentence where no pose came out.
        key: groups equal reasons for throttling.
        frame, result: where the pipeline has run.
        age_ms: age of the image when work on it began, None where no clock tells.
        warning: what is odd about a frame that was processed all the same.
    """

    name: str
    reason: str = ""
    key: str = ""
    frame: Frame | None = None
    result: LocalizationResult | None = None
    age_ms: float | None = None
    warning: str = ""


@dataclass(frozen=True)
class _Prior:
    T_map_cam: NDArray[np.float64]
    stamp_ns: int


class FramePipeline:
    """Checks, decodes and localizes image messages, one at a time, newest stamps only.

    `process` is for the worker thread; `set_initial_pose` and `add_odometry` may be called from
    another.
    """

    def __init__(self, settings: Settings, cameras: CameraCache) -> None:
        self._max_age_s = settings.config.runtime.max_image_age_s
        self._max_gap_ns = int(settings.config.tracking.max_gap_s * 1e9)
        self._frame_override: str = settings["camera_optical_frame"]
        self._cameras = cameras
        self._tracker: Tracker | None = None
        self._last_stamp_ns: int | None = None
        self._prior: _Prior | None = None
        self._lock = threading.Lock()

    @property
    def tracker(self) -> Tracker | None:
        return self._tracker

    def use(self, tracker: Tracker) -> None:
        """Go on with another map; the track begins anew."""
        self._tracker = tracker
        self._last_stamp_ns = None

    def reset(self) -> None:
        """Forget the track: the next frame is localized from nothing."""
        with self._lock:
            self._prior = None
        self._last_stamp_ns = None
        if self._tracker is not None:
            self._tracker.reset()

    def set_initial_pose(self, T_map_cam: NDArray[np.float64], stamp_ns: int) -> None:
        """Try this pose first on the next frame; 0 as stamp means the next frame's."""
        with self._lock:
            self._prior = _Prior(T_map_cam, stamp_ns)

    def add_odometry(self, stamp_ns: int, T_odom_cam: NDArray[np.float64]) -> None:
        if self._tracker is not None:
            self._tracker.add_odometry(stamp_ns, T_odom_cam)

    def camera_frame(self, message: ImageMessage) -> str:
        """Name of the camera's optical frame."""
        return self._frame_override or str(message.header.frame_id)

    def process(self, message: ImageMessage, now_ns: int | None) -> Outcome:
        """Localize one image.

        Args:
            now_ns: the time of the node's clock; None where it has none yet.
        """
        stamp_ns = stamp_to_ns(message.header.stamp)
        if self._tracker is None:
            return Outcome("no_map", "no map is loaded yet", "no_map")
        if stamp_ns == 0:
            reason = "the image's stamp is 0: its driver must set it, a pose carries it"
            return Outcome("rejected", reason, "stamp_zero")
        age_ms = None if now_ns is None else (now_ns - stamp_ns) * 1e-6
        if age_ms is not None and 0 < self._max_age_s < age_ms * 1e-3:
            return Outcome("stale", _stale_text(age_ms, self._max_age_s), "stale", age_ms=age_ms)
        try:
            image = image_from_ros(message)
            height, width = image.shape[:2]
            camera = self._cameras.find(width, height, self.camera_frame(message))
        except IGaussianError as error:
            return Outcome("rejected", str(error), key_of(str(error)), age_ms=age_ms)
        warning = self._time_warning(stamp_ns, age_ms)
        self._apply_prior(stamp_ns)
        self._last_stamp_ns = stamp_ns
        frame = Frame(stamp_ns, image, camera)
        result = self._tracker.process(frame)
        name = "localized" if result.T_map_cam is not None else "lost"
        reason = result.reason or result.status.value
        return Outcome(name, reason, name, frame, result, age_ms, warning)

    def _apply_prior(self, stamp_ns: int) -> None:
        with self._lock:
            prior, self._prior = self._prior, None
        if prior is None or self._tracker is None:
            return
        # a hand-set pose stamped by another clock is meant for now
        usable = 0 <= stamp_ns - prior.stamp_ns <= self._max_gap_ns
        self._tracker.set_prior(prior.T_map_cam, prior.stamp_ns if usable else stamp_ns)

    def _time_warning(self, stamp_ns: int, age_ms: float | None) -> str:
        last = self._last_stamp_ns
        if last is not None and stamp_ns < last:
            back = (last - stamp_ns) * 1e-9
            return f"image stamps went back by {back:.3f} s (a bag started again?): track reset"
        if age_ms is not None and age_ms < -1000:
            return (
                f"the image's stamp is {-age_ms * 1e-3:.1f} s ahead of this node's clock: "
                "do camera and node use the same clock (use_sim_time)?"
            )
        return ""


def _stale_text(age_ms: float, limit_s: float) -> str:
    age_s = age_ms * 1e-3
    text = f"image is {age_s:.1f} s old, runtime.max_image_age_s is {limit_s:g}: dropped"
    if age_s > 3600:
        text += "; a replayed bag needs use_sim_time:=true and a /clock"
    return text

