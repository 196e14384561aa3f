"""The blocks with compiled kernels or NumPy in their place where these may work: the same names, the same results.

Each class here inherits from the plain block of the same name, overrides one method, and asks one gate. TorchScript,
torch.export and torch.compile get the plain block.
"""

from .blocks import (
    AdaptiveIntegration,
    Compensate,
    GradientFromNormal,
    NormalFromIntensity,
    NormalFromResponse,
    PerspectiveIntegration,
    PoissonBackground,
    PoissonDCT,
    SmoothDrift,
)
from .gate import reference_only
from .kernels import library
from .twin import reference, scriptable

__all__ = [
    "AdaptiveIntegration",
    "Compensate",
    "GradientFromNormal",
    "NormalFromIntensity",
    "NormalFromResponse",
    "PerspectiveIntegration",
    "PoissonBackground",
    "PoissonDCT",
    "SmoothDrift",
    "library",
    "reference",
    "reference_only",
    "scriptable",
]
