"""Whether presses and background are images of one unit, taken in the same way: refused or left out before anything is fitted."""

import statistics
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.arrays import array_of
from ..core.blur import blur, gaussian_weights
from ..core.views import SAME_VIEW, TWELVE_BITS, Views
from .contacts import DARK, MOST_SATURATED, channel_band
from .presses import Press
from .refusals import other_crop

OTHER_UNIT = 0.2
"""Median difference from the background, logarithm of the image value, from which presses are of another unit or light. It is at
most 0.08 on 14 units, and 0.15 to 0.85 between units of different types."""

CONTACT = 0.35
"""A background holds a contact if its structure exceeds that of the presses, in a place, by this part of what theirs exceeds its
own. The part is at most 0.2 on 14 units, and above 0.35 for 19 in 20 presses of theirs given as the background."""

LEAST_STRUCTURE = 0.02
"""Smallest such excess: less is noise. A press has 0.03 to 0.7."""


class Sorted(NamedTuple):
    """Presses that can be used.

    Attributes:
        kept: in the order given.
        left_out: index among those given, and why, of each other.
    """

    kept: list[Press]
    left_out: list[tuple[int, str]]


def sort_presses(background: Tensor, presses: Sequence[Press]) -> Sorted:
    """Presses that show the background's view of the skin. A few that do not are left out; if they are half of all, none is used.

    Args:
        background: (3, H, W) in [0, 1].
        presses: checked, with names.
    Raises:
        ValueError: presses that are saturated, much darker than the background, turned, mirrored, cropped or swapped otherwise, or
            of another unit; a background much darker than the presses, or one that holds a contact.
    """
    if not presses:
        return Sorted([], [])
    _check_levels(background, presses)
    views = Views(array_of(background))
    cells = [views.cells(array_of(press.image)) for press in presses]
    found = [views.other(one) for one in cells]
    odd = [(k, view) for k, view in enumerate(found) if view is not None]
    refused = odd[0] if 2 * len(odd) >= len(presses) else None
    differences = [views.difference(one) for one in cells]
    if statistics.median(differences) > SAME_VIEW and (refused is None or refused[1].cropped):
        crop = other_crop(background, [press.image for press in presses])
        if crop is not None:
            raise ValueError(f"presses: expected the crop of the background, got images that show it {crop.in_words()}")
    if refused is not None:
        raise ValueError(
            f"presses: expected the background's view of the skin, got {len(odd)} of {len(presses)} that show another: "
            f"{presses[refused[0]].name} {refused[1].in_words()}: read and turn the presses as the background, or take them again"
        )
    if min(differences) > OTHER_UNIT:
        raise ValueError(
            f"presses: expected the light of the background, got images that differ from it by {min(differences):.0%} and more "
            f"in the median of the skin, at most {OTHER_UNIT:.0%} is usual: another unit, or another light"
        )
    reasons = {k: f"it {view.in_words()}" for k, view in odd}
    for k in range(len(presses)):
        if k not in reasons and (first := _first_like(presses, k)) != k:
            reasons[k] = f"it is {presses[first].name} once more"
    kept = [press for k, press in enumerate(presses) if k not in reasons]
    _check_contact(background, kept)
    return Sorted(kept, sorted(reasons.items()))


def _first_like(presses: Sequence[Press], k: int) -> int:
    """Index of the first press with the image and the diameter of the k-th."""
    wanted = presses[k]
    alike = (i for i, press in enumerate(presses) if press.ball_diameter_mm == wanted.ball_diameter_mm)
    return next(i for i in alike if torch.equal(presses[i].image, wanted.image))


def _check_levels(background: Tensor, presses: Sequence[Press]) -> None:
    """Raise if the presses, in the median, are saturated, or much darker than the background, or it than they."""
    saturated = statistics.median(float((press.image > 0.995).double().mean()) for press in presses)
    if saturated > MOST_SATURATED:
        raise ValueError(
            f"presses: expected light below the camera's limit, got images of which {saturated:.0%} is saturated in the median: "
            "lower the exposure"
        )
    level = statistics.median(float(press.image.double().mean()) for press in presses) / float(background.double().mean())
    for name, other, ratio, images in (
        ("presses", "the background's", level, [press.image for press in presses]),
        ("background", "that of the presses", 1.0 / max(level, 1e-9), [background]),
    ):
        if ratio < DARK:
            most = max(float(image.max()) for image in images)
            twelve = 0.01 < most <= TWELVE_BITS + 1e-6
            bits = f"its largest value is {round(65535 * most)} of 65535: 12 bits stored in 16?"
            cause = bits if twelve else "black, or the LEDs were off"
            raise ValueError(f"{name}: expected a brightness like {other}, got {ratio:.0%} of it: {cause}")


def _check_contact(background: Tensor, presses: Sequence[Press]) -> None:
    """Raise if the background has structure, somewhere, that the presses lack there, as much as they have where they touch."""
    own, theirs = _structure(background), torch.stack([_structure(press.image) for press in presses])
    usual = theirs.median(dim=0).values if len(presses) > 2 else theirs.amax(dim=0)
    excess, contact = float((own - usual).max()), float((theirs - own).flatten(1).amax(dim=1).median())
    if excess > LEAST_STRUCTURE and excess > CONTACT * contact:
        raise ValueError(
            f"background: expected the skin without contact, got structure between the channels of {excess:.2f} in a place where "
            f"the presses have none (their contacts have {contact:.2f}): was a press given as the background?"
        )


def _structure(image: Tensor) -> Tensor:
    """Structure between the channels of an image (3, H, W), RMS around each of about 60 x 80 cells less a margin, (h, w).

    As :func:`channel_structure`, but of each place.
    """
    band = channel_band(image, 60, min(image.shape[1:]))
    height = min(band.shape[2:])
    around = blur(band.square().sum(dim=1, keepdim=True), gaussian_weights(height / 20.0))[0, 0].sqrt()
    margin = round(0.1 * height)
    return around[margin : around.shape[0] - margin, margin : around.shape[1] - margin]
