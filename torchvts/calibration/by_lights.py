"""Point lights of a unit: from the sensor file, or fitted to the background."""

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor

from ..model.calibration import Calibration
from ..model.lights import PointLights, flat_image
from ..model.report import CandidateRow, Report
from ..model.response_field import CHANGE_SCALE, ResponseField, ResponseModel
from ..model.sensor import Sensor
from .background import BackgroundPixels, misfit_of_paraboloid
from .lights import POORLY_CONSTRAINED_DEG, LightFit, fit_lights

GIVEN_MISFIT = 0.2
"""RMS of log(background / image of the sensor file's lights) from which they are not the unit's: only their directions are used."""

LARGE_MISFIT = 0.2
"""Misfit from which lights are no candidate beside another model."""

CLOSED_FORM_MISFIT = 0.1
"""Misfit of the closed-form lights from which no fit is tried beside another model. It is 0.125 to 0.20 on five real sensors; on
drawn rigs at most 0.07, with half of the corners' light lost 0.05."""

NOTHING_LEFT = 0.005
"""Misfit from which another gamma is tried where the sensor file leaves it open, and from which depth is not metric: it is at most
0.002 of lights as the model has them, 0.007 with 5 % less light in the corners, where depth is 12 % off."""

OTHER_GAMMA = 2.2
"""Of most cameras. Lights fitted to its images as if they were linear are 11 degrees off, and leave a misfit of 3 %."""


class LightsResult(NamedTuple):
    """What point lights gave.

    Attributes:
        unit: the calibrated unit; None where lights were not fitted, or the fit failed.
        row: how they did.
        direction_deg: standard deviation of the least certain light's direction, degrees; None where nothing was fitted.
        misfit: part of the background's light that they leave unexplained; None without lights.
        complaint: why not to trust them, or "".
    """

    unit: Calibration | None
    row: CandidateRow
    direction_deg: float | None
    misfit: float | None
    complaint: str


def by_lights(background: Tensor, sensor: Sensor, other_models: bool, progress: bool) -> LightsResult:
    """Calibrate by point lights.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit; where it gives the lights' positions, only the albedo is fitted.
        other_models: other models than lights exist, so lights that cannot win are not fitted, and those with a large misfit are
            not refined.
        progress: show a bar.
    Raises:
        ValueError: as :func:`fit_lights`.
    """
    if sensor.light_position_mm is not None:
        return _given(background, sensor, sensor.light_position_mm)
    if other_models and (objection := objection_to_lights(background, sensor)):
        row: CandidateRow = {"model": "point lights", "score_deg": None, "note": f"not fitted: {objection}"}
        return LightsResult(None, row, None, None, "")
    fit, linear = _fit(background, sensor, other_models, progress)
    loosest, misfit = float(fit.direction_std_deg.max()), float(fit.misfit.max())
    row = {
        "model": "point lights",
        "family": _family(fit),
        "gamma": linear.exponent,
        "parameters": 12,
        "passes": 2,
        "score_deg": None,
    }
    if fit.failed:
        return LightsResult(None, row | {"note": fit.message}, None, None, f"background: {fit.message}")
    constrained = f"one image constrains the lights to {loosest:.1f} deg, with a smooth misfit of {misfit:.1%}"
    row |= {"misfit": misfit, "note": constrained if fit.converged else fit.message}
    report: Report = {
        "model": "point_lights",
        "source": "background",
        "family": _family(fit),
        "converged": fit.converged,
        "message": fit.message,
        "steps": len(fit.loss_history),
        "loss": fit.loss_history[-1],
        "gamma": linear.exponent,
        "direction_std_deg": fit.direction_std_deg.tolist(),
        "position_std_mm": fit.position_std_mm.tolist(),
        "misfit": fit.misfit.tolist(),
        "inlier_fraction": fit.inlier_fraction,
        "gloss": fit.lights.gloss.tolist(),
    }
    complaint = "" if fit.converged and loosest <= POORLY_CONSTRAINED_DEG else f"background: {fit.message}"
    unit = Calibration.from_lights(fit.lights, linear, background, report)
    return LightsResult(unit, row, loosest if fit.converged else None, misfit, complaint)


def _family(fit: LightFit) -> str:
    return "three lights" + ", glossy skin" * fit.lights.glossy


def _fit(background: Tensor, sensor: Sensor, other_models: bool, progress: bool) -> tuple[LightFit, Sensor]:
    """Lights, and the sensor with the gamma that they were fitted with.

    A sparse image shows the gamma, and whether lights can win beside other models; those that can are fitted to the whole image.
    """
    linear = dataclasses.replace(sensor, gamma=sensor.exponent, prior=None)
    sparse, small = _sparse(background, linear, 60)
    fit = fit_lights(sparse, small, progress=progress)
    if sensor.gamma is None and float(fit.misfit.max()) > NOTHING_LEFT:
        other = fit_lights(sparse, dataclasses.replace(small, gamma=OTHER_GAMMA), progress=progress)
        if other.converged and other.loss_history[-1] < 0.5 * fit.loss_history[-1]:
            fit, linear = other, dataclasses.replace(linear, gamma=OTHER_GAMMA)
    if fit.failed or (other_models and not _can_win(fit, small.mm_per_pixel / sensor.mm_per_pixel)):
        return fit, linear
    return fit_lights(background, linear, progress=progress), linear


def _can_win(fit: LightFit, stride: float) -> bool:
    """Whether lights fitted to every ``stride``-th row and column may be good ones on all: noise is that much less there."""
    return float(fit.misfit.max()) <= LARGE_MISFIT and float(fit.direction_std_deg.max()) <= POORLY_CONSTRAINED_DEG * stride


def objection_to_lights(background: Tensor, sensor: Sensor) -> str:
    """Why point lights cannot explain a background, by their closed form on a sparse image and without any fit, or "".

    Fitted lights are chosen beside another model only if they leave next to nothing of the background. The closed form leaves
    more than they do, but not by orders: a lens that darkens the corners bends the fall-off of a light, it does not turn it
    over.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: both gammas are tried where it leaves gamma open.
    Example:
        >>> from torchvts.model.lights import PointLights, flat_image
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> image, sensor = flat_image(lights, 48, 64, 0.6).detach(), Sensor("rig", 48, 64, 0.6)
        >>> objection_to_lights(image, sensor), objection_to_lights(1.0 - image, sensor)
        ('', 'the background of G, B falls off as under no near point light')
    """
    objections = []
    for gamma in (sensor.exponent,) if sensor.gamma is not None else (1.0, OTHER_GAMMA):
        image, small = _sparse(background, dataclasses.replace(sensor, gamma=gamma, prior=None), 30)
        left, far = misfit_of_paraboloid(BackgroundPixels.of(image.detach().to(torch.float64).cpu(), small))
        if bool(far.any()):
            named = ", ".join(name for name, one in zip("RGB", far.tolist(), strict=True) if one)
            objections.append(f"the background of {named} falls off as under no near point light")
        elif float(left.max()) > CLOSED_FORM_MISFIT:
            objections.append(f"the closed-form lights leave a misfit of {float(left.max()):.0%} of the background")
        else:
            return ""
    return objections[0]


def _sparse(background: Tensor, sensor: Sensor, rows: int) -> tuple[Tensor, Sensor]:
    """Rows and columns at an odd stride, about ``rows`` rows, with the image centre kept in the middle."""
    stride = max(1, min(sensor.height, sensor.width) // rows) // 2 * 2 + 1
    row, column = _evenly(sensor.height, stride), _evenly(sensor.width, stride)
    pitch = stride * sensor.mm_per_pixel
    small = dataclasses.replace(
        sensor, height=len(row), width=len(column), mm_per_pixel=pitch, corners_px=None, roi_px=None, raw_size_px=()
    )
    return background[:, row[:, None], column[None, :]], small


def _evenly(size: int, stride: int) -> Tensor:
    """Every stride-th index, with equal margins at both ends."""
    steps = (size - 1) // stride
    steps -= (size - 1 - steps * stride) % 2
    return (size - 1 - steps * stride) // 2 + stride * torch.arange(steps + 1)


def _given(background: Tensor, sensor: Sensor, position_mm: tuple[tuple[float, float, float], ...]) -> LightsResult:
    """Lights at the positions of the sensor file."""
    lights = PointLights([list(row) for row in position_mm], [1.0, 1.0, 1.0])
    model = flat_image(lights, sensor.height, sensor.width, sensor.mm_per_pixel).detach()
    # the albedo that makes the median of image / model one in each channel
    albedo = (background.to(model.dtype) ** sensor.exponent / model).flatten(1).median(dim=1).values
    lights = PointLights(lights.position_mm.detach(), torch.clamp_min(albedo, 1e-6))
    family = "three lights at known positions"
    report: Report = {"model": "point_lights", "source": "sensor_file", "converged": True, "family": family}
    unit = Calibration.from_lights(lights, sensor, background, report)
    cell = max(1, min(sensor.height, sensor.width) // 30)
    log = [torch.nn.functional.avg_pool2d(i[None], cell).clamp_min(1e-3).log() for i in (unit.background, unit.model_image)]
    misfit = float((log[0] - log[1]).std(dim=(2, 3)).max())
    note = f"given by the sensor file; the background differs from them by {misfit:.1%} (RMS)"
    row: CandidateRow = {"model": "point lights", "family": family, "parameters": 3, "passes": 2, "score_deg": None}
    row |= {"misfit": misfit, "note": note}
    if misfit <= GIVEN_MISFIT:
        return LightsResult(unit, row, None, misfit, "")
    complaint = f"background: lights {note}: not this unit's lights, and depth is not metric"
    return LightsResult(_by_directions(background, sensor, position_mm, misfit), row, None, misfit, complaint)


def _by_directions(background: Tensor, sensor: Sensor, position_mm: tuple[tuple[float, ...], ...], misfit: float) -> Calibration:
    """A stand-in where the sensor file's lights do not look like the background: slope = - pinv(D) change, D being the lights'
    x / z and y / z. Shapes are right, but depth is only as right as the heights of the LEDs."""
    position = torch.tensor(position_mm, dtype=torch.float64)
    slope = -torch.linalg.pinv(position[:, :2] / position[:, 2:]) * CHANGE_SCALE
    field = ResponseField(0, -1, 0.5 * sensor.width * sensor.mm_per_pixel, tuple(tuple(line) for line in slope.tolist()))
    reason = f"directions of the sensor file's lights; as point lights they miss the background by {misfit:.0%}"
    model = ResponseModel(field, None, sensor.exponent, max(1.0, sensor.blur_px))
    return Calibration.from_response(model, sensor, background, {"model": "response", "source": "stand_in", "reason": reason})
