"""Exact scenes and objects with known depth, normals and contact, and their camera images: for tests, demos and training data."""

from . import objects
from .camera import render, skin_spots
from .dots import DottedSkin, Drag
from .letters import distance_to_segments, letter_segments
from .presses import cone_press, cylinder_press, letters_press, punch_press, sine_press, sphere_press
from .skin import hanging_skin
from .surfaces import Scene, smooth_step, surface, surface_at, undeformed

__all__ = [
    "DottedSkin",
    "Drag",
    "Scene",
    "cone_press",
    "cylinder_press",
    "distance_to_segments",
    "hanging_skin",
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
