"""iGaussian: where is the camera in a 3D Gaussian Splatting map? ROS-free core."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from igaussian_core.camera import Camera
    from igaussian_core.config import Config
    from igaussian_core.errors import IGaussianError
    from igaussian_core.gaussian_map import GaussianMap, load_map
    from igaussian_core.localizer import Localizer
    from igaussian_core.result import LocalizationResult, Status

# Threads that spin at OpenMP's barriers slow a frame tenfold as soon as another process wants
# a core, as on any robot; it is read when torch loads, so it is set before that.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Config",
    "GaussianMap",
    "IGaussianError",
    "LocalizationResult",
    "Localizer",
    "Status",
    "load_map",
]

_HOMES = {
    "Camera": "camera",
    "Config": "config",
    "GaussianMap": "gaussian_map",
    "IGaussianError": "errors",
    "LocalizationResult": "result",
    "Localizer": "localizer",
    "Status": "result",
    "load_map": "gaussian_map",
}


def __getattr__(name: str) -> Any:
    """Public names are imported when used: reading a bag needs no torch, which takes seconds."""
    if name not in _HOMES:
        raise AttributeError(f"module 'igaussian_core' has no attribute '{name}'")
    return getattr(importlib.import_module(f"igaussian_core.{_HOMES[name]}"), name)
