"""Fit a response field to touches by unknown objects: a surface's slopes have no curl, which gives the field up to one scale.

With slopes linear in the change of intensity, the mean squared curl over some frames is a quadratic form in the coefficients. Its
smallest generalised eigenvector, at unit mean squared slope, is the field; the gap to the next eigenvalue shows how well it is
constrained. The scale needs a ball of known size or a known depth. The curl does not show either how the scale varies over the
image, since slopes that are too long everywhere in a contact have no curl; there the brightness of the background helps: where
it is bright, more of the light comes straight from the LEDs.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from ..core.blur import blur, gaussian_weights
from ..core.geometry import pixel_grid_mm
from ..model.response_field import ResponseField, position_basis
from .contacts import LEAST_INSIDE, Contact, first_pass_depths
from .field import Family, ball_sine, curl_form

TOUCH_BLUR_PX = 3.0
"""Blur of touches at 320 x 240: the curl is a derivative, and its noise biases the field towards smooth channels."""

LEAST_GAP = 4.0
"""Ratio of the second to the first eigenvalue from which a family counts as well constrained."""

BRIGHTNESS_POWER = -0.5
"""Slope per relative change is taken as proportional to this power of the background's brightness. Balls on a GelSight Mini give
-0.75, the network of another Mini -1 or beyond, a lab sensor -0.25, point lights without stray light 0: the middle costs none of
them much."""

BRIGHTNESS_DEGREE = 2
"""Degree of the polynomial in position that stands for it."""

PARAMETERS_PER_TOUCH = 6
"""A field that varies over the image needs touches at several places: one ball at the border gave 18 parameters, 32 degrees off."""

LEAST_SPREAD = 0.05
"""Mean squared slope across the main direction over that along it: below this the touches do not constrain one of the slopes."""


@dataclass(frozen=True)
class TouchFit:
    """A field up to scale.

    Attributes:
        field: the field, with a positive sign: contacts are pressed in.
        family: the family that the touches constrain, without the brightness.
        gap: its ratio of eigenvalues.
        tried: the degrees tried, with their gap and spread.
    """

    field: ResponseField
    family: Family
    gap: float
    tried: list[dict[str, float]]


def touch_blur_px(height: int, width: int) -> float:
    """Blur of touches before the fit, pixels."""
    return TOUCH_BLUR_PX * max(1.0, min(height, width) / 240)


def fit_touches(contacts: list[Contact], light: Tensor, half_mm: float, pitch_mm: float) -> TouchFit:
    """Fit the largest linear family that the touches constrain, times a scale over the image from the background's brightness.

    Args:
        contacts: usable ones, blurred by :func:`touch_blur_px`.
        light: (3, H, W), background, linear light.
        half_mm: scale of positions, mm.
        pitch_mm: pixel pitch, mm.
    Raises:
        ValueError: the touches do not constrain even one constant field; gives the gap.
    """
    tried: list[dict[str, float]] = []
    best: tuple[Family, Tensor, float] | None = None
    gain, normalised = brightness_normalised(contacts, light, half_mm, pitch_mm)
    for degree in (0, 1, 2):
        family = Family(degree, -1, half_mm)
        if degree > 0 and family.size() > PARAMETERS_PER_TOUCH * len(contacts):
            break
        solution, gap = _smallest_eigenvector(family, normalised)
        spread = _spread(family, solution, normalised)
        tried.append({"degree": degree, "parameters": family.size(), "gap": gap, "spread": spread})
        if gap < LEAST_GAP or spread < LEAST_SPREAD:
            break
        best = (family, solution, gap)
    if best is None:
        raise ValueError(
            f"touches: expected contacts that constrain a response field, got an eigenvalue gap of {tried[0]['gap']:.1f} (at least "
            f"{LEAST_GAP:g} is needed) and a spread of directions of {tried[0]['spread']:.2f} (at least {LEAST_SPREAD:g}): all are "
            "alike, flat or faint; add objects with slopes in several directions"
        )
    family, solution, gap = best
    field = multiplied(family.field(solution), gain)
    depth = first_pass_depths(contacts, field, pitch_mm)
    inward = sum(float(one[contact.mask].sum()) for contact, one in zip(contacts, depth))
    return TouchFit(scaled(field, -1.0) if inward < 0 else field, family, gap, tried)


def brightness_normalised(contacts: list[Contact], light: Tensor, half_mm: float, pitch_mm: float) -> tuple[Tensor, list[Contact]]:
    """The scale over the image expected from the background's brightness, and the contacts with changes times that scale.

    Args:
        contacts: any.
        light: (3, H, W), background, linear light.
        half_mm: scale of positions, mm.
        pitch_mm: pixel pitch, mm.
    Returns:
        Coefficients of the scale as a polynomial of degree ``BRIGHTNESS_DEGREE``, and changed copies of the contacts.
    """
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
    """Coefficients of least curl at unit mean squared slope, and the second eigenvalue over the first."""
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
    return ResponseField(degree, -1, field.half_mm, tuple(tuple(row) for row in product.flatten(1).tolist()))


def _powers(degree: int) -> list[tuple[int, int]]:
    """Powers of x and y, in the order of :func:`position_basis`."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def scaled(field: ResponseField, scale: float) -> ResponseField:
    """The field times a number."""
    rows = tuple(tuple(scale * number for number in row) for row in field.coefficient)
    return dataclasses.replace(field, coefficient=rows)


def scale_by_presses(field: ResponseField, presses: list[Contact], rounds: int = 12) -> float:
    """The scale at which the field's sines are those of the balls. The centers move with it; the contact radii stay.

    The sine -(x - center) / radius is linear in the scale and in a shift of the center together.
    """
    family = Family.of(field)
    sines = [field.tensor() @ family.terms(press) for press in presses]
    scale = 0.0
    for _ in range(rounds):
        product = square = 0.0
        parts = []
        for press, sine in zip(presses, sines):
            inside = press.inside()
            if int(inside.sum()) < LEAST_INSIDE:
                continue
            found, ball = sine[:, inside], ball_sine(press)[:, inside]
            free = found - found.mean(1, keepdim=True)  # a shift of the center adds a constant
            product += float((free * ball).sum()) / free.shape[1]
            square += float(free.square().sum()) / free.shape[1]
            parts.append((press, found, ball))
        scale = product / max(square, 1e-30)
        for press, found, ball in parts:
            if not press.known:
                shift = press.radius_mm * (scale * found - ball).mean(1)
                limit = 0.25 * press.radius_mm
                press.center_mm = press.center_mm + shift.clamp(-limit, limit)
    return scale


def presses_as_touches(presses: list[Contact], light: Tensor, half_mm: float, pitch_mm: float) -> ResponseField | None:
    """The field of presses that are used as touches, scaled by their balls; None if they do not constrain one.

    It uses no center, so it is a start for few presses with uncertain centers.
    """
    wide = gaussian_weights(touch_blur_px(*light.shape[1:]))
    smooth = [dataclasses.replace(press, change=blur(press.change[None], wide)[0]) for press in presses]
    try:
        field = fit_touches(smooth, light, half_mm, pitch_mm).field
    except ValueError:
        return None
    scale = scale_by_presses(field, [dataclasses.replace(press) for press in presses])
    return scaled(field, scale) if scale > 0 else None
