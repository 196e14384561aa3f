"""Calibrate a unit: from what is given of it to its record."""

import warnings
from typing import Any

import torch
from torch import Tensor

from ..contact import ContactMask
from ..core.checks import check_image
from ..core.sensor import Sensor
from ..record import Calibration
from ..shading import PointLights, flat_image
from .lights import LOOSE_DEG, check_exposure, fit_lights


class CalibrationWarning(UserWarning):
    """A calibration that was made, but should not be trusted as it is."""


def calibrate(background: Tensor, sensor: Sensor, *, progress: bool = False) -> Calibration:
    """Calibrate a unit from one image without contact.

    Lights that the sensor file gives keep their place and only their albedo is fitted; else :func:`fit_lights` finds both.

    Args:
        background: (3, H, W) in [0, 1], R, G, B, of the sensor's size.
        sensor: the sensor.
        progress: show a bar.
    Returns:
        A :class:`Calibration`; its ``report`` holds the figures of the fit.
    Raises:
        ValueError, TypeError: bad image: shape, dtype, range, black, saturated.
    Warns:
        CalibrationWarning: the fit did not converge, the image does not pin the lights, or it seems to hold a contact.
    Source:
        eq. 6-8 of the paper.
    Example:
        >>> sensor = Sensor(name="rig", height=48, width=64, mm_per_pixel=0.6)
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> calibrate(flat_image(lights, 48, 64, 0.6).detach(), sensor).report["converged"]
        True
    """
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_exposure(background)
    report: dict[str, Any] = {"model": "point_lights", "lights": "fitted"}
    if sensor.light_position_mm is not None:
        lights = _scale_albedo(PointLights([list(row) for row in sensor.light_position_mm], [1.0, 1.0, 1.0]), background, sensor)
        report |= {"lights": "positions from the sensor file, albedo fitted", "converged": True}
    else:
        fit = fit_lights(background, sensor, progress=progress)
        lights = fit.lights
        report |= {
            "converged": fit.converged,
            "message": fit.message,
            "steps": len(fit.loss_history),
            "loss": fit.loss_history[-1],
            "direction_std_deg": fit.direction_std_deg.tolist(),
            "position_std_mm": fit.position_std_mm.tolist(),
            "misfit": fit.misfit.tolist(),
            "inlier_fraction": fit.inlier_fraction,
        }
        report["gloss"] = fit.lights.gloss.tolist()
        if not fit.converged or bool((fit.direction_std_deg > LOOSE_DEG).any()):
            warnings.warn(f"background: {fit.message}", CalibrationWarning, stacklevel=2)
    calibration = Calibration.from_lights(lights, sensor, background, report)
    model = calibration.model_image
    spread = calibration.compensation.abs().flatten(1).median(dim=1).values / 0.6745
    report["residual_std"] = spread.tolist()
    # contact changes the light by more than 5 % and is wider than dirt: 5 sigmas of the residual and of 1 % of the model
    judge = ContactMask(model, spread.reshape(3, 1, 1) + 0.01 * model, min_size_px=0.05 * sensor.height)
    full = (background.to(model.dtype) > 0.995) | (model > 0.95)  # what the camera clips tells nothing
    seen = torch.where(full, model, calibration.background)
    standing_out = float(judge(seen[None]).double().mean())
    report["standing_out"] = standing_out
    if standing_out > 0.01:
        warnings.warn(
            f"background: {standing_out:.1%} of the image stands out from the fitted lights by more than 5 times their residual "
            f"({', '.join(f'{v:.4f}' for v in spread.tolist())}): contact in the calibration image? take it again without",
            CalibrationWarning,
            stacklevel=2,
        )
    return calibration


def _scale_albedo(lights: PointLights, background: Tensor, sensor: Sensor) -> PointLights:
    """The albedo that makes the median of image / model one in each channel."""
    model = flat_image(lights, sensor.height, sensor.width, sensor.mm_per_pixel).detach()
    ratio = (background.to(model.dtype) ** sensor.gamma / model).flatten(1).median(dim=1).values
    return PointLights(lights.position_mm.detach(), torch.clamp_min(ratio, 1e-6))
