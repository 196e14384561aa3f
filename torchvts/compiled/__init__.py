"""A frame in C, and the sums of tracking: a library behind ctypes, which ``pipeline/frozen.py`` and ``pose/`` use."""

from .binding import library, why_no_library
from .blocks import NotCompiled, check_block
from .plan import Plan, ends

__all__ = ["NotCompiled", "Plan", "check_block", "ends", "library", "why_no_library"]
