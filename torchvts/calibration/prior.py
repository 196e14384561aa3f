"""Fit the prior of a sensor type, and measure how good it is on presses that it was not fitted to."""

import warnings
from collections.abc import Sequence

from torch import Tensor

from ..core.checks import check_image, check_sequence
from ..model.response_field import SensorPrior, fit_log_background
from ..model.sensor import Sensor, check_sensor
from . import objections
from .by_presses import by_presses
from .contacts import Contact, used
from .field import Family
from .given_images import sort_presses
from .objections import CalibrationWarning
from .presses import Press, check_presses
from .response_fit import FEW, Candidates, fit_field, mean_error_deg

PRIOR_CANDIDATES = Candidates(((2, 1, -1),), 60.0)
"""Chosen by other units: larger fields, and weakly regularised products, fit the unit of the presses better and others worse
(docs/decisions.md)."""

PARTS = 4
"""Presses of one ball are held out in so many parts."""


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
    for message in messages + objections.to_contacts(result.contacts):
        warnings.warn(message, CalibrationWarning, stacklevel=2)
    log_background = fit_log_background(result.unit.background, sensor.mm_per_pixel)
    half_mm = 0.5 * sensor.width * sensor.mm_per_pixel
    error = held_out_by_groups(used(result.contacts), PRIOR_CANDIDATES.families(half_mm)[0])
    return SensorPrior(result.fit.model, log_background, half_mm, source, () if error is None else (error,))


def score_prior(background: Tensor, sensor: Sensor, presses: Sequence[Press]) -> float:
    """Mean angle between normals by a prior and those of balls pressed into another unit, degrees.

    The prior sees the background alone. Balls without labels are located by a field that is fitted to these presses from the prior:
    without one, a common shift of all centers looks like a response, and counts as an error of the prior.

    Args:
        background: (3, H, W) in [0, 1], of the unit.
        sensor: with the prior to score.
        presses: of balls, on the unit.
    Raises:
        ValueError, TypeError: a sensor without a prior, or presses that cannot be used.
    """
    check_sensor("sensor", sensor)
    if sensor.prior is None:
        raise ValueError(f"sensor: expected one with a prior to score, '{sensor.name}' has none: fit one first")
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    contacts = by_presses(background, sensor, check_presses(presses, sensor), sensor.prior.response, False).contacts
    return mean_error_deg(sensor.prior.response.field, used(contacts))


def held_out_by_groups(contacts: Sequence[Contact], family: Family) -> float | None:
    """Mean angle on each group of located presses by a field of the others, degrees; None with too few to fit one.

    Groups are the balls of each diameter, or else every fourth press. Another ball is pressed deeper or wider, so its frames are
    new to the field; a neighbouring press of the same ball is not.
    """
    sizes = sorted({contact.radius_mm for contact in contacts})
    groups = [[contact for contact in contacts if contact.radius_mm == size] for size in sizes]
    if len(groups) < 2 or min(map(len, groups)) < FEW:
        groups = [list(contacts[k::PARTS]) for k in range(PARTS)]
    if len(contacts) < 2 * FEW:
        return None
    total = 0.0
    for group in groups:
        others = [contact for other in groups if other is not group for contact in other]
        total += len(group) * mean_error_deg(fit_field(others, family), group)
    return total / len(contacts)
