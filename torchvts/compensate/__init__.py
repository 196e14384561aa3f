"""From a camera's image to the compensated image that models speak of."""

from .compensate import Compensate

__all__ = ["Compensate"]
