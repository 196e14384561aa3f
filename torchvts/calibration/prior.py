"""Fit the prior of a sensor type, and measure how good it is on presses that it was not fitted to."""

import dataclasses
import functools
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import check_image, check_record, check_sequence
from ..model.response_field import ResponseModel, SensorPrior, TaughtRange, fit_log_background
from ..model.sensor import Sensor, check_sensor
from . import objections
from .by_presses import PressResult, by_presses
from .contacts import Contact, used
from .field import Family
from .given_images import sort_presses
from .objections import CalibrationWarning
from .presses import Press, check_presses
from .response_fit import FEW, Candidates, fit_depth_brightness, fit_field, mean_error_deg, taught_range

PRIOR_CANDIDATES = Candidates(((2, 1, -1),), 60.0)
"""Chosen by other units: larger fields, and weakly regularised products, fit the unit of the presses better and others worse
(docs/decisions.md)."""

PARTS = 4
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

    Linear terms have degree 2, products degree 1. Products are strongly regularised, because otherwise they fit these units
    better and others worse. Of several units each counts alike. ``held_out_deg`` of the result is then the error on each unit by
    the others; of one unit that on the balls of each diameter by those of the others, or on every fourth press by the rest.
    :func:`score_prior` measures it on further units.

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
    if not isinstance(source, str):
        raise TypeError(f"source: expected a text, got {type(source).__name__}")
    check_sequence("presses", presses, "Press")
    check_sequence("others", others, "PriorUnit")
    for k, other in enumerate(others):
        check_record(f"others[{k}]", other, PriorUnit, "PriorUnit(background, sensor, presses) makes one")
    units = [PriorUnit(background, sensor, presses), *others]
    results = [_fitted(unit) for unit in units]
    half_mm = 0.5 * sensor.width * sensor.mm_per_pixel
    family = PRIOR_CANDIDATES.families(half_mm)[0]
    balls = _alike([used(result.contacts) for result in results])
    patterns = [_pattern(unit.sensor, result, sensor) for unit, result in zip(units, results, strict=True)]
    log_background = fit_log_background(torch.stack(patterns).log().mean(0).exp(), sensor.mm_per_pixel)
    if len(units) == 1:
        error = held_out_by_groups(balls[0], family)
        return SensorPrior(results[0].fit.model, log_background, half_mm, source, () if error is None else (error,))
    errors = tuple(mean_error_deg(fit_field(_but(balls, k), family), balls[k]) for k in range(len(units)))
    return SensorPrior(_joint(results, balls, family, units), log_background, half_mm, source, errors)


def _fitted(unit: PriorUnit) -> PressResult:
    """The balls of a unit, located, and its own fit."""
    background, sensor, presses = unit
    if len(presses) == 0:
        raise ValueError("presses: expected one or more, got none: a prior is fitted to presses")
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    named = check_presses(presses, sensor)
    kept, left_out = sort_presses(background, named)
    result = by_presses(background, sensor.without_prior(), kept, None, False, PRIOR_CANDIDATES)
    messages = [f"{named[k].name}: left out: {reason}" for k, reason in left_out]
    for message in messages + objections.to_contacts(result.contacts):
        warnings.warn(message, CalibrationWarning, stacklevel=3)
    return result


def _alike(balls: list[list[Contact]]) -> list[list[Contact]]:
    """As many of each unit, evenly chosen."""
    count = min(map(len, balls))
    return [[own[k * len(own) // count] for k in range(count)] for own in balls]


def _but(balls: list[list[Contact]], left_out: int) -> list[Contact]:
    return [contact for k, own in enumerate(balls) if k != left_out for contact in own]


def _pattern(own: Sensor, result: PressResult, sensor: Sensor) -> Tensor:
    """The smooth background of a unit on the pixels of a sensor, (3, H, W), linear light."""
    coefficients = fit_log_background(result.unit.background, own.mm_per_pixel)
    smooth = SensorPrior(result.fit.model, coefficients, 0.5 * own.width * own.mm_per_pixel, "")
    return smooth.background(sensor.height, sensor.width, sensor.mm_per_pixel)


def _joint(results: list[PressResult], balls: list[list[Contact]], family: Family, units: list[PriorUnit]) -> ResponseModel:
    """One model for several units."""
    field, first = fit_field([contact for own in balls for contact in own], family), results[0].fit.model
    pairs = list(zip(balls, units, strict=True))
    depths = [fit_depth_brightness(own, field, unit.sensor.mm_per_pixel) for own, unit in pairs]
    rows = torch.stack([depth.tensor() for depth in depths]).mean(0).tolist()
    reference_mm = sum(depth.reference_mm for depth in depths) / len(depths)
    by_depth = dataclasses.replace(depths[0], coefficient=tuple(tuple(row) for row in rows), reference_mm=reference_mm)
    ranges = [taught_range(own, field, unit.sensor.mm_per_pixel) for own, unit in pairs]
    return ResponseModel(field, by_depth, first.gamma, first.blur_px, functools.reduce(TaughtRange.with_all_of, ranges))


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
