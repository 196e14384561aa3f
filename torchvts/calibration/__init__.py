"""Offline calibration: from images of a unit to its Calibration."""

from .contacts import ROUGH, channel_structure
from .doubts import CalibrationWarning
from .lights import LightFit, fit_lights
from .outliers import LEAST_WEIGHT
from .press_model import RESPONSE_BLUR_PX, by_presses, with_preprocessing
from .presses import Press, read_presses
from .unit import calibrate

__all__ = [
    "LEAST_WEIGHT",
    "RESPONSE_BLUR_PX",
    "ROUGH",
    "CalibrationWarning",
    "LightFit",
    "Press",
    "by_presses",
    "calibrate",
    "channel_structure",
    "fit_lights",
    "read_presses",
    "with_preprocessing",
]
