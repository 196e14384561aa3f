"""Thresholds of contact that a user can set."""

from dataclasses import dataclass

from ..core.checks import check_least, check_positive

MOST_SIZE_PX = 10000.0
"""No image is wider."""


@dataclass(frozen=True)
class ContactSettings:
    """Thresholds of where the skin has moved and of where an object touches it.

    Args:
        sigmas: change of a pixel from which its skin has moved, in units of the frame's own noise; two thirds of it decide how far
            the faint skin around goes on. Higher loses that skin, and with it depth; lower finds fainter presses and more dirt.
        min_size_px: diameter of the smallest area that counts, pixels.
        share: pressure from which the object touches, in units of what lifts free skin of the slope nearby. Higher draws the rim
            of the contact inward.
    Raises:
        TypeError: not a number.
        ValueError: a value that no frame could use: ``sigmas`` below 1, which calls noise contact, or above 1000; a size of less
            than a pixel; a ``share`` that is not above 0, or above 1, since all pressure that lifts free skin is contact.
    Example:
        >>> ContactSettings(sigmas=6.0).share
        0.8
    """

    sigmas: float = 4.5
    min_size_px: float = 8.0
    share: float = 0.8

    def __post_init__(self) -> None:
        for name, least, most in (("sigmas", 1.0, 1000.0), ("min_size_px", 1.0, MOST_SIZE_PX)):
            object.__setattr__(self, name, check_least(name, getattr(self, name), least, most))
        object.__setattr__(self, "share", check_positive("share", self.share, 1.0))
