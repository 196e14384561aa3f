"""Floor 0: checks, geometry, the sensor, files. Imports nothing else of torchvts."""

__version__ = "0.1.0"
