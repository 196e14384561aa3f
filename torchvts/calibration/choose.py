"""The calibration that the given images allow: by presses, else by the sensor's prior, else by point lights."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..model.calibration import Calibration
from ..model.report import Report, Tried
from ..model.response_field import SensorPrior
from ..model.sensor import Sensor
from . import resting
from .by_lights import by_lights
from .contacts import Contact, NoUsablePress, used
from .doubts import SURE, Doubt, not_checked, of_error, of_fitted_lights, of_presses, of_sizes, of_type, too_wide, width_of
from .field import Family
from .given_images import colourless
from .posterior import Evidence, prior_of, weights_of
from .press_model import by_presses
from .presses import Press
from .touching import with_contact

LEAST_USED = 0.25
"""Share of the presses that must count by a prior, else it is of another type: all are two standard deviations off it."""


class Given(NamedTuple):
    """The arguments of :func:`calibrate`, checked."""

    background: Tensor
    sensor: Sensor
    presses: list[Press]
    progress: bool
    force: bool


class Made(NamedTuple):
    """A calibration, what speaks against it, and models that were made before it and not taken."""

    unit: Calibration
    doubts: list[Doubt]
    name: str
    before: Sequence[Tried] = ()


def choose(given: Given) -> Calibration:
    """The calibration; what was tried, and all doubts, are in its report.

    Raises:
        ValueError: none can be made.
    """
    if given.presses:
        made = _from_presses(given)
    elif given.sensor.prior is not None:
        made = _from_prior(given.background, given.sensor, given.sensor.prior)
    else:
        made = _from_lights(given)
    texts = list(dict.fromkeys(doubt.text for doubt in made.doubts))
    of_scale = list(dict.fromkeys(doubt.text for doubt in made.doubts if doubt.of_scale))
    report: Report = {**made.unit.report, "tried": [*made.before, _tried(made)], "doubts": texts, "not_metric": of_scale}
    return dataclasses.replace(made.unit, report=report)


def _tried(made: Made) -> Tried:
    report = made.unit.report
    spread = report.get("direction_std_deg") if report.get("converged") else None
    error = report.get("held_out_deg") or report.get("prior_deg") or (max(spread) if spread else None)
    return {"name": made.name, "error_deg": error, "doubts": [doubt.text for doubt in made.doubts]}


def _from_lights(given: Given) -> Made:
    unit, found = by_lights(given.background, given.sensor, given.progress)
    doubts = [Doubt(text, True) for text in found]
    if unit.report["source"] == "background":
        doubts += of_fitted_lights(unit)
    return Made(unit, doubts, "point lights")


def _from_prior(background: Tensor, sensor: Sensor, prior: SensorPrior) -> Made:
    """The prior of the sensor's type, transferred by the background: its posterior by no press."""
    doubts = of_type(background, sensor)
    if doubts and (no_colour := colourless(background)):
        raise ValueError(no_colour)
    model = prior.response if sensor.blur_px == 0 else dataclasses.replace(prior.response, blur_px=sensor.blur_px)
    reason = "the sensor's prior, transferred to this unit by its background"
    report: Report = {"model": "response", "source": "prior", "reason": reason, "prior_deg": prior.expected_deg}
    if prior.own_deg is not None:
        report["own_deg"] = prior.own_deg
    if prior.expected_deg is not None:
        report["stated_deg"] = prior.expected_deg
    family = Family.of(prior.response.field)
    covariance = Evidence(family, ()).posterior(prior_of(family, (), prior)).covariance
    unit = Calibration.from_response(model, sensor, background, report, covariance)
    if not doubts and (contact := resting.read_as_frame(unit)):
        doubts = [Doubt(contact, True)]
    return Made(unit, doubts, "prior")


def _from_presses(given: Given) -> Made:
    """The posterior by presses, from the sensor's prior unless presses or background contradict it.

    Raises:
        ValueError: no press can be used, or contacts are wider than their balls.
    """
    contact = resting.beside_presses(given.background, given.presses)
    strange = of_type(given.background, given.sensor) if given.sensor.prior is not None else []
    try:
        made, contacts = _fitted(given, strange)
    except NoUsablePress as error:
        causes = [contact] * bool(contact) + [doubt.text for doubt in strange]
        if not causes:
            raise
        raise ValueError("; ".join([*causes, str(error)])) from error
    unit = made.unit
    assert unit.response is not None
    if strange and "prior_deg" in unit.report:  # whatever presses seem to be by the prior of another view follows from that
        doubts = [Doubt(contact, True)] * bool(contact) + strange
        return made._replace(unit=with_contact(unit, given.presses, contacts)[0], doubts=doubts)
    field, pitch_mm = unit.response.field, given.sensor.mm_per_pixel
    width = width_of(field, used(contacts), pitch_mm)
    if width.times > 1.0 + SURE * width.std and not given.force:
        raise ValueError(f"{too_wide(width, pitch_mm)}; force=True (--force) goes on all the same")
    doubts = [*made.doubts, *of_presses(contacts, field, pitch_mm, width), *of_error(unit.report["stated_deg"], contacts)]
    if contact:
        doubts.insert(0, Doubt(contact, True))
    unit, depth_mm = with_contact(unit, given.presses, contacts)
    if not any(doubt.of_scale for doubt in doubts):
        sensor = given.sensor if "prior_deg" in unit.report else given.sensor.without_prior()
        doubts.append(not_checked(contacts, sensor, width, depth_mm))
    return made._replace(unit=unit, doubts=doubts)


def _fitted(given: Given, strange: list[Doubt]) -> tuple[Made, list[Contact]]:
    """The fit from the prior, if there is one; without it where presses or background contradict it, and that is better.

    Better is a fit that uses clearly more presses, or else has the lower held-out error. Without a held-out error it is the one
    from the prior: of one or two presses alone a field knows only their places. ``strange``: what :func:`of_type` says.
    """
    background, sensor, presses, prior = given.background, given.sensor, given.presses, given.sensor.prior
    if prior is None:
        unit, contacts = by_presses(background, sensor, presses, None, given.progress)
        return Made(unit, [], "presses"), contacts
    on_prior: Calibration | None = None
    try:
        on_prior, contacts = by_presses(background, sensor, presses, prior, given.progress)
    except NoUsablePress as error:
        contacts = error.contacts
    sizes = [] if strange else of_sizes(contacts, sensor.mm_per_pixel)
    first = None if on_prior is None else Made(on_prior, strange + sizes, "presses on the prior")
    left, count = float(weights_of(used(contacts)).sum()), len(contacts)
    contradiction = "the background does not have its pattern of light" if strange else ""
    if not contradiction and left < LEAST_USED * count:
        reasons = "; ".join(f"{contact.name}: {contact.reason}" for contact in contacts if contact.reason)
        contradiction = f"by the prior only {left:.1f} of {count} presses can be used" + (f" ({reasons})" if reasons else "")
    if not contradiction and sizes:
        contradiction = "by the prior all sizes are wrong"
    if first is not None and not contradiction:
        return first, contacts
    try:
        second, others = by_presses(background, sensor.without_prior(), presses, None, given.progress)
    except NoUsablePress:
        if first is None:
            raise
        return first, contacts
    if first is not None and not _better(second, first.unit):
        return first, contacts
    why = f"calibrated from {len(used(others))} presses without the sensor's prior: {contradiction}"
    report: Report = {**second.report, "reason": f"{second.report['reason']}; {why}"}
    doubts = [*(Doubt(doubt.text) for doubt in strange), Doubt(why), *sizes]
    before = [] if first is None else [_tried(first)]
    return Made(dataclasses.replace(second, report=report), doubts, "presses", before), others


def _better(second: Calibration, first: Calibration) -> bool:
    """Whether the fit without a prior is to be taken."""
    more, fewer = (sum(row["weight"] for row in unit.report["presses"]) for unit in (second, first))
    if fewer < LEAST_USED * more or more < LEAST_USED * fewer:
        return more > fewer
    error, by_prior = second.report["held_out_deg"], first.report["held_out_deg"]
    return error is not None and by_prior is not None and error < by_prior
