"""What a sensor and a unit are: description, lights, response fields, a calibration and its report, gs_sdk's formats."""

from . import gs_sdk
from .calibration import Calibration, check_calibration
from .lights import PointLights, near_field_shading
from .markers import FillMarkers, fill_markers, find_markers
from .report import Report
from .response_field import DepthBrightness, ResponseField, ResponseModel, SensorPrior
from .sensor import Sensor, check_sensor, shipped_sensors
from .stated_error import StatedError, press_next, stated_deg, stated_error_deg

__all__ = [
    "Calibration",
    "DepthBrightness",
    "FillMarkers",
    "PointLights",
    "Report",
    "ResponseField",
    "ResponseModel",
    "Sensor",
    "SensorPrior",
    "StatedError",
    "check_calibration",
    "check_sensor",
    "fill_markers",
    "find_markers",
    "gs_sdk",
    "near_field_shading",
    "press_next",
    "shipped_sensors",
    "stated_deg",
    "stated_error_deg",
]
