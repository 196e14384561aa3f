"""Where the skin is touched."""

from .masks import ContactMask

__all__ = ["ContactMask"]
