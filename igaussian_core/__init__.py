"""iGaussian: where is the camera in a 3D Gaussian Splatting map? ROS-free core."""

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
