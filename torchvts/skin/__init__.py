"""What the skin does: how surely it has moved, its depth from where it has not, and where an object touches it."""

from .pressure import BLUR_MM, SHARE, ContactFromDepth
from .settings import ContactSettings
from .weight import ContactMask, moved, unseen_deg
from .zero import ZeroBackground

__all__ = ["BLUR_MM", "SHARE", "ContactFromDepth", "ContactMask", "ContactSettings", "ZeroBackground", "moved", "unseen_deg"]
