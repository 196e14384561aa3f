"""Export: a pipeline as one file that runs without torchvts, and the proof that it does."""

from .formats import FORMATS, OUTPUTS, Format, describe, export_onnx, export_program, export_torchscript, missing
from .verify import ExportCheck, compare, export_checked, run_bare, sample_frames

__all__ = [
    "FORMATS",
    "OUTPUTS",
    "ExportCheck",
    "Format",
    "compare",
    "describe",
    "export_checked",
    "export_onnx",
    "export_program",
    "export_torchscript",
    "missing",
    "run_bare",
    "sample_frames",
]
