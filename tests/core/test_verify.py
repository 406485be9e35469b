"""The verdict on a pose, at each threshold and from both sides."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from igaussian_core.config import VerifyConfig
from igaussian_core.refine.verify import Evidence, confidence, judge
from igaussian_core.result import Status

CONFIG = VerifyConfig()
GOOD = Evidence("xfeat", matches=300, inliers=280, residual_px=0.6, coverage=0.9, spread=0.6)


def verdict(**change: Any) -> tuple[Status, str]:
    return judge(dataclasses.replace(GOOD, **change), CONFIG)


def test_good_evidence_is_accepted() -> None:
    status, reason = verdict()
    assert status is Status.OK and "280 of 300" in reason


@pytest.mark.parametrize(
    ("change", "status"),
    [
        ({"coverage": CONFIG.min_coverage - 0.01}, Status.OUT_OF_MAP),
        ({"matches": 0, "inliers": 0}, Status.TOO_FEW_MATCHES),
        ({"matches": CONFIG.min_inliers_xfeat - 1, "inliers": 5}, Status.TOO_FEW_MATCHES),
        ({"inliers": CONFIG.min_inliers_xfeat - 1}, Status.INCONSISTENT),
        ({"matches": 2000, "inliers": 300}, Status.INCONSISTENT),
        ({"residual_px": CONFIG.max_residual_px + 0.01}, Status.INCONSISTENT),
        ({"spread": CONFIG.min_spread - 0.01}, Status.INCONSISTENT),
        ({"sigma_deg": CONFIG.max_sigma_deg + 0.1}, Status.INCONSISTENT),
        ({"agreement": CONFIG.min_agreement - 0.01}, Status.INCONSISTENT),
        ({"sharpness": CONFIG.min_sharpness - 0.01}, Status.TOO_DARK_OR_BLURRED),
    ],
)
def test_each_lack_is_named(change: dict[str, Any], status: Status) -> None:
    found, reason = verdict(**change)
    assert found is status and not found.ok
    assert any(character.isdigit() for character in reason)
    assert confidence(dataclasses.replace(GOOD, **change), CONFIG) < 0.5


def test_evidence_near_the_thresholds_is_accepted_with_a_warning() -> None:
    assert verdict(inliers=CONFIG.min_inliers_xfeat, matches=60)[0] is Status.OK_DEGRADED
    assert verdict(inliers=400, matches=1000)[0] is Status.OK_DEGRADED
    assert Status.OK_DEGRADED.ok


@pytest.mark.parametrize(
    ("method", "least"),
    [
        ("align", CONFIG.min_inliers_align),
        ("xfeat", CONFIG.min_inliers_xfeat),
        ("sift", CONFIG.min_inliers_sift),
    ],
)
def test_each_method_has_thresholds_of_its_own(method: str, least: int) -> None:
    for inliers, accepted in ((least, True), (least - 1, False)):
        assert verdict(method=method, matches=least + 5, inliers=inliers)[0].ok is accepted


def test_missing_values_are_not_accepted() -> None:
    assert not judge(Evidence("align"), CONFIG)[0].ok
    assert not judge(Evidence("sift", coverage=1.0), CONFIG)[0].ok


def test_far_from_the_prior_more_is_wanted() -> None:
    little = {"inliers": CONFIG.min_inliers_xfeat + 5, "matches": 60}
    near, far = CONFIG.max_prior_shift - 0.1, CONFIG.max_prior_shift + 0.1
    assert verdict(**little, prior_shift=near)[0] is Status.OK_DEGRADED
    assert not verdict(**little, prior_shift=far)[0].ok
    assert verdict(prior_shift=far)[0] is Status.OK  # much evidence is enough
    assert verdict(**little)[0].ok  # and without a prior nothing is asked


def test_confidence_is_half_at_each_threshold() -> None:
    """And it says the same as the verdict on both sides."""
    assert 0.8 < confidence(GOOD, CONFIG) <= 1
    for change in (
        {"coverage": CONFIG.min_coverage}, {"residual_px": CONFIG.max_residual_px},
        {"spread": CONFIG.min_spread}, {"sigma_deg": CONFIG.max_sigma_deg},
        {"agreement": CONFIG.min_agreement}, {"sharpness": CONFIG.min_sharpness},
        {"inliers": CONFIG.min_inliers_xfeat, "matches": 50},
    ):  # fmt: skip
        at = dataclasses.replace(GOOD, **change)  # type: ignore[arg-type]
        assert confidence(at, CONFIG) == pytest.approx(0.5) and judge(at, CONFIG)[0].ok
    assert confidence(Evidence("align"), CONFIG) == 0


def test_confidence_grows_with_the_evidence() -> None:
    for name, values in (
        ("inliers", (0, 20, 60, 200, 290)), ("agreement", (-0.5, 0.3, 0.85, 0.99)),
        ("sharpness", (-0.2, 0.1, 0.3, 0.9)), ("spread", (0.0, 0.02, 0.06, 0.5)),
        ("residual_px", (5.0, 2.0, 1.0, 0.2)), ("sigma_deg", (3.0, 1.0, 0.5, 0.1)),
    ):  # fmt: skip
        found = [confidence(dataclasses.replace(GOOD, **{name: v}), CONFIG) for v in values]
        assert found == sorted(found) and 0 <= found[0] < found[-1] <= 1


def test_ratio() -> None:
    assert Evidence("sift").ratio == 0
    assert Evidence("sift", matches=4, inliers=3).ratio == 0.75
