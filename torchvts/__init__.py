"""torchvts: camera images of visual-tactile sensors into depth, normals, contact and pose, as differentiable PyTorch modules.

``Sensor.load`` describes a sensor, ``calibrate`` makes a ``Calibration`` of a unit from its images, and
``DepthPipeline.from_calibration`` makes of that the module from images to a ``DepthOutput``.

* To calibrate: ``Press``, ``read_presses``, ``fit_lights``, ``PointLights``, ``CalibrationWarning``; ``gs_sdk`` reads
  the files of gs_sdk.
* Parts of a pipeline, in its order: ``Rectify`` (raw frames), ``Compensate``, ``ContactMask``, a ``NormalModel``,
  ``GradientFromNormal``, an ``Integrator``, ``ContactFromDepth``. Models are named ``NormalFrom...``, integrators ``Poisson...``
  and ``AdaptiveIntegration``; ``poisson_dct`` and the like are the same as functions.
* Input: ``frames`` of images, folders, TIFFs, videos and cameras; ``read_image``, ``write_image``, ``read_result``.
* With depth: ``depth_to_points``, ``SkinMotion``, ``register_depth``, ``PoseTracker``, ``ConfidentPipeline``, ``diagnose``,
  ``stream``. ``scenes`` has exact scenes for tests.

All parts are plain PyTorch modules. ``pipe.freeze()`` makes a ``FrozenPipeline``: the same, compiled, for cameras and recordings.
"""

from . import scenes, stream
from .calibration import CalibrationWarning, Press, calibrate, fit_lights, read_presses
from .compensate import Compensate, Rectify
from .core import __version__ as __version__
from .core.files import read_image, write_image
from .core.geometry import GradientFromNormal, depth_to_points
from .core.results import Result, read_result
from .diagnose import diagnose
from .integration import (
    AdaptiveIntegration,
    Integrator,
    PoissonBackground,
    PoissonDCT,
    PoissonDST,
    poisson_background,
    poisson_dct,
    poisson_dst,
)
from .model import Calibration, PointLights, Sensor, gs_sdk, near_field_shading, shipped_sensors
from .normals import NormalFromIntensity, NormalFromLookup, NormalFromMLP, NormalFromResponse, NormalModel
from .pipeline import ConfidentPipeline, DepthOutput, DepthPipeline, FrozenPipeline
from .pose import PoseTracker, register_depth, register_points
from .skin import ContactFromDepth, ContactMask, ContactSettings, SkinMotion
from .stream import frames

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
    "FrozenPipeline",
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
    "Rectify",
    "Result",
    "Sensor",
    "SkinMotion",
    "calibrate",
    "depth_to_points",
    "diagnose",
    "fit_lights",
    "frames",
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
