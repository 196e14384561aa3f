"""Floor 3, offline: from images to the record of a calibrated unit."""

from .calibrate import CalibrationWarning, calibrate, fit_prior
from .lights import LightFit, fit_lights
from .presses import Press
from .touches import Touch

__all__ = ["CalibrationWarning", "LightFit", "Press", "Touch", "calibrate", "fit_lights", "fit_prior"]
