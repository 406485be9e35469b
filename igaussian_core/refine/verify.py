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
    """

    method: str
    matches: int = 0
    inliers: int = 0
    residual_px: float = float("nan")
    coverage: float = float("nan")
    spread: float = 0.0
    sigma_deg: float = 0.0

    @property
    def ratio(self) -> float:
        return self.inliers / self.matches if self.matches else 0.0


def judge(evidence: Evidence, config: VerifyConfig) -> tuple[Status, str]:
    """The verdict and its reason in words."""
    e = evidence
    min_inliers, min_ratio = _thresholds(e.method, config)
    if e.coverage < config.min_coverage:
        return Status.OUT_OF_MAP, f"the map covers {e.coverage:.0%} of the view"
    if e.matches < min_inliers:
        return Status.TOO_FEW_MATCHES, f"{e.matches} matches, {min_inliers} wanted"
    if e.inliers < min_inliers or e.ratio < min_ratio:
        wanted = f"{min_inliers} and {min_ratio:.0%} wanted"
        return Status.INCONSISTENT, f"{e.inliers} of {e.matches} matches agree, {wanted}"
    if e.residual_px > config.max_residual_px:
        return Status.INCONSISTENT, f"median reprojection error {e.residual_px:.2f} px"
    if e.spread < config.min_spread:
        return Status.INCONSISTENT, f"the inliers cover {e.spread:.1%} of the image only"
    if e.sigma_deg > config.max_sigma_deg:
        return Status.INCONSISTENT, f"the rotation is known to {e.sigma_deg:.1f} degrees only"
    if e.inliers < 1.5 * min_inliers or e.ratio < 1.25 * min_ratio:
        return Status.OK_DEGRADED, f"{e.inliers} of {e.matches} matches agree: little evidence"
    return Status.OK, f"{e.inliers} of {e.matches} matches agree"


def _thresholds(method: str, config: VerifyConfig) -> tuple[int, float]:
    """Least inliers and inlier ratio of a kind of correspondences."""
    return {
        "align": (config.min_inliers_align, config.min_ratio_align),
        "sift": (config.min_inliers_sift, config.min_ratio_sift),
    }.get(method, (config.min_inliers_xfeat, config.min_ratio_xfeat))
