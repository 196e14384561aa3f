"""What the skin does: how surely it has moved, its depth from where it has not, contact, and where its dots went."""

from .dot_motion import DotMotion, Slip
from .motion import SkinMotion, motion_of_unit
from .pressure import BLUR_MM, SHARE, ContactFromDepth
from .settings import ContactSettings
from .weight import ContactMask, moved, unseen_deg
from .zero import ZeroBackground

__all__ = [
    "BLUR_MM",
    "SHARE",
    "ContactFromDepth",
    "ContactMask",
    "ContactSettings",
    "DotMotion",
    "SkinMotion",
    "Slip",
    "ZeroBackground",
    "motion_of_unit",
    "moved",
    "unseen_deg",
]
