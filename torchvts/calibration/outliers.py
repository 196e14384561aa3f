"""Weigh presses by what the others, and the sensor's prior, expect of them, in size and in slopes. No press is left out for that.

A press with a wrong diameter errs alike all over it: the slopes that the others expect there are ``gain`` times the ball's. What is
no ball is far from a ball of any size, beside the error that the others state for its place. With z, the logarithm of either in its
standard deviations, the press counts (1.5 / z)^4 beyond 1.5 of them for its size, (3 / z)^4 beyond 3 for its slopes, which by few
presses are known less. Weights and z are found in turn.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..model.response_field import SensorPrior
from ..model.sensor import Sensor
from ..model.stated_error import stated_deg
from .balls import locate
from .closure import PENALTY
from .contacts import Contact, used
from .field import Family, ball_sine, power_of
from .posterior import Evidence, Prior, weights_of

PRIOR_PRESSES = 0.3
"""A prior counts as so many presses when a press is compared with the prior as the others change it, where they cover its place."""

PRESS_GAIN = 0.1
"""Standard deviation of the gain of a press by the field of others that cover its place, and of one press over its unit's: of
single presses of two Minis and two DIGITs, 7 in 200 are beyond a factor of 1.42."""

DOUBTED = 3.0
"""So many standard deviations off, a press is named."""

CORE = 1.5
"""Standard deviations of its size up to which a press counts wholly."""

LEAST_WEIGHT = (CORE / DOUBTED) ** 4
"""What a press counts whose size is named: less is hardly a press."""

ROUNDS = 12
"""Weights and gains in turn."""

SLOPES = 0.35
"""Standard deviation of the logarithm of the error of a press's slopes over the one that the others state: 0.33 of 545 presses of
eight sensors."""


class Weighed(NamedTuple):
    """What the others expect of presses, (N,) each.

    Attributes:
        gains: slopes by the others over the ball's.
        far: logarithm of that over the usual one, in standard deviations.
        std: those standard deviations.
        errors_deg: of slopes from those of a ball of any size.
        expected_deg: the error that the others state.
        off: logarithm of their quotient, in standard deviations.
    """

    gains: Tensor
    far: Tensor
    std: Tensor
    errors_deg: Tensor
    expected_deg: Tensor
    off: Tensor


def locate_and_weigh(contacts: list[Contact], sensor: Sensor, prior: SensorPrior | None, half_mm: float) -> list[Contact]:
    """Locate the balls and weigh them. Without a prior, locate again with these weights: outliers move others.

    Args:
        contacts: of presses; changed in place.
        sensor: of the unit.
        prior: of the sensor's type, or None.
        half_mm: scale of positions, mm.
    Returns:
        The contacts that show a press.
    """
    located = None
    while located is None or (prior is None and located - float(weights_of(used(contacts)).sum()) > 0.5):
        locate(contacts, sensor, None if prior is None else prior.response, half_mm)
        located = float(weights_of(used(contacts)).sum())
        _weigh(contacts, prior, half_mm)
    return used(contacts)


def _weigh(contacts: list[Contact], prior: SensorPrior | None, half_mm: float) -> None:
    """Weigh each press, and name those that count little."""
    left = used(contacts)
    if len(left) < (1 if prior is not None else 2):
        return
    family = Family(2, -1, half_mm) if prior is None else Family.of(prior.response.field)
    for contact in left:
        contact.weight, contact.doubt = 1.0, ""
    evidence = Evidence(family, left)
    if prior is None:
        start = Prior(torch.zeros(2, family.size(), dtype=torch.float64), PENALTY * family.penalty())
    else:
        start = Prior(prior.response.field.tensor(), PRIOR_PRESSES * family.penalty(power_of(left)))
    found = _in_turn(evidence, start)
    shown = found.gains if prior is None else evidence.gains([start.mean] * len(left))
    errors = evidence.errors_deg([evidence.posterior(start).mean] * len(left))
    for k, contact in enumerate(left):
        contact.weight = float(evidence.weights[k])
        contact.metrics |= {"error_deg": errors[k], "gain": float(shown[k])}
        if prior is None:
            contact.metrics["gain_std"] = float(found.std[k])
        others = _others(len(left) - 1, prior is not None)
        if float(found.off[k]) > max(DOUBTED, abs(float(found.far[k]))):
            contact.doubt = _no_ball(contact, float(found.errors_deg[k]), float(found.expected_deg[k]), others)
        elif abs(float(found.far[k])) > DOUBTED:
            contact.doubt = _wrong_diameter(contact, float(found.gains[k]), others)


def _in_turn(evidence: Evidence, prior: Prior) -> Weighed:
    """What presses are by prior and others, with the weights that follow; sets the evidence's weights."""
    std = _uncertainty(evidence, prior)
    evidence.weights = torch.ones_like(std)
    for _ in range(ROUNDS):
        others = evidence.held_out(prior)
        gains = evidence.gains([one.mean for one in others]).clamp_min(1e-3)
        far = (gains / _usual(gains, std / evidence.weights.sqrt())).log() / std
        own = torch.tensor(evidence.errors_deg([evidence.posterior(prior).mean] * len(others)), dtype=torch.float64).median()
        expected = stated_deg(float(own), evidence.variances([one.covariance for one in others]))
        scaled = [one.mean / gain for one, gain in zip(others, gains, strict=True)]
        errors = torch.tensor(evidence.errors_deg(scaled), dtype=torch.float64)
        off = (errors / expected).log() / SLOPES
        counts = torch.minimum(CORE / far.abs().clamp_min(CORE), DOUBTED / off.clamp_min(DOUBTED)) ** 4
        weights = 0.5 * (evidence.weights + counts)
        evidence.weights = weights / weights.max()  # else the prior takes over, all gains fall, and with them all weights
    return Weighed(gains, far, std, errors, expected, off)


def _others(count: int, by_prior: bool) -> str:
    others = f"the other {count} presses" if count > 1 else "the other press"
    return others if not by_prior else "the sensor's prior" + (f" and {others}" if count else "")


def _no_ball(contact: Contact, error_deg: float, expected_deg: float, others: str) -> str:
    return (
        f"counts {contact.weight:.2f} of a press: by {others} its slopes are {error_deg:.0f} degrees from those of a ball of any "
        f"size, {expected_deg:.0f} are expected: two contacts, no ball, or skin that answers otherwise than where they lie"
    )


def _wrong_diameter(contact: Contact, gain: float, others: str) -> str:
    return (
        f"counts {contact.weight:.2f} of a press: by {others} the ball seems {2 * contact.radius_mm / gain:.2f} mm wide, but "
        f"{2 * contact.radius_mm:g} mm was given: a wrong diameter, or skin that answers otherwise than where they lie; more "
        "presses beside it will show which"
    )


def _uncertainty(evidence: Evidence, prior: Prior) -> Tensor:
    """(N,): standard deviation of the gain of each press by a field of the others.

    A press errs by :data:`PRESS_GAIN` of its sines, alike all over it; the normal equations of the others give what that does
    elsewhere. It is large where no other press lies near, and where little light changes: there the others say nothing.
    """
    penalty, form = torch.diag(prior.precision.repeat(2)), evidence.grams.sum(0)
    variance = []
    for item, gram in zip(evidence.forms, evidence.grams):
        inside = item.contact.inside()
        terms, ball = item.terms[:, inside], ball_sine(item.contact)[:, inside]
        along = (ball @ terms.t()).reshape(-1) / ball.square().sum().clamp_min(1e-12)  # of the gain by the coefficients
        carried = along @ torch.linalg.solve(form - gram + penalty, along)
        variance.append(1.0 + ball.square().sum(0).mean() * carried)
    return PRESS_GAIN * torch.stack(variance).sqrt()


def _usual(gains: Tensor, std: Tensor) -> float:
    """The gain of right presses, as a small field is off by one factor in the middle of all: weighted median of gains and one 1."""
    values, order = torch.cat((gains, torch.ones_like(gains[:1]))).sort()
    weights = torch.cat(((PRESS_GAIN / std).square(), torch.ones_like(std[:1])))[order]
    return max(float(values[int((weights.cumsum(0) < 0.5 * weights.sum()).sum())]), 1e-3)
