"""From a camera's image to the compensated image that models speak of."""

from .compensate import Blur, Compensate
from .defects import FillDefects
from .light import AsItIs, Relight, unchanged_light
from .rectify import Rectify

__all__ = ["AsItIs", "Blur", "Compensate", "FillDefects", "Rectify", "Relight", "unchanged_light"]
