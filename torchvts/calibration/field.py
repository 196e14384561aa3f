"""Response fields by linear least squares: from presses of known balls, and from what every true surface obeys.

A field is linear in its coefficients, so each contact contributes a quadratic form, and all of them, a prior and a penalty on
coefficients of high degree add up. The forms: on the ball its slope is known; around it, on the skirt, the slope points to
the center; and everywhere the slope of a surface has no curl.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.response_field import ResponseField, term_degrees, term_degrees_by_term, term_values
from .contacts import Contact

CURL_WEIGHT = 3.0
SKIRT_WEIGHT = 0.3
SKIRT_REACH = 2.0
"""The skirt ends at this many contact radii."""
DEGREE_PENALTY = 2.0
"""Each degree in position makes a coefficient this many times dearer: slow fields are the likely ones."""
PRODUCT_PENALTY = 10.0
"""Coefficients of products are this many times dearer: they fit one unit's own ways, and do not carry over to another."""
DEPTH_PENALTY = 3.0
"""Terms with the depth are this many times dearer: half a millimetre is a deep press, and depth alone can tell a ball's shape."""
SLOPE_PENALTY = 0.3
"""Slopes of the depth are this many times as dear: they are slopes already."""


@dataclass(frozen=True)
class Family:
    """What kind of field: its degrees, whether depth is an input, and the scale of positions."""

    degree: int
    product_degree: int
    uses_depth: bool
    half_mm: float
    product_penalty: float = PRODUCT_PENALTY

    def label(self) -> str:
        """Such as "linear 2, products 1, with depth"."""
        products = "" if self.product_degree < 0 else f", products {self.product_degree}"
        return f"linear {self.degree}{products}{', with depth' if self.uses_depth else ''}"

    def penalty(self) -> Tensor:
        """(2 K,): what a unit of each coefficient costs; dz/dx first."""
        by_term = term_degrees_by_term(self.degree, self.product_degree, self.uses_depth)
        dear = [self._term_penalty(term) for term, d in by_term.items() for _ in range((d + 1) * (d + 2) // 2)]
        degrees = torch.tensor(term_degrees(self.degree, self.product_degree, self.uses_depth), dtype=torch.float64)
        return (torch.tensor(dear, dtype=torch.float64) * DEGREE_PENALTY**degrees).repeat(2)

    def _term_penalty(self, term: tuple[int, ...]) -> float:
        if len(term) == 2:
            return self.product_penalty * (DEPTH_PENALTY if 3 in term else 1.0)
        return (1.0, 1.0, 1.0, DEPTH_PENALTY, SLOPE_PENALTY, SLOPE_PENALTY)[term[0]]

    def size(self) -> int:
        """Numbers in a field of this family, both slopes."""
        return 2 * len(term_degrees(self.degree, self.product_degree, self.uses_depth))

    def field(self, coefficient: Tensor) -> ResponseField:
        """The field of coefficients (2 K,)."""
        rows = coefficient.reshape(2, -1).tolist()
        return ResponseField(self.degree, self.product_degree, self.uses_depth, self.half_mm, tuple(tuple(row) for row in rows))

    @classmethod
    def of(cls, field: ResponseField) -> "Family":
        """The family of a field."""
        return cls(field.degree, field.product_degree, field.uses_depth, field.half_mm)

    def terms(self, contact: Contact, shift: int = 0) -> Tensor:
        """(K, N): factors of the coefficients at the sampled pixels, or at neighbours ``shift`` further in memory."""
        index = contact.index + shift
        deep = contact.deep.flatten(1)[:, index] if self.uses_depth else None
        change = contact.change.flatten(1)[:, index]
        return term_values(change, deep, contact.x, contact.y, self.half_mm, self.degree, self.product_degree)


class ContactForms:
    """What one contact says of a family's coefficients."""

    def __init__(self, family: Family, contact: Contact) -> None:
        self.contact = contact
        self.terms = family.terms(contact)
        self.curl = curl_form(family, contact)

    def ball(self) -> tuple[Tensor, Tensor]:
        """Quadratic form (2 K, 2 K) and linear part (2 K,) of a press with its center where it is, over one press's weight."""
        inside = self.contact.inside()
        terms = self.terms[:, inside]
        count = max(1, int(inside.sum()))
        gram = terms @ terms.t() / count
        right = (terms @ self.contact.ball_slope()[:, inside].t() / count).t().reshape(-1)
        form = self.skirt()
        half = len(gram)
        form[:half, :half] += gram
        form[half:, half:] += gram
        return form, right

    def skirt(self) -> Tensor:
        """(2 K, 2 K): slopes across the way to the center, on the skirt, and the curl everywhere."""
        dx, dy, r = self.contact.polar()
        on_skirt = (r > self.contact.contact_radius_mm) & (r < SKIRT_REACH * self.contact.contact_radius_mm)
        form = CURL_WEIGHT * self.curl
        count = int(on_skirt.sum())
        if count < 10:
            return form
        terms = self.terms[:, on_skirt]
        across = torch.cat((-terms * (dy / r)[on_skirt], terms * (dx / r)[on_skirt]))
        return form + SKIRT_WEIGHT * across @ across.t() / count

    def center(self) -> tuple[Tensor, Tensor, Tensor]:
        """How slope and center go together: coupling (2, K), weight of a shift, and the right side it has by itself (2,).

        Around the present center the ball's slope is -(x - c) / down, so a shift of the center by d adds d / down.
        """
        inside = self.contact.inside()
        lean = 1.0 / self.contact.down()[inside]
        count = max(1, len(lean))
        coupling = -(self.terms[:, inside] * lean).sum(1) / count
        weight = lean.square().sum().clamp_min(1e-12) / count
        own = -(self.contact.ball_slope()[:, inside] * lean).sum(1) / count
        return coupling, weight, own

    def slope(self, coefficient: Tensor) -> Tensor:
        """(2, N) slopes that coefficients (2 K,) give at the sampled pixels."""
        return coefficient.reshape(2, -1) @ self.terms

    def error_deg(self, coefficient: Tensor) -> float:
        """Mean angle between the normals of these slopes and of the ball, inside the contact, degrees."""
        inside = self.contact.inside()
        return angle_deg(self.slope(coefficient)[:, inside], self.contact.ball_slope()[:, inside])

    def gain(self, coefficient: Tensor) -> float:
        """Slope found over slope expected: the ball seems this many times smaller than it was said to be."""
        inside = self.contact.inside()
        ball = self.contact.ball_slope()[:, inside]
        return float((self.slope(coefficient)[:, inside] * ball).sum() / ball.square().sum().clamp_min(1e-12))


def curl_form(family: Family, contact: Contact) -> Tensor:
    """(2 K, 2 K): mean squared curl over the sampled pixels, per pixel pitch."""
    width = contact.mask.shape[1]
    across = 0.5 * (family.terms(contact, width) - family.terms(contact, -width))  # d / dy for dz/dx
    along = 0.5 * (family.terms(contact, 1) - family.terms(contact, -1))
    rows = torch.cat((across, -along))
    return rows @ rows.t() / max(1, rows.shape[1])


def angle_deg(slope: Tensor, other: Tensor) -> float:
    """Mean angle between normals of slopes (2, N), degrees."""
    dot = (slope * other).sum(0) + 1.0
    length = ((slope.square().sum(0) + 1.0) * (other.square().sum(0) + 1.0)).sqrt()
    return float(torch.rad2deg(torch.acos((dot / length).clamp(-1.0, 1.0))).mean())


def solve(form: Tensor, right: Tensor, penalty: Tensor, prior: Tensor | None = None) -> Tensor:
    """Coefficients (2 K,) that minimise w' form w - 2 right' w + penalty (w - prior)^2."""
    target = right if prior is None else right + penalty * prior
    solution: Tensor = torch.linalg.solve(form + torch.diag(penalty), target)
    return solution


def solve_with_centers(forms: list[ContactForms], penalty: Tensor, anchors: list[Tensor] | None, anchor_weight: float) -> Tensor:
    """Coefficients and all centers at once; moves the centers. ``anchors`` (mm) hold them by ``anchor_weight`` of a press."""
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
