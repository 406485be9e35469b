"""ATE and RPE of a trajectory by evo, which the field compares trajectories with."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import ConfigError

Array = NDArray[np.float64]


def trajectory_errors(poses: Sequence[tuple[Array, Array, float]]) -> dict[str, float]:
    """Absolute and relative errors in metres and degrees of (T_map_cam, its truth, stamp in s).

    `ate_*` is not aligned: the estimate claims to be in the map's frame. `ate_aligned_rmse_m`
    is after the best rigid motion, as SLAM papers give it. `rpe_*` compares the motion between
    consecutive poses.

    Returns:
        NaN with fewer than three poses.

    Raises:
        ConfigError: evo is not installed.
    """
    try:
        from evo.core import metrics
        from evo.core.trajectory import PoseTrajectory3D
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"ATE and RPE need the package evo ({error}): pip install 'igaussian_ros[eval]'"
        ) from error
    names = ("ate_rmse_m", "ate_median_m", "ate_max_m", "ate_aligned_rmse_m", "rpe_rmse_m",
             "rpe_rmse_deg")  # fmt: skip
    if len(poses) < 3:
        return dict.fromkeys(names, math.nan)
    estimated, true, stamps_s = zip(*poses, strict=True)
    stamps = np.array(stamps_s)
    reference = PoseTrajectory3D(poses_se3=list(true), timestamps=stamps)
    estimate = PoseTrajectory3D(poses_se3=list(estimated), timestamps=stamps)

    def measured(metric: metrics.PE) -> dict[str, float]:
        metric.process_data((reference, estimate))
        return {k: float(v) for k, v in metric.get_all_statistics().items()}

    parts = metrics.PoseRelation
    absolute = measured(metrics.APE(parts.translation_part))
    moved = measured(metrics.RPE(parts.translation_part))
    turned = measured(metrics.RPE(parts.rotation_angle_deg))
    estimate.align(reference)
    aligned = measured(metrics.APE(parts.translation_part))
    return {
        "ate_rmse_m": absolute["rmse"], "ate_median_m": absolute["median"],
        "ate_max_m": absolute["max"], "ate_aligned_rmse_m": aligned["rmse"],
        "rpe_rmse_m": moved["rmse"], "rpe_rmse_deg": turned["rmse"],
    }  # fmt: skip
