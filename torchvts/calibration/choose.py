"""The calibration that the given images allow: by presses, else by the sensor's prior, else by point lights."""

import dataclasses
from typing import NamedTuple

from torch import Tensor

from ..model.calibration import Calibration
from ..model.report import Report, Tried
from ..model.response_field import SensorPrior
from ..model.sensor import Sensor
from . import objections
from .by_lights import by_lights
from .by_presses import by_presses
from .contacts import Contact, NoUsablePress, used
from .field import Family
from .given_images import colourless
from .posterior import Evidence, prior_of
from .presses import Press
from .touching import with_contact

LEAST_USED = 0.5
"""Share of the presses that a prior must be able to use."""


class Given(NamedTuple):
    """The arguments of :func:`calibrate`, checked."""

    background: Tensor
    sensor: Sensor
    presses: list[Press]
    progress: bool
    force: bool


def choose(given: Given) -> Calibration:
    """The calibration; what was tried, and all doubts, are in its report.

    Raises:
        ValueError: none can be made.
    """
    if given.presses:
        unit, tried = _from_presses(given)
    elif given.sensor.prior is not None:
        unit, tried = _from_prior(given, given.sensor.prior)
    else:
        unit, lights = by_lights(given.background, given.sensor, given.progress)
        tried = [lights]
    unit, more = objections.to_background_of_lights(unit)
    report: Report = {**unit.report, "tried": tried}
    report["doubts"] = list(dict.fromkeys([doubt for one in tried for doubt in one["doubts"]] + more))
    if objection := objections.to_scale(report):
        report["objection"] = objection
    return dataclasses.replace(unit, report=report)


def _from_prior(given: Given, prior: SensorPrior) -> tuple[Calibration, list[Tried]]:
    """The prior of the sensor's type, transferred by the background: its posterior by no press."""
    background, sensor = given.background, given.sensor
    doubts = objections.to_background_of_prior(background, sensor)
    if doubts and (no_colour := colourless(background)):
        raise ValueError(no_colour)
    model = prior.response if sensor.blur_px == 0 else dataclasses.replace(prior.response, blur_px=sensor.blur_px)
    reason = "the sensor's prior, transferred to this unit by its background"
    report: Report = {"model": "response", "source": "prior", "reason": reason, "prior_deg": prior.expected_deg}
    if prior.own_deg is not None:
        report["own_deg"] = prior.own_deg
    if doubts:
        report["objection"] = "; ".join(doubts)
    family = Family.of(prior.response.field)
    covariance = Evidence(family, ()).posterior(prior_of(family, (), prior)).covariance
    unit = Calibration.from_response(model, sensor, background, report, covariance)
    return unit, [{"name": "prior", "error_deg": prior.expected_deg, "doubts": doubts}]


def _from_presses(given: Given) -> tuple[Calibration, list[Tried]]:
    """The posterior by presses, from the sensor's prior unless presses or background contradict it.

    Raises:
        ValueError: no press can be used, or they contradict the pitch or all diameters.
    """
    unit, contacts, tried, sizes = _fitted(given)
    assert unit.response is not None
    refused = sizes or objections.to_sizes(contacts, given.sensor.mm_per_pixel)
    refused = refused or objections.to_directions(unit.response.field, used(contacts))
    if refused and not given.force:
        raise ValueError(f"{refused}; force=True (--force) goes on all the same")
    by_prior = "prior_deg" in unit.report
    doubts = ([refused] if refused else []) + objections.to_contacts(contacts)
    apart = [] if refused or by_prior else objections.to_diameters_by_others(used(contacts))
    doubts += apart or ([] if refused else objections.to_deep_presses(contacts))
    if by_prior and not refused:
        doubts += objections.to_diameters_by_prior(used(contacts))
    tried[-1]["doubts"] += doubts
    report = unit.report.copy()
    if refused or apart:
        report["objection"] = refused or apart[0]
    return with_contact(dataclasses.replace(unit, report=report), given.presses, contacts), tried


def _fitted(given: Given) -> tuple[Calibration, list[Contact], list[Tried], str]:
    """The fit from the prior, if there is one; without it where presses or background contradict it, and that is better. Last
    comes why the prior contradicts all sizes, or "".

    Better is a fit that uses clearly more presses, or else has the lower held-out error. Without a held-out error it is the one
    from the prior: of one or two presses alone a field knows only their places.
    """
    background, sensor, presses, prior = given.background, given.sensor, given.presses, given.sensor.prior
    if prior is None:
        unit, contacts = by_presses(background, sensor, presses, None, given.progress)
        return unit, contacts, [_tried(unit, "presses")], ""
    strange = objections.to_background_of_prior(background, sensor)
    first: Calibration | None = None
    try:
        first, contacts = by_presses(background, sensor, presses, prior, given.progress)
    except NoUsablePress as error:
        contacts = error.contacts
    left, count = len(used(contacts)), len(contacts)
    contradiction = "the background does not have its pattern of light" if strange else ""
    if not contradiction and left < LEAST_USED * count:
        contradiction = f"by the prior only {left} of {count} presses can be used"
    sizes = "" if strange else objections.to_sizes_by_prior(contacts)
    by_prior: list[Tried] = [] if first is None else [_tried(first, "presses on the prior")]
    if by_prior:
        by_prior[0]["doubts"] += strange
    if first is not None and not contradiction:
        return first, contacts, by_prior, sizes
    try:
        second, others = by_presses(background, sensor.without_prior(), presses, None, given.progress)
    except NoUsablePress:
        if first is None:
            raise
        second = None
    if first is not None and (second is None or not _better(second, first)):
        return first, contacts, by_prior, sizes
    assert second is not None
    why = f"calibrated from {len(used(others))} presses without the sensor's prior: {contradiction}"
    report: Report = {**second.report, "reason": f"{second.report['reason']}; {why}"}
    alone = _tried(second, "presses")
    alone["doubts"] += [*strange, why]
    return dataclasses.replace(second, report=report), others, [*by_prior, alone], sizes if first is None else ""


def _tried(unit: Calibration, name: str) -> Tried:
    return {"name": name, "error_deg": unit.report["held_out_deg"], "doubts": []}


def _better(second: Calibration, first: Calibration) -> bool:
    """Whether the fit without a prior is to be taken."""
    more, fewer = (sum(row["used"] for row in unit.report["presses"]) for unit in (second, first))
    if fewer < LEAST_USED * more or more < LEAST_USED * fewer:
        return more > fewer
    error, by_prior = second.report["held_out_deg"], first.report["held_out_deg"]
    return error is not None and by_prior is not None and error < by_prior
