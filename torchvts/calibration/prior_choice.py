"""Presses beside a prior: fit from the prior, and where presses or background contradict it, without it, too."""

import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..model.response_field import ResponseModel
from ..model.sensor import Sensor
from .by_presses import PressResult, by_presses
from .contacts import Contact, used
from .presses import Press
from .refusals import NoUsablePress

LEAST_USED = 0.5
"""Share of the presses that a prior must be able to use."""

SAME_FACTOR = 1.15
"""Presses whose slopes by the prior are those of the balls times one factor, to within this one, have a wrong diameter or pitch."""


class FromPresses(NamedTuple):
    """A fit to presses, and whether it starts from the prior.

    Attributes:
        result: the fit.
        dropped: why the prior was left out, or "".
    """

    result: PressResult
    dropped: str


def fit_with_or_without(
    background: Tensor, sensor: Sensor, presses: Sequence[Press], prior: ResponseModel, objection: str, progress: bool
) -> FromPresses:
    """Fit presses from a prior, and without it where they or the background contradict it; take the better one.

    The better one uses clearly more presses, or else has the lower held-out error. Without a held-out error, the fit without the
    prior is taken where the background contradicts the prior.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit.
        presses: of balls.
        prior: fields of the sensor's type.
        objection: what the background has against the prior, or "".
        progress: show a bar.
    Raises:
        NoUsablePress: with the prior and without it, or all diameters are wrong by the same factor.
    """
    try:
        first: PressResult | None = by_presses(background, sensor, presses, prior, progress)
        failure = None
    except NoUsablePress as error:
        first, failure = None, error
    contradiction = objection or _objection_of_presses(first, failure)
    if first is not None and not contradiction:
        return FromPresses(first, "")
    if failure is not None and not objection and _same_factor(failure.contacts):
        raise failure
    try:
        second = by_presses(background, sensor.without_prior(), presses, None, progress)
    except NoUsablePress as error:
        if first is None:
            raise error from failure
        return FromPresses(first, "")
    if first is not None and not _better(second, first, bool(objection)):
        return FromPresses(first, "")
    count = len(used(second.contacts))
    why = "the background does not have its pattern of light" if objection else contradiction
    return FromPresses(second, f"calibrated from {count} presses without the sensor's prior: {why}")


def _objection_of_presses(first: PressResult | None, failure: NoUsablePress | None) -> str:
    """What presses have against the prior, or ""."""
    contacts = first.contacts if first is not None else failure.contacts if failure is not None else []
    left = len(used(contacts))
    if left >= LEAST_USED * len(contacts):
        return ""
    return f"by the prior only {left} of {len(contacts)} presses can be used"


def _same_factor(contacts: Sequence[Contact]) -> bool:
    """Whether all presses were located, with slopes by the prior that are the balls' times one factor."""
    logs = [math.log(max(contact.metrics["gain"], 1e-3)) for contact in contacts if "gain" in contact.metrics]
    if not logs or len(logs) < LEAST_USED * len(contacts):
        return False
    middle = statistics.median(logs)
    return statistics.median(abs(value - middle) for value in logs) < math.log(SAME_FACTOR)


def _better(second: PressResult, first: PressResult, contradicted: bool) -> bool:
    """Whether the fit without a prior is to be taken."""
    more, fewer = len(used(second.contacts)), len(used(first.contacts))
    if fewer < LEAST_USED * more or more < LEAST_USED * fewer:
        return more > fewer
    if second.fit.error_deg is None or first.fit.error_deg is None:
        return contradicted
    return second.fit.error_deg < first.fit.error_deg
