"""Normals from compensated images."""

from .base import DOMAINS, NormalModel, WrappedNormals, as_normal_model, check_domain
from .lookup import NormalFromLookup
from .mlp import NormalFromMLP
from .photometric import NormalFromIntensity
from .response import NormalFromResponse

__all__ = [
    "DOMAINS",
    "NormalFromIntensity",
    "NormalFromLookup",
    "NormalFromMLP",
    "NormalFromResponse",
    "NormalModel",
    "WrappedNormals",
    "as_normal_model",
    "check_domain",
]
