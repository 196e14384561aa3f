"""Exact scenes and objects for tests, demos and training data."""

from . import objects
from .scenes import (
    Scene,
    cone_press,
    cylinder_press,
    distance_to_segments,
    letter_segments,
    letters_press,
    punch_press,
    render,
    sine_press,
    skin_spots,
    smooth_step,
    sphere_press,
    surface,
    surface_at,
    undeformed,
)

__all__ = [
    "Scene",
    "cone_press",
    "cylinder_press",
    "distance_to_segments",
    "letter_segments",
    "letters_press",
    "objects",
    "punch_press",
    "render",
    "sine_press",
    "skin_spots",
    "smooth_step",
    "sphere_press",
    "surface",
    "surface_at",
    "undeformed",
]
