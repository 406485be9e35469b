"""What a localization says: a pose with its evidence, or a status that says why there is none."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray


class Status(str, Enum):
    """What became of a frame. Only `OK` and `OK_DEGRADED` come with a pose."""

    OK = "ok"
    OK_DEGRADED = "ok_degraded"  # accepted, on evidence near the thresholds
    NO_HYPOTHESIS = "no_hypothesis"  # nothing in the map resembles the image
    TOO_FEW_MATCHES = "too_few_matches"  # image and render at the hypothesis do not match
    INCONSISTENT = "inconsistent"  # matches that do not agree on one pose
    OUT_OF_MAP = "out_of_map"  # the map covers too little of the view
    TOO_DARK_OR_BLURRED = "too_dark_or_blurred"  # no structure, or far less than the map shows
    TIMEOUT = "timeout"  # the budget ended before every hypothesis was tried

    @property
    def ok(self) -> bool:
        return self in (Status.OK, Status.OK_DEGRADED)


@dataclass(frozen=True)
class LocalizationResult:
    """The outcome of one frame.

    Attributes:
        status: what became of the frame; `reason` says it with figures.
        T_map_cam: 4x4 float64, camera's optical frame in `map`, metres; None unless ok.
        covariance: 6x6 float64, order x y z rx ry rz in the map's axes (rotation vector in
            radians that turns the estimate, fixed axes); None unless ok.
        inliers, matches: PnP inliers and matches of the deciding round.
        inlier_ratio: inliers / matches.
        residual_px: median reprojection error of the inliers in pixels.
        coverage: share of the render's pixels that the map covers.
        agreement: correlation of image and render around the inliers, at most 1; NaN where
            the matches told enough already, or too little could be compared.
        sharpness: share of the render's fine detail that the image shows; NaN likewise.
        confidence: how far the evidence is from the thresholds, 0 to 1; a pose is accepted
            above 0.5 (`refine/verify.py`). No probability.
        matcher: what the deciding correspondences came from: "align", "xfeat", "sift".
        source: where the accepted (or last tried) hypothesis came from.
        T_map_cam_coarse: the best hypothesis before refinement, or None.
        timings_ms: milliseconds by stage, with `total`.
    """

    status: Status
    reason: str = ""
    T_map_cam: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    inliers: int = 0
    matches: int = 0
    inlier_ratio: float = 0.0
    residual_px: float = float("nan")
    coverage: float = float("nan")
    agreement: float = float("nan")
    sharpness: float = float("nan")
    confidence: float = 0.0
    matcher: str = ""
    source: str = ""
    T_map_cam_coarse: NDArray[np.float64] | None = None
    timings_ms: dict[str, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        return self.status.ok
