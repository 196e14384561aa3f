"""Floor 2: from compensated image to normals."""

from .photometric import NormalFromIntensity

__all__ = ["NormalFromIntensity"]
