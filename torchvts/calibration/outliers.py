"""Leave out presses that the others, or the sensor's prior, contradict: wrong diameters, and contacts that are no clean balls."""

import math

import torch
from torch import Tensor

from ..model.response_field import SensorPrior
from ..model.sensor import Sensor
from .balls import locate
from .contacts import Contact, used
from .field import Family, ball_sine, power_of
from .posterior import Evidence, Prior

SCREENING_PENALTY = 0.01
"""Regularisation of the small fields by which presses without a prior are compared with each other."""

PRIOR_PRESSES = 0.3
"""A prior counts as so many presses when a press is compared with the prior as the others change it, where they cover its place."""

FAR_FROM_PRIOR = 1.42
"""By a prior a diameter is wrong where the ball seems so many times as wide or as narrow as given."""

NOISE = 0.1
"""Standard deviation of the gain of a press by the field of others that cover its place."""

LEAST_KNOWN = 0.5
"""Part of a press's gain that the others must know to contradict it."""

FAR_IN_SPREADS = 3.0
"""So many of its standard deviations from the others' a gain is wrong."""

FAR_DEG, APART_DEG = 15.0, 12.0
"""Mean errors of slopes of a press that is no clean ball: by itself, and where it is thrice that of the others."""


def locate_and_screen(contacts: list[Contact], sensor: Sensor, prior: SensorPrior | None, half_mm: float) -> list[Contact]:
    """Locate the balls and leave out outliers. Without a prior, locate again without them, because they moved the other balls.

    Args:
        contacts: of presses; changed in place.
        sensor: of the unit.
        prior: of the sensor's type, or None.
        half_mm: scale of positions, mm.
    Returns:
        The contacts that are used.
    """
    located = None
    while located is None or (prior is None and located > len(used(contacts))):
        locate(contacts, sensor, None if prior is None else prior.response, half_mm)
        located = len(used(contacts))
        _leave_out(contacts, prior, half_mm)
    return used(contacts)


def _leave_out(contacts: list[Contact], prior: SensorPrior | None, half_mm: float) -> None:
    """Give a reason to presses that the others, or the prior, contradict, one after the other."""
    while True:
        left = used(contacts)
        if len(left) < (1 if prior is not None else 2):
            return
        family = Family(2, -1, half_mm) if prior is None else Family.of(prior.response.field)
        evidence = Evidence(family, left)
        if prior is None:
            start = Prior(torch.zeros(2, family.size(), dtype=torch.float64), SCREENING_PENALTY * family.penalty())
        else:
            start = Prior(prior.response.field.tensor(), PRIOR_PRESSES * family.penalty(power_of(left)))
        gains = evidence.gains(evidence.held_out(start))
        errors = evidence.errors_deg([evidence.posterior(start).mean] * len(left))
        if prior is None:
            shown, std = gains, _uncertainty(evidence, start)
            for contact, one in zip(left, std.tolist()):
                contact.metrics["gain_std"] = one
            wrong = _wrong_by_others(evidence, start, gains, std.masked_fill(_known(evidence, start) < LEAST_KNOWN, math.inf))
        else:
            shown, wrong = evidence.gains([start.mean] * len(left)), _wrong_by_prior(gains)
        for contact, gain, error in zip(left, shown.tolist(), errors):
            contact.metrics |= {"error_deg": error, "gain": gain}
        if wrong is not None:
            _reject_diameter(left, wrong, float(gains[wrong]), prior is not None)
        elif not _reject_slopes(left, errors, prior is not None):
            return


def _reject_diameter(left: list[Contact], wrong: int, gain: float, by_prior: bool) -> None:
    contact = left[wrong]
    others = f"the other {len(left) - 1} presses" if len(left) > 2 else "the other press"
    reference = "the sensor's prior" + (f" and {others}" if len(left) > 1 else "") if by_prior else others
    seen = 2 * contact.radius_mm / max(gain, 1e-3)
    contact.reason = f"by {reference} the ball seems {seen:.2f} mm wide, but {2 * contact.radius_mm:g} mm was given"
    contact.reason += (
        ": a wrong diameter, or skin that answers otherwise than where they lie; more presses beside it will show which"
    )
    if not by_prior and len(left) == 3:
        contact.reason += "; of three, another may be the wrong one"
    if not by_prior and len(left) == 2:
        left[1 - wrong].reason = "contradicts the only other press: one of the two diameters is wrong"


def _reject_slopes(left: list[Contact], errors_deg: list[float], by_prior: bool) -> bool:
    """Reject the worst press if its slopes are far from those of a ball."""
    errors = torch.tensor(errors_deg, dtype=torch.float64)
    worst, usual = int(errors.argmax()), float(errors.median())
    error = float(errors[worst])
    # fields too small for a sensor are far off on all presses alike
    far = FAR_DEG if by_prior or len(left) < 3 else max(FAR_DEG, 2.0 * usual)
    if not (error > max(3.0 * usual, APART_DEG) or error > far):
        return False
    left[worst].reason = f"its slopes are {error:.1f} degrees from a ball's, others' {usual:.1f}: not a clean press"
    return True


def _wrong_by_prior(gains: Tensor) -> int | None:
    """The press with a wrong diameter, if any; gains are slopes by the prior and the others, divided by slopes expected."""
    far = gains.clamp_min(1e-3).log().abs()
    worst = int(far.argmax())
    return worst if float(far[worst]) > math.log(FAR_FROM_PRIOR) else None


def _known(evidence: Evidence, prior: Prior) -> Tensor:
    """(N,): part of the gain of each press that a field of the others can know: regularisation takes what no other press covers.

    It is that of a field by exact presses of the others, if the field of the press by itself is the true one, up to a factor.
    """
    penalty, form = torch.diag(prior.precision.repeat(2)), evidence.grams.sum(0)
    parts = []
    for item, gram, right in zip(evidence.forms, evidence.grams, evidence.rights):
        own, others = torch.linalg.solve(gram + penalty, right), form - gram
        known = torch.linalg.solve(others + penalty, others @ own)
        parts.append(item.gain(known.reshape(2, -1)) / max(item.gain(own.reshape(2, -1)), 1e-3))
    return torch.tensor(parts, dtype=torch.float64)


def _uncertainty(evidence: Evidence, prior: Prior) -> Tensor:
    """(N,): standard deviation of the gain of each press by a field of the others.

    A press errs by :data:`NOISE` of its sines, alike all over it; the normal equations of the others give what that does elsewhere.
    It is large where no other press lies near, and where little light changes: there the others say nothing.
    """
    penalty, form = torch.diag(prior.precision.repeat(2)), evidence.grams.sum(0)
    variance = []
    for item, gram in zip(evidence.forms, evidence.grams):
        inside = item.contact.inside()
        terms, ball = item.terms[:, inside], ball_sine(item.contact)[:, inside]
        along = (ball @ terms.t()).reshape(-1) / ball.square().sum().clamp_min(1e-12)  # of the gain by the coefficients
        carried = along @ torch.linalg.solve(form - gram + penalty, along)
        variance.append(1.0 + ball.square().sum(0).mean() * carried)
    return NOISE * torch.stack(variance).sqrt()


def _usual(gains: Tensor, std: Tensor) -> float:
    """The gain of right presses, as a small field is off by one factor in the middle of all: weighted median of gains and one 1."""
    values, order = torch.cat((gains, torch.ones_like(gains[:1]))).sort()
    weights = torch.cat(((NOISE / std).square(), torch.ones_like(std[:1])))[order]
    return max(float(values[int((weights.cumsum(0) < 0.5 * weights.sum()).sum())]), 1e-3)


def _wrong_by_others(evidence: Evidence, prior: Prior, gains: Tensor, std: Tensor) -> int | None:
    """The press with a wrong diameter, if any; each gain, and its standard deviation, is by the field of the other presses.

    A wrong press bends the field for all, so the wrong one is that without which the others agree best. It must differ from them
    by more than they differ from each other, and by more than they know of its place.
    """
    relative, disagreement, spread = [], [], []
    for place, gain in enumerate(gains.tolist()):
        rest = evidence.without(place)
        others = rest.gains(rest.held_out(prior)) if len(gains) > 2 else torch.ones(1, dtype=torch.float64)
        apart = torch.cat((std[:place], std[place + 1 :]))
        usual = _usual(others, apart)
        off = (others / usual - 1.0) / apart
        relative.append(gain / usual - 1.0)
        disagreement.append(float(off.square().mean()))
        spread.append(max(1.0, float(off.abs().median()) / 0.6745))
    if len(gains) == 2:
        disagreement = [-abs(one) for one in relative]
    worst = min(range(len(gains)), key=disagreement.__getitem__)
    return worst if abs(relative[worst]) > FAR_IN_SPREADS * spread[worst] * float(std[worst]) else None
