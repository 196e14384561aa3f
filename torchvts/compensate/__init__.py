"""From a camera's image to the compensated image that models speak of."""

from .compensate import Blur, Compensate
from .defects import FillDefects
from .drift import Drift, SmoothDrift

__all__ = ["Blur", "Compensate", "Drift", "FillDefects", "SmoothDrift"]
