"""iGaussian: where is the camera in a 3D Gaussian Splatting map? ROS-free core."""

import os

# Threads that spin at OpenMP's barriers slow a frame tenfold as soon as another process wants
# a core, as on any robot; it is read when torch loads, so it is set before that.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# ruff: noqa: E402
from igaussian_core.camera import Camera
from igaussian_core.config import Config
from igaussian_core.errors import IGaussianError
from igaussian_core.gaussian_map import GaussianMap, load_map
from igaussian_core.localizer import Localizer
from igaussian_core.result import LocalizationResult, Status

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
