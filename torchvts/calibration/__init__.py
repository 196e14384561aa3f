"""Floor 3, offline: from images to the record of a calibrated unit."""

from .calibrate import CalibrationWarning, calibrate, fit_prior
from .contacts import Press, Touch, read_presses
from .lights import LightFit, fit_lights

__all__ = ["CalibrationWarning", "LightFit", "Press", "Touch", "calibrate", "fit_lights", "fit_prior", "read_presses"]
