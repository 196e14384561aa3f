"""What one located press says of a response field, which is linear in its coefficients: a quadratic form.

The sine of a ball's surface, slope / sqrt(1 + |slope|^2), is -(x - center) / radius inside the contact, and around it the slope
points to the center. A field gives the sine w phi, with coefficients w (2, K) and factors phi (K,) at each pixel. So the mean
squared error of a press is w G w' - 2 R w' + const, with w as one row (2 K,),

    G = mean(phi phi') of either slope inside + 0.3 mean((t phi) (t phi)') around,    R = mean(sine phi') inside,

where t is the direction across that to the center. Presses add up, and so does a Gaussian prior: see posterior.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.response_field import (
    CHANGE_SCALE,
    ResponseField,
    Terms,
    powers,
    sine_from_slope,
    slope_from_sine,
    term_values,
)
from .contacts import CORE, LEAST_SAMPLES, Contact

TRANSITION_WEIGHT = 0.3
"""Weight of the transition zone around a contact."""
TRANSITION_REACH = 2.0
"""The transition zone between ball and undeformed skin ends at this many contact radii."""
ORDER_PENALTY = (1.0, 10.0, 30.0)
"""Prior precision of linear terms, products of two, and of three, relative to each other: products fit one unit and one place."""
DEGREE_PENALTY = 2.0
"""Each degree in position multiplies it: slowly varying fields are likely."""
USUAL_SINE = 0.3
"""Sine of the skin's slope within contacts of balls, root mean square, that a field is meant for: of real sets 0.28 to 0.49."""


@dataclass(frozen=True)
class Family(Terms):
    """The size of a field: K coefficients of each slope.

    Attributes:
        degree: of linear terms in position.
        product_degree: of products in position; -1 for none.
        half_mm: scale of positions, mm.
        cubic_degree: of products of three in position; -1 for none.
    """

    degree: int
    product_degree: int
    half_mm: float
    cubic_degree: int = -1

    def penalty(self, power: float = 1.0) -> Tensor:
        """(K,): how much less likely than a constant linear term each coefficient is, as a precision.

        Args:
            power: of the unit's changes, from :func:`power_of`, so that a coefficient counts by what it adds to the sine: else a
                unit of faint changes is regularised more strongly than one of strong changes.
        """
        factors = [
            ORDER_PENALTY[len(term) - 1] * DEGREE_PENALTY ** (i + j) * power ** len(term) for term, i, j in powers(self.degrees())
        ]
        return torch.tensor(factors, dtype=torch.float64)

    def field(self, coefficient: Tensor) -> ResponseField:
        """The field of coefficients (2, K)."""
        rows = tuple(tuple(row) for row in coefficient.tolist())
        return ResponseField(self.degree, self.product_degree, self.half_mm, rows, self.cubic_degree)

    @classmethod
    def of(cls, field: ResponseField) -> "Family":
        """The family of a field."""
        return cls(field.degree, field.product_degree, field.half_mm, field.cubic_degree)

    def terms(self, contact: Contact) -> Tensor:
        """(K, N): factors of the coefficients at the sampled pixels."""
        return self.terms_of(contact, contact.change.flatten(1)[:, contact.index])

    def terms_of(self, contact: Contact, change: Tensor) -> Tensor:
        """(K, N): the same for another change (3, N) at the sampled pixels."""
        return term_values(change, contact.x, contact.y, self.half_mm, self.degrees())


class ContactForms:
    """What one press says of the coefficients of a family."""

    def __init__(self, family: Family, contact: Contact) -> None:
        self.contact = contact
        self.terms = family.terms(contact)

    def ball(self) -> tuple[Tensor, Tensor]:
        """G (2 K, 2 K) and R (2 K,) of the press with its center where it is, of weight one per press."""
        inside = self.contact.inside()
        terms, count = self.terms[:, inside], max(1, int(inside.sum()))
        gram = terms @ terms.t() / count
        form: Tensor = torch.block_diag(gram, gram)  # type: ignore[no-untyped-call]
        right = ball_sine(self.contact)[:, inside] @ terms.t() / count
        dx, dy, r = self.contact.polar()
        zone = (r > self.contact.contact_radius_mm) & (r < TRANSITION_REACH * self.contact.contact_radius_mm)
        if (count := int(zone.sum())) >= LEAST_SAMPLES:
            around = self.terms[:, zone]
            across = torch.cat((-around * (dy / r)[zone], around * (dx / r)[zone]))
            form = form + TRANSITION_WEIGHT * across @ across.t() / count
        return form, right.reshape(-1)

    def center(self) -> tuple[Tensor, Tensor, Tensor]:
        """How sine and center depend on each other: coupling (K,), weight of a shift, and the shift's own right side (2,).

        The ball's sine is -(x - c) / radius, so a shift of the center by d adds d / radius, everywhere.
        """
        inside = self.contact.inside()
        per_shift = 1.0 / max(self.contact.radius_mm, 1e-6)
        count = max(1, int(inside.sum()))
        coupling = -self.terms[:, inside].sum(1) * per_shift / count
        weight = torch.tensor(per_shift**2, dtype=torch.float64)
        own = -ball_sine(self.contact)[:, inside].sum(1) * per_shift / count
        return coupling, weight, own

    def slope(self, coefficient: Tensor) -> Tensor:
        """(2, N) slopes by coefficients (2, K) at the sampled pixels."""
        return slope_from_sine(coefficient @ self.terms)

    def error_deg(self, coefficient: Tensor) -> float:
        """Mean angle between the normals by coefficients (2, K) and those of the ball, inside the contact, degrees."""
        inside = self.contact.inside()
        slope = slope_from_sine(coefficient @ self.terms[:, inside])
        return angle_deg(slope, self.contact.ball_slope()[:, inside])

    def gain(self, coefficient: Tensor) -> float:
        """Sine found divided by sine expected in the middle of the contact: the ball seems this many times smaller than given.

        Of a ball that is smaller than given, too wide a contact is found, and around its middle slopes are no longer the ball's.
        """
        core = self.contact.polar()[2] < CORE * self.contact.contact_radius_mm
        ball = ball_sine(self.contact)[:, core]
        found = coefficient @ self.terms[:, core]
        return float((found * ball).sum() / ball.square().sum().clamp_min(1e-12))


def seen_slopes(field: ResponseField, contacts: Sequence[Contact]) -> Tensor:
    """(2, 2): from the balls' slopes to those that a field finds, by least squares; the identity where all are found."""
    family, coefficient = Family.of(field), field.tensor()
    found, given = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
    for contact in contacts:
        inside = contact.inside()
        ball = contact.ball_slope()[:, inside]
        share = contact.weight / max(1, int(inside.sum()))
        found += share * ContactForms(family, contact).slope(coefficient)[:, inside] @ ball.t()
        given += share * ball @ ball.t()
    seen: Tensor = found @ torch.linalg.pinv(given)
    return seen


def power_of(contacts: Sequence[Contact]) -> float:
    """Mean square of the changes within contacts, in units of ``CHANGE_SCALE``, summed over the channels.

    Shallow contacts count as if they were as steep as usual: else they leave products free, which become large in steeper skin.
    It is 0.8 on a pale GelSight, 1.6 and 2.8 on two GelSight Minis and 5 on a DIGIT.
    """
    inside = [(contact, contact.inside()) for contact in contacts]
    changes = [float(one.change.flatten(1)[:, one.index[some]].square().sum(0).mean()) for one, some in inside if some.any()]
    sines = [float(ball_sine(one)[:, some].square().sum(0).mean()) for one, some in inside if some.any()]
    steeper = max(1.0, USUAL_SINE**2 * len(sines) / max(sum(sines), 1e-9))
    return steeper * sum(changes) / max(1, len(changes)) / CHANGE_SCALE**2 or 1.0  # so that a field of nothing stays determined


def ball_sine(contact: Contact) -> Tensor:
    """(2, N): sine of the ball's surface at the sampled pixels, -(x - center) / radius."""
    return sine_from_slope(contact.ball_slope())


def angle_deg(slope: Tensor, other: Tensor) -> float:
    """Mean angle between normals of slopes (2, N), degrees."""
    dot = (slope * other).sum(0) + 1.0
    length = ((slope.square().sum(0) + 1.0) * (other.square().sum(0) + 1.0)).sqrt()
    return float(torch.rad2deg(torch.acos((dot / length).clamp(-1.0, 1.0))).mean())


def solve_with_centers(forms: list[ContactForms], penalty: Tensor, anchors: list[Tensor] | None, anchor_weight: float) -> Tensor:
    """Solve for the coefficients and all centers at once, and move the centers.

    Args:
        forms: one per press.
        penalty: (K,), regularisation.
        anchors: positions (2,), mm, that regularise the centers; None for none.
        anchor_weight: weight of that regularisation, in presses.
    Returns:
        Coefficients (2, K).
    """
    half, count = len(penalty), len(forms)
    size = 2 * half
    matrix = torch.zeros(size + 2 * count, size + 2 * count, dtype=torch.float64)
    right = torch.zeros(size + 2 * count, dtype=torch.float64)
    for k, item in enumerate(forms):
        form, ball = item.ball()
        matrix[:size, :size] += item.contact.weight * form
        right[:size] += item.contact.weight * ball
        coupling, weight, own = (item.contact.weight * part for part in item.center())
        for axis in range(2):
            part, place = slice(axis * half, (axis + 1) * half), size + 2 * k + axis
            matrix[part, place] += coupling
            matrix[place, part] += coupling
            matrix[place, place] += weight * (1e9 if item.contact.known else 1.001 + anchor_weight)
            right[place] += own[axis]
            if anchors is not None:
                right[place] += weight * anchor_weight * (anchors[k][axis] - item.contact.center_mm[axis])
    matrix[:size, :size] += torch.diag(penalty.repeat(2))
    solution: Tensor = torch.linalg.solve(matrix, right)
    for k, item in enumerate(forms):
        if item.contact.known:
            continue
        limit = min(0.15 * item.contact.radius_mm, 0.5 * item.contact.contact_radius_mm)
        item.contact.center_mm = item.contact.center_mm + solution[size + 2 * k : size + 2 * k + 2].clamp(-limit, limit)
    return solution[:size].reshape(2, half)
