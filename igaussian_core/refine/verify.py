"""Accept a pose, or say why not, by evidence that knows no truth."""

from __future__ import annotations

from dataclasses import dataclass

from igaussian_core.config import VerifyConfig
from igaussian_core.result import Status


@dataclass(frozen=True)
class Evidence:
    """What the last round of refinement saw.

    Attributes:
        method: where the correspondences came from: "align", or the matcher's name.
        matches: correspondences of image and render looked at, with trusted depth.
        inliers: of them, those that agree with the pose.
        residual_px: the inliers' median reprojection error.
        coverage: share of the render's pixels that the map covers.
        spread: share of the image's area that the inliers' spread covers.
        sigma_deg: standard deviation of the rotation, over all axes.
        agreement: mean correlation of image and render in cells of inliers (`agreement.py`);
            NaN where it was not or could not be looked at, then it is no reason.
        sharpness: share of the render's fine detail that the image shows there; NaN likewise.
        prior_shift: image motion between the prior's view and the pose's, in image widths;
            NaN without a prior.
    """

    method: str
    matches: int = 0
    inliers: int = 0
    residual_px: float = float("nan")
    coverage: float = float("nan")
    spread: float = 0.0
    sigma_deg: float = 0.0
    agreement: float = float("nan")
    sharpness: float = float("nan")
    prior_shift: float = float("nan")

    @property
    def ratio(self) -> float:
        return self.inliers / self.matches if self.matches else 0.0


def judge(evidence: Evidence, config: VerifyConfig) -> tuple[Status, str]:
    """The verdict and its reason in words."""
    e = evidence
    min_inliers, min_ratio = thresholds(e, config)
    if e.coverage < config.min_coverage:
        return Status.OUT_OF_MAP, f"the map covers {e.coverage:.0%} of the view"
    if e.matches < min_inliers:
        return Status.TOO_FEW_MATCHES, f"{e.matches} matches, {min_inliers:.0f} wanted"
    if e.inliers < min_inliers or e.ratio < min_ratio:
        wanted = f"{min_inliers:.0f} and {min_ratio:.0%} wanted"
        return Status.INCONSISTENT, f"{e.inliers} of {e.matches} matches agree, {wanted}"
    if e.residual_px > config.max_residual_px:
        return Status.INCONSISTENT, f"median reprojection error {e.residual_px:.2f} px"
    if e.spread < config.min_spread:
        return Status.INCONSISTENT, f"the inliers cover {e.spread:.1%} of the image only"
    if e.sigma_deg > config.max_sigma_deg:
        return Status.INCONSISTENT, f"the rotation is known to {e.sigma_deg:.1f} degrees only"
    if e.sharpness < config.min_sharpness:
        reason = f"the image shows {e.sharpness:.0%} of the map's fine detail"
        return Status.TOO_DARK_OR_BLURRED, reason
    if e.agreement < config.min_agreement:
        return Status.INCONSISTENT, f"image and map correlate by {e.agreement:.2f} only"
    if e.inliers < 1.5 * min_inliers or e.ratio < 1.25 * min_ratio:
        return Status.OK_DEGRADED, f"{e.inliers} of {e.matches} matches agree: little evidence"
    return Status.OK, f"{e.inliers} of {e.matches} matches agree"


def confidence(evidence: Evidence, config: VerifyConfig) -> float:
    """How far the evidence is from its thresholds, 0 to 1, by its weakest part.

    0.5 lies at a threshold: `judge` accepts what is above. A value that is required to be x at
    least counts 1 - (x / value)^2 / 2 above x and (value / x)^2 / 2 below it; one that is
    allowed to be x at most, the other way round. It is no probability.
    """
    e = evidence
    min_inliers, min_ratio = thresholds(e, config)
    parts = [
        _at_least(e.coverage, config.min_coverage),
        _at_least(e.inliers, min_inliers),
        _at_least(e.ratio, min_ratio),
        _at_least(config.max_residual_px, e.residual_px),
        _at_least(e.spread, config.min_spread),
        _at_least(config.max_sigma_deg, e.sigma_deg),
    ]
    if e.sharpness == e.sharpness:
        parts.append(_at_least(e.sharpness, config.min_sharpness))
    if e.agreement == e.agreement:
        parts.append(_at_least(1 - config.min_agreement, 1 - e.agreement))
    return min(parts)


def _at_least(value: float, least: float) -> float:
    """0.5 where both are the same, towards 1 where the value is larger; NaN counts nothing."""
    if value != value or least != least:
        return 0.0
    value = max(value, 0.0)
    if value >= least:
        return 1 - 0.5 * (max(least, 0.0) / value) ** 2 if value > 0 else 0.5
    return 0.5 * (value / least) ** 2


def thresholds(evidence: Evidence, config: VerifyConfig) -> tuple[float, float]:
    """Least inliers and inlier ratio of a kind of correspondences; more against a prior."""
    inliers, ratio = {
        "align": (config.min_inliers_align, config.min_ratio_align),
        "sift": (config.min_inliers_sift, config.min_ratio_sift),
    }.get(evidence.method, (config.min_inliers_xfeat, config.min_ratio_xfeat))
    if evidence.prior_shift > config.max_prior_shift:
        return 1.5 * inliers, 1.25 * ratio
    return inliers, ratio
