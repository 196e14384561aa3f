"""torchvts: camera images of visual-tactile sensors into depth, normals, contact and pose, as differentiable PyTorch modules."""

from . import scenes, stream
from .calibration import CalibrationWarning, Press, Touch, calibrate, fit_lights, read_presses
from .compensate import Compensate
from .contact import ContactMask
from .core import __version__ as __version__
from .core.files import read_image, write_image
from .core.geometry import GradientFromNormal, depth_to_points
from .diagnose import diagnose
from .integration import (
    AdaptiveIntegration,
    PoissonBackground,
    PoissonDCT,
    PoissonDST,
    poisson_background,
    poisson_dct,
    poisson_dst,
)
from .model import Calibration, PointLights, Sensor, gs_sdk, near_field_shading, shipped_sensors
from .normals import NormalFromIntensity, NormalFromLookup, NormalFromMLP, NormalFromResponse
from .pipeline import ConfidentPipeline, DepthOutput, DepthPipeline
from .pose import register_depth, register_points

__all__ = [
    "AdaptiveIntegration",
    "Calibration",
    "CalibrationWarning",
    "Compensate",
    "ConfidentPipeline",
    "ContactMask",
    "DepthOutput",
    "DepthPipeline",
    "GradientFromNormal",
    "NormalFromIntensity",
    "NormalFromLookup",
    "NormalFromMLP",
    "NormalFromResponse",
    "PointLights",
    "PoissonBackground",
    "PoissonDCT",
    "PoissonDST",
    "Press",
    "Sensor",
    "Touch",
    "calibrate",
    "depth_to_points",
    "diagnose",
    "fit_lights",
    "gs_sdk",
    "near_field_shading",
    "poisson_background",
    "poisson_dct",
    "poisson_dst",
    "read_image",
    "read_presses",
    "register_depth",
    "register_points",
    "scenes",
    "shipped_sensors",
    "stream",
    "write_image",
]
