"""Calibrate a unit by point lights: from the sensor file, or fitted to the background."""

from typing import NamedTuple

import torch
from torch import Tensor

from ..model.calibration import Calibration
from ..model.lights import PointLights, flat_image
from ..model.report import CandidateRow, Report
from ..model.response_field import CHANGE_SCALE, ResponseField, ResponseModel
from ..model.sensor import Sensor
from .light_choice import choose_lights, objection_to_lights

GIVEN_MISFIT = 0.2
"""RMS of log(background / image of the sensor file's lights) from which they are not the unit's: only their directions are used."""


class LightsResult(NamedTuple):
    """What point lights gave.

    Attributes:
        unit: the calibrated unit; None where the lights were not fitted or the fit failed.
        rows: the table of candidates, the chosen one first.
        complaint: why not to trust them, or "".
    """

    unit: Calibration | None
    rows: list[CandidateRow]
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
    objection = objection_to_lights(background, sensor) if other_models else ""
    if objection:
        note = f"not fitted: {objection}"
        return LightsResult(None, [{"model": "point lights", "family": "three lights", "score_deg": None, "note": note}], "")
    choice = choose_lights(background, sensor, other_models, progress)
    fit, row = choice.fit, choice.rows[0]
    if fit.failed:
        return LightsResult(None, choice.rows, f"background: {fit.message}")
    report: Report = {
        "model": "point_lights",
        "source": "background",
        "family": row["family"],
        "chosen_because": choice.reason,
        "converged": fit.converged,
        "message": fit.message,
        "steps": len(fit.loss_history),
        "loss": fit.loss_history[-1],
        "gamma": choice.sensor.exponent,
        "direction_std_deg": fit.direction_std_deg.tolist(),
        "position_std_mm": fit.position_std_mm.tolist(),
        "misfit": fit.misfit.tolist(),
        "inlier_fraction": fit.inlier_fraction,
        "gloss": fit.lights.gloss.tolist(),
        "vignetting": fit.vignetting,
        "ambient": fit.ambient.tolist(),
    }
    ambient = fit.ambient.clamp_min(0.0) if bool((fit.ambient > 0).any()) else None
    unit = Calibration.from_lights(fit.lights, choice.sensor, background, report, ambient)
    return LightsResult(unit, choice.rows, choice.complaint)


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
    row: CandidateRow = {
        "model": "point lights",
        "family": family,
        "parameters": 3,
        "passes": 2,
        "misfit": misfit,
        "score_deg": 0.0,
        "note": note,
    }
    complaint = "" if misfit < GIVEN_MISFIT else f"background: lights {note}: not this unit's lights, and depth is not metric"
    return LightsResult(unit, [row], complaint)


def by_light_directions(background: Tensor, sensor: Sensor, lights: LightsResult) -> Calibration | None:
    """A stand-in where the sensor file's lights do not look like the background: slope = - pinv(D) change, D being the lights'
    x / z and y / z. Shapes are right, but depth is only as right as the heights of the LEDs. None where the lights do.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit.
        lights: from :func:`by_lights`.
    """
    row = lights.rows[0]
    misfit = row.get("misfit")
    if sensor.light_position_mm is None or misfit is None or misfit <= GIVEN_MISFIT:
        return None
    position = torch.tensor(sensor.light_position_mm, dtype=torch.float64)
    slope = -torch.linalg.pinv(position[:, :2] / position[:, 2:]) * CHANGE_SCALE
    field = ResponseField(0, -1, 0.5 * sensor.width * sensor.mm_per_pixel, tuple(tuple(line) for line in slope.tolist()))
    reason = f"directions of the sensor file's lights; as point lights they miss the background by {misfit:.0%}"
    report: Report = {"model": "response", "source": "stand_in", "reason": reason, "candidates": lights.rows}
    model = ResponseModel(field, None, sensor.exponent, max(1.0, sensor.blur_px))
    return Calibration.from_response(model, sensor, background, report)
