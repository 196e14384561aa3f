"""A pipeline as one file that runs without torchvts."""

from .export import (
    FORMATS,
    OUTPUTS,
    ExportCheck,
    Format,
    PoissonBackgroundByMatrix,
    compare,
    describe,
    export_aoti,
    export_checked,
    export_onnx,
    export_program,
    export_torchscript,
    missing,
    run_bare,
    sample_frames,
)

__all__ = [
    "FORMATS",
    "OUTPUTS",
    "ExportCheck",
    "Format",
    "PoissonBackgroundByMatrix",
    "compare",
    "describe",
    "export_aoti",
    "export_checked",
    "export_onnx",
    "export_program",
    "export_torchscript",
    "missing",
    "run_bare",
    "sample_frames",
]
