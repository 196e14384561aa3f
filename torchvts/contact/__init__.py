"""Where the skin has moved, from a compensated image; where an object touches it, from the depth."""

from .masks import ContactMask
from .settings import ContactSettings
from .touching import ContactFromDepth

__all__ = ["ContactFromDepth", "ContactMask", "ContactSettings"]
