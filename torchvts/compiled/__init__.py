"""A frame in C, and the sums of tracking: a library behind ctypes, which ``pipeline/frozen.py`` and ``pose/`` use."""

from .binding import library, why_no_library
from .blocks import NotCompiled, check_block
from .plan import Plan, PlanError, plan_bytes

__all__ = ["NotCompiled", "Plan", "PlanError", "check_block", "library", "plan_bytes", "why_no_library"]
