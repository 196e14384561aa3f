"""Leave out presses that the others, or the sensor's prior, contradict: wrong diameters, and contacts that are no clean balls."""

import math

import torch
from torch import Tensor

from ..model.response_field import ResponseModel
from ..model.sensor import Sensor
from .balls import locate
from .contacts import Contact, used
from .field import Evidence, Family
from .touches import brightness_normalised

SCREENING_PENALTY = 0.01
"""Regularisation of the small fields by which presses without a prior are compared with each other."""

FAR_FROM_PRIOR = 1.4
FAR_FROM_OTHERS = 1.35
FAR_FROM_ONE = 1.5
"""A diameter is wrong where the ball seems so many times as wide as given: by a prior; relative to all others, by the prior or by
their field; by a single other press elsewhere. Correct ones on a GelSight Mini: by the prior of another ball 0.76 to 1.10, relative
to their median 0.82 to 1.17. Fields of seven presses or fewer are rough: in two draws of five they leave out a good one."""


FAR_IN_SPREADS = 3.0
SPREAD_FROM = 8
"""A gain by the others is also wrong only by so many spreads of their own gains, from this number of presses on."""


def locate_and_screen(
    contacts: list[Contact], light: Tensor, sensor: Sensor, prior: ResponseModel | None, half_mm: float
) -> list[Contact]:
    """Locate the balls and leave out outliers. Without a prior, locate again without them, because they moved the other balls.

    Args:
        contacts: of presses; changed in place.
        light: (3, H, W), background, linear light.
        sensor: of the unit.
        prior: of the sensor's type, or None.
        half_mm: scale of positions, mm.
    Returns:
        The contacts that are used.
    """
    located = None
    while located is None or (prior is None and located > len(used(contacts))):
        locate(contacts, sensor, prior, half_mm)
        located = len(used(contacts))
        _leave_out(contacts, light, sensor.mm_per_pixel, prior, half_mm)
    return used(contacts)


def _leave_out(contacts: list[Contact], light: Tensor, pitch_mm: float, prior: ResponseModel | None, half_mm: float) -> None:
    """Give a reason to presses that the others, or the prior, contradict, one after the other."""
    while True:
        left = used(contacts)
        if len(left) < (1 if prior is not None else 2):
            return
        if prior is not None:
            evidence = Evidence.of(Family.of(prior.field), left)
            solutions = [prior.field.tensor().reshape(-1)] * len(left)
        else:
            # small fields, helped by what the background's brightness says of the place
            family = Family(2 if len(left) >= 8 else 0, -1, half_mm)
            evidence = Evidence.of(family, brightness_normalised(left, light, half_mm, pitch_mm)[1])
            solutions = evidence.held_out(SCREENING_PENALTY * family.penalty(), None)
        gains, errors = evidence.gains(solutions), evidence.errors_deg(solutions)
        for contact, gain, error in zip(left, gains.tolist(), errors):
            contact.metrics |= {"error_deg": error, "gain": gain}
        wrong = _wrong_by_prior(gains) if prior is not None else _wrong_by_others(evidence, gains, left, half_mm)
        if wrong is not None:
            _reject_diameter(left, wrong, float(gains[wrong]), prior is not None)
        elif not _reject_slopes(left, errors, prior is not None):
            return


def _reject_diameter(left: list[Contact], wrong: int, gain: float, by_prior: bool) -> None:
    reference = "the sensor's prior" if by_prior else f"the other {len(left) - 1} presses" if len(left) > 2 else "the other press"
    press = left[wrong]
    seen = 2 * press.radius_mm / max(gain, 1e-3)
    press.reason = f"by {reference} the ball seems {seen:.2f} mm wide, but {2 * press.radius_mm:g} mm was given"
    if not by_prior and len(left) == 2:
        left[1 - wrong].reason = "contradicts the only other press: one of the two diameters is wrong"


def _reject_slopes(left: list[Contact], errors_deg: list[float], by_prior: bool) -> bool:
    """Reject the worst press if its slopes are far from those of a ball."""
    errors = torch.tensor(errors_deg, dtype=torch.float64)
    worst, usual = int(errors.argmax()), float(errors.median())
    error = float(errors[worst])
    # fields too small for a sensor are far off on all presses alike
    far = 15.0 if by_prior or len(left) < 3 else max(15.0, 2.0 * usual)
    if not (error > max(3.0 * usual, 8.0) or error > far):
        return False
    left[worst].reason = f"its slopes are {error:.1f} degrees from a ball's, others' {usual:.1f}: not a clean press"
    return True


def _wrong_by_prior(gains: Tensor) -> int | None:
    """The press with a wrong diameter, if any; gains are slopes by the prior divided by slopes expected."""
    logs = gains.clamp_min(1e-3).log()
    relative = logs - logs.median() if len(logs) > 2 else logs
    for far, limit in ((logs, FAR_FROM_PRIOR), (relative, FAR_FROM_OTHERS)):
        worst = int(far.abs().argmax())
        if float(far[worst].abs()) > math.log(limit):
            return worst
    return None


def _uncertainty(contacts: list[Contact], half_mm: float) -> Tensor:
    """(N,): how uncertain the slopes of each press are by a field of the others, relative to the usual press; at least 1.

    The standard deviation of the slopes along the ball's, by the normal equations of the others. It is large where no other press
    lies near, and where little light changes.
    """
    family = Family(2 if len(contacts) >= 8 else 1, -1, half_mm)
    evidence = Evidence.of(family, contacts)
    penalty = torch.diag(SCREENING_PENALTY * family.penalty())
    spreads = []
    for item, (form, _) in zip(evidence.forms, evidence.each):
        inside = item.contact.inside()
        ball = item.contact.ball_slope()[:, inside]
        along = (
            (item.terms[:, inside] @ ball.t()).t().reshape(-1) / ball.square().sum().sqrt().clamp_min(1e-12) / len(ball[0]) ** 0.5
        )
        spreads.append(along @ torch.linalg.solve(evidence.form - form + penalty, along))
    spread = torch.stack(spreads).sqrt()
    return (spread / spread.median().clamp_min(1e-12)).clamp_min(1.0)


def _wrong_by_others(evidence: Evidence, gains: Tensor, contacts: list[Contact], half_mm: float) -> int | None:
    """The press with a wrong diameter, if any; each gain is by the field of the other presses.

    A wrong press bends the field for all, so the wrong one is that without which the others agree best. It must differ from them
    by more than they differ from each other, and by more where the field is uncertain: where an LED hardly reaches, gains of good
    presses vary.
    """
    logs = gains.clamp_min(1e-3).log()
    if float(logs.abs().max()) <= math.log(FAR_FROM_OTHERS if len(logs) > 2 else FAR_FROM_ONE):
        return None
    if len(logs) == 2:
        return int(logs.abs().argmax())
    penalty = SCREENING_PENALTY * evidence.family.penalty()
    others = []
    for place in range(len(logs)):
        rest = evidence.without(place)
        others.append(rest.gains(rest.held_out(penalty, None)).clamp_min(1e-3).log())
    wrong = min(range(len(logs)), key=lambda place: float(others[place].square().mean()))
    spread = float(others[wrong].abs().median()) / 0.6745 if len(logs) >= SPREAD_FROM else 0.0
    limit = max(math.log(FAR_FROM_OTHERS), FAR_IN_SPREADS * spread) * float(_uncertainty(contacts, half_mm)[wrong])
    return wrong if float(logs[wrong].abs()) > limit else None
