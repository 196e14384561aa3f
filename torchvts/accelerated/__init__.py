"""The blocks with compiled kernels, NumPy or OpenCV in their place where these may work: the same names, the same results.

Each class here inherits from the plain block of the same name, overrides one method, and asks one gate. TorchScript,
torch.export and torch.compile get the plain block.
"""

from .blocks import (
    AdaptiveIntegration,
    Compensate,
    ContactFromDepth,
    ContactMask,
    Crop,
    GradientFromNormal,
    LargestChange,
    Masked,
    MaskedGradient,
    NormalFromIntensity,
    NormalFromResponse,
    PerspectiveIntegration,
    PoissonBackground,
    PoissonDCT,
    SmoothDrift,
    Uncrop,
    ZeroBackground,
)
from .gate import reference_only
from .kernels import library
from .twin import reference, scriptable

__all__ = [
    "AdaptiveIntegration",
    "Compensate",
    "ContactFromDepth",
    "ContactMask",
    "Crop",
    "GradientFromNormal",
    "LargestChange",
    "Masked",
    "MaskedGradient",
    "NormalFromIntensity",
    "NormalFromResponse",
    "PerspectiveIntegration",
    "PoissonBackground",
    "PoissonDCT",
    "SmoothDrift",
    "Uncrop",
    "ZeroBackground",
    "library",
    "reference",
    "reference_only",
    "scriptable",
]
