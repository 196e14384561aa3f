"""Response fields by linear least squares: from presses of known balls, and from the curl, which every surface has zero.

A field is linear in its coefficients, so each contact contributes a quadratic form, and contacts, a prior and a regularisation
add up. The forms: inside the contact the ball's sine (slope / sqrt(1 + |slope|^2)) is known; in the transition zone around it the
slope points to the center; and everywhere the slope of a surface has no curl, nor, nearly, have sines.
"""

import copy
import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.response_field import (
    CHANGE_SCALE,
    ResponseField,
    monomials,
    sine_from_slope,
    slope_from_sine,
    term_degrees_by_term,
    term_values,
)
from .contacts import Contact

CURL_WEIGHT = 3.0
TRANSITION_WEIGHT = 0.3
TRANSITION_REACH = 2.0
"""The transition zone between ball and undeformed skin ends at this many contact radii."""
DEGREE_PENALTY = 2.0
"""Each degree in position regularises a coefficient this many times more: slowly varying fields are likely."""
CORE = 0.5
"""Share of the contact radius within which slopes are compared with those of a ball of another size."""
LEAST_POWER = 1e-3
"""Least mean square of the changes, so that a field of nothing stays determined."""
PRODUCT_PENALTY = 10.0
"""Coefficients of products are regularised this many times more: they fit one unit and do not carry over to another."""


@dataclass(frozen=True)
class Family:
    """The size of a field.

    Attributes:
        degree: of linear terms in position.
        product_degree: of products in position; -1 for none.
        half_mm: scale of positions, mm.
        product_penalty: regularisation of products relative to linear terms.
        cubic_degree: of products of three in position; -1 for none.
    """

    degree: int
    product_degree: int
    half_mm: float
    product_penalty: float = PRODUCT_PENALTY
    cubic_degree: int = -1

    def degrees(self) -> dict[tuple[int, ...], int]:
        """Degree in position of every term, in order."""
        return term_degrees_by_term(self.degree, self.product_degree, self.cubic_degree)

    def holds(self, other: "Family") -> bool:
        """Whether every field of the other family is one of this family."""
        own = self.degrees()
        return all(own.get(term, -1) >= degree for term, degree in other.degrees().items())

    def with_all_of(self, other: "Family") -> "Family":
        """The smallest family that holds this one and the other."""
        return dataclasses.replace(
            self,
            degree=max(self.degree, other.degree),
            product_degree=max(self.product_degree, other.product_degree),
            cubic_degree=max(self.cubic_degree, other.cubic_degree),
        )

    def places_in(self, larger: "Family") -> Tensor:
        """(2 K,): where the coefficients of this family stand among those of one that holds it."""
        theirs = {place: k for k, place in enumerate(larger.powers())}
        half = torch.tensor([theirs[place] for place in self.powers()])
        return torch.cat((half, half + len(theirs)))

    def powers(self) -> list[tuple[tuple[int, ...], int, int]]:
        """Term and powers of x and y of every coefficient of a slope, in order."""
        return [(term, i, j) for term, d in self.degrees().items() for i in range(d + 1) for j in range(d + 1 - i)]

    def label(self) -> str:
        """Such as "linear 2, products 1, cubic 0"."""
        parts = (("linear", self.degree), ("products", self.product_degree), ("cubic", self.cubic_degree))
        return ", ".join(f"{name} {degree}" for name, degree in parts if degree >= 0)

    def penalty(self, power: float = 1.0) -> Tensor:
        """(2 K,): regularisation of each coefficient; along x first.

        Args:
            power: of the unit's changes, from :func:`power_of`, so that a coefficient counts by what it adds to the sine: else a
                unit of faint changes is regularised more strongly than one of strong changes.
        """
        factors = [
            (1.0 if len(term) == 1 else self.product_penalty) * DEGREE_PENALTY ** (i + j) * power ** len(term)
            for term, i, j in self.powers()
        ]
        return torch.tensor(factors, dtype=torch.float64).repeat(2)

    def size(self) -> int:
        """Number of parameters of a field of this family, both slopes."""
        return 2 * sum(map(monomials, self.degrees().values()))

    def field(self, coefficient: Tensor) -> ResponseField:
        """The field of coefficients (2 K,)."""
        rows = coefficient.reshape(2, -1).tolist()
        return ResponseField(self.degree, self.product_degree, self.half_mm, tuple(tuple(row) for row in rows), self.cubic_degree)

    @classmethod
    def of(cls, field: ResponseField) -> "Family":
        """The family of a field."""
        return cls(field.degree, field.product_degree, field.half_mm, cubic_degree=field.cubic_degree)

    def terms(self, contact: Contact, shift: int = 0, every: int = 1) -> Tensor:
        """(K, N): factors of the coefficients at the sampled pixels, or every so many, or at pixels ``shift`` further in memory."""
        change = contact.change.flatten(1)[:, contact.index[::every] + shift]
        return term_values(change, contact.x[::every], contact.y[::every], self.half_mm, self.degrees())

    def terms_of(self, contact: Contact, change: Tensor) -> Tensor:
        """(K, N): the same for another change (3, N) at the sampled pixels."""
        return term_values(change, contact.x, contact.y, self.half_mm, self.degrees())


class ContactForms:
    """The quadratic forms that one contact contributes to a family's coefficients."""

    def __init__(self, family: Family, contact: Contact) -> None:
        self.contact = contact
        self.terms = family.terms(contact)
        self.curl = curl_form(family, contact)

    def part(self, places: Tensor) -> "ContactForms":
        """The forms of a smaller family, whose coefficients have these places (2 K,)."""
        forms = copy.copy(self)
        forms.terms, forms.curl = self.terms[places[: len(places) // 2]], self.curl[places][:, places]
        return forms

    def ball(self) -> tuple[Tensor, Tensor]:
        """Quadratic form (2 K, 2 K) and linear part (2 K,) of a press with its center fixed, of weight one per press."""
        inside = self.contact.inside()
        terms = self.terms[:, inside]
        count = max(1, int(inside.sum()))
        gram = terms @ terms.t() / count
        right = (terms @ ball_sine(self.contact)[:, inside].t() / count).t().reshape(-1)
        form = self.transition_and_curl()
        half = len(gram)
        form[:half, :half] += gram
        form[half:, half:] += gram
        return form, right

    def transition_and_curl(self) -> Tensor:
        """(2 K, 2 K): slopes across the direction to the center in the transition zone, and the curl everywhere."""
        dx, dy, r = self.contact.polar()
        zone = (r > self.contact.contact_radius_mm) & (r < TRANSITION_REACH * self.contact.contact_radius_mm)
        form = CURL_WEIGHT * self.curl
        count = int(zone.sum())
        if count < 10:
            return form
        terms = self.terms[:, zone]
        across = torch.cat((-terms * (dy / r)[zone], terms * (dx / r)[zone]))
        return form + TRANSITION_WEIGHT * across @ across.t() / count

    def center(self) -> tuple[Tensor, Tensor, Tensor]:
        """How sine and center depend on each other: coupling (2, K), weight of a shift, and the shift's own right side (2,).

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
        """(2, N) slopes by coefficients (2 K,) at the sampled pixels."""
        return slope_from_sine(coefficient.reshape(2, -1) @ self.terms)

    def errors_deg(self, coefficients: Tensor) -> list[float]:
        """For each of coefficients (P, 2 K) the mean angle between the normals of their slopes and of the ball, inside the contact,
        degrees."""
        inside = self.contact.inside()
        terms, ball = self.terms[:, inside], self.contact.ball_slope()[:, inside]
        return [angle_deg(slope_from_sine(coefficient.reshape(2, -1) @ terms), ball) for coefficient in coefficients]

    def gain(self, coefficient: Tensor) -> float:
        """Sine found divided by sine expected in the middle of the contact: the ball seems this many times smaller than given.

        Of a ball that is smaller than given, too wide a contact is found, and around its middle slopes are no longer the ball's.
        """
        core = self.contact.polar()[2] < CORE * self.contact.contact_radius_mm
        ball = ball_sine(self.contact)[:, core]
        found = coefficient.reshape(2, -1) @ self.terms[:, core]
        return float((found * ball).sum() / ball.square().sum().clamp_min(1e-12))


class Evidence:
    """The forms of all contacts for a family's coefficients, together and without one."""

    def __init__(self, family: Family, forms: list[ContactForms], each: list[tuple[Tensor, Tensor]]) -> None:
        self.family, self.forms, self.each = family, forms, each
        self.form = torch.stack([form for form, _ in each]).sum(0)
        self.right = torch.stack([right for _, right in each]).sum(0)

    @classmethod
    def of(cls, family: Family, contacts: list[Contact]) -> "Evidence":
        """The forms of contacts, each with its center fixed."""
        forms = [ContactForms(family, contact) for contact in contacts]
        return cls(family, forms, [item.ball() for item in forms])

    def part(self, family: Family) -> "Evidence":
        """The same for a family that this one holds: what the two have in common is not worked out again."""
        places = family.places_in(self.family)
        each = [(form[places][:, places], right[places]) for form, right in self.each]
        return Evidence(family, [item.part(places) for item in self.forms], each)

    def without(self, place: int) -> "Evidence":
        """The same without one contact."""
        others = [k for k in range(len(self.forms)) if k != place]
        return Evidence(self.family, [self.forms[k] for k in others], [self.each[k] for k in others])

    def penalty(self, strength: float) -> Tensor:
        """(2 K,): regularisation towards zero by so many presses."""
        return strength * self.family.penalty(power_of([item.contact for item in self.forms]))

    def gains(self, solutions: list[Tensor]) -> Tensor:
        """For each contact the slopes by its coefficients divided by the ball's."""
        return torch.tensor([item.gain(solution) for item, solution in zip(self.forms, solutions)], dtype=torch.float64)

    def errors_deg(self, solutions: list[Tensor]) -> list[float]:
        """For each contact the mean angle under its coefficients, degrees."""
        return [item.errors_deg(solution[None])[0] for item, solution in zip(self.forms, solutions)]

    def held_out_errors_deg(self, penalties: list[Tensor], start: Tensor | None) -> list[list[float]]:
        """For each penalty and contact the mean angle under the coefficients by all other contacts, degrees."""
        solutions = zip(*(self.held_out(penalty, start) for penalty in penalties))
        errors = [item.errors_deg(torch.stack(each)) for item, each in zip(self.forms, solutions)]
        return [list(row) for row in zip(*errors)]

    def mean_error_deg(self, solutions: list[Tensor]) -> float:
        """Mean of :meth:`errors_deg` over contacts of which pixels are seen; infinite where there are none."""
        errors = [error for error in self.errors_deg(solutions) if not math.isnan(error)]
        return sum(errors) / len(errors) if errors else math.inf

    def solve(self, penalty: Tensor, start: Tensor | None) -> Tensor:
        """Coefficients by all contacts."""
        return solve(self.form, self.right, penalty, start)

    def held_out(self, penalty: Tensor, start: Tensor | None) -> list[Tensor]:
        """For each contact the coefficients by all others."""
        return [solve(self.form - form, self.right - right, penalty, start) for form, right in self.each]


def seen_slopes(field: ResponseField, contacts: Sequence[Contact]) -> Tensor:
    """(2, 2): from the balls' slopes to those that a field finds, by least squares; the identity where all are found."""
    family, coefficient = Family.of(field), field.tensor().reshape(-1)
    found, given = torch.zeros(2, 2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
    for contact in contacts:
        inside = contact.inside()
        ball = contact.ball_slope()[:, inside]
        found += ContactForms(family, contact).slope(coefficient)[:, inside] @ ball.t() / max(1, int(inside.sum()))
        given += ball @ ball.t() / max(1, int(inside.sum()))
    seen: Tensor = found @ torch.linalg.pinv(given)
    return seen


def power_of(contacts: list[Contact]) -> float:
    """Mean square of the changes within contacts, in units of ``CHANGE_SCALE``, summed over the channels.

    It is 0.9 on a pale GelSight, 1.5 and 2.0 on two GelSight Minis and 4.6 on a DIGIT.
    """
    changes = [contact.change.flatten(1)[:, contact.index[contact.inside()]] for contact in contacts]
    squares = [float(change.square().sum(0).mean()) for change in changes if change.shape[1] > 0]
    return max(sum(squares) / max(1, len(squares)) / CHANGE_SCALE**2, LEAST_POWER)


def ball_sine(contact: Contact) -> Tensor:
    """(2, N): sine of the ball's surface at the sampled pixels, -(x - center) / radius."""
    return sine_from_slope(contact.ball_slope())


def curl_form(family: Family, contact: Contact) -> Tensor:
    """(2 K, 2 K): mean squared curl over every third sampled pixel, per pixel pitch. All of them give nothing more."""
    width = contact.mask.shape[1]
    across = 0.5 * (family.terms(contact, width, 3) - family.terms(contact, -width, 3))  # d / dy for dz/dx
    along = 0.5 * (family.terms(contact, 1, 3) - family.terms(contact, -1, 3))
    rows = torch.cat((across, -along))
    return rows @ rows.t() / max(1, rows.shape[1])


def angle_deg(slope: Tensor, other: Tensor) -> float:
    """Mean angle between normals of slopes (2, N), degrees."""
    dot = (slope * other).sum(0) + 1.0
    length = ((slope.square().sum(0) + 1.0) * (other.square().sum(0) + 1.0)).sqrt()
    return float(torch.rad2deg(torch.acos((dot / length).clamp(-1.0, 1.0))).mean())


def solve(form: Tensor, right: Tensor, penalty: Tensor, prior: Tensor | None = None) -> Tensor:
    """Coefficients w (2 K,) that minimise w' form w - 2 right' w + penalty (w - prior)^2."""
    target = right if prior is None else right + penalty * prior
    solution: Tensor = torch.linalg.solve(form + torch.diag(penalty), target)
    return solution


def solve_with_centers(forms: list[ContactForms], penalty: Tensor, anchors: list[Tensor] | None, anchor_weight: float) -> Tensor:
    """Solve for the coefficients and all centers at once, and move the centers.

    Args:
        forms: one per press.
        penalty: (2 K,), regularisation.
        anchors: positions (2,), mm, that regularise the centers; None for none.
        anchor_weight: weight of that regularisation, in presses.
    Returns:
        Coefficients (2 K,).
    """
    size = len(penalty)
    half, count = size // 2, len(forms)
    matrix = torch.zeros(size + 2 * count, size + 2 * count, dtype=torch.float64)
    right = torch.zeros(size + 2 * count, dtype=torch.float64)
    for k, item in enumerate(forms):
        form, ball = item.ball()
        matrix[:size, :size] += form
        right[:size] += ball
        coupling, weight, own = item.center()
        for axis in range(2):
            part, place = slice(axis * half, (axis + 1) * half), size + 2 * k + axis
            matrix[part, place] += coupling
            matrix[place, part] += coupling
            matrix[place, place] += weight * (1e9 if item.contact.known else 1.001 + anchor_weight)
            right[place] += own[axis]
            if anchors is not None:
                right[place] += weight * anchor_weight * (anchors[k][axis] - item.contact.center_mm[axis])
    matrix[:size, :size] += torch.diag(penalty)
    solution: Tensor = torch.linalg.solve(matrix, right)
    for k, item in enumerate(forms):
        if item.contact.known:
            continue
        limit = min(0.15 * item.contact.radius_mm, 0.5 * item.contact.contact_radius_mm)
        item.contact.center_mm = item.contact.center_mm + solution[size + 2 * k : size + 2 * k + 2].clamp(-limit, limit)
    return solution[:size]
