"""The figures of a drive, on drives whose figures are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from igaussian_core.evaluate.drive import DriveFrame, MemorySample, Trajectory, summarize_drive
from igaussian_core.geometry import compose, pose_error, rotation_from_vector

START = 1_700_000_000_000_000_000


def _T(x: float, yaw_deg: float = 0.0) -> np.ndarray:
    return compose(rotation_from_vector([0, 0, math.radians(yaw_deg)]), [x, 0.0, 0.0])


def _frame(i: int, error_m: float | None, latency_ms: float = 100.0) -> DriveFrame:
    T = None if error_m is None else _T(i + error_m, 2 * error_m)
    status = "ok" if error_m is not None else "inconsistent"
    return DriveFrame(START + i, i * 0.1, status, "", T, _T(i), 50, latency_ms, i * 0.5)


def test_truth_between_its_samples():
    truth = Trajectory([(START + 100_000_000, _T(1, 90)), (START, _T(0))])
    np.testing.assert_array_equal(truth.at(START), _T(0))
    angle, distance = pose_error(truth.at(START + 50_000_000), _T(0.5, 45))
    assert angle < 1e-9 and distance == pytest.approx(0, abs=1e-9)
    assert truth.at(START - 1) is None and truth.at(START + 100_000_001) is None


def test_no_truth_across_a_gap():
    truth = Trajectory([(START, _T(0)), (START + 10**9, _T(1))])
    assert truth.at(START + 5 * 10**8) is None


def test_summary():
    frames = [_frame(i, error) for i, error in enumerate([0.01, 0.02, None, 0.05, 0.03])]
    figures = summarize_drive(frames, 20, [MemorySample(0, 100.0), MemorySample(1, 120.0)])
    assert (figures["sent"], figures["processed"], figures["accepted"]) == (20, 5, 4)
    assert figures["accepted_ratio"] == pytest.approx(0.8)
    assert figures["median_error_m"] == pytest.approx(0.025)
    assert figures["max_error_m"] == pytest.approx(0.05)
    assert figures["max_error_deg"] == pytest.approx(0.1)
    assert figures["rate_hz"] == pytest.approx(3 / 2.0)  # 4 poses in the 2 s from 0 to 4
    assert figures["latency_ms_p95"] == pytest.approx(100)
    assert figures["rss_mb"] == 120


def test_growth_shows_a_backlog():
    steady = [_frame(i, 0.01, 100.0) for i in range(40)]
    growing = [_frame(i, 0.01, 100.0 + 10 * i) for i in range(40)]
    assert summarize_drive(steady, 40, [])["latency_growth_ms"] == 0
    assert summarize_drive(growing, 40, [])["latency_growth_ms"] == pytest.approx(200)


def test_nothing_processed():
    figures = summarize_drive([], 10, [])
    assert figures["processed"] == 0 and math.isnan(figures["median_error_m"])
    lost = summarize_drive([_frame(0, None)], 10, [])
    assert lost["accepted"] == 0 and math.isnan(lost["rate_hz"])
