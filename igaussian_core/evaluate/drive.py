"""A drive: frame after frame of one recording, its errors against the truth, its summary."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from igaussian_core.geometry import interpolate_pose, pose_error

Array = NDArray[np.float64]
_MAX_TRUTH_GAP_NS = 500_000_000


@dataclass(frozen=True)
class DriveFrame:
    """What became of one processed frame.

    Attributes:
        stamp_ns: the image's stamp, as in the recording.
        time_s: of the stamp, since the drive's first frame.
        status, reason: of LocalizationResult.
        T_map_cam: the accepted pose, or None.
        T_map_cam_true: the true pose at the stamp, or None where the truth does not cover it.
        latency_ms: from the image's stamp until the pose was there; NaN without a pose.
        arrived_s: when the outcome was there, wall time since the drive began.
        covariance: of the accepted pose, 6x6, map axes, x y z rx ry rz; None where not heard.
    """

    stamp_ns: int
    time_s: float
    status: str
    reason: str
    T_map_cam: Array | None
    T_map_cam_true: Array | None
    inliers: int
    latency_ms: float
    arrived_s: float
    timings_ms: dict[str, float] = field(default_factory=dict)
    covariance: Array | None = None

    @property
    def error(self) -> tuple[float, float]:
        """(degrees, metres) of the accepted pose; NaN without pose or truth."""
        if self.T_map_cam is None or self.T_map_cam_true is None:
            return math.nan, math.nan
        return pose_error(self.T_map_cam, self.T_map_cam_true)


@dataclass(frozen=True)
class MemorySample:
    """Resident memory of the localizing process."""

    time_s: float
    rss_mb: float


class Trajectory:
    """True poses by stamp."""

    def __init__(self, poses: Sequence[tuple[int, Array]]) -> None:
        ordered = sorted(poses, key=lambda item: item[0])
        self.stamps_ns = [stamp for stamp, _ in ordered]
        self.poses = [T for _, T in ordered]

    def __len__(self) -> int:
        return len(self.poses)

    def positions(self) -> Array:
        """[N, 3] metres."""
        return np.array([T[:3, 3] for T in self.poses]).reshape(-1, 3)

    def at(self, stamp_ns: int) -> Array | None:
        """The pose at a stamp, between its neighbours where none has it; None outside."""
        index = bisect_left(self.stamps_ns, stamp_ns)
        if index < len(self.poses) and self.stamps_ns[index] == stamp_ns:
            return self.poses[index]
        if index == 0 or index == len(self.poses):
            return None
        before, after = self.stamps_ns[index - 1], self.stamps_ns[index]
        if after - before > _MAX_TRUTH_GAP_NS:
            return None
        share = (stamp_ns - before) / (after - before)
        return interpolate_pose(self.poses[index - 1], self.poses[index], share)


def summarize_drive(
    frames: Sequence[DriveFrame], sent: int, memory: Sequence[MemorySample]
) -> dict[str, float]:
    """The figures of a drive; NaN where nothing was measured.

    Errors run over accepted poses that have a true one. `rate_hz` is accepted poses over the
    time from the first to the last. `rss_growth_mb` is the median memory of the drive's last
    quarter less that of its second, so that the first frames' allocations do not count.

    Args:
        sent: images that the recording holds.
    """
    accepted = [frame for frame in frames if frame.T_map_cam is not None]
    errors = np.array([frame.error for frame in accepted]).reshape(-1, 2)
    latency = np.array([frame.latency_ms for frame in accepted])
    arrived = np.array([frame.arrived_s for frame in accepted])
    span_s = float(arrived.max() - arrived.min()) if len(arrived) > 1 else math.nan
    rss = np.array([sample.rss_mb for sample in memory])
    return {
        "sent": float(sent),
        "processed": float(len(frames)),
        "accepted": float(len(accepted)),
        "accepted_ratio": len(accepted) / len(frames) if frames else math.nan,
        "median_error_m": _percentile(errors[:, 1], 50),
        "median_error_deg": _percentile(errors[:, 0], 50),
        "p95_error_m": _percentile(errors[:, 1], 95),
        "p95_error_deg": _percentile(errors[:, 0], 95),
        "max_error_m": _percentile(errors[:, 1], 100),
        "max_error_deg": _percentile(errors[:, 0], 100),
        "rate_hz": (len(arrived) - 1) / span_s if span_s > 0 else math.nan,
        "latency_ms_p50": _percentile(latency, 50),
        "latency_ms_p95": _percentile(latency, 95),
        "latency_ms_max": _percentile(latency, 100),
        "latency_growth_ms": _growth(latency),
        "rss_mb": float(rss.max()) if len(rss) else math.nan,
        "rss_growth_mb": _growth(rss),
    }


def _percentile(values: Array, q: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, q)) if len(known) else math.nan


def _growth(values: Array) -> float:
    """Median of the last quarter less that of the second quarter."""
    quarter = len(values) // 4
    if quarter < 2:
        return math.nan
    return float(np.median(values[-quarter:]) - np.median(values[quarter : 2 * quarter]))
