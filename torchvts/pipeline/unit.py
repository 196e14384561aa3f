"""The pipeline of a calibrated unit, by its own model or by a trained network."""

from pathlib import Path

from ..model import Calibration, check_calibration
from ..skin import ContactSettings
from .depth import DepthPipeline


def unit_pipeline(
    calibration: Calibration, mode: str = "fast", network: str | Path | None = None, contact: ContactSettings | None = None
) -> DepthPipeline:
    """The pipeline of a unit; with a network, its normals are the network's, on images as the camera gives them.

    Args:
        calibration: of the unit; with a network, its sensor and background are used.
        mode: "fast" or "precise"; a network has no "precise".
        network: gs_sdk's ``nnmodel.pth``, or what ``torchvts train`` or ``NormalFromMLP.save`` wrote; None for the unit's model.
        contact: thresholds; None for the usual ones.
    Raises:
        FileNotFoundError: no such network.
        ValueError, TypeError: a file that is no such network, a mode that it does not have, or thresholds beside it.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> unit_pipeline(Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5)), "fast").mode
        'fast'
    """
    check_calibration("calibration", calibration)
    if network is None:
        return DepthPipeline.from_calibration(calibration, mode, contact=contact)
    if contact is not None:
        raise ValueError("contact: expected None beside a network, whose images have other thresholds")
    return DepthPipeline.from_gs_sdk(network, calibration.background_value, calibration.sensor, mode, calibration.markers)
