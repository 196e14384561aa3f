"""Calibrate a unit: fit every model that the given images allow, and choose one."""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..core.checks import check_image, check_sequence, check_switch
from ..core.threads import OneThread
from ..model.calibration import Calibration
from ..model.report import CandidateRow, Report
from ..model.response_field import ResponseModel, SensorPrior, fit_log_background
from ..model.sensor import Sensor, check_sensor
from . import complaints
from .by_lights import LightsResult, by_light_directions, by_lights
from .by_presses import by_presses, error_of_lights_deg
from .by_touches import TouchResult, by_touches
from .complaints import CalibrationWarning
from .contacts import press_row, touch_row, used
from .given_images import sort_presses
from .light_choice import objection_to_lights
from .lights import POORLY_CONSTRAINED_DEG, check_exposure
from .pattern import compare_patterns
from .presses import Press, Touch, check_presses, check_touches
from .prior_choice import FromPresses, fit_with_or_without
from .prior_score import held_out_by_groups
from .refusals import check_colour, check_coloured_background, check_coloured_contacts
from .response_fit import Candidates
from .sizes import objection_to_sizes
from .touching import with_contact_share

WELL_CONSTRAINED_DEG = 2.0
"""Point lights replace a sensor's prior only if the image constrains each of them this well."""

PRIOR_CANDIDATES = Candidates(((2, 1, -1),), 60.0)
"""Chosen by other units: larger fields, and weakly regularised products, fit the unit of the presses better and others worse
(docs/decisions.md)."""

MOST_MISFIT = 0.02
"""Point lights explain a unit whose background they miss by less than this, smoothly. Where they miss more, as under extended or
scattered light, their normals may be right on balls, but undeformed skin seems deformed as soon as its light changes."""

TIE = 1.05
"""Point lights are preferred to response fields unless these are better by more than this factor."""


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
      were held out; point lights if they do better on the presses and explain the background. The balls are located
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
        eq. 6-8 of the paper for lights; the rest is this project's.
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
    check_colour(background)
    kept, left_out = sort_presses(background, named)
    given = _Given(background, sensor, kept, touched, progress, force)
    check_coloured_contacts(background, given.presses or given.touches)
    if not (kept or touched or sensor.prior or sensor.light_position_mm) and objection_to_lights(background, sensor):
        check_coloured_background(background)
    with OneThread(background[0].numel()):
        calibration, messages = _choose(given)
    for k, reason in left_out:
        calibration.report["presses"].insert(k, {"name": named[k].name, "used": False, "reason": reason})
    for message in [f"{named[k].name}: left out: {reason}" for k, reason in left_out] + messages:
        warnings.warn(message, CalibrationWarning, stacklevel=2)
    return calibration


def _choose(given: "_Given") -> tuple[Calibration, list[str]]:
    """The calibration, and what to warn of."""
    lights = by_lights(given.background, given.sensor, bool(given.presses or given.touches or given.sensor.prior), given.progress)
    prior = _prior(given)
    touched, more = _touched(given, prior.model)
    choose = _with_presses if given.presses else _without_presses
    calibration, last = choose(given, lights, prior, touched)
    return calibration, prior.complaints + more + last


def fit_prior(background: Tensor, sensor: Sensor, presses: Sequence[Press], source: str = "") -> SensorPrior:
    """Fit a prior for every unit of a sensor type to presses on one unit.

    Linear terms have degree 2, products degree 1. Products are strongly regularised, because otherwise they fit this unit
    better and others worse. ``held_out_deg`` of the result is the error on the balls of each diameter by those of the others, or
    on every fourth press by the rest; :func:`score_prior` measures it on other units.

    Args:
        background: as for :func:`calibrate`.
        sensor: as for :func:`calibrate`; its own prior is ignored.
        presses: as for :func:`calibrate`, at least one.
        source: whose images these are, kept with the prior.
    Raises:
        ValueError, TypeError: as :func:`calibrate`.
    Source:
        this project.
    """
    check_sensor("sensor", sensor)
    if not isinstance(source, str):
        raise TypeError(f"source: expected a text, got {type(source).__name__}")
    check_sequence("presses", presses, "Press")
    if len(presses) == 0:
        raise ValueError("presses: expected one or more, got none: a prior is fitted to presses")
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    named = check_presses(presses, sensor)
    kept, left_out = sort_presses(background, named)
    result = by_presses(background, sensor.without_prior(), kept, None, False, PRIOR_CANDIDATES)
    messages = [f"{named[k].name}: left out: {reason}" for k, reason in left_out]
    for message in messages + complaints.of_contacts(result.contacts):
        warnings.warn(message, CalibrationWarning, stacklevel=2)
    log_background = fit_log_background(result.unit.background, sensor.mm_per_pixel)
    half_mm = 0.5 * sensor.width * sensor.mm_per_pixel
    error = held_out_by_groups(used(result.contacts), PRIOR_CANDIDATES.families(half_mm)[0])
    return SensorPrior(result.fit.model, log_background, half_mm, source, () if error is None else (error,))


class _Given(NamedTuple):
    """The arguments of :func:`calibrate`, checked."""

    background: Tensor
    sensor: Sensor
    presses: list[Press]
    touches: list[Touch]
    progress: bool
    force: bool


class _Prior(NamedTuple):
    """The sensor's prior.

    Attributes:
        model: with the sensor's blur if it has one; None where the sensor has no prior.
        objection: why the background is not that of the prior's sensor type, or "".
        complaints: about the background, the objection and a contact among them.
        error_deg: mean error on presses and units that it was not fitted to, degrees; None where its file does not say.
    """

    model: ResponseModel | None
    objection: str
    complaints: list[str]
    error_deg: float | None = None


def _prior(given: _Given) -> _Prior:
    """The prior, and how the background fits it."""
    if given.sensor.prior is None:
        return _Prior(None, "", [])
    prior = given.sensor.prior.response
    if given.sensor.blur_px > 0:
        prior = dataclasses.replace(prior, blur_px=given.sensor.blur_px)
    match = compare_patterns(given.background, given.sensor)
    objection = complaints.of_pattern(match, given.sensor)
    found = complaints.of_background_with_prior(given.background, given.sensor, match)
    return _Prior(prior, objection, found, given.sensor.prior.expected_deg)


def _touched(given: _Given, prior: ResponseModel | None) -> tuple[TouchResult | None, list[str]]:
    """The model by touches, if it is wanted and possible, and complaints."""
    if not given.touches:
        return None, []
    if prior is not None:
        return None, ["touches: not used: they add nothing to the sensor's prior; press balls to improve on it"]
    try:
        result = by_touches(given.background, given.sensor, given.touches, given.presses)
    except ValueError as error:
        if not given.presses:
            raise
        return None, [f"{error}; using the presses alone"]
    return result, complaints.of_contacts(result.contacts)


def _without_presses(
    given: _Given, lights: LightsResult, prior: _Prior, touched: TouchResult | None
) -> tuple[Calibration, list[str]]:
    """The calibration by touches, the prior or point lights, and complaints."""
    row = lights.rows[0]
    if touched is not None:
        reason = f"{touched.row['note']}; point lights rejected: {row['note']}"
        report: Report = {
            "model": "response",
            "source": "touches",
            "reason": reason,
            "candidates": [*lights.rows, touched.row],
            "touches": [touch_row(contact) for contact in touched.contacts],
        }
        return Calibration.from_response(touched.model, given.sensor, given.background, report), []
    constrained = lights.unit is not None and _constrained(row)
    no_fitting_prior = prior.model is None or prior.objection != ""
    if no_fitting_prior and not constrained and not given.touches and given.sensor.light_position_mm is None:
        check_coloured_background(given.background)
    if prior.model is not None and not constrained:
        family = "response of the sensor type"
        candidate: CandidateRow = {"model": "prior", "family": family, "parameters": 0, "score_deg": None, "passes": 2}
        reason = f"the sensor's prior, transferred to this unit by its background; point lights rejected: {row['note']}"
        report = {"model": "response", "source": "prior", "reason": reason, "candidates": [*lights.rows, candidate]}
        report["prior_deg"] = prior.error_deg
        if prior.complaints:
            report["objection"] = "; ".join(prior.complaints)
        return Calibration.from_response(prior.model, given.sensor, given.background, report), []
    if lights.unit is None:
        raise ValueError(
            f"{lights.complaint or row['note']}; nothing else is there to calibrate from: give presses of balls, or a sensor with "
            "a prior"
        )
    if (stand_in := by_light_directions(given.background, given.sensor, lights)) is not None:
        return stand_in, [lights.complaint]
    fitted = constrained and row["score_deg"] != 0.0  # it is 0 for lights that the sensor file gives
    reason = f"the image constrains the lights to {row['score_deg']:.2f} deg" if fitted else row["note"]
    if len(lights.rows) > 1:
        reason += f"; {lights.unit.report['chosen_because']}"
    report = {**lights.unit.report, "reason": f"point lights: {reason}", "candidates": lights.rows}
    unit, found = complaints.of_background_by_lights(dataclasses.replace(lights.unit, report=report))
    return unit, [lights.complaint] * bool(lights.complaint) + found


def _constrained(row: CandidateRow) -> bool:
    """Whether the image constrains the lights so well that they replace a prior."""
    score = row.get("score_deg")
    return score is not None and score <= WELL_CONSTRAINED_DEG and _explained(row)


def _explained(row: CandidateRow) -> bool:
    """Whether point lights give the light of the background."""
    misfit = row.get("misfit")
    return misfit is not None and misfit < MOST_MISFIT


def _fit_presses(given: _Given, prior: _Prior, touched: TouchResult | None) -> FromPresses:
    """The response fit, from the prior unless it is contradicted, or from touches.

    Raises:
        NoUsablePress: none can be used.
    """
    background, sensor, presses = given.background, given.sensor, given.presses
    if prior.model is not None and touched is None:
        return fit_with_or_without(background, sensor, presses, prior.model, prior.objection, given.progress)
    start = None if touched is None else touched.model
    return FromPresses(by_presses(background, sensor, presses, start, given.progress), "")


def _with_presses(given: _Given, lights: LightsResult, prior: _Prior, touched: TouchResult | None) -> tuple[Calibration, list[str]]:
    """The calibration by response fields or by point lights, whichever is better on the presses, and complaints."""
    (fit, contacts, unit), dropped, by_prior = _fit_presses(given, prior, touched)
    sizes = by_prior or objection_to_sizes(contacts, given.sensor.mm_per_pixel)
    if sizes and not given.force:
        raise ValueError(f"{sizes}; force=True (--force) goes on all the same")
    balls, row = used(contacts), lights.rows[0]
    if lights.unit is not None:
        row["score_deg"] = error_of_lights_deg(lights.unit, given.presses, contacts, unit.sensor.blur_px)
    error_deg = math.inf if lights.unit is None or row["score_deg"] is None else row["score_deg"]
    from_presses_alone = (prior.model is None or bool(dropped)) and touched is None
    found = [text for text in (dropped, sizes) if text] + complaints.of_contacts(contacts)
    if not from_presses_alone and not sizes:
        found += complaints.of_diameters_by_prior(balls)
    # twelve parameters that do about as well as a hundred are the better model
    as_good = error_deg < (math.inf if fit.error_deg is None else TIE * fit.error_deg) and error_deg < POORLY_CONSTRAINED_DEG
    known = given.sensor.light_position_mm is not None  # they explain it where nothing is complained of
    lights_win = as_good and (not lights.complaint if known else _explained(row))
    if lights_win and lights.unit is not None:
        other = "too few presses for a response field" if fit.error_deg is None else f"response fields {fit.error_deg:.2f}"
        report = lights.unit.report.copy()
        report["reason"] = f"point lights: on {len(balls)} presses their normals are {error_deg:.2f} deg off, {other}"
    else:
        if math.isfinite(error_deg):
            row["note"] = f"rejected: on {len(balls)} presses their normals are {error_deg:.1f} deg off; {row['note']}"
        reason = f"{fit.reason}; {dropped}" if dropped else fit.reason
        report = {"model": "response", "source": "presses", "reason": reason, "held_out_deg": fit.error_deg}
        if fit.own_deg is not None:
            report["own_deg"] = fit.own_deg
        if prior.model is not None and not from_presses_alone:
            report["prior_deg"] = prior.error_deg
    report["candidates"] = [*lights.rows, *([] if touched is None else [touched.row]), *fit.candidates]
    report["presses"] = [press_row(contact, given.sensor) for contact in contacts]
    if touched is not None:
        report["touches"] = [touch_row(contact) for contact in touched.contacts]
    if not lights_win or lights.unit is None:
        return with_contact_share(dataclasses.replace(unit, report=report), given.presses, contacts), found
    unit, more = complaints.of_background_by_lights(dataclasses.replace(lights.unit, report=report))
    return with_contact_share(unit, given.presses, contacts), found + more
