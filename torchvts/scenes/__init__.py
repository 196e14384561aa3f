"""Exact scenes and objects with known depth, normals and contact, and their camera images: for tests, demos and training data."""

from . import objects
from .camera import render, skin_spots
from .dots import DottedSkin, Drag
from .letters import distance_to_segments, letter_segments
from .presses import cone_depth, cylinder_depth, letters_depth, punch_depth, sine_depth, sphere_press
from .skin import hanging_skin
from .surfaces import Scene, smooth_step, surface, surface_at, undeformed

__all__ = [
    "DottedSkin",
    "Drag",
    "Scene",
    "cone_depth",
    "cylinder_depth",
    "distance_to_segments",
    "hanging_skin",
    "letter_segments",
    "letters_depth",
    "objects",
    "punch_depth",
    "render",
    "sine_depth",
    "skin_spots",
    "smooth_step",
    "sphere_press",
    "surface",
    "surface_at",
    "undeformed",
]
