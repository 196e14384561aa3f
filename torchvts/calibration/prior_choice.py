"""Presses beside a prior: fit from the prior, and where presses or background contradict it, without it, too."""

from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..model.response_field import ResponseModel
from ..model.sensor import Sensor
from .by_presses import PressResult, by_presses
from .contacts import used
from .presses import Press
from .refusals import NoUsablePress
from .sizes import objection_by_prior

LEAST_USED = 0.5
"""Share of the presses that a prior must be able to use."""


class FromPresses(NamedTuple):
    """A fit to presses, and whether it starts from the prior.

    Attributes:
        result: the fit.
        dropped: why the prior was left out, or "".
        sizes: why the prior contradicts the sizes of all balls alike, or "".
    """

    result: PressResult
    dropped: str
    sizes: str = ""


def fit_with_or_without(
    background: Tensor, sensor: Sensor, presses: Sequence[Press], prior: ResponseModel, objection: str, progress: bool
) -> FromPresses:
    """Fit presses from a prior, and without it where they or the background contradict it; take the better one.

    The better one uses clearly more presses, or else has the lower held-out error. Without a held-out error it is the fit from the
    prior: of one or two presses alone a field knows only their places.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit.
        presses: of balls.
        prior: fields of the sensor's type.
        objection: what the background has against the prior, or "".
        progress: show a bar.
    Raises:
        NoUsablePress: with the prior and without it.
    """
    try:
        first: PressResult | None = by_presses(background, sensor, presses, prior, progress)
        failure = None
    except NoUsablePress as error:
        first, failure = None, error
    contradiction = objection or _objection_of_presses(first, failure)
    located = first.contacts if first is not None else failure.contacts if failure is not None else []
    sizes = "" if objection else objection_by_prior(located)
    if first is not None and not contradiction:
        return FromPresses(first, "", sizes)
    try:
        second = by_presses(background, sensor.without_prior(), presses, None, progress)
    except NoUsablePress as error:
        if first is None:
            raise error from failure
        return FromPresses(first, "", sizes)
    if first is not None and not _better(second, first):
        return FromPresses(first, "", sizes)
    count = len(used(second.contacts))
    why = "the background does not have its pattern of light" if objection else contradiction
    return FromPresses(second, f"calibrated from {count} presses without the sensor's prior: {why}", sizes)


def _objection_of_presses(first: PressResult | None, failure: NoUsablePress | None) -> str:
    """What presses have against the prior, or ""."""
    contacts = first.contacts if first is not None else failure.contacts if failure is not None else []
    left = len(used(contacts))
    if left >= LEAST_USED * len(contacts):
        return ""
    return f"by the prior only {left} of {len(contacts)} presses can be used"


def _better(second: PressResult, first: PressResult) -> bool:
    """Whether the fit without a prior is to be taken."""
    more, fewer = len(used(second.contacts)), len(used(first.contacts))
    if fewer < LEAST_USED * more or more < LEAST_USED * fewer:
        return more > fewer
    if second.fit.error_deg is None or first.fit.error_deg is None:
        return False
    return second.fit.error_deg < first.fit.error_deg
