"""Weigh presses by what the others, and the sensor's prior, expect of them; only contacts that are no clean balls are left out.

A press with a wrong diameter errs alike all over it: the slopes that the others expect there are ``gain`` times the ball's. With
z, the logarithm of that in its standard deviations, the press counts (1.5 / z)^4 beyond 1.5 of them. Weights and gains are found
in turn.
"""

import torch
from torch import Tensor

from ..model.response_field import SensorPrior
from ..model.sensor import Sensor
from .balls import locate
from .contacts import Contact, used
from .field import Family, ball_sine, power_of
from .posterior import Evidence, Prior, weights_of

SCREENING_PENALTY = 0.01
"""Regularisation of the small fields by which presses without a prior are compared with each other."""

PRIOR_PRESSES = 0.3
"""A prior counts as so many presses when a press is compared with the prior as the others change it, where they cover its place."""

NOISE = 0.1
"""Standard deviation of the gain of a press by the field of others that cover its place."""

DOUBTED = 3.0
"""So many standard deviations off, a press is named; it counts a sixteenth."""

CORE = 1.5
"""Standard deviations up to which a press counts wholly."""

ROUNDS = 12
"""Weights and gains in turn."""

FAR_DEG, APART_DEG = 15.0, 12.0
"""Mean errors of slopes of a press that is no clean ball: by itself, and where it is thrice that of the others."""


def locate_and_weigh(contacts: list[Contact], sensor: Sensor, prior: SensorPrior | None, half_mm: float) -> list[Contact]:
    """Locate the balls, weigh them, and leave out outliers. Without a prior, locate again with these weights: outliers move others.

    Args:
        contacts: of presses; changed in place.
        sensor: of the unit.
        prior: of the sensor's type, or None.
        half_mm: scale of positions, mm.
    Returns:
        The contacts that are used.
    """
    located = None
    while located is None or (prior is None and located - float(weights_of(used(contacts)).sum()) > 0.5):
        locate(contacts, sensor, None if prior is None else prior.response, half_mm)
        located = float(weights_of(used(contacts)).sum())
        _weigh(contacts, prior, half_mm)
    return used(contacts)


def _weigh(contacts: list[Contact], prior: SensorPrior | None, half_mm: float) -> None:
    """Weigh each press, and give a reason to those that are no clean balls, one after the other."""
    while True:
        left = used(contacts)
        for contact in left:  # the others may have been left out
            contact.weight, contact.doubt = 1.0, ""
        if len(left) < (1 if prior is not None else 2):
            return
        family = Family(2, -1, half_mm) if prior is None else Family.of(prior.response.field)
        evidence = Evidence(family, left)
        if prior is None:
            start = Prior(torch.zeros(2, family.size(), dtype=torch.float64), SCREENING_PENALTY * family.penalty())
        else:
            start = Prior(prior.response.field.tensor(), PRIOR_PRESSES * family.penalty(power_of(left)))
        gains, far, std = _robust_gains(evidence, start)
        shown = gains if prior is None else evidence.gains([start.mean] * len(left))
        found = evidence.posterior(start).mean
        errors = evidence.errors_deg([found] * len(left))
        for k, contact in enumerate(left):
            contact.weight = float(evidence.weights[k])
            contact.metrics |= {"error_deg": errors[k], "gain": float(shown[k])}
            if prior is None:
                contact.metrics["gain_std"] = float(std[k])
            if abs(float(far[k])) > DOUBTED:
                contact.doubt = _wrong_diameter(contact, float(gains[k]), len(left) - 1, prior is not None)
        own = evidence.gains([found] * len(left)).clamp_min(1e-3).tolist()
        scaled = evidence.errors_deg([found / gain for gain in own])
        if not _reject_slopes(left, list(map(min, errors, scaled)), prior is not None):
            return


def _robust_gains(evidence: Evidence, prior: Prior) -> tuple[Tensor, Tensor, Tensor]:
    """(N,) each: gains by prior and others, how far they are off in standard deviations, and those; sets the evidence's weights."""
    std = _uncertainty(evidence, prior)
    evidence.weights = torch.ones_like(std)
    for _ in range(ROUNDS):
        gains = evidence.gains(evidence.held_out(prior)).clamp_min(1e-3)
        far = (gains / _usual(gains, std / evidence.weights.sqrt())).log() / std
        weights = 0.5 * (evidence.weights + (CORE / far.abs().clamp_min(CORE)) ** 4)
        evidence.weights = weights / weights.max()  # else the prior takes over, all gains fall, and with them all weights
    return gains, far, std


def _wrong_diameter(contact: Contact, gain: float, others: int, by_prior: bool) -> str:
    reference = f"the other {others} presses" if others > 1 else "the other press"
    if by_prior:
        reference = "the sensor's prior" + (f" and {reference}" if others else "")
    return (
        f"counts {contact.weight:.2f} of a press: by {reference} the ball seems {2 * contact.radius_mm / gain:.2f} mm wide, but "
        f"{2 * contact.radius_mm:g} mm was given: a wrong diameter, or skin that answers otherwise than where they lie; more "
        "presses beside it will show which"
    )


def _reject_slopes(left: list[Contact], errors_deg: list[float], by_prior: bool) -> bool:
    """Reject the worst press if its slopes are far from those of a ball of whatever size."""
    errors = torch.tensor(errors_deg, dtype=torch.float64)
    worst, usual = int(errors.argmax()), float(errors.median())
    error = float(errors[worst])
    # fields too small for a sensor are far off on all presses alike
    far = FAR_DEG if by_prior or len(left) < 3 else max(FAR_DEG, 2.0 * usual)
    if not (error > max(3.0 * usual, APART_DEG) or error > far):
        return False
    off = f"its slopes are {error:.1f} degrees from a ball's, others' {usual:.1f}"
    left[worst].reason = f"{off}: not a clean press, or a wrong diameter"
    return True


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
