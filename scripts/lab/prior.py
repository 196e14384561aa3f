"""Fit the prior of a sensor type, and measure how good it is on presses that it was not fitted to."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchvts.calibration import CalibrationWarning, Press, by_presses
from torchvts.calibration.contacts import Contact, used
from torchvts.calibration.field import ContactForms, Family, power_of
from torchvts.calibration.given_images import sort_presses
from torchvts.calibration.posterior import FEW, Evidence, Prior
from torchvts.calibration.presses import check_presses
from torchvts.calibration.response_fit import fit_depth_brightness
from torchvts.core.checks import check_image
from torchvts.model.calibration import Calibration
from torchvts.model.response_field import ResponseField, ResponseModel, SensorPrior, image_basis
from torchvts.model.sensor import Sensor, check_sensor

PRIOR_DEGREES = (2, 1)
"""Degrees of a type's field in position, of linear terms and of products of two."""

RIDGE = 0.0005
"""Prior precision of a constant linear term, in units: of each unit by the other, 0.0001 to 0.002 are as good within 2 %."""

PRIOR_PARTS = 4
"""Presses of one ball are held out in so many parts."""


class PriorUnit(NamedTuple):
    """A unit that a prior is fitted to: as the arguments of :func:`calibrate`."""

    background: Tensor
    sensor: Sensor
    presses: Sequence[Press]


def fit_prior(
    background: Tensor, sensor: Sensor, presses: Sequence[Press], source: str = "", others: Sequence[PriorUnit] = ()
) -> SensorPrior:
    """Fit a prior for every unit of a sensor type to presses on one unit, or on several.

    Each unit counts alike, however many presses it has. ``held_out_deg`` of the result is the error on each unit by the others; of
    one unit that on the balls of each diameter by those of the others, or on every fourth press by the rest. :func:`score_prior`
    measures it on further units.

    Args:
        background: as for :func:`calibrate`.
        sensor: as for :func:`calibrate`; its own prior is ignored.
        presses: as for :func:`calibrate`, at least one.
        source: whose images these are, kept with the prior.
        others: further units of the type, each with a sensor of its own size and pitch.
    Raises:
        ValueError, TypeError: as :func:`calibrate`.
    """
    check_sensor("sensor", sensor)
    units = [PriorUnit(background, sensor, presses), *others]
    results = [_fitted(unit) for unit in units]
    half_mm = 0.5 * sensor.width * sensor.mm_per_pixel
    balls = [used(contacts) for _, contacts in results]
    patterns = [_pattern(unit.sensor, found, sensor) for unit, (found, _) in zip(units, results, strict=True)]
    log_background = fit_log_background(torch.stack(patterns).log().mean(0).exp(), sensor.mm_per_pixel)
    field = _pooled(balls, half_mm)
    if len(units) == 1:
        errors = _held_out_by_groups(balls[0], half_mm)
    else:
        errors = tuple(mean_error_deg(_pooled([own for own in balls if own is not unit], half_mm), unit) for unit in balls)
    own_deg = sum(mean_error_deg(field, own) for own in balls) / len(balls)
    power = sum(power_of(own) for own in balls) / len(balls)
    model = _model(field, balls, units, results[0][0])
    return SensorPrior(model, log_background, half_mm, source, errors, own_deg, power)


def _fitted(unit: PriorUnit) -> tuple[Calibration, list[Contact]]:
    """The unit by its own presses, and the balls, located."""
    background, sensor, presses = unit
    if len(presses) == 0:
        raise ValueError("presses: expected one or more, got none: a prior is fitted to presses")
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    named = check_presses(presses, sensor)
    kept, left_out = sort_presses(background, named)
    calibration, contacts = by_presses(background, sensor.without_prior(), kept, None)
    messages = [f"{named[k].name}: left out: {reason}" for k, reason in left_out]
    messages += [f"{contact.name}: left out: {contact.reason}" for contact in contacts if contact.reason]
    for message in messages:
        warnings.warn(message, CalibrationWarning, stacklevel=3)
    return calibration, contacts


def _pooled(balls: Sequence[Sequence[Contact]], half_mm: float) -> ResponseField:
    """The field of several units, each of which counts alike."""
    family = Family(*PRIOR_DEGREES, half_mm)
    evidence = Evidence(family, [contact for own in balls for contact in own])
    weights = torch.tensor([1.0 / len(own) / len(balls) for own in balls for _ in own], dtype=torch.float64)
    power = sum(power_of(own) for own in balls) / len(balls)
    prior = Prior(torch.zeros(2, family.size(), dtype=torch.float64), RIDGE * family.penalty(power))
    return evidence.posterior(prior, weights).field


def _pattern(own: Sensor, found: Calibration, sensor: Sensor) -> Tensor:
    """The smooth background of a unit on the pixels of a sensor, (3, H, W), linear light."""
    coefficients = fit_log_background(found.background, own.mm_per_pixel)
    assert found.response is not None
    smooth = SensorPrior(found.response, coefficients, 0.5 * own.width * own.mm_per_pixel, "")
    return smooth.background(sensor.height, sensor.width, sensor.mm_per_pixel)


def _model(field: ResponseField, balls: list[list[Contact]], units: list[PriorUnit], first: Calibration) -> ResponseModel:
    """The field with the mean over units of what depth does to brightness."""
    assert first.response is not None
    pairs = list(zip(balls, (unit.sensor.mm_per_pixel for unit in units), strict=True))
    by_depth = [fit_depth_brightness(own, field, pitch_mm) for own, pitch_mm in pairs]
    rows = torch.stack([depth.tensor() for depth in by_depth]).mean(0).tolist()
    reference_mm = sum(depth.reference_mm for depth in by_depth) / len(by_depth)
    mean = dataclasses.replace(by_depth[0], coefficient=tuple(map(tuple, rows)), reference_mm=reference_mm)
    return ResponseModel(field, mean, first.response.gamma, first.response.blur_px)


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
    contacts = by_presses(background, sensor, check_presses(presses, sensor), sensor.prior)[1]
    return mean_error_deg(sensor.prior.response.field, used(contacts))


def _held_out_by_groups(contacts: Sequence[Contact], half_mm: float) -> tuple[float, ...]:
    """Mean angle on each group of located presses by a field of the others, degrees; none with too few to fit one.

    Groups are the balls of each diameter, or else every fourth press. Another ball is pressed deeper or wider, so its frames are
    new to the field; a neighbouring press of the same ball is not.
    """
    sizes = sorted({contact.radius_mm for contact in contacts})
    groups = [[contact for contact in contacts if contact.radius_mm == size] for size in sizes]
    if len(groups) < 2 or min(map(len, groups)) < FEW:
        groups = [list(contacts[k::PRIOR_PARTS]) for k in range(PRIOR_PARTS)]
    if len(contacts) < 2 * FEW:
        return ()
    total = 0.0
    for group in groups:
        others = [contact for other in groups if other is not group for contact in other]
        total += len(group) * mean_error_deg(_pooled([others], half_mm), group)
    return (total / len(contacts),)


def mean_error_deg(field: ResponseField, contacts: Sequence[Contact]) -> float:
    """Mean angle between the normals of a field and those of balls, degrees."""
    errors = [ContactForms(Family.of(field), contact).error_deg(field.tensor()) for contact in contacts]
    return sum(errors) / len(errors)


def fit_log_background(background: Tensor, mm_per_pixel: float) -> tuple[tuple[float, ...], ...]:
    """``log_background`` of a :class:`SensorPrior`, by least squares.

    Args:
        background: (3, H, W), linear light.
        mm_per_pixel: pixel pitch, mm.
    """
    height, width = background.shape[1:]
    basis = image_basis(height, width, mm_per_pixel, 0.5 * width * mm_per_pixel, 4).flatten(1)
    values = background.double().clamp_min(1e-3).log().flatten(1)
    solution = torch.linalg.lstsq(basis.t(), values.t()).solution  # (15, 3)
    return tuple(tuple(float(v) for v in column) for column in solution.t())
