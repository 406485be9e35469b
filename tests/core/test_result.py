"""Results and timings as plain data."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from igaussian_core.result import LocalizationResult, Status
from igaussian_core.timing import StageTimer


def test_only_two_statuses_come_with_a_pose() -> None:
    assert {status for status in Status if status.ok} == {Status.OK, Status.OK_DEGRADED}


def test_a_status_is_its_word() -> None:
    assert Status("inconsistent") is Status.INCONSISTENT
    assert json.dumps(Status.OK) == '"ok"'
    assert len({status.value for status in Status}) == len(Status)


def test_failure_is_a_status_and_never_identity() -> None:
    result = LocalizationResult(Status.NO_HYPOTHESIS)
    assert not result.ok
    assert result.T_map_cam is None and result.covariance is None
    assert result.T_map_cam_coarse is None and result.inliers == 0


def test_a_result_is_frozen_and_shares_nothing() -> None:
    a, b = LocalizationResult(Status.OK), LocalizationResult(Status.OK)
    a.timings_ms["x"] = 1.0
    assert b.timings_ms == {}
    with pytest.raises(dataclasses.FrozenInstanceError):
        a.T_map_cam = np.eye(4)  # type: ignore[misc]


def test_stages_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 1.5, 2.0, 2.25, 3.0, 3.125, 10.0])
    monkeypatch.setattr("igaussian_core.timing.time.perf_counter", lambda: next(clock))
    timer = StageTimer()
    for stage in ("match", "solve", "match"):
        with timer(stage):
            pass
    assert timer.timings_ms() == {"match": 625.0, "solve": 250.0, "total": 10000.0}


def test_a_stage_that_fails_is_timed_too(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 2.0, 3.0])
    monkeypatch.setattr("igaussian_core.timing.time.perf_counter", lambda: next(clock))
    timer = StageTimer()
    with pytest.raises(KeyError), timer("render"):
        raise KeyError
    assert timer.timings_ms() == {"render": 1000.0, "total": 3000.0}
