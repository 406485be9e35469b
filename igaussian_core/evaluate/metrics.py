"""Error statistics of a set of localizations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from igaussian_core.geometry import pose_error, vector_from_rotation
from igaussian_core.result import LocalizationResult

Array = NDArray[np.float64]


@dataclass(frozen=True)
class QueryOutcome:
    """One query: what was said and how far from the truth it is.

    Attributes:
        angle_deg, distance: errors of an accepted pose; inf where none was accepted.
        nees: e^T C^-1 e of the pose error, 6 on average where the covariance is true.
    """

    name: str
    status: str
    reason: str
    source: str
    inliers: int
    inlier_ratio: float
    angle_deg: float
    distance: float
    coarse_angle_deg: float
    coarse_distance: float
    nees: float
    timings_ms: dict[str, float]


def outcome(name: str, result: LocalizationResult, T_map_cam_true: Array) -> QueryOutcome:
    """The errors of one localization."""
    fine = coarse = (float("inf"), float("inf"))
    nees = float("nan")
    if result.T_map_cam is not None:
        fine = pose_error(result.T_map_cam, T_map_cam_true)
        if result.covariance is not None:
            nees = normalized_error_squared(result.T_map_cam, result.covariance, T_map_cam_true)
    if result.T_map_cam_coarse is not None:
        coarse = pose_error(result.T_map_cam_coarse, T_map_cam_true)
    return QueryOutcome(
        name, result.status.value, result.reason, result.source, result.inliers,
        result.inlier_ratio, *fine, *coarse, nees, dict(result.timings_ms),
    )  # fmt: skip


def normalized_error_squared(T_map_cam: Array, covariance: Array, T_map_cam_true: Array) -> float:
    """NEES of a pose: e^T C^-1 e, e = (position, rotation vector in the map's axes)."""
    turn = T_map_cam_true[:3, :3] @ T_map_cam[:3, :3].T
    error = np.concatenate(
        [T_map_cam_true[:3, 3] - T_map_cam[:3, 3], vector_from_rotation(turn)]
    )
    return float(error @ np.linalg.solve(covariance, error))


def summarize(
    outcomes: Sequence[QueryOutcome], max_deg: float, max_distance: float
) -> dict[str, float]:
    """Counts, medians and percentiles; success is accepted and within both thresholds.

    Medians and percentiles run over all queries: one without a pose counts as infinite.
    """
    if not outcomes:
        return {"queries": 0.0}
    angle = np.array([o.angle_deg for o in outcomes])
    distance = np.array([o.distance for o in outcomes])
    accepted = np.isfinite(angle)
    right = (angle < max_deg) & (distance < max_distance)
    total = np.array([o.timings_ms.get("total", np.nan) for o in outcomes])
    nees = np.array([o.nees for o in outcomes])
    return {
        "queries": float(len(outcomes)),
        "accepted": float(accepted.sum()),
        "success": float(right.mean()),
        "wrong_accepted": float((accepted & ~right).sum()),
        "median_deg": _percentile(angle, 50),
        "median_distance": _percentile(distance, 50),
        "p90_deg": _percentile(angle, 90),
        "p90_distance": _percentile(distance, 90),
        "max_deg": float(angle[accepted].max()) if accepted.any() else float("nan"),
        "max_distance": float(distance[accepted].max()) if accepted.any() else float("nan"),
        "coarse_median_deg": _percentile(np.array([o.coarse_angle_deg for o in outcomes]), 50),
        "coarse_median_distance": _percentile(np.array([o.coarse_distance for o in outcomes]), 50),
        "median_ms": float(np.nanmedian(total)),
        "p95_ms": float(np.nanpercentile(total, 95)),
        "median_nees": float(np.nanmedian(nees)) if np.isfinite(nees).any() else float("nan"),
    }


def _percentile(values: Array, q: float) -> float:
    """Percentile by the nearest rank above, so that infinities count and nothing is averaged."""
    return float(np.percentile(values, q, method="higher"))
