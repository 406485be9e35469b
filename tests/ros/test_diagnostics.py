"""Counts add up, rates and percentiles are right, messages carry stamp and evidence."""

from __future__ import annotations

import math

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from scene import header

from igaussian_core.result import LocalizationResult, Status
from igaussian_ros import diagnostics
from igaussian_ros.throttle import Throttle, key_of


def _values(array):
    return {pair.key: pair.value for pair in array.status[0].values}


def test_rates_follow_the_clock_and_fall_when_events_stop():
    now = [0.0]
    meter = diagnostics.RateMeter(window_s=5.0, now=lambda: now[0])
    assert meter.hz() == 0
    for i in range(100):
        now[0] = i * 0.1
        meter.tick()
    assert meter.hz() == pytest.approx(10)
    now[0] += 2.5
    assert meter.hz() == pytest.approx(5, rel=0.05)
    now[0] += 10
    assert meter.hz() == 0


def test_percentiles_are_of_the_last_values():
    window = diagnostics.Window(size=100)
    assert math.isnan(window.percentile(50))
    for value in range(1000):
        window.add(value)
    assert window.percentile(50) == pytest.approx(949.5)
    assert window.percentile(100) == 999


def test_counters_know_every_outcome():
    counters = diagnostics.Counters()
    for name in ("received", *diagnostics.OUTCOMES):
        counters.add(name)
    assert set(counters.snapshot().values()) == {1}
    with pytest.raises(KeyError):
        counters.add("unheard of")
    counters.clear()
    assert set(counters.snapshot().values()) == {0}


@pytest.mark.parametrize(
    ("status", "level"),
    [
        (Status.OK, DiagnosticStatus.OK),
        (Status.OK_DEGRADED, DiagnosticStatus.WARN),
        (Status.NO_HYPOTHESIS, DiagnosticStatus.WARN),
    ],
)
def test_the_status_of_a_frame(status, level):
    result = LocalizationResult(
        status, "because", inliers=80, matches=100, inlier_ratio=0.8, residual_px=0.7,
        coverage=0.9, agreement=0.97, sharpness=0.85, confidence=0.91, matcher="xfeat",
        source="prior", timings_ms={"match": 12.34, "total": 50},
    )  # fmt: skip
    message = diagnostics.frame_status(header(1234, "map"), "localizer: frame", result, 61.0)
    assert message.header.stamp.nanosec == 1234
    assert message.status[0].level == level
    assert _values(message) == {
        "status": status.value, "reason": "because", "inliers": "80", "matches": "100",
        "ratio": "0.8000", "residual_px": "0.7000", "coverage": "0.9000",
        "agreement": "0.9700", "sharpness": "0.8500", "confidence": "0.9100", "matcher": "xfeat",
        "source": "prior", "latency_ms": "61.0", "timing.match_ms": "12.3",
        "timing.total_ms": "50.0",
    }  # fmt: skip


def test_the_status_of_a_refused_frame():
    message = diagnostics.refused_status(header(5, "map"), "n", "rejected", "stamp is 0")
    assert message.status[0].level == DiagnosticStatus.ERROR
    assert _values(message) == {"status": "rejected", "reason": "stamp is 0"}


def test_resident_memory_is_that_of_a_python_process():
    assert 20 < diagnostics.resident_mb() < 20_000


def test_a_throttle_says_the_first_and_counts_the_rest():
    now, said = [0.0], []
    throttle = Throttle(said.append, period_s=5.0, now=lambda: now[0])
    for i in range(10):
        now[0] = float(i)
        throttle("a", f"a{i}")
    throttle("b", "b")
    assert said == ["a0", "a5 (4 more of these since)", "b"]


def test_equal_mistakes_have_equal_keys():
    a = key_of("jpeg: 120 bytes beginning with ff d8 00 1a are no image")
    b = key_of("jpeg: 7 bytes beginning with 12 34 fe 9c are no image")
    assert a == b != key_of("encoding '32FC1' is not supported")
