"""A response field from touches by unknown objects: a true surface's slopes have no curl, which pins a field up to one scale.

Slopes linear in the change of intensity make the mean squared curl over some frames a quadratic form in the coefficients. Its
smallest generalised eigenvector, at unit mean squared slope, is the field; how far the next eigenvalue lies above says how well it
is pinned. What the touches do not tell is the scale: a ball of known size, a known depth, or the sensor's prior does.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..core.response import ResponseField, ResponseModel
from .balls import update_radius
from .contacts import Contact, depths
from .field import Family, curl_form, solve

TOUCH_BLUR_PX = 3.0
"""Blur of touches at 320 x 240: the curl is a derivative, and noise in it pulls the field towards smooth channels."""

LEAST_GAP = 4.0
"""The second eigenvalue over the first from which a family counts as pinned."""

LEAST_SPREAD = 0.05
"""Mean squared slope across over along: below it the touches say nothing of one of the two slopes."""


@dataclass(frozen=True)
class TouchFit:
    """A field up to scale: unit mean squared slope, contacts pressed in; how well it is pinned, and the degrees tried."""

    field: ResponseField
    gap: float
    tried: list[dict[str, float]]


def fit_touches(contacts: list[Contact], half_mm: float, pitch_mm: float) -> TouchFit:
    """The largest linear family that the touches pin, and its field.

    Args:
        contacts: usable ones, read with ``TOUCH_BLUR_PX``. half_mm, pitch_mm: as for fields, mm.
    Raises:
        ValueError: the touches pin not even one constant field; says the gap.
    """
    tried: list[dict[str, float]] = []
    best: tuple[Family, Tensor, float] | None = None
    for degree in (0, 1, 2):
        family = Family(degree, -1, False, half_mm)
        solution, gap = _smallest_eigenvector(family, contacts)
        spread = _spread(family, solution, contacts)
        tried.append({"degree": degree, "numbers": family.size(), "gap": gap, "spread": spread})
        if gap < LEAST_GAP or spread < LEAST_SPREAD:
            break
        best = (family, solution, gap)
    if best is None:
        raise ValueError(
            f"touches: expected contacts that pin a response field, got an eigenvalue gap of {tried[0]['gap']:.1f} (at least "
            f"{LEAST_GAP:g} is needed) and a spread of directions of {tried[0]['spread']:.2f} (at least {LEAST_SPREAD:g}): all are "
            "alike, flat or faint; add objects with slopes in several directions"
        )
    family, solution, gap = best
    field = family.field(solution)
    inward = sum(float(depth[contact.mask].sum()) for contact, depth in zip(contacts, depths(contacts, field, pitch_mm)))
    if inward < 0:
        field = family.field(-solution)
    return TouchFit(field, gap, tried)


def _spread(family: Family, solution: Tensor, contacts: list[Contact]) -> float:
    """Mean squared slope across the touches' main direction over that along it: 1 for balls, 0 for a straight ridge."""
    covariance = torch.zeros(2, 2, dtype=torch.float64)
    for contact in contacts:
        slope = solution.reshape(2, -1) @ family.terms(contact)
        covariance += slope @ slope.t() / max(1, slope.shape[1])
    values = torch.linalg.eigvalsh(covariance)
    return float(values[0] / values[1].clamp_min(1e-30))


def _smallest_eigenvector(family: Family, contacts: list[Contact]) -> tuple[Tensor, float]:
    curl = torch.stack([curl_form(family, contact) for contact in contacts]).mean(0)
    energy = torch.zeros_like(curl)
    for contact in contacts:
        terms = family.terms(contact)
        gram = terms @ terms.t() / max(1, terms.shape[1]) / len(contacts)
        energy += torch.block_diag(gram, gram)  # type: ignore[no-untyped-call]
    floor = 1e-9 * float(energy.diagonal().mean()) * torch.eye(len(energy), dtype=energy.dtype)
    whiten = torch.linalg.inv(torch.linalg.cholesky(energy + floor))
    values, vectors = torch.linalg.eigh(whiten @ curl @ whiten.t())
    return whiten.t() @ vectors[:, 0], float(values[1] / values[0].clamp_min(1e-30))


def scaled(field: ResponseField, scale: float) -> ResponseField:
    """The field times a number."""
    rows = tuple(tuple(scale * number for number in row) for row in field.coefficient)
    return ResponseField(field.degree, field.product_degree, field.uses_depth, field.half_mm, rows)


def scale_by_presses(field: ResponseField, presses: list[Contact], pitch_mm: float, rounds: int = 12) -> float:
    """The scale at which the field's slopes are those of the balls, whose centers it finds on the way.

    Slope = -(x - center) / down is linear in the scale and in a shift of the center together.
    """
    family = Family.of(field)
    slopes = [field.tensor() @ family.terms(press) for press in presses]
    scale = 0.0
    for _ in range(rounds):
        product = square = 0.0
        parts = []
        for press, slope in zip(presses, slopes):
            inside = press.inside()
            lean = 1.0 / press.down()[inside]
            found, ball = slope[:, inside], press.ball_slope()[:, inside]
            # eliminate the shift: project found off the lean
            across = lean / lean.square().sum().sqrt()
            free = found - (found @ across)[:, None] * across
            product += float((free * ball).sum()) / free.shape[1]
            square += float(free.square().sum()) / free.shape[1]
            parts.append((found, ball, lean))
        scale = product / max(square, 1e-30)
        for press, slope, (found, ball, lean) in zip(presses, slopes, parts):
            if not press.known:
                shift = ((scale * found - ball) * lean).sum(1) / lean.square().sum()
                limit = 0.25 * press.radius_mm
                press.center_mm = press.center_mm + shift.clamp(-limit, limit)
            update_radius(press, scale * slope, pitch_mm)
    return scale


def scale_by_prior(field: ResponseField, prior: ResponseField, contacts: list[Contact]) -> float:
    """The scale at which the field's slopes are nearest to the prior's over the touches."""
    one, other = Family.of(field), Family.of(prior)
    product = square = 0.0
    for contact in contacts:
        own, given = field.tensor() @ one.terms(contact), prior.tensor() @ other.terms(contact)
        product += float((own * given).mean())
        square += float(own.square().mean())
    return product / max(square, 1e-30)


def moved_by_touches(prior: ResponseModel, contacts: list[Contact], weight: float = 0.1) -> ResponseModel:
    """The prior's fields moved to where these touches have less curl, their scale kept.

    On a unit that the prior fits, this changes nothing to speak of (0.01 degrees on a GelSight Mini); it is for units that differ.

    Args:
        prior: of the sensor's type. contacts: touches. weight: how dear coefficients are, in touches.
    """
    family = Family.of(prior.fast)
    start = prior.fast.tensor().reshape(-1)
    form = torch.stack([curl_form(family, contact) for contact in contacts]).sum(0)
    moved = family.field(solve(form, torch.zeros_like(start), weight * family.penalty(), start))
    moved = scaled(moved, scale_by_prior(moved, prior.fast, contacts))
    if prior.precise is None:
        return ResponseModel(moved, None, prior.gamma, prior.blur_px)
    deep = prior.precise
    size = (deep.degree, deep.product_degree, True)
    change = (moved.tensor() - prior.fast.tensor()).reshape(-1)
    rows = deep.tensor() + family.field(change).lifted(*size).tensor()
    precise = Family.of(deep).field(rows.reshape(-1))
    return ResponseModel(moved, precise, prior.gamma, prior.blur_px)
