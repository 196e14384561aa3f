"""Whether balls of the given diameters can make the contacts that are seen: a pitch or diameters that are wrong for all presses.

One wrong diameter among right ones is found by the others (outliers.py). Where all are wrong by one factor, presses agree with each
other: a field fitted to them makes the same mistake, and even promises more accuracy.
"""

import math
import statistics
from collections.abc import Sequence

from .contacts import Contact, used

WIDE = 0.86
"""Contact radius over the ball's, in the median over presses, from which sizes are wrong: it is 0.55 to 0.78 on eleven real and
eight drawn sensors, 0.8 to 0.95 with a pitch that is twice too large. Presses that are all deep are no mistake."""

WIDE_OUTLINE = 1.75
"""The same of the outline of the strong change of light: 0.54 to 1.61, and 1.4 to 3.2."""

ENOUGH = 5
"""Presses from which contact radii are known well enough for that; outlines do not hang on where the balls are found."""

ALIKE = 1.15
"""Gains of presses by the prior that are the same to within this factor show one mistake of all."""

FAR = 1.4
"""That factor, from one which no unit differs so much from the prior of its type: 0.87 to 1 on three units."""


def objection_to_sizes(contacts: Sequence[Contact], mm_per_pixel: float) -> str:
    """Why contacts are too wide for their balls, in the median over those that are used; "" where they are not."""
    located = [contact for contact in used(contacts) if not (contact.known and contact.radius_known)]
    if not located:
        return ""
    wide = statistics.median(contact.contact_radius_mm / contact.radius_mm for contact in located)
    outline = statistics.median(contact.outline_mm / contact.radius_mm for contact in located)
    if (wide < WIDE or len(located) < ENOUGH) and outline < WIDE_OUTLINE:
        return ""
    return (
        f"presses: expected contacts narrower than their balls, got contacts {wide:.2f} times as wide as the balls, and outlines "
        f"{outline:.2f} times (0.5 to 0.8, and 0.6 to 1.6, are usual): either mm_per_pixel, {mm_per_pixel:g}, is too large, "
        "or radii were given for diameters"
    )


def objection_by_prior(contacts: Sequence[Contact]) -> str:
    """Why the prior contradicts the sizes of all presses alike; "" where it does not, or where they differ from each other."""
    logs = [math.log(max(contact.metrics["gain"], 1e-3)) for contact in contacts if "gain" in contact.metrics]
    if len(logs) < 0.5 * len(contacts) or not logs:
        return ""
    middle = statistics.median(logs)
    alike = statistics.median(abs(value - middle) for value in logs) < math.log(ALIKE)
    if not alike or abs(middle) < math.log(FAR):
        return ""
    return (
        f"presses: by the sensor's prior all balls seem {math.exp(-middle):.2f} times as wide as given, on a background like that "
        "of the prior: wrong diameters (radii, inches?), or a wrong mm_per_pixel"
    )
