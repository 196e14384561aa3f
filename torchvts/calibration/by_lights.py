"""Point lights of a unit: from the sensor file, or fitted to the background."""

import dataclasses

import torch
from torch import Tensor

from ..core.levels import BLACK
from ..model.calibration import Calibration
from ..model.lights import PointLights, flat_image
from ..model.report import Report
from ..model.response_field import CHANGE_SCALE, ResponseField, ResponseModel
from ..model.sensor import Sensor
from .given_images import colourless
from .lights import NOTHING_LEFT, POORLY_CONSTRAINED_DEG, LightFit, fit_lights

GIVEN_MISFIT = 0.2
"""RMS of log(background / image of the sensor file's lights) from which they are not the unit's: only their directions are used."""

OTHER_GAMMA = 2.2
"""Of most cameras. Lights fitted to its images as if they were linear are 11 degrees off, and leave a misfit of 3 %."""


def by_lights(background: Tensor, sensor: Sensor, progress: bool = False) -> tuple[Calibration, list[str]]:
    """Calibrate by point lights, where there is neither a press nor a prior.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit; where it gives the lights' positions, only the albedo is fitted.
        progress: show a bar.
    Returns:
        The unit, and why its depth is not in mm, as far as that is known.
    Raises:
        ValueError: as :func:`fit_lights`; the fit failed, no lights of different colours are seen, or a channel is mostly black.
    """
    if sensor.light_position_mm is not None:
        return _given(background, sensor, sensor.light_position_mm)
    for name, share in zip("RGB", (background <= BLACK).flatten(1).double().mean(dim=1).tolist()):
        if share >= 0.5:
            raise ValueError(
                f"background: expected light in channel {name}, got one that is black in {share:.0%} of the image: an LED too "
                "weak, or a camera that cuts off dark values: light it, or give presses of a ball"
            )
    fit, linear = _fit(background, sensor, progress)
    if fit.failed:
        raise ValueError(
            f"background: {fit.message}; nothing else is there to calibrate from: give presses of balls, or a sensor with a prior"
        )
    loosest, misfit = float(fit.direction_std_deg.max()), float(fit.misfit.max())
    sure = fit.converged and loosest <= POORLY_CONSTRAINED_DEG
    if not (sure and misfit <= NOTHING_LEFT) and (no_colour := colourless(background)):
        raise ValueError(no_colour)
    constrained = f"one image constrains the lights to {loosest:.2f} deg, with a smooth misfit of {misfit:.1%}"
    report: Report = {
        "model": "point_lights",
        "source": "background",
        "reason": f"point lights: {constrained if fit.converged else fit.message}",
        "converged": fit.converged,
        "direction_std_deg": fit.direction_std_deg.tolist(),
        "misfit": fit.misfit.tolist(),
    }
    doubts = [] if sure else [f"background: {fit.message}"]
    return Calibration.from_lights(fit.lights, linear, background, report), doubts


def _fit(background: Tensor, sensor: Sensor, progress: bool) -> tuple[LightFit, Sensor]:
    """Lights, and the sensor with the gamma that they were fitted with: the image shows it where the sensor leaves it open."""
    linear = dataclasses.replace(sensor, gamma=sensor.exponent, prior=None)
    fit = fit_lights(background, linear, progress=progress)
    if sensor.gamma is None and float(fit.misfit.max()) > NOTHING_LEFT:
        curved = dataclasses.replace(linear, gamma=OTHER_GAMMA)
        other = fit_lights(background, curved, progress=progress)
        if other.converged and other.loss_history[-1] < 0.5 * fit.loss_history[-1]:
            return other, curved
    return fit, linear


def _given(
    background: Tensor, sensor: Sensor, position_mm: tuple[tuple[float, float, float], ...]
) -> tuple[Calibration, list[str]]:
    """Lights at the positions of the sensor file."""
    lights = PointLights([list(row) for row in position_mm], [1.0, 1.0, 1.0])
    model = flat_image(lights, sensor.height, sensor.width, sensor.mm_per_pixel).detach()
    # the albedo that makes the median of image / model one in each channel
    albedo = (background.to(model.dtype) ** sensor.exponent / model).flatten(1).median(dim=1).values
    lights = PointLights(lights.position_mm.detach(), torch.clamp_min(albedo, 1e-6))
    report: Report = {"model": "point_lights", "source": "sensor_file", "converged": True}
    unit = Calibration.from_lights(lights, sensor, background, report)
    cell = max(1, min(sensor.height, sensor.width) // 30)
    log = [torch.nn.functional.avg_pool2d(i[None], cell).clamp_min(1e-3).log() for i in (unit.background, unit.model_image)]
    misfit = float((log[0] - log[1]).std(dim=(2, 3)).max())
    note = f"given by the sensor file; the background differs from them by {misfit:.1%} (RMS)"
    if misfit > GIVEN_MISFIT:
        doubt = f"background: lights {note}: not this unit's lights, and depth is not metric: calibrate with presses of a ball"
        return _by_directions(background, sensor, position_mm, misfit), [doubt]
    unit = dataclasses.replace(unit, report={**unit.report, "reason": f"point lights: {note}"})
    return unit, [f"background: lights {note}: nothing has measured this unit's own: calibrate with presses of a ball"]


def _by_directions(background: Tensor, sensor: Sensor, position_mm: tuple[tuple[float, ...], ...], misfit: float) -> Calibration:
    """A stand-in where the sensor file's lights do not look like the background: slope = - pinv(D) change, D being the lights'
    x / z and y / z. Shapes are right, but depth is only as right as the heights of the LEDs."""
    position = torch.tensor(position_mm, dtype=torch.float64)
    slope = -torch.linalg.pinv(position[:, :2] / position[:, 2:]) * CHANGE_SCALE
    field = ResponseField(0, -1, 0.5 * sensor.width * sensor.mm_per_pixel, tuple(tuple(line) for line in slope.tolist()))
    reason = f"directions of the sensor file's lights; as point lights they miss the background by {misfit:.0%}"
    model = ResponseModel(field, None, sensor.exponent, max(1.0, sensor.blur_px))
    return Calibration.from_response(model, sensor, background, {"model": "response", "source": "stand_in", "reason": reason})
