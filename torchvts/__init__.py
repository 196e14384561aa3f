"""torchvts: camera images of visual-tactile sensors into depth, normals, contact and pose, as differentiable PyTorch modules."""

from . import metrics, scenes
from .calibration import CalibrationWarning, LightFit, calibrate, fit_lights
from .compensate import Compensate
from .contact import ContactMask
from .core.files import read_image, write_image
from .core.geometry import GradientFromNormal, depth_to_points, gradient_from_normal, normal_from_gradient
from .core.sensor import Sensor, shipped_sensors
from .integration import PoissonDCT, PoissonDST, PoissonRest, divergence, poisson_dct, poisson_dst, poisson_rest
from .normals import NormalFromIntensity
from .pipeline import DepthOutput, DepthPipeline
from .record import Calibration
from .shading import PointLights, near_field_shading

__version__ = "0.1.0"

__all__ = [
    "Calibration",
    "CalibrationWarning",
    "Compensate",
    "ContactMask",
    "DepthOutput",
    "DepthPipeline",
    "GradientFromNormal",
    "LightFit",
    "NormalFromIntensity",
    "PointLights",
    "PoissonDCT",
    "PoissonDST",
    "PoissonRest",
    "Sensor",
    "calibrate",
    "depth_to_points",
    "divergence",
    "fit_lights",
    "gradient_from_normal",
    "metrics",
    "near_field_shading",
    "normal_from_gradient",
    "poisson_dct",
    "poisson_dst",
    "poisson_rest",
    "read_image",
    "scenes",
    "shipped_sensors",
    "write_image",
]
