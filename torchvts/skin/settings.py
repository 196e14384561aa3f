"""Thresholds of contact that a user can set."""

from dataclasses import dataclass

from ..core.checks import check_decay, check_least, check_positive


@dataclass(frozen=True)
class ContactSettings:
    """Thresholds of where the skin has moved and of where an object touches it.

    Args:
        sigmas: evidence that a contact has somewhere, in units of its spread in undeformed skin. Lower finds fainter presses and
            more dirt.
        share: pressure from which the object touches, as a share of the frame's; None for the unit's own. Higher draws the
            rim of the contact inward.
        decay_mm: length L over which free skin decays, mm; None for the unit's own, or each frame's. 0 where an object has no
            skin around it, as in some renders: all depth is contact.
    Raises:
        TypeError: not a number.
        ValueError: a value that no frame could use: ``sigmas`` below 1, which calls noise contact, or above 1000; a ``share`` that
            is not above 0, or above 1; a ``decay_mm`` below 0, or above 10, which a length in um is.
    Example:
        >>> ContactSettings(sigmas=6.0).share is None
        True
    """

    sigmas: float = 4.5
    share: float | None = None
    decay_mm: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "sigmas", check_least("sigmas", self.sigmas, 1.0, 1000.0))
        if self.share is not None:
            object.__setattr__(self, "share", check_positive("share", self.share, 1.0))
        if self.decay_mm is not None:
            object.__setattr__(self, "decay_mm", check_decay("decay_mm", self.decay_mm))
