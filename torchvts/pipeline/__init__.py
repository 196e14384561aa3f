"""Online: a calibration made into a chain of modules that turns images into depth, and how far that may be off."""

from .confidence import Bounds, Confidence, bound_at
from .depth import MODES, ConfidentOutput, ConfidentPipeline, DepthOutput, DepthPipeline

__all__ = [
    "MODES",
    "Bounds",
    "Confidence",
    "ConfidentOutput",
    "ConfidentPipeline",
    "DepthOutput",
    "DepthPipeline",
    "bound_at",
]
