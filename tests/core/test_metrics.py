"""The metric itself: known answers, signs that must not cancel, failures that must count."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from igaussian_core.evaluate.metrics import (
    QueryOutcome,
    area_under_recall,
    by_group,
    from_json,
    normalized_error_squared,
    outcome,
    recall_curve,
    stage_times,
    summarize,
    to_json,
)
from igaussian_core.geometry import compose, rotation_from_quaternion, rotation_from_vector
from igaussian_core.result import LocalizationResult, Status

TRUE = compose(rotation_from_vector([0.3, -0.2, 1.0]), [1.0, -2.0, 0.5])


def accepted(T: np.ndarray, covariance: np.ndarray | None = None) -> LocalizationResult:
    return LocalizationResult(
        Status.OK, "fine", T, covariance, inliers=50, T_map_cam_coarse=T, timings_ms={"total": 10.0}
    )


def measured(T: np.ndarray) -> tuple[float, float]:
    o = outcome("q", accepted(T), TRUE)
    return o.angle_deg, o.distance


def test_no_error() -> None:
    angle, distance = measured(TRUE)
    assert angle < 1e-6 and distance == 0


@pytest.mark.parametrize("axis", np.eye(3).tolist())
@pytest.mark.parametrize("degrees", [0.01, 1.0, 90.0, 179.0, 180.0])
def test_rotation_error_is_the_angle(axis: list[float], degrees: float) -> None:
    turn = rotation_from_vector(np.radians(degrees) * np.array(axis))
    assert measured(compose(TRUE[:3, :3] @ turn, TRUE[:3, 3]))[0] == pytest.approx(degrees)


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    q = np.array([0.3, -0.5, 0.1, 0.8])
    truth = compose(rotation_from_quaternion(q), [0, 0, 0])
    same = compose(rotation_from_quaternion(-q), [0, 0, 0])
    assert outcome("q", accepted(same), truth).angle_deg < 1e-6
    conjugate = compose(rotation_from_quaternion(q * [1, -1, -1, -1]), [0, 0, 0])
    assert outcome("q", accepted(conjugate), truth).angle_deg > 45


@pytest.mark.parametrize("signs", [[-1, -1, -1], [-1, 1, 1], [1, -1, 1], [1, 1, -1]])
def test_a_mirrored_translation_is_not_hidden(signs: list[int]) -> None:
    """norm(|t1| - |t2|) would call these perfect."""
    mirrored = compose(TRUE[:3, :3], TRUE[:3, 3] * signs)
    flipped = np.array(signs) < 0
    assert measured(mirrored)[1] == pytest.approx(2 * np.linalg.norm(TRUE[:3, 3][flipped]))


def test_an_inverted_pose_is_not_hidden() -> None:
    angle, distance = measured(np.linalg.inv(TRUE))
    assert angle > 30 and distance > 1


def test_distance_is_between_camera_positions() -> None:
    moved = compose(TRUE[:3, :3], TRUE[:3, 3] + [0.3, 0.0, -0.4])
    assert measured(moved)[1] == pytest.approx(0.5)


def test_what_was_not_accepted_is_infinitely_wrong() -> None:
    lost = LocalizationResult(Status.INCONSISTENT, "why", T_map_cam_coarse=TRUE)
    o = outcome("q", lost, TRUE)
    assert np.isinf([o.angle_deg, o.distance]).all() and np.isnan(o.nees)
    assert o.coarse_angle_deg < 1e-6 and o.coarse_distance == 0
    assert (o.name, o.status, o.reason) == ("q", "inconsistent", "why")
    nothing = outcome("q", LocalizationResult(Status.NO_HYPOTHESIS), TRUE)
    assert np.isinf([nothing.coarse_angle_deg, nothing.coarse_distance]).all()


def test_nees_of_drawn_errors_is_six_on_average() -> None:
    """Estimates drawn from a covariance: chi squared with six degrees of freedom."""
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * [[0.02]] * 3 + 0.01 * np.eye(6)
    covariance = A @ A.T
    values = []
    for _ in range(4000):
        e = rng.multivariate_normal(np.zeros(6), covariance)
        # a rotation vector in the map's axes, as LocalizationResult.covariance says
        estimate = compose(rotation_from_vector(e[3:]) @ TRUE[:3, :3], TRUE[:3, 3] + e[:3])
        values.append(normalized_error_squared(estimate, covariance, TRUE))
    assert np.mean(values) == pytest.approx(6, abs=0.3)
    assert np.mean(np.array(values) > 12.59) == pytest.approx(0.05, abs=0.012)


def test_nees_knows_the_axes() -> None:
    sure_of_x = np.diag([1e-6, 1, 1, 1, 1, 1])
    off_x = compose(TRUE[:3, :3], TRUE[:3, 3] + [0.01, 0, 0])
    off_y = compose(TRUE[:3, :3], TRUE[:3, 3] + [0, 0.01, 0])
    assert normalized_error_squared(off_x, sure_of_x, TRUE) == pytest.approx(100)
    assert normalized_error_squared(off_y, sure_of_x, TRUE) == pytest.approx(1e-4)
    sure_about_z = np.diag([1, 1, 1, 1, 1, 1e-6])
    turned = compose(rotation_from_vector([0, 0, 0.01]) @ TRUE[:3, :3], TRUE[:3, 3])
    assert normalized_error_squared(turned, sure_about_z, TRUE) == pytest.approx(100, rel=1e-6)


def some(angle: float, distance: float, ms: float = 10.0, nees: float = 6.0) -> QueryOutcome:
    return QueryOutcome(
        "q", "ok", "", "landmarks", 50, 0.9, angle, distance, angle, distance, nees, {"total": ms}
    )


LOST = some(float("inf"), float("inf"), nees=float("nan"))


def test_summary_of_known_outcomes() -> None:
    outcomes = [some(1, 0.1, 10, 4), some(2, 0.2, 20, 6), some(30, 0.1, 30, 8), LOST]
    s = summarize(outcomes, max_deg=5, max_distance=0.5)
    assert (s["queries"], s["accepted"], s["success"], s["wrong_accepted"]) == (4, 3, 0.5, 1)
    assert s["median_deg"] == 30 and s["median_distance"] == 0.2  # the upper of the middle two
    assert np.isinf(s["p90_deg"]) and s["max_deg"] == 30 and s["max_distance"] == 0.2
    assert s["median_ms"] == 15 and s["median_nees"] == 6


@pytest.mark.parametrize(("lost", "median"), [(0, 1.0), (2, 1.0), (3, np.inf), (5, np.inf)])
def test_failures_count_in_the_median(lost: int, median: float) -> None:
    s = summarize([some(1.0, 0.1)] * (5 - lost) + [LOST] * lost, 5, 0.5)
    assert s["median_deg"] == s["coarse_median_deg"] == median
    assert s["success"] == (5 - lost) / 5


def test_success_wants_both() -> None:
    s = summarize([some(1, 9), some(9, 0.1), some(4.9, 0.49), some(5, 0.5)], 5, 0.5)
    assert s["success"] == 0.25 and s["wrong_accepted"] == 3


def test_nothing_to_summarize() -> None:
    assert summarize([], 5, 0.5) == {"queries": 0.0}


def test_all_lost() -> None:
    s = summarize([LOST, LOST], 5, 0.5)
    assert s["accepted"] == s["success"] == s["wrong_accepted"] == 0
    assert np.isinf(s["median_deg"]) and np.isnan(s["max_deg"]) and np.isnan(s["median_nees"])


def test_means_run_over_accepted_poses() -> None:
    s = summarize([some(1, 0.1, nees=4), some(3, 0.3, nees=20), LOST], 5, 0.5)
    assert s["mean_deg"] == pytest.approx(2) and s["mean_distance"] == pytest.approx(0.2)
    assert s["mean_nees"] == pytest.approx(12) and s["inside_95"] == 0.5


def test_shares_within_the_papers_thresholds_count_the_lost() -> None:
    s = summarize([some(15, 0.5), some(15.1, 0.4), some(1, 0.6), LOST], 5, 0.5)
    assert s["within_15_deg"] == 0.5 and s["within_half_unit"] == 0.5


def test_area_under_the_recall_curve() -> None:
    """By hand: the step function's exact area, nothing for what is beyond the limit."""
    assert area_under_recall(np.array([0.0, 0.0]), 5.0) == 1
    assert area_under_recall(np.array([2.5, 2.5]), 5.0) == 0.5
    assert area_under_recall(np.array([1.0, 4.0, 7.0, np.inf]), 5.0) == pytest.approx(0.25)
    assert np.isnan(area_under_recall(np.array([]), 5.0))
    x, y = recall_curve(np.array([1.0, 4.0, 7.0, np.inf]), 5.0)
    under_steps = np.sum(np.diff(x) * y[:-1]) / 5.0
    assert under_steps == pytest.approx(0.25)
    assert (x[-1], y[-1]) == (5.0, 0.5)


def test_joint_area_takes_the_worse_of_both() -> None:
    s = summarize([some(1.0, 0.4)], 5, 0.5)  # 0.2 and 0.8 of the limits
    assert s["auc"] == pytest.approx(0.2)
    assert s["auc_deg"] == pytest.approx(0.8) and s["auc_distance"] == pytest.approx(0.2)


def test_rotation_alone() -> None:
    s = summarize([some(1.0, 7.0), some(9.0, 0.0), LOST], 5, float("inf"))
    assert s["success"] == pytest.approx(1 / 3) and s["wrong_accepted"] == 1
    assert s["auc"] == s["auc_deg"] == pytest.approx(0.8 / 3)


def test_stage_times_count_who_went_through() -> None:
    def timed(**ms: float) -> QueryOutcome:
        return dataclasses.replace(some(1, 1), timings_ms=ms)

    times = stage_times([timed(a=1.0, total=3.0), timed(a=3.0, b=8.0, total=11.0)])
    assert list(times) == ["a", "b", "total"]
    assert times["a"]["median_ms"] == 2 and times["a"]["queries"] == 2
    assert times["b"]["median_ms"] == 8 and times["b"]["queries"] == 1
    assert times["total"]["mean_ms"] == 7


def test_groups_keep_their_order() -> None:
    outcomes = [dataclasses.replace(some(1, 1), group=g) for g in ("b", "a", "b")]
    assert {k: len(v) for k, v in by_group(outcomes).items()} == {"b": 2, "a": 1}


@pytest.mark.parametrize("result", [
    accepted(TRUE, np.eye(6)), LocalizationResult(Status.INCONSISTENT, "why"),
])  # fmt: skip
def test_an_outcome_survives_strict_json(result: LocalizationResult) -> None:
    before = outcome("q", result, TRUE, "bin")
    text = json.dumps(to_json(before), allow_nan=False)
    after = from_json(json.loads(text))
    for name in ("name", "group", "status", "angle_deg", "distance", "coarse_angle_deg"):
        assert getattr(after, name) == getattr(before, name)
    np.testing.assert_equal(after.nees, before.nees)
    np.testing.assert_array_equal(after.T_map_cam_true, TRUE)
    assert (after.T_map_cam is None) == (before.T_map_cam is None)
