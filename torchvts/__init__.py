"""torchvts: camera images of visual-tactile sensors into depth, normals, contact and pose, as differentiable PyTorch modules."""

from . import scenes, stream
from .accelerated import (
    AdaptiveIntegration,
    Compensate,
    ContactMask,
    GradientFromNormal,
    NormalFromIntensity,
    PoissonBackground,
    PoissonDCT,
)
from .calibration import CalibrationWarning, Press, Touch, calibrate, fit_lights, read_presses
from .contact import ContactFromDepth, ContactSettings
from .core import __version__ as __version__
from .core.files import read_image, write_image
from .core.geometry import depth_to_points
from .core.results import Result, read_result
from .diagnose import diagnose
from .integration import Integrator, PoissonDST, poisson_background, poisson_dct, poisson_dst
from .model import Calibration, PointLights, Sensor, gs_sdk, near_field_shading, shipped_sensors
from .normals import NormalFromLookup, NormalFromMLP, NormalFromResponse, NormalModel
from .pipeline import ConfidentPipeline, DepthOutput, DepthPipeline
from .pose import PoseTracker, register_depth, register_points

__all__ = [
    "AdaptiveIntegration",
    "Calibration",
    "CalibrationWarning",
    "Compensate",
    "ConfidentPipeline",
    "ContactFromDepth",
    "ContactMask",
    "ContactSettings",
    "DepthOutput",
    "DepthPipeline",
    "GradientFromNormal",
    "Integrator",
    "NormalFromIntensity",
    "NormalFromLookup",
    "NormalFromMLP",
    "NormalFromResponse",
    "NormalModel",
    "PointLights",
    "PoissonBackground",
    "PoissonDCT",
    "PoissonDST",
    "PoseTracker",
    "Press",
    "Result",
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
    "read_result",
    "register_depth",
    "register_points",
    "scenes",
    "shipped_sensors",
    "stream",
    "write_image",
]
