"""Error statistics of a set of localizations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from igaussian_core.geometry import pose_error, vector_from_rotation
from igaussian_core.result import LocalizationResult

Array = NDArray[np.float64]

# of chi squared with six degrees of freedom: 95 % of the NEES of a true covariance lie below
NEES_95 = 12.592


@dataclass(frozen=True)
class QueryOutcome:
    """One query: what was said and how far from the truth it is.

    Attributes:
        angle_deg, distance: errors of an accepted pose; inf where none was accepted.
        nees: e^T C^-1 e of the pose error, 6 on average where the covariance is true.
        group: what the query belongs to, e.g. a bin of the rendered track.
        T_map_cam, T_map_cam_coarse: what was said, None where nothing was.
        T_map_cam_true: what it was judged by.
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
    group: str = ""
    T_map_cam: Array | None = field(default=None, compare=False)
    T_map_cam_coarse: Array | None = field(default=None, compare=False)
    T_map_cam_true: Array | None = field(default=None, compare=False)

    @property
    def accepted(self) -> bool:
        return math.isfinite(self.angle_deg)


def outcome(
    name: str, result: LocalizationResult, T_map_cam_true: Array, group: str = ""
) -> QueryOutcome:
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
        result.inlier_ratio, *fine, *coarse, nees, dict(result.timings_ms), group,
        result.T_map_cam, result.T_map_cam_coarse, T_map_cam_true,
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
    """The figures of a set of queries; distances in map units.

    Shares, medians, percentiles and areas run over all queries: one without a pose counts as
    infinitely wrong. Means and maxima run over accepted poses, since they have no value
    otherwise; read them with `accepted`. `success` is accepted and within both thresholds,
    `wrong_accepted` counts the accepted ones that are not. `auc` is the area under the recall
    curve while both thresholds grow together from 0; `auc_deg` and `auc_distance` look at one.
    `max_distance` may be infinite: rotation alone counts.
    """
    if not outcomes:
        return {"queries": 0.0}
    angle = np.array([o.angle_deg for o in outcomes])
    distance = np.array([o.distance for o in outcomes])
    accepted = np.isfinite(angle)
    right = (angle < max_deg) & (distance < max_distance)
    of_limit = np.full(len(outcomes), np.inf)
    of_limit[accepted] = distance[accepted] / max_distance
    total = np.array([o.timings_ms.get("total", np.nan) for o in outcomes])
    nees = np.array([o.nees for o in outcomes])
    nees = nees[np.isfinite(nees)]
    return {
        "queries": float(len(outcomes)),
        "accepted": float(accepted.sum()),
        "success": float(right.mean()),
        "wrong_accepted": float((accepted & ~right).sum()),
        "mean_deg": _mean(angle[accepted]),
        "mean_distance": _mean(distance[accepted]),
        "median_deg": _percentile(angle, 50),
        "median_distance": _percentile(distance, 50),
        "p90_deg": _percentile(angle, 90),
        "p90_distance": _percentile(distance, 90),
        "max_deg": float(angle[accepted].max()) if accepted.any() else float("nan"),
        "max_distance": float(distance[accepted].max()) if accepted.any() else float("nan"),
        "within_15_deg": float((angle <= 15.0).mean()),
        "within_half_unit": float((distance <= 0.5).mean()),
        "auc": area_under_recall(np.maximum(angle / max_deg, of_limit), 1.0),
        "auc_deg": area_under_recall(angle, max_deg),
        "auc_distance": area_under_recall(of_limit, 1.0),
        "coarse_median_deg": _percentile(np.array([o.coarse_angle_deg for o in outcomes]), 50),
        "coarse_median_distance": _percentile(np.array([o.coarse_distance for o in outcomes]), 50),
        "median_ms": float(np.nanmedian(total)) if np.isfinite(total).any() else float("nan"),
        "p95_ms": float(np.nanpercentile(total, 95)) if np.isfinite(total).any() else float("nan"),
        "mean_nees": _mean(nees),
        "median_nees": float(np.median(nees)) if len(nees) else float("nan"),
        "inside_95": float((nees <= NEES_95).mean()) if len(nees) else float("nan"),
    }


def stage_times(outcomes: Sequence[QueryOutcome]) -> dict[str, dict[str, float]]:
    """Median, mean and 95th percentile of the milliseconds of each stage, over the queries that
    went through it; in the order of their first use, `total` last."""
    stages = list(dict.fromkeys(s for o in outcomes for s in o.timings_ms if s != "total"))
    result = {}
    for stage in [*stages, "total"]:
        values = np.array([o.timings_ms[stage] for o in outcomes if stage in o.timings_ms])
        if len(values):
            result[stage] = {
                "queries": float(len(values)),
                "median_ms": float(np.median(values)),
                "mean_ms": float(values.mean()),
                "p95_ms": float(np.percentile(values, 95)),
            }
    return result


def by_group(outcomes: Sequence[QueryOutcome]) -> dict[str, list[QueryOutcome]]:
    """The outcomes of each group, groups in the order of their first query."""
    groups: dict[str, list[QueryOutcome]] = {}
    for o in outcomes:
        groups.setdefault(o.group, []).append(o)
    return groups


def recall_curve(errors: Array, limit: float) -> tuple[Array, Array]:
    """Thresholds from 0 to `limit` and the share of errors [N] up to each: a step function's
    corners, for plotting with steps after."""
    known = np.sort(errors[errors <= limit])
    thresholds = np.concatenate([[0.0], known, [limit]])
    share = np.arange(len(known) + 1) / max(len(errors), 1)
    return thresholds, np.concatenate([share, share[-1:]])


def area_under_recall(errors: Array, limit: float) -> float:
    """Area under the recall curve up to a threshold, as a share: 1 where all errors are 0.

    Exact for the step function: every error e below the limit adds 1 - e / limit.
    """
    if len(errors) == 0:
        return float("nan")
    return float(np.clip(1 - errors / limit, 0, 1).mean())


def plain(figures: Mapping[str, float]) -> dict[str, float | int | None]:
    """Figures as JSON values: whole numbers as integers, NaN as null."""
    result: dict[str, float | int | None] = {}
    for name, value in figures.items():
        if not math.isfinite(value):
            result[name] = None
        else:
            result[name] = int(value) if value == int(value) else round(value, 6)
    return result


def to_json(o: QueryOutcome) -> dict[str, Any]:
    """Plain JSON values; what is infinite or no number becomes null."""
    data = {**o.__dict__, "timings_ms": {k: round(v, 3) for k, v in o.timings_ms.items()}}
    for name, value in data.items():
        if isinstance(value, np.ndarray):
            data[name] = value.tolist()
        elif isinstance(value, float) and not math.isfinite(value):
            data[name] = None
    return data


def from_json(data: dict[str, Any]) -> QueryOutcome:
    """The outcome that `to_json` wrote."""
    values = dict(data)
    for name in ("angle_deg", "distance", "coarse_angle_deg", "coarse_distance"):
        values[name] = float("inf") if values[name] is None else values[name]
    for name in ("nees", "inlier_ratio"):
        values[name] = float("nan") if values[name] is None else values[name]
    for name in ("T_map_cam", "T_map_cam_coarse", "T_map_cam_true"):
        values[name] = None if values[name] is None else np.array(values[name])
    return QueryOutcome(**values)


def _mean(values: Array) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _percentile(values: Array, q: float) -> float:
    """Percentile by the nearest rank above, so that infinities count and nothing is averaged."""
    return float(np.percentile(values, q, method="higher"))
