"""A recording through worker and tracker in this process, frame by frame with its truth."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from igaussian_core.bags import Bag
from igaussian_core.config import Config
from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory
from igaussian_core.localizer import Localizer
from igaussian_core.replay import ReplayedFrame, replay


@dataclass(frozen=True)
class DriveRun:
    """What a replay brings back; `dropped` images were too late to be processed."""

    frames: list[DriveFrame]
    memory: list[MemorySample]
    dropped: int


def run_drive(
    bag: Bag,
    localizer: Localizer,
    config: Config,
    truth: Trajectory,
    rate: float = 1.0,
    duration_s: float | None = None,
    every_frame: bool = False,
    on_frame: Callable[[DriveFrame], None] = lambda frame: None,
    topics: tuple[str | None, str | None] = (None, None),
) -> DriveRun:
    """Replay a recording as a robot would have seen it. Arguments as of `replay`.

    Args:
        truth: true camera poses; looked up by the frames' stamps after they are localized.
    """
    frames: list[DriveFrame] = []
    memory: list[MemorySample] = []

    def keep(replayed: ReplayedFrame) -> None:
        result, stamp_ns = replayed.result, replayed.frame.stamp_ns
        first_ns = frames[0].stamp_ns if frames else stamp_ns
        # a replay that waits for every frame has no clock: the work alone is meant then
        took_ms = result.timings_ms["total"] if every_frame else replayed.latency_ms
        latency_ms = took_ms if result.T_map_cam is not None else math.nan
        frame = DriveFrame(
            stamp_ns, (stamp_ns - first_ns) * 1e-9, result.status.value, result.reason,
            result.T_map_cam, truth.at(stamp_ns), result.inliers, latency_ms,
            replayed.finished_s, result.timings_ms, result.covariance,
        )  # fmt: skip
        frames.append(frame)
        memory.append(MemorySample(replayed.finished_s, resident_mb(os.getpid())))
        on_frame(frame)

    stats = replay(
        bag, localizer, config, keep, rate, duration_s, every_frame, topics=topics
    )
    return DriveRun(frames, memory, stats.dropped)


def resident_mb(pid: int) -> float:
    """Resident memory of a process in MB; NaN where the system does not say."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return math.nan
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
