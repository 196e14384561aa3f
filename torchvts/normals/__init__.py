"""From a compensated image to normals."""

from .base import NormalModel, WrappedNormals, as_normal_model
from .lookup import NormalFromLookup
from .mlp import MlpFit, NormalFromMLP, fit_mlp
from .photometric import NormalFromIntensity
from .response import NormalFromResponse

__all__ = [
    "MlpFit",
    "NormalFromIntensity",
    "NormalFromLookup",
    "NormalFromMLP",
    "NormalFromResponse",
    "NormalModel",
    "WrappedNormals",
    "as_normal_model",
    "fit_mlp",
]
