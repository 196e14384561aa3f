"""torchvts: camera images of visual-tactile sensors into depth, normals, contact and pose, as differentiable PyTorch modules."""

from . import metrics, objects, scenes, stream
from .calibration import CalibrationWarning, LightFit, Press, Touch, calibrate, fit_lights, fit_prior, read_presses
from .compensate import Compensate
from .confidence import Confidence, bound_at
from .contact import ContactMask
from .core import __version__ as __version__
from .core import gs_sdk
from .core.files import read_image, write_image
from .core.geometry import GradientFromNormal, depth_to_points, gradient_from_normal, normal_from_gradient
from .core.sensor import Sensor, shipped_sensors
from .diagnose import Diagnosis, Finding, diagnose
from .heights import HeightFromBrightness
from .integration import (
    AdaptiveIntegration,
    CliffIntegration,
    PerspectiveIntegration,
    PoissonDCT,
    PoissonDST,
    PoissonRest,
    divergence,
    integrate_cliffs,
    integrate_perspective,
    poisson_dct,
    poisson_dst,
    poisson_rest,
)
from .markers import FillMarkers, fill_markers, find_markers
from .normals import NormalFromIntensity, NormalFromLookup, NormalFromMLP, NormalFromResponse, fit_mlp
from .pipeline import CliffPipeline, ConfidentOutput, ConfidentPipeline, DepthOutput, DepthPipeline
from .pose import Registration, contact_cloud, register_depth, register_points
from .record import Calibration
from .shading import PointLights, near_field_shading

__all__ = [
    "AdaptiveIntegration",
    "Calibration",
    "CalibrationWarning",
    "CliffIntegration",
    "CliffPipeline",
    "Compensate",
    "Confidence",
    "ConfidentOutput",
    "ConfidentPipeline",
    "ContactMask",
    "DepthOutput",
    "DepthPipeline",
    "Diagnosis",
    "FillMarkers",
    "Finding",
    "GradientFromNormal",
    "HeightFromBrightness",
    "LightFit",
    "NormalFromIntensity",
    "NormalFromLookup",
    "NormalFromMLP",
    "NormalFromResponse",
    "PerspectiveIntegration",
    "PointLights",
    "PoissonDCT",
    "PoissonDST",
    "PoissonRest",
    "Press",
    "Registration",
    "Sensor",
    "Touch",
    "bound_at",
    "calibrate",
    "contact_cloud",
    "depth_to_points",
    "diagnose",
    "divergence",
    "fill_markers",
    "find_markers",
    "fit_lights",
    "fit_mlp",
    "fit_prior",
    "gradient_from_normal",
    "gs_sdk",
    "integrate_cliffs",
    "integrate_perspective",
    "metrics",
    "near_field_shading",
    "normal_from_gradient",
    "objects",
    "poisson_dct",
    "poisson_dst",
    "poisson_rest",
    "read_image",
    "read_presses",
    "register_depth",
    "register_points",
    "scenes",
    "shipped_sensors",
    "stream",
    "write_image",
]
