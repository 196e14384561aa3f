"""From a camera's image to the compensated image that models speak of."""

from .compensate import Compensate
from .defects import FillDefects
from .drift import Drift

__all__ = ["Compensate", "Drift", "FillDefects"]
