"""Normals from compensated images."""

from .lookup import NormalFromLookup
from .mlp import NormalFromMLP
from .photometric import NormalFromIntensity
from .response import NormalFromResponse

__all__ = ["NormalFromIntensity", "NormalFromLookup", "NormalFromMLP", "NormalFromResponse"]
