"""Calibrate a unit: make every calibration that the given images allow, and choose one."""

import dataclasses
import warnings
from collections.abc import Sequence

from torch import Tensor

from ..core.checks import check_image, check_switch
from ..core.threads import OneThread
from ..model.calibration import Calibration
from ..model.report import CandidateRow, Report
from ..model.sensor import Sensor, check_sensor
from . import objections
from .candidates import Candidate, Given, doubtful, from_lights, from_presses, from_prior, from_touches
from .given_images import check_exposure, check_light, sort_presses
from .objections import CalibrationWarning
from .presses import Press, Touch, check_presses, check_touches


def calibrate(
    background: Tensor,
    sensor: Sensor,
    presses: Sequence[Press] = (),
    touches: Sequence[Touch | Tensor] = (),
    *,
    progress: bool = False,
    force: bool = False,
) -> Calibration:
    """Calibrate a unit from one image without contact, and what else there is: presses of balls, touches by any object.

    A model is either three point lights or a response field (docs/conventions.md). Which one depends on what is given:

    * An image alone: the sensor's prior, which is the response field of its type, applied to this unit's background, unless the
      image constrains point lights well. Without a prior point lights, and a warning where they are poorly constrained. Of lights
      that the sensor file gives and that do not look like the image only the directions are used, with a warning: depth is then
      not metric.
    * Presses: response fields, starting from the prior if there is one, their size chosen by the error of normals on presses that
      were held out; point lights if they do as well to 5 % and explain the background. The balls are located
      automatically.
    * Touches: a response field whose slopes have the least curl, with its scale from presses or a known depth. They add nothing
      to a prior, so with one they are not used.

    Args:
        background: (3, H, W) in [0, 1], R, G, B, of the sensor's size.
        sensor: the sensor; its gamma is chosen where it is left open.
        presses: images of balls pressed anywhere; centers need not be known.
        touches: images of unknown objects, or :class:`Touch` with the depth, if that is known.
        progress: show a bar.
        force: go on where the presses contradict the pitch or all diameters; that is then a warning.
    Returns:
        A :class:`Calibration`. Its ``report`` (:class:`torchvts.model.report.Report`) says which model was chosen and why, and
        what became of each press.
    Raises:
        ValueError, TypeError: bad image: shape, dtype, range, black, saturated, greyscale; a sensor without coloured lights;
            presses or touches of which none can be used; presses that are turned, mirrored, cropped or swapped otherwise than the
            background, of another unit, or 12 bits stored in 16; contacts too wide for their balls, or balls of
            another size than given, all alike, by the sensor's prior; with presses, a background that holds a contact; touches that
            do not constrain a field, or have no scale; nothing but lights to calibrate from, and their fit failed.
    Warns:
        CalibrationWarning: what was left out and why; the fit did not converge, the image does not constrain the lights, it
            seems to hold a contact, or it does not have the pattern of light of the prior's sensor type. Presses then decide
            whether the prior is used.
    Source:
        eq. 6-8 of the paper for lights.
    Example:
        >>> from torchvts.model.lights import PointLights, flat_image
        >>> sensor = Sensor(name="rig", height=48, width=64, mm_per_pixel=0.6)
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> calibrate(flat_image(lights, 48, 64, 0.6).detach(), sensor).report["model"]
        'point_lights'
    """
    check_sensor("sensor", sensor)
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_exposure(background)
    check_switch("progress", progress)
    check_switch("force", force)
    named, touched = check_presses(presses, sensor), check_touches(touches, sensor)
    kept, left_out = sort_presses(background, named)
    check_light(background, kept or touched)
    with OneThread(background[0].numel()):
        calibration, found = choose(Given(background, sensor, kept, touched, progress, force))
    for k, reason in left_out:
        calibration.report["presses"].insert(k, {"name": named[k].name, "used": False, "reason": reason})
    for message in [f"{named[k].name}: left out: {reason}" for k, reason in left_out] + found:
        warnings.warn(message, CalibrationWarning, stacklevel=2)
    return calibration


def choose(given: Given) -> tuple[Calibration, list[str]]:
    """The first calibration that is not refused, and what to warn of; that by presses has compared lights with fields.

    Raises:
        ValueError: none can be made.
    """
    lights, prior, touches = from_lights(given), from_prior(given), from_touches(given)
    presses = from_presses(given, lights, prior, touches)
    order = (presses, touches, lights, prior, doubtful(given, lights))
    chosen = next((candidate for candidate in order if not candidate.objection), order[-1])
    tried = (presses if presses.rows else lights, touches, prior)
    return _taken(chosen, [row for candidate in tried for row in candidate.rows], [*prior.warnings, *touches.warnings])


def _taken(chosen: Candidate, tried: list[CandidateRow], found: list[str]) -> tuple[Calibration, list[str]]:
    """The chosen calibration, with all that was tried in its report, and what to warn of."""
    if chosen.unit is None or chosen.objection:
        raise ValueError(chosen.objection)
    unit, more = objections.to_background_of_lights(chosen.unit)
    report: Report = {**unit.report, "candidates": tried}
    if objection := objections.to_scale(report):
        report["objection"] = objection
    unit = dataclasses.replace(unit, report=report)
    return unit, list(dict.fromkeys([*found, *chosen.warnings, *more]))
