"""Where the skin has moved, from a compensated image; where an object touches it, from the depth."""

from .masks import ContactMask, Moved
from .settings import ContactSettings
from .touching import ContactFromDepth, above_tail

__all__ = ["ContactFromDepth", "ContactMask", "ContactSettings", "Moved", "above_tail"]
