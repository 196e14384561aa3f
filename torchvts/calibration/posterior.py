r"""A response field is one Gaussian posterior: a prior of fields and any number of located presses, by one linear solve.

The coefficients w (2 K,) of a field, of both slopes, are Gaussian before any press: mean m, precision diag(p). A press of a ball
adds its mean squared error (field.py: G, R) as a log likelihood, so that after n of them, up to the noise of a press,

    C = (diag(p) / n + sum G)^-1     (2 K, 2 K), the covariance
    w = C (diag(p) m / n + sum R)    (2 K,), the mean.

The prior's part falls with n, because presses err alike in what a field cannot describe, and that does not average. There is one
family of fields, the largest: what no press shows keeps the prior. The prior is that of all sensors (m = 0) or that of a sensor
type (the field of its units, and how far units differ from it), and no press at all leaves it as it is.

C says what is not known. What is kept is the mean of its blocks of the two slopes, (K, K), divided by sqrt(n), between errors that
presses have alike and errors that average: phi' C phi is large where no ball was pressed, and for steeper skin than any ball's.
With ``own``, the mean error of the field on its own presses, the error of normals is expected to be
(:func:`torchvts.model.stated_deg`)

    sqrt(own^2 (1 + 0.15 phi' C phi) + 1.5^2) degrees.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..model.response_field import ResponseField, SensorPrior
from ..model.stated_error import variance_of
from .contacts import Contact
from .field import ContactForms, Family, power_of

LARGEST = (4, 3, 1)
"""Degrees in position of linear terms, products of two, and of three."""

FEW = 3
"""Presses from which a field is judged by each of them by the others."""

ALL_SENSORS = 0.015
"""Prior precision of a constant linear term over all sensors, in presses."""


class Prior(NamedTuple):
    """Gaussian prior of the coefficients of a family, for a number of presses.

    Attributes:
        mean: (2, K).
        precision: (K,), the same of both slopes.
    """

    mean: Tensor
    precision: Tensor


@dataclass(frozen=True, eq=False)
class Posterior:
    """What prior and presses say of a field.

    Attributes:
        family: of the field.
        mean: (2, K).
        covariance: (K, K), mean of those of the two slopes, up to the noise of a press, divided by the root of their number.
    """

    family: Family
    mean: Tensor
    covariance: Tensor

    @property
    def field(self) -> ResponseField:
        """The most likely field."""
        return self.family.field(self.mean)


def largest(half_mm: float) -> Family:
    """The family that presses are fitted with."""
    return Family(*LARGEST[:2], half_mm, LARGEST[2])


def prior_of(family: Family, contacts: Sequence[Contact], of_type: SensorPrior | None = None) -> Prior:
    """The prior of a sensor type, or of all sensors, for so many presses.

    Args:
        family: that holds the type's fields.
        contacts: of the presses; that of all sensors takes the strength of their changes.
        of_type: the sensor's prior, or None.
    """
    count = max(1.0, float(weights_of(contacts).sum()))
    if of_type is None:
        return Prior(torch.zeros(2, family.size(), dtype=torch.float64), ALL_SENSORS / count * family.penalty(power_of(contacts)))
    mean = of_type.response.field.embedded(family.degree, family.product_degree, family.cubic_degree).tensor()
    return Prior(mean, of_type.precision / count * family.penalty(of_type.power))


class Evidence:
    """What located presses say of a family's coefficients, together and without one.

    Attributes:
        weights: (N,), how much of a press each counts.
    """

    def __init__(self, family: Family, contacts: Sequence[Contact]) -> None:
        self.family = family
        self.forms = [ContactForms(family, contact) for contact in contacts]
        each = [item.ball() for item in self.forms]
        size = 2 * family.size()
        self.grams = torch.stack([gram for gram, _ in each]) if each else torch.zeros(0, size, size, dtype=torch.float64)
        self.rights = torch.stack([right for _, right in each]) if each else torch.zeros(0, size, dtype=torch.float64)
        self.weights = weights_of(contacts)

    def posterior(self, prior: Prior, weights: Tensor | None = None) -> Posterior:
        """Mean and covariance by all presses with their weights, or with other ``weights`` (N,)."""
        weight = self.weights if weights is None else weights
        half, precision = self.family.size(), prior.precision.repeat(2)
        form = torch.diag(precision) + torch.tensordot(weight, self.grams, 1)
        covariance = torch.cholesky_inverse(torch.linalg.cholesky(form))
        mean = covariance @ (precision * prior.mean.reshape(-1) + torch.tensordot(weight, self.rights, 1))
        both = 0.5 * (covariance[:half, :half] + covariance[half:, half:]) / weight.sum().clamp_min(1.0).sqrt()
        return Posterior(self.family, mean.reshape(2, half), both)

    def held_out(self, prior: Prior) -> list[Posterior]:
        """For each press the posterior by all others."""
        others = self.weights * (1.0 - torch.eye(len(self.forms), dtype=torch.float64))
        return [self.posterior(prior, weights) for weights in others]

    def held_out_deg(self, prior: Prior) -> list[float]:
        """For each press the mean angle by all others, degrees."""
        return self.errors_deg([one.mean for one in self.held_out(prior)])

    def variances(self, covariances: Sequence[Tensor]) -> Tensor:
        """(N,): for each press the mean variance of its sines, phi' C phi, by its covariance (K, K)."""
        inside = [item.terms[:, item.contact.inside()] for item in self.forms]
        return torch.stack([variance_of(*both).mean() for both in zip(inside, covariances, strict=True)])

    def errors_deg(self, coefficients: Sequence[Tensor]) -> list[float]:
        """For each press the mean angle under its coefficients (2, K), degrees."""
        return [item.error_deg(coefficient) for item, coefficient in zip(self.forms, coefficients, strict=True)]

    def gains(self, coefficients: Sequence[Tensor]) -> Tensor:
        """(N,): for each press the slopes by its coefficients divided by the ball's."""
        gains = [item.gain(coefficient) for item, coefficient in zip(self.forms, coefficients, strict=True)]
        return torch.tensor(gains, dtype=torch.float64)


def weights_of(contacts: Sequence[Contact]) -> Tensor:
    """(N,): how much of a press each counts."""
    return torch.tensor([contact.weight for contact in contacts], dtype=torch.float64)
