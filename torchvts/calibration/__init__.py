"""Floor 3, offline: from images to the record of a calibrated unit."""

from .calibrate import CalibrationWarning, calibrate
from .lights import LightFit, fit_lights

__all__ = ["CalibrationWarning", "LightFit", "calibrate", "fit_lights"]
