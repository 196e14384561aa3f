"""Calibrate a unit from presses of balls: preprocessing, response fields, and how well point lights do on the same balls."""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..compensate import Compensate
from ..core.geometry import gradient_from_normal
from ..integration import poisson_background
from ..model.calibration import Calibration
from ..model.response_field import ResponseModel
from ..model.sensor import Sensor
from ..normals import NormalFromIntensity
from .balls import center_by_slope
from .by_lights import OTHER_GAMMA
from .contacts import Contact, middle_px, read_contacts, unit_without_model
from .field import Family, angle_deg
from .presses import Press
from .response_fit import Candidates, ResponseFit, fit_response, held_out_deg

RESPONSE_BLUR_PX = 1.0
"""Blur of a response field at 320 x 240: it reduces the error of normals on a GelSight Mini by a third; more blur gains nothing."""

PREPROCESSING_WORTH = 0.1
"""Another gamma or blur must lower the held-out error by this part."""

PREPROCESSING_PRESSES = 10
"""About so many presses choose it: reading them again takes most of the time."""

ALL_CANDIDATES = Candidates()


class PressResult(NamedTuple):
    """What presses gave.

    Attributes:
        fit: the response fit.
        contacts: one per press, with the reason of those left out.
        unit: the calibrated unit.
    """

    fit: ResponseFit
    contacts: list[Contact]
    unit: Calibration


def by_presses(
    background: Tensor,
    sensor: Sensor,
    presses: Sequence[Press],
    prior: ResponseModel | None,
    progress: bool,
    candidates: Candidates = ALL_CANDIDATES,
) -> PressResult:
    """Fit a response model to presses.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit; gamma and blur are chosen where they are left open and there is no prior.
        presses: of balls.
        prior: fields of the sensor's type, or None.
        progress: show a bar.
        candidates: the fields to try.
    Raises:
        ValueError: no press can be used.
    """
    chosen = with_preprocessing(sensor, prior)
    contacts = read_contacts(presses, background, chosen)
    light = unit_without_model(background, chosen).background
    fit = fit_response(contacts, light, chosen, prior, progress, candidates)
    if prior is None and fit.error_deg is not None:
        others = _other_preprocessing(sensor, chosen)
        fit, chosen = _choose_preprocessing(background, chosen, others, list(zip(presses, contacts)), fit, candidates)
    return PressResult(fit, contacts, Calibration.from_response(fit.model, chosen, background))


def with_preprocessing(sensor: Sensor, prior: ResponseModel | None) -> Sensor:
    """The sensor with the gamma and blur of the images' preprocessing: the prior's, or usual ones to start with."""
    if prior is not None:
        return dataclasses.replace(sensor, gamma=prior.gamma, blur_px=prior.blur_px)
    usual_px = RESPONSE_BLUR_PX * max(1.0, min(sensor.height, sensor.width) / 240)
    return dataclasses.replace(sensor, gamma=sensor.exponent, blur_px=max(sensor.blur_px, usual_px))


def _other_preprocessing(given: Sensor, chosen: Sensor) -> list[Sensor]:
    """The sensor with other values of what was left open: half the blur, and another gamma.

    Not twice the blur: balls are smooth, and fit better the more noise is blurred away; what edges lose they cannot show.
    """
    others = [dataclasses.replace(chosen, blur_px=0.5 * chosen.blur_px)] if given.blur_px == 0 else []
    return others + ([dataclasses.replace(chosen, gamma=OTHER_GAMMA)] if given.gamma is None else [])


def _choose_preprocessing(
    background: Tensor,
    sensor: Sensor,
    others: list[Sensor],
    pairs: list[tuple[Press, Contact]],
    fit: ResponseFit,
    candidates: Candidates,
) -> tuple[ResponseFit, Sensor]:
    """Another gamma or blur if the first pass of the same family is clearly better with it on held-out presses; then refit.

    The balls stay where they were found: preprocessing moves a center by less than its uncertainty.
    """
    usable = [(press, contact) for press, contact in pairs if not contact.reason]
    some = usable[:: max(1, len(usable) // PREPROCESSING_PRESSES)]
    located = [_located(press, contact, sensor) for press, contact in some]
    best = (1.0 - PREPROCESSING_WORTH) * held_out_deg([contact for _, contact in some], fit.model.field)
    taken: Sensor | None = None
    for other in others:
        contacts = read_contacts(located, background, other)
        score = held_out_deg(contacts, fit.model.field)
        fit.candidates.append(
            {
                "model": f"response, preprocessed with gamma {other.exponent:g} and a blur of {other.blur_px:g} px",
                "family": Family.of(fit.model.field).label(),
                "parameters": 2 * fit.model.field.size(),
                "score_deg": score if math.isfinite(score) else None,
                "passes": 1,
            }
        )
        if score < best:
            best, taken = score, other
    if taken is None:
        return fit, sensor
    chosen = taken
    contacts = read_contacts([_located(press, contact, sensor) for press, contact in usable], background, chosen)
    again = fit_response(contacts, unit_without_model(background, chosen).background, chosen, None, False, candidates)
    again.candidates = fit.candidates + again.candidates
    return again, chosen


def _located(press: Press, contact: Contact, sensor: Sensor) -> Press:
    """The press with the ball where it was found."""
    x, y = (contact.center_mm / sensor.mm_per_pixel + middle_px(sensor)).tolist()
    return dataclasses.replace(press, center_px=(x, y), contact_radius_px=contact.contact_radius_mm / sensor.mm_per_pixel)


def error_of_lights_deg(
    calibration: Calibration, presses: Sequence[Press], contacts: Sequence[Contact], blur_px: float
) -> float | None:
    """Mean angle of the point lights' normals on the located balls, by their second pass and with the same blur, degrees.

    None where no ball is seen.

    Each ball is located again by the lights' own slopes: a wrong response field hides part of an error of the centers, lights
    cannot.
    """
    blurred = dataclasses.replace(calibration, sensor=dataclasses.replace(calibration.sensor, blur_px=blur_px))
    pitch = calibration.sensor.mm_per_pixel
    compensate = Compensate.from_calibration(blurred)
    normals = NormalFromIntensity.from_calibration(blurred)
    errors = []
    for press, contact in zip(presses, contacts):
        if contact.reason:
            continue
        image = compensate(press.image.detach().cpu().to(calibration.background.dtype)[None])
        depth = poisson_background(gradient_from_normal(normals(image)) * contact.mask, pitch)
        slope = gradient_from_normal(normals(image, depth))[0].double()
        own = dataclasses.replace(contact)  # a copy: center_by_slope moves its center, or gives it a reason
        if not own.known:
            center_by_slope(own, slope, pitch)
        if own.reason or not bool(own.inside().any()):
            own = contact
        inside = own.inside()
        if not bool(inside.any()):
            continue
        errors.append(angle_deg(slope.flatten(1)[:, own.index][:, inside], own.ball_slope()[:, inside]))
    return sum(errors) / len(errors) if errors else None
