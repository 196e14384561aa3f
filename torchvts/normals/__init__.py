"""Normals from compensated images."""

from .base import NormalModel, WrappedNormals, as_normal_model
from .lookup import NormalFromLookup
from .mlp import NormalFromMLP
from .photometric import NormalFromIntensity
from .response import NormalFromResponse

__all__ = [
    "NormalFromIntensity",
    "NormalFromLookup",
    "NormalFromMLP",
    "NormalFromResponse",
    "NormalModel",
    "WrappedNormals",
    "as_normal_model",
]
