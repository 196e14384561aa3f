"""A response field from touches by unknown objects: a true surface's slopes have no curl, which pins a field up to one scale.

Slopes linear in the change of intensity make the mean squared curl over some frames a quadratic form in the coefficients. Its
smallest generalised eigenvector, at unit mean squared slope, is the field; how far the next eigenvalue lies above says how well it
is pinned. What the touches do not tell is the scale: a ball of known size, a known depth, or the sensor's prior does. Nor do
they tell how the scale varies over the image, since a slope that is too long everywhere in a contact has no curl; of that the
image at rest says something: where it is bright, more of the light comes straight from the lamps.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from ..core.blur import blur, gaussian_weights
from ..core.geometry import pixel_grid_mm
from ..model.response_field import ResponseField, ResponseModel, position_basis
from .contacts import LEAST_INSIDE, Contact, depths
from .field import Family, curl_form, solve

TOUCH_BLUR_PX = 3.0
"""Blur of touches at 320 x 240: the curl is a derivative, and noise in it pulls the field towards smooth channels."""

LEAST_GAP = 4.0
"""The second eigenvalue over the first from which a family counts as pinned."""

BRIGHTNESS_POWER = -0.5
"""Slope per relative change is taken to go as the brightness at rest to this power. Balls on a GelSight Mini say -0.75, the
network of another Mini -1 or beyond, a lab sensor -0.25, point lights without stray light 0: half way costs none of them much."""

BRIGHTNESS_DEGREE = 2
"""Of the polynomial in position that stands for it."""

NUMBERS_PER_TOUCH = 6
"""A field that varies over the image takes touches at several places: one ball at the border pinned 18 numbers, 32 degrees off."""

LEAST_SPREAD = 0.05
"""Mean squared slope across over along: below it the touches say nothing of one of the two slopes."""


@dataclass(frozen=True)
class TouchFit:
    """A field up to scale, contacts pressed in; the family that the touches pinned, how well, and the degrees tried."""

    field: ResponseField
    pinned: Family
    gap: float
    tried: list[dict[str, float]]


def touch_blur_px(height: int, width: int) -> float:
    """Blur under which touches are read, pixels."""
    return TOUCH_BLUR_PX * max(1.0, min(height, width) / 240)


def fit_touches(contacts: list[Contact], light: Tensor, half_mm: float, pitch_mm: float) -> TouchFit:
    """The largest linear family that the touches pin, times what the image at rest says of its scale over the image.

    Args:
        contacts: usable ones, read with :func:`touch_blur_px`. light: (3, H, W), linear light at rest. half_mm, pitch_mm: as
            for fields, mm.
    Raises:
        ValueError: the touches pin not even one constant field; says the gap.
    """
    tried: list[dict[str, float]] = []
    best: tuple[Family, Tensor, float] | None = None
    gain, even = evened(contacts, light, half_mm, pitch_mm)
    for degree in (0, 1, 2):
        family = Family(degree, -1, False, half_mm)
        if degree > 0 and family.size() > NUMBERS_PER_TOUCH * len(contacts):
            break
        solution, gap = _smallest_eigenvector(family, even)
        spread = _spread(family, solution, even)
        tried.append({"degree": degree, "parameters": family.size(), "gap": gap, "spread": spread})
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
    field = multiplied(family.field(solution), gain)
    inward = sum(float(depth[contact.mask].sum()) for contact, depth in zip(contacts, depths(contacts, field, pitch_mm)))
    return TouchFit(scaled(field, -1.0) if inward < 0 else field, family, gap, tried)


def evened(contacts: list[Contact], light: Tensor, half_mm: float, pitch_mm: float) -> tuple[Tensor, list[Contact]]:
    """The contacts with their changes times what the image at rest says of the scale, and that as a polynomial in position."""
    height, width = light.shape[1:]
    x, y = pixel_grid_mm(height, width, pitch_mm, torch.float64)
    basis = position_basis(x.expand(height, width), y.expand(height, width), half_mm, BRIGHTNESS_DEGREE)
    bright = light.double().sum(0).clamp_min(1e-3)
    wanted = (bright / bright.mean()) ** BRIGHTNESS_POWER
    gain = torch.linalg.lstsq(basis.flatten(1).t(), wanted.flatten()[:, None]).solution[:, 0]
    scale = torch.tensordot(gain, basis, 1)
    return gain, [dataclasses.replace(contact, change=contact.change * scale) for contact in contacts]


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


def multiplied(field: ResponseField, gain: Tensor) -> ResponseField:
    """A linear field without depth times a polynomial of degree ``BRIGHTNESS_DEGREE`` in position."""
    degree = field.degree + BRIGHTNESS_DEGREE
    powers, own, other = (_powers(d) for d in (degree, field.degree, BRIGHTNESS_DEGREE))
    rows = field.tensor().reshape(2, -1, len(own))
    product = torch.zeros(2, rows.shape[1], len(powers), dtype=torch.float64)
    for k, (i, j) in enumerate(own):
        for factor, (m, n) in zip(gain.tolist(), other):
            product[:, :, powers.index((i + m, j + n))] += factor * rows[:, :, k]
    return ResponseField(degree, -1, False, field.half_mm, tuple(tuple(row) for row in product.flatten(1).tolist()))


def _powers(degree: int) -> list[tuple[int, int]]:
    """Powers of x and y, in the order of :func:`position_basis`."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def scaled(field: ResponseField, scale: float) -> ResponseField:
    """The field times a number."""
    rows = tuple(tuple(scale * number for number in row) for row in field.coefficient)
    return dataclasses.replace(field, coefficient=rows)


def scale_by_presses(field: ResponseField, presses: list[Contact], pitch_mm: float, rounds: int = 12) -> float:
    """The scale at which the field's slopes are those of the balls, whose centers it finds on the way; contact radii stay.

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
            if int(inside.sum()) < LEAST_INSIDE:
                continue
            lean = 1.0 / press.down()[inside]
            found, ball = slope[:, inside], press.ball_slope()[:, inside]
            # eliminate the shift: project found off the lean
            across = lean / lean.square().sum().sqrt()
            free = found - (found @ across)[:, None] * across
            product += float((free * ball).sum()) / free.shape[1]
            square += float(free.square().sum()) / free.shape[1]
            parts.append((press, found, ball, lean))
        scale = product / max(square, 1e-30)
        for press, found, ball, lean in parts:
            if not press.known:
                shift = ((scale * found - ball) * lean).sum(1) / lean.square().sum()
                limit = 0.25 * press.radius_mm
                press.center_mm = press.center_mm + shift.clamp(-limit, limit)
    return scale


def start_of_presses(presses: list[Contact], light: Tensor, half_mm: float, pitch_mm: float) -> ResponseField | None:
    """The field that presses give as if they were touches, and its scale by their balls; None if they pin none.

    It heeds no center, so that few presses whose centers are uncertain have something to start from.
    """
    wide = gaussian_weights(touch_blur_px(*light.shape[1:]))
    smooth = [dataclasses.replace(press, change=blur(press.change[None], wide)[0]) for press in presses]
    try:
        field = fit_touches(smooth, light, half_mm, pitch_mm).field
    except ValueError:
        return None
    scale = scale_by_presses(field, [dataclasses.replace(press) for press in presses], pitch_mm)
    return scaled(field, scale) if scale > 0 else None


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
