"""Online: a calibration made into a chain of modules that turns images into depth, and how far that may be off."""

from ..core.frame import Conditions, DepthOutput
from .conditions import UNEVEN, UNSEEN_DEG, doubts_of, usual_unseen_deg
from .confidence import Confidence, ConfidentOutput, ConfidentPipeline, bound_at
from .depth import MODES, DepthPipeline
from .frozen import FrozenPipeline
from .refine import Refine
from .shadows import Shadows
from .solve import Solve
from .unit import unit_pipeline

__all__ = [
    "MODES",
    "UNEVEN",
    "UNSEEN_DEG",
    "Conditions",
    "Confidence",
    "ConfidentOutput",
    "ConfidentPipeline",
    "DepthOutput",
    "DepthPipeline",
    "FrozenPipeline",
    "Refine",
    "Shadows",
    "Solve",
    "bound_at",
    "doubts_of",
    "unit_pipeline",
    "usual_unseen_deg",
]
