"""Frame after frame: the last accepted pose, moved by odometry, is the next frame's prior."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.config import Config
from igaussian_core.frame import Frame
from igaussian_core.geometry import compose, inverse, rotation_from_vector, vector_from_rotation
from igaussian_core.localizer import Localizer
from igaussian_core.result import LocalizationResult

Array = NDArray[np.float64]

_ODOMETRY_LENGTH = 2000
_MAX_ODOMETRY_GAP_S = 0.25


@dataclass(frozen=True)
class _Fix:
    stamp_ns: int
    T_map_cam: Array


class Tracker:
    """Localizes a stream of frames; the ROS node and the ROS-free replay share it.

    `process` is for one thread; `add_odometry` may be called from another.
    """

    def __init__(self, localizer: Localizer, config: Config) -> None:
        self._localizer = localizer
        self._config = config.tracking
        self._fix: _Fix | None = None
        self._previous: _Fix | None = None
        self._last_stamp_ns: int | None = None
        self._odometry: deque[tuple[int, Array]] = deque(maxlen=_ODOMETRY_LENGTH)
        self._lock = threading.Lock()

    @property
    def localizer(self) -> Localizer:
        return self._localizer

    @property
    def tracking(self) -> bool:
        """True while there is a pose to go on from."""
        return self._fix is not None

    def process(self, frame: Frame) -> LocalizationResult:
        """Localize the next frame. Stamps that jump back (a bag's loop) reset the track.

        Raises:
            CameraError: image and camera do not belong together.
        """
        if self._last_stamp_ns is not None and frame.stamp_ns < self._last_stamp_ns:
            self.reset()
        self._last_stamp_ns = frame.stamp_ns
        result = self._localizer.localize(frame.image, frame.camera, self._prior(frame.stamp_ns))
        if result.T_map_cam is not None:
            self._previous, self._fix = self._fix, _Fix(frame.stamp_ns, result.T_map_cam)
        elif self._fix is not None and self._age_s(frame.stamp_ns) > self._config.max_gap_s:
            self._fix = self._previous = None
        return result

    def reset(self) -> None:
        """Forget the track and the odometry: the next frame is localized from nothing."""
        self._fix = self._previous = self._last_stamp_ns = None
        with self._lock:
            self._odometry.clear()

    def set_prior(self, T_map_cam: NDArray[np.float64], stamp_ns: int) -> None:
        """Take a pose from outside (a user's initial pose) as the next frame's prior."""
        self._fix, self._previous = _Fix(stamp_ns, np.asarray(T_map_cam, np.float64)), None

    def add_odometry(self, stamp_ns: int, T_odom_cam: NDArray[np.float64]) -> None:
        """The camera's pose in a smooth frame that may drift, at a stamp of the images' clock."""
        with self._lock:
            if self._odometry and stamp_ns < self._odometry[-1][0]:
                self._odometry.clear()
            self._odometry.append((stamp_ns, np.asarray(T_odom_cam, np.float64)))

    def _age_s(self, stamp_ns: int) -> float:
        assert self._fix is not None
        return abs(stamp_ns - self._fix.stamp_ns) * 1e-9

    def _prior(self, stamp_ns: int) -> Array | None:
        """The last pose moved by odometry, else by the last motion, to a stamp."""
        if self._fix is None or not self._config.enabled:
            return None
        if self._age_s(stamp_ns) > self._config.max_gap_s:
            return None
        start, end = self._odometry_at(self._fix.stamp_ns), self._odometry_at(stamp_ns)
        if start is not None and end is not None:
            return np.asarray(self._fix.T_map_cam @ inverse(start) @ end)
        return self._extrapolated(stamp_ns)

    def _extrapolated(self, stamp_ns: int) -> Array:
        """Constant velocity over the last two poses, at most as far as they are apart."""
        assert self._fix is not None
        if self._previous is None or self._previous.stamp_ns >= self._fix.stamp_ns:
            return self._fix.T_map_cam
        span = self._fix.stamp_ns - self._previous.stamp_ns
        share = (stamp_ns - self._fix.stamp_ns) / span
        if span * 1e-9 > self._config.max_gap_s or share > 2:
            return self._fix.T_map_cam
        motion = inverse(self._previous.T_map_cam) @ self._fix.T_map_cam
        turn = rotation_from_vector(share * vector_from_rotation(motion[:3, :3]))
        return np.asarray(self._fix.T_map_cam @ compose(turn, share * motion[:3, 3]))

    def _odometry_at(self, stamp_ns: int) -> Array | None:
        """The odometry pose nearest to a stamp, None where none is near."""
        with self._lock:
            stamps = [stamp for stamp, _ in self._odometry]
            if not stamps:
                return None
            index = bisect_left(stamps, stamp_ns)
            near = min(
                (i for i in (index - 1, index) if 0 <= i < len(stamps)),
                key=lambda i: abs(stamps[i] - stamp_ns),
            )
            if abs(stamps[near] - stamp_ns) * 1e-9 > _MAX_ODOMETRY_GAP_S:
                return None
            return self._odometry[near][1]
