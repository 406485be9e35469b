"""Compares a stored map with the laid one that it was fitted from, and with another fit of it.

Laying is the same to the last bit on any CPU. Fitting is float32 work: the same bytes on one
machine, but instruction sets add in different orders, and Adam makes much of small differences.
So a fitted map is held to what it must share with the laid one, and two fits to looking alike.
"""

from __future__ import annotations

import numpy as np

from igaussian_core import GaussianMap

from .drive import mapping_poses
from .fit import LARGEST_MOVE, OPACITIES, SIZES, mapping_camera, tangents
from .gaussians import SH_C0, Gaussians
from .surfaces import Array

# what rounding may add: metres; units of logarithms, logits and colours
PLACE_STEP, LOG_STEP = 2e-5, 2e-4
EVERY = 14  # mapping poses between those that are compared: two turns of a stop apart


def broken_rules(fitted: Gaussians, laid: Gaussians) -> list[str]:
    """What no fit of the laid map can have changed so, by name. Both as parse_ply() reads them."""
    if len(fitted) != len(laid):
        return ["number"]
    first, second = tangents(laid.quats_wxyz).transpose(1, 0, 2)
    axes = np.stack([first, second, np.cross(first, second)], 1)
    moved = np.abs(((fitted.means - laid.means)[:, None] * axes).sum(2))
    reach = np.column_stack([LARGEST_MOVE * laid.scales[:, :2], np.zeros(len(laid))])
    growth = np.log(fitted.scales[:, :2] / laid.scales[:, :2])
    logits = np.log(fitted.opacities / (1 - fitted.opacities))
    low, high = (np.log(p / (1 - p)) for p in OPACITIES)
    kept = {
        "rotations": np.array_equal(fitted.quats_wxyz, laid.quats_wxyz),
        "thickness": np.array_equal(fitted.scales[:, 2], laid.scales[:, 2]),
        "places": bool((moved <= reach + PLACE_STEP).all()),
        "sizes": _within(growth, np.log(SIZES[0]), np.log(SIZES[1]), LOG_STEP),
        "opacities": _within(logits, low, high, LOG_STEP),
        "colours": _within(fitted.colours, 0.0, 1.0, LOG_STEP),
    }
    return [name for name, sound in kept.items() if not sound]


def _within(values: Array, low: float, high: float, step: float) -> bool:
    return bool(np.all((values >= low - step) & (values <= high + step)))


def likeness(one: Gaussians, other: Gaussians) -> float:
    """Lowest PSNR in dB between the two maps' renderings at some of the mapping poses."""
    maps, camera, errors = (as_map(one), as_map(other)), mapping_camera(), []
    for T_map_cam in mapping_poses()[::EVERY]:
        first, second = (m.render(camera, np.linalg.inv(T_map_cam))[0] for m in maps)
        errors.append(float(np.mean((np.asarray(first) - np.asarray(second)) ** 2)))
    return float(-10 * np.log10(max(*errors, 1e-12)))


def as_map(gaussians: Gaussians) -> GaussianMap:
    """What load_map() gives for the file of these Gaussians."""
    sh = (gaussians.colours - 0.5)[:, None] / SH_C0
    return GaussianMap(
        gaussians.means.astype(np.float32),
        gaussians.quats_wxyz.astype(np.float32),
        gaussians.scales.astype(np.float32),
        gaussians.opacities.astype(np.float32),
        sh.astype(np.float32),
    )
