"""The lowest layer: checks, geometry, files. Imports nothing else of torchvts."""

__version__ = "0.1.0"
