"""Thresholds of contact that a user can set."""

from dataclasses import dataclass

from ..core.checks import check_positive


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
        ValueError: a value that is not above zero.
    Example:
        >>> ContactSettings(sigmas=6.0).share
        0.8
    """

    sigmas: float = 4.5
    min_size_px: float = 8.0
    share: float = 0.8

    def __post_init__(self) -> None:
        for name in ("sigmas", "min_size_px", "share"):
            check_positive(name, getattr(self, name))
