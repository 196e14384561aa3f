"""How good a sensor type's prior is: on presses that it was not fitted to, of its own unit and of others."""

from collections.abc import Sequence

from torch import Tensor

from ..core.checks import check_image
from ..model.sensor import Sensor, check_sensor
from .by_presses import by_presses
from .contacts import Contact, used
from .field import Family
from .presses import Press, check_presses
from .response_fit import FEW, fit_field, mean_error_deg

PARTS = 4
"""Presses of one ball are held out in so many parts."""


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
