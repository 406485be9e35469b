"""The metric itself: known answers, signs that must not cancel, failures that must count."""

from __future__ import annotations

import numpy as np
import pytest

from igaussian_core.evaluate.metrics import (
    QueryOutcome,
    normalized_error_squared,
    outcome,
    summarize,
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
