"""What a map holds, in lines for people."""

from __future__ import annotations

import math

import numpy as np

from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.overview import kind_of, likely_up


def summarize(gmap: GaussianMap) -> dict[str, str]:
    """Counts, bounds, scales, opacities, kind and up axis, in order of display."""
    total = len(gmap) + gmap.dropped
    rows = {"format": gmap.file_format} if gmap.file_format else {}
    rows |= {
        "Gaussians": f"{len(gmap):,}",
        "left out on loading": f"{gmap.dropped:,} ({gmap.dropped / max(total, 1):.2%}; "
        "not finite or no rotation)",
        "SH degree": str(gmap.sh_degree),
        "antialiased": "yes" if gmap.antialiased else "no, or the file does not say",
    }
    return rows | _geometry(gmap) if len(gmap) else rows


def _geometry(gmap: GaussianMap) -> dict[str, str]:
    low, high = gmap.bounds()
    order = np.sort(gmap.scales, axis=1).astype(np.float64)
    p1, p50, p99 = np.percentile(order[:, 2], [1, 50, 99])
    diagonal = float(np.linalg.norm(high - low))
    kind = kind_of(gmap)
    up = likely_up(gmap, kind)
    return {
        "bounds (98 %)": f"{_point(low)} to {_point(high)}",
        "size (98 %)": f"{_point(high - low)}, diagonal {diagonal:.4g}",
        "bounds (all)": f"{_point(gmap.means.min(axis=0))} to {_point(gmap.means.max(axis=0))}",
        "largest scale p1, p50, p99": f"{p1:.3g}, {p50:.3g}, {p99:.3g}",
        "longest to middle axis p50, p99": " and ".join(
            f"{v:.3g}" for v in np.percentile(_ratio(order[:, 2], order[:, 1]), [50, 99])
        ),
        "needles (over 10)": f"{float((_ratio(order[:, 2], order[:, 1]) > 10).mean()):.1%}",
        "giants (a tenth of the size)": f"{int((order[:, 2] > 0.1 * diagonal).sum()):,}",
        "opacity below 0.05": f"{float((gmap.opacities < 0.05).mean()):.1%}",
        "kind, from the Gaussians": kind,
        "up axis": f"{up.label} ({up.confidence}: {up.reason})",
    }


def _ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a / np.maximum(b, 1e-30))


def _point(values: np.ndarray) -> str:
    """Three numbers with as many digits as the largest one makes sensible."""
    largest = float(np.abs(values).max())
    digits = max(0, 3 - math.floor(math.log10(largest))) if largest > 0 else 0
    return "[" + ", ".join(f"{v:.{digits}f}" for v in values) + "]"
