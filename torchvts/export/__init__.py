"""Export: a pipeline as one file that runs without torchvts, and the proof that it does."""

from .formats import (
    FORMATS,
    OUTPUTS,
    Format,
    describe,
    export_onnx,
    export_program,
    export_torchscript,
    missing,
)
from .trace import PoissonBackgroundByMatrix
from .verify import ExportCheck, compare, export_checked, run_bare, sample_frames

__all__ = [
    "FORMATS",
    "OUTPUTS",
    "ExportCheck",
    "Format",
    "PoissonBackgroundByMatrix",
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
