"""Where a map's training cameras were, read off the sizes of its Gaussians.

Training splits Gaussians until they are small in the image, so their size grows with the
distance from the cameras: places from which log size and log distance correlate best are
likely. Among random places, true cameras rank in the best few per cent
(benchmarks/camera_traces.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from igaussian_core.gaussian_map import GaussianMap

Array = NDArray[np.float64]

_GAUSSIANS = 4000  # that the correlation is taken over
_KEPT = 0.95  # of the highest correlation


def likely_camera_positions(
    gmap: GaussianMap, low: Array, high: Array, samples: int = 4000
) -> Array:
    """Positions [N, 3] where training cameras probably were, likeliest first.

    Random places in a box 2.5 times as large as the map's, then around the best of them.

    Args:
        low, high: the map's bounds.
    """
    rng = np.random.default_rng(0)
    size = high - low
    places = low - 0.75 * size + rng.random((samples, 3)) * 2.5 * size
    correlation = size_distance_correlation(gmap, places, low, high)
    best = places[np.argsort(-correlation)[:20]]
    near = best[rng.integers(len(best), size=samples // 2)]
    near = near + rng.uniform(-0.4, 0.4, near.shape) * size
    places = np.concatenate([places, near])
    correlation = np.concatenate(
        [correlation, size_distance_correlation(gmap, near, low, high)]
    )
    order = np.argsort(-correlation)
    kept = int((correlation > _KEPT * correlation.max()).sum())
    return np.asarray(places[order[: max(20, min(kept, len(places) // 20))]])


def size_distance_correlation(
    gmap: GaussianMap, positions: Array, low: Array, high: Array
) -> Array:
    """Correlation [N] of log size and log distance of the Gaussians from positions [N, 3]."""
    inside = ((gmap.means > low) & (gmap.means < high)).all(axis=1) & (gmap.opacities > 0.3)
    index = np.random.default_rng(0).permutation(np.flatnonzero(inside))[:_GAUSSIANS]
    if len(index) < 50:
        return np.zeros(len(positions))
    points = gmap.means[index].astype(np.float64)
    two_largest = np.sort(gmap.scales[index].astype(np.float64), axis=1)[:, 1:]
    log_size = _standardized(np.log(np.maximum(two_largest, 1e-9)).mean(axis=1))
    return np.array(
        [
            log_size @ _standardized(np.log(np.linalg.norm(points - position, axis=1) + 1e-9))
            for position in positions
        ]
    )


def _standardized(values: Array) -> Array:
    centred = values - values.mean()
    return np.asarray(centred / max(float(np.linalg.norm(centred)), 1e-12))
