"""Floor 2: from compensated image to normals."""

from .lookup import NormalFromLookup
from .mlp import MlpFit, NormalFromMLP, fit_mlp
from .photometric import NormalFromIntensity
from .response import NormalFromResponse

__all__ = ["MlpFit", "NormalFromIntensity", "NormalFromLookup", "NormalFromMLP", "NormalFromResponse", "fit_mlp"]
