"""The calibrations that given images allow, each with what speaks against it."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from ..model.calibration import Calibration
from ..model.report import CandidateRow, Report
from ..model.sensor import Sensor
from . import objections
from .by_lights import LightsResult, by_lights
from .by_presses import PressResult, by_presses, error_of_lights_deg
from .by_touches import by_touches
from .contacts import NoUsablePress, press_row, touch_row, used
from .given_images import colourless
from .lights import POORLY_CONSTRAINED_DEG
from .presses import Press, Touch
from .touching import with_contact

WELL_CONSTRAINED_DEG = 2.0
"""Point lights replace a sensor's prior only if the image constrains each of them this well."""

MOST_MISFIT = 0.02
"""Point lights explain a unit whose background they miss by less than this, smoothly. Where they miss more, as under extended or
scattered light, their normals may be right on balls, but undeformed skin seems deformed as soon as its light changes."""

TIE = 1.05
"""Point lights are preferred to response fields unless these are better by more than this factor: twelve parameters that do about
as well as a hundred are the better model."""

LEAST_USED = 0.5
"""Share of the presses that a prior must be able to use."""


class Given(NamedTuple):
    """The arguments of :func:`calibrate`, checked."""

    background: Tensor
    sensor: Sensor
    presses: list[Press]
    touches: list[Touch]
    progress: bool
    force: bool


@dataclass(frozen=True, eq=False)
class Candidate:
    """A calibration that can be taken, or why not.

    Attributes:
        unit: the calibration; None where it could not be made.
        error_deg: error of its normals or lights, as far as it is known, degrees.
        objection: why it is not taken, or "".
        warnings: what to say of what was given.
        rows: the models that were tried for it; with presses point lights are one of them.
    """

    unit: Calibration | None = None
    error_deg: float | None = None
    objection: str = ""
    warnings: tuple[str, ...] = ()
    rows: tuple[CandidateRow, ...] = ()


def from_lights(given: Given) -> Candidate:
    """Point lights; objected to unless the image constrains them well and they explain it."""
    result = by_lights(given.background, given.sensor, bool(given.presses or given.touches or given.sensor.prior), given.progress)
    warnings = (result.complaint,) if result.complaint else ()
    loose = result.direction_deg is not None and result.direction_deg > WELL_CONSTRAINED_DEG
    objection = result.row["note"] if result.unit is None or warnings or loose or not _explained(result) else ""
    unit = result.unit
    if unit is not None and "reason" not in unit.report:
        constrained = f"the image constrains the lights to {result.direction_deg or 0.0:.2f} deg"
        reason = result.row["note"] if objection or result.direction_deg is None else constrained
        unit = dataclasses.replace(unit, report={**unit.report, "reason": f"point lights: {reason}"})
    return Candidate(unit, result.direction_deg, objection, warnings, (result.row,))


def _explained(result: LightsResult) -> bool:
    """Whether point lights give the light of the background."""
    return result.misfit is not None and result.misfit < MOST_MISFIT


def doubtful(given: Given, lights: Candidate) -> Candidate:
    """Lights that were objected to, where nothing else is left: with a warning, unless the light has no colours."""
    objection = colourless(given.background) if given.sensor.light_position_mm is None else ""
    if not objection and lights.unit is None:
        remedy = "nothing else is there to calibrate from: give presses of balls, or a sensor with a prior"
        objection = f"{lights.objection}; {remedy}"
    return dataclasses.replace(lights, objection=objection)


def from_prior(given: Given) -> Candidate:
    """The prior of the sensor's type, transferred by the background."""
    prior = given.sensor.prior
    if prior is None:
        return Candidate(objection="the sensor has no prior")
    model, blur_px = prior.response, given.sensor.blur_px
    if blur_px > 0:
        model = dataclasses.replace(model, blur_px=blur_px)
    found = objections.to_background_of_prior(given.background, given.sensor)
    if found and not (given.presses or given.touches) and (no_colour := colourless(given.background)):
        return Candidate(objection=no_colour)
    row: CandidateRow = {"model": "prior", "family": "response of the sensor type", "parameters": 0, "passes": 2, "score_deg": None}
    reason = "the sensor's prior, transferred to this unit by its background"
    report: Report = {"model": "response", "source": "prior", "reason": reason, "prior_deg": prior.expected_deg}
    if found:
        report["objection"] = "; ".join(found)
    unit = Calibration.from_response(model, given.sensor, given.background, report)
    return Candidate(unit, prior.expected_deg, "", tuple(found), (row,))


def from_touches(given: Given) -> Candidate:
    """A response field by touches. They add nothing to a prior, so beside one they are not used."""
    if not given.touches:
        return Candidate(objection="no touches")
    if given.sensor.prior is not None:
        text = "touches: not used: they add nothing to the sensor's prior; press balls to improve on it"
        return Candidate(objection=text, warnings=(text,))
    try:
        result = by_touches(given.background, given.sensor, given.touches, given.presses)
    except ValueError as error:
        if not given.presses:
            raise
        return Candidate(objection=str(error), warnings=(f"{error}; using the presses alone",))
    report: Report = {"model": "response", "source": "touches", "reason": result.row["note"]}
    report["touches"] = [touch_row(contact) for contact in result.contacts]
    unit = Calibration.from_response(result.model, given.sensor, given.background, report)
    return Candidate(unit, None, "", tuple(objections.to_contacts(result.contacts)), (result.row,))


class _Fit(NamedTuple):
    """A response fitted to presses; ``dropped``: why it does not start from the prior, ``sizes``: why sizes are wrong; or ""."""

    result: PressResult
    dropped: str = ""
    sizes: str = ""


def from_presses(given: Given, lights: Candidate, prior: Candidate, touches: Candidate) -> Candidate:
    """Response fields by presses, or point lights where these do as well on the balls and explain the background.

    Raises:
        ValueError: no press can be used, or they contradict the pitch or all diameters.
    """
    if not given.presses:
        return Candidate(objection="no presses")
    start = prior if prior.unit is not None else touches
    (fit, contacts, unit), dropped, sizes = _fitted(given, start)
    refused = sizes or objections.to_sizes(contacts, given.sensor.mm_per_pixel)
    refused = refused or objections.to_directions(fit.model.field, used(contacts))
    if refused and not given.force:
        raise ValueError(f"{refused}; force=True (--force) goes on all the same")
    from_prior = start is prior and not dropped
    warnings = [text for text in (dropped, refused) if text] + objections.to_contacts(contacts)
    doubts = [] if refused or from_prior else objections.to_diameters_by_others(used(contacts))
    warnings += doubts or ([] if refused else objections.to_deep_presses(contacts))
    if from_prior and not refused:
        warnings += objections.to_diameters_by_prior(used(contacts))
    report: Report = {"model": "response", "source": "presses", "held_out_deg": fit.error_deg}
    report["reason"] = f"{fit.reason}; {dropped}" if dropped else fit.reason
    if fit.own_deg is not None:
        report["own_deg"] = fit.own_deg
    if from_prior:
        report["prior_deg"] = prior.error_deg
    row, error_deg = lights.rows[0], fit.error_deg
    if lights.unit is not None and lights.unit.lights is not None:
        of_lights_deg = error_of_lights_deg(lights.unit, given.presses, contacts, unit.sensor.blur_px)
        row = {**row, "score_deg": of_lights_deg}
        if of_lights_deg is not None and _lights_do(lights, of_lights_deg, fit.error_deg):
            other = "too few presses for a response field" if fit.error_deg is None else f"response fields {fit.error_deg:.2f}"
            reason = f"point lights: on {len(used(contacts))} presses their normals are {of_lights_deg:.2f} deg off, {other}"
            unit, error_deg, report = lights.unit, of_lights_deg, {**lights.unit.report, "reason": reason}
        elif of_lights_deg is not None:
            row["note"] = f"rejected: on {len(used(contacts))} presses their normals are {of_lights_deg:.1f} deg off; {row['note']}"
    report["presses"] = [press_row(contact, given.sensor) for contact in contacts]
    if refused or doubts:
        report["objection"] = refused or doubts[0]
    if touches.unit is not None:
        report["touches"] = touches.unit.report["touches"]
    unit = with_contact(dataclasses.replace(unit, report=report), given.presses, contacts)
    return Candidate(unit, error_deg, "", tuple(warnings), (row, *fit.candidates))


def _lights_do(lights: Candidate, error_deg: float, of_fields_deg: float | None) -> bool:
    """Whether point lights are about as good on balls as fields, and explain the background."""
    assert lights.unit is not None
    known = lights.unit.report["source"] == "sensor_file"  # they explain it where nothing is complained of
    explained = not lights.warnings if known else lights.rows[0].get("misfit", MOST_MISFIT) < MOST_MISFIT
    as_good = of_fields_deg is None or error_deg < TIE * of_fields_deg
    return explained and as_good and error_deg < POORLY_CONSTRAINED_DEG


def _fitted(given: Given, start: Candidate) -> _Fit:
    """The fit from a prior or touches; without the prior where presses or background contradict it, and that is better.

    Better is a fit that uses clearly more presses, or else has the lower held-out error. Without a held-out error it is the one
    from the prior: of one or two presses alone a field knows only their places.
    """
    background, sensor, presses = given.background, given.sensor, given.presses
    if start.unit is None or start.unit.report["source"] != "prior":
        model = None if start.unit is None else start.unit.response
        return _Fit(by_presses(background, sensor, presses, model, given.progress))
    first: PressResult | None = None
    try:
        first = by_presses(background, sensor, presses, start.unit.response, given.progress)
        contacts = first.contacts
    except NoUsablePress as error:
        contacts = error.contacts
    unlike = "objection" in start.unit.report
    count, left = len(contacts), len(used(contacts))
    contradiction = "the background does not have its pattern of light" if unlike else ""
    if not contradiction and left < LEAST_USED * count:
        contradiction = f"by the prior only {left} of {count} presses can be used"
    sizes = "" if unlike else objections.to_sizes_by_prior(contacts)
    if first is not None and not contradiction:
        return _Fit(first, "", sizes)
    try:
        second = by_presses(background, sensor.without_prior(), presses, None, given.progress)
    except NoUsablePress:
        if first is None:
            raise
        return _Fit(first, "", sizes)
    if first is not None and not _better(second, first):
        return _Fit(first, "", sizes)
    why = f"calibrated from {len(used(second.contacts))} presses without the sensor's prior: {contradiction}"
    return _Fit(second, why, sizes)


def _better(second: PressResult, first: PressResult) -> bool:
    """Whether the fit without a prior is to be taken."""
    more, fewer = len(used(second.contacts)), len(used(first.contacts))
    if fewer < LEAST_USED * more or more < LEAST_USED * fewer:
        return more > fewer
    if second.fit.error_deg is None or first.fit.error_deg is None:
        return False
    return second.fit.error_deg < first.fit.error_deg
