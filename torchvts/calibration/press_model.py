"""Calibrate a unit from presses of balls: preprocessing, located balls, and the posterior of its response."""

import dataclasses
from collections.abc import Sequence

from torch import Tensor

from ..model.calibration import Calibration
from ..model.report import Report
from ..model.response_field import SensorPrior
from ..model.sensor import Sensor
from .contacts import Contact, press_row, read_contacts, uneven_light, used
from .posterior import weights_of
from .presses import Press
from .response_fit import fit_response

RESPONSE_BLUR_PX = 1.0
"""Blur of a response field at 320 x 240, pixels."""


def by_presses(
    background: Tensor, sensor: Sensor, presses: Sequence[Press], prior: SensorPrior | None, progress: bool = False
) -> tuple[Calibration, list[Contact]]:
    """Fit a response model to presses.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit.
        presses: of balls.
        prior: of the sensor's type, or None.
        progress: show a bar.
    Returns:
        The unit, its errors in its report, and one contact per press, with the reason of those left out.
    Raises:
        ValueError: no press can be used.
    """
    chosen = with_preprocessing(sensor, prior)
    contacts = read_contacts(presses, background, chosen)
    fit = fit_response(contacts, chosen, prior, progress)
    count = sum(not contact.reason for contact in contacts)
    weight, given = float(weights_of(used(contacts)).sum()), f"{count} press{'es' * (count > 1)}"
    if f"{weight:.1f}" != f"{count:.1f}":
        given += f" that count as {weight:.1f}"
    report: Report = {
        "model": "response",
        "source": "presses",
        "reason": f"from {'the sensor' + chr(39) + 's prior and ' if prior else ''}{given}",
        "held_out_deg": fit.held_out_deg,
        "own_deg": fit.own_deg,
        "stated_deg": fit.stated_deg,
        "presses": [press_row(contact, sensor) for contact in contacts],
        "uneven": uneven_light(used(contacts)),
    }
    if prior is not None:
        report["prior_deg"] = prior.expected_deg
    return Calibration.from_response(fit.model, chosen, background, report, fit.covariance), contacts


def with_preprocessing(sensor: Sensor, prior: SensorPrior | None) -> Sensor:
    """The sensor with the gamma and blur of the images' preprocessing: the prior's, or usual ones."""
    if prior is not None:
        return dataclasses.replace(sensor, gamma=prior.response.gamma, blur_px=prior.response.blur_px)
    usual_px = RESPONSE_BLUR_PX * max(1.0, min(sensor.height, sensor.width) / 240)
    return dataclasses.replace(sensor, gamma=sensor.exponent, blur_px=max(sensor.blur_px, usual_px))
