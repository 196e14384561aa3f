"""A new background for a calibrated unit, while its model stays: what re-zero does."""

from torch import Tensor

from ..core.checks import check_image
from ..model import Calibration, check_calibration


def with_background(calibration: Calibration, background: Tensor) -> Calibration:
    """The calibration with another image without contact: defects, gain and noise come from it, lights or response fields stay.

    Args:
        calibration: of the unit.
        background: (3, H, W) in [0, 1].
    Raises:
        ValueError, TypeError: background of another shape or range.
    Example:
        >>> import torch
        >>> from torchvts.model import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> unit = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> with_background(unit, torch.full((3, 48, 64), 0.5)).background.mean()
        tensor(0.5000)
    """
    check_calibration("calibration", calibration)
    sensor = calibration.sensor
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    if calibration.response is not None:
        background = background.to(calibration.background.dtype)
        return Calibration.from_response(calibration.response, sensor, background, calibration.report)
    assert calibration.lights is not None
    return Calibration.from_lights(calibration.lights, sensor, background, calibration.report, calibration.ambient)
