"""Move located balls so that the skin around them closes: undeformed skin all around a contact means no net slope over a disc.

Balls that are located jointly with a response field drift where pressed skin is darker or brighter for its depth alone: the field
takes that for a slope, and the centers follow. Held-out angles inside the contacts do not show it; they are even better with the
drift. The tilt does, because it leaves the skin around the contact on different heights.
"""

import dataclasses

import torch
from torch import Tensor

from .contacts import Contact
from .field import Family
from .posterior import FEW, Evidence, Prior

REACH = 1.5
"""Radius of the disc, in contact radii."""

STEP = 0.7
"""Part of the predicted error that is taken away at once. On drawn sensors errors are 0.6 to 1.0 of what is predicted."""

CLOSURE_ROUNDS = 3

LEFT = 0.75
"""Net slope that may be left after the shift, as a part of that before, in the mean over the two largest families."""

MOST_SATURATED = 0.05
"""Saturated part of the disc from which its net slope says nothing."""

MOST_CUT = 0.5
"""Share of the presses that may be without a net slope: cut by the image border, or saturated."""

PENALTY = 0.01
"""Regularisation of the fields by which balls are located and compared where there is no prior, in presses."""


def close_loops(contacts: list[Contact], half_mm: float) -> None:
    """Move the centers by what loop closure predicts, as long as slopes in and around the contacts agree better; in place.

    Tried are one common shift, and then a shift of each ball. The score is the held-out angle inside the contact and the angle of
    the net slope over the disc, both as root mean squares over the presses, added in squares. The contact radii stay.

    Args:
        contacts: of presses with located balls.
        half_mm: scale of positions, mm.
    """
    if len(contacts) < FEW or all(contact.known for contact in contacts):
        return
    degrees = ((1, -1), (2, -1), (2, 1)) if len(contacts) >= 5 else ((0, -1), (1, -1))
    before = [_Rating(Family(degree, products, half_mm), contacts) for degree, products in degrees]
    found = min(before, key=lambda rating: rating.inside_deg)
    if float(found.errors_mm.isnan().any(1).double().mean()) > MOST_CUT:
        return
    for common in (True, False):
        for _ in range(CLOSURE_ROUNDS):
            moved = _Rating(found.family, _moved(found.contacts, found.errors_mm, common))
            if moved.score() >= found.score():
                break
            found = moved
    after = [_Rating(rating.family, found.contacts) for rating in before[-2:]]
    left = [one.around_deg / max(other.around_deg, 1e-9) for one, other in zip(after, before[-2:])]
    if sum(left) / len(left) > LEFT:
        return
    for contact, moved_contact in zip(contacts, found.contacts):
        contact.center_mm = moved_contact.center_mm


class _Rating:
    """How well a field of a family explains located presses by each other: inside the contacts, and around them."""

    def __init__(self, family: Family, contacts: list[Contact]) -> None:
        evidence = Evidence(family, contacts)
        prior = Prior(torch.zeros(2, family.size(), dtype=torch.float64), PENALTY * family.penalty())
        coefficient = evidence.posterior(prior).mean
        net = torch.stack([_net_slope(item.contact, item.slope(coefficient)) for item in evidence.forms])
        angles = torch.tensor(evidence.held_out_deg(prior), dtype=torch.float64)
        self.family, self.contacts = family, contacts
        self.inside_deg = float(angles.square().mean().sqrt())
        # (N, 2), mm: within the contact a shift by d changes the slope by about d / radius of the ball
        self.errors_mm = net * torch.tensor([[contact.radius_mm] for contact in contacts], dtype=torch.float64)
        closed = net.norm(dim=1)
        self.around_deg = float(torch.rad2deg(closed[~closed.isnan()].atan()).square().mean().sqrt())

    def score(self) -> float:
        """Degrees."""
        return float((self.inside_deg**2 + self.around_deg**2) ** 0.5)


def _net_slope(contact: Contact, slope: Tensor) -> Tensor:
    """(2,): slopes (2, N) at the sampled pixels summed over the disc, relative to the contact's area; NaN where the disc is cut
    by the image border or holds saturated pixels."""
    r, edge = contact.polar()[2], contact.contact_radius_mm
    disc = r < REACH * edge
    cut = bool((contact.center_mm.abs() > contact.half_size_mm - REACH * edge).any())
    if cut or float(contact.saturated[disc].double().mean()) > MOST_SATURATED:
        return torch.full((2,), torch.nan, dtype=torch.float64)
    return slope[:, disc].sum(1) / (r < edge).sum().clamp_min(1)


def _moved(contacts: list[Contact], errors_mm: Tensor, common: bool) -> list[Contact]:
    """Copies with moved centers; where nothing is predicted, with the usual shift of the others."""
    usual = errors_mm.nanmedian(dim=0).values.expand_as(errors_mm)
    moved = []
    for contact, error in zip(contacts, usual if common else torch.where(errors_mm.isnan(), usual, errors_mm)):
        limit = 0.25 * contact.contact_radius_mm
        shift = torch.zeros_like(error) if contact.known else (STEP * error).clamp(-limit, limit)
        moved.append(dataclasses.replace(contact, center_mm=contact.center_mm - shift))
    return moved
