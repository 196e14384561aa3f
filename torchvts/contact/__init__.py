"""From a compensated image to the contact mask."""

from .masks import ContactMask

__all__ = ["ContactMask"]
