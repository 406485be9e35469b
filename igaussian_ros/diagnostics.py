"""Counts, rates and latencies, and the messages that carry them."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Header

from igaussian_core.result import LocalizationResult, Status

# what may become of a received image; each ends as exactly one of these
OUTCOMES = (
    "localized",  # a pose was published
    "lost",  # processed, no pose accepted
    "dropped",  # a newer image came before work on it began
    "rejected",  # the message cannot be used
    "stale",  # older than runtime.max_image_age_s when work began
    "no_map",  # no map was loaded yet
    "throttled",  # more than max_rate_hz
    "paused",  # ~/pause
    "failed",  # an error inside the pipeline
)


class Counters:
    """Thread-safe counts of received images and of what became of them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts = dict.fromkeys(("received", *OUTCOMES), 0)

    def add(self, name: str) -> None:
        with self._lock:
            self._counts[name] += 1

    def snapshot(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)

    def clear(self) -> None:
        with self._lock:
            self._counts = dict.fromkeys(self._counts, 0)


class RateMeter:
    """Events a second over the last few seconds of wall time; thread-safe."""

    def __init__(self, window_s: float = 5.0, now: Callable[[], float] = time.monotonic) -> None:
        self._window_s, self._now = window_s, now
        self._times: deque[float] = deque(maxlen=10_000)
        self._lock = threading.Lock()

    def tick(self) -> None:
        with self._lock:
            self._times.append(self._now())

    def hz(self) -> float:
        with self._lock:
            begin = self._now() - self._window_s
            while self._times and self._times[0] < begin:
                self._times.popleft()
            if len(self._times) < 2:
                return 0.0
            # from the first event until now, so that the rate falls when events stop
            return (len(self._times) - 1) / max(self._now() - self._times[0], 1e-9)


class Window:
    """The last values of something; thread-safe."""

    def __init__(self, size: int = 200) -> None:
        self._values: deque[float] = deque(maxlen=size)
        self._lock = threading.Lock()

    def add(self, value: float) -> None:
        with self._lock:
            self._values.append(value)

    def percentile(self, q: float) -> float:
        """The q-th percentile, NaN without values."""
        with self._lock:
            return float(np.percentile(self._values, q)) if self._values else float("nan")

    def clear(self) -> None:
        with self._lock:
            self._values.clear()


def frame_status(
    header: Header, name: str, result: LocalizationResult, latency_ms: float | None
) -> DiagnosticArray:
    """What happened to a processed frame; header.stamp is the image's."""
    level = {Status.OK: DiagnosticStatus.OK}.get(result.status, DiagnosticStatus.WARN)
    values: dict[str, Any] = {
        "status": result.status.value,
        "reason": result.reason,
        "inliers": result.inliers,
        "matches": result.matches,
        "ratio": f"{result.inlier_ratio:.4f}",
        "residual_px": f"{result.residual_px:.4f}",
        "coverage": f"{result.coverage:.4f}",
        "agreement": f"{result.agreement:.4f}",
        "sharpness": f"{result.sharpness:.4f}",
        "confidence": f"{result.confidence:.4f}",
        "matcher": result.matcher,
        "source": result.source,
        "latency_ms": "" if latency_ms is None else f"{latency_ms:.1f}",
    }
    values |= {f"timing.{stage}_ms": f"{ms:.1f}" for stage, ms in result.timings_ms.items()}
    return _array(header, name, level, result.reason or result.status.value, values)


def refused_status(header: Header, name: str, outcome: str, reason: str) -> DiagnosticArray:
    """What happened to a frame that did not reach the pipeline or failed in it."""
    values = {"status": outcome, "reason": reason}
    return _array(header, name, DiagnosticStatus.ERROR, reason, values)


def summary(
    header: Header, name: str, level: bytes, state: str, values: dict[str, Any]
) -> DiagnosticArray:
    """The node's state for /diagnostics."""
    return _array(header, name, level, state, values)


def resident_mb() -> float:
    """Resident memory of this process in MB; NaN where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _array(
    header: Header, name: str, level: bytes, message: str, values: dict[str, Any]
) -> DiagnosticArray:
    status = DiagnosticStatus(level=level, name=name, message=message, values=_pairs(values))
    return DiagnosticArray(header=header, status=[status])


def _pairs(values: dict[str, Any]) -> list[KeyValue]:
    items: Iterable[tuple[str, Any]] = values.items()
    return [KeyValue(key=key, value=str(value)) for key, value in items]
