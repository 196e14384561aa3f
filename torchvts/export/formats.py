"""The writers: a pipeline as one file in TorchScript, torch.export or ONNX.

Every file takes images (B, 3, H, W) of the pipeline's size, or with ``rectify`` raw frames of the camera, any B (at most 1024 by
torch.export), and returns depth_mm, gradient, normal, contact and deformed in that order.
"""

import copy
import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from ..compensate import Rectify
from ..core import __version__
from ..core.checks import check_choice, check_record
from ..core.files import check_target, write_atomically
from ..integration import AdaptiveIntegration
from ..pipeline import DepthPipeline
from .onnx_operators import InOnnxOperators, simplify
from .trace import size_and_dtype, trace

METADATA_KEY = "torchvts"
"""Name under which a file keeps its metadata (:func:`describe`) as JSON."""

OUTPUTS = ("depth_mm", "gradient", "normal", "contact", "deformed")
"""Names of the outputs of an exported file, in order."""


def describe(pipe: DepthPipeline, rectify: Rectify | None = None) -> dict[str, Any]:
    """The metadata of an exported file, plain JSON; refuses a ``rectify`` that makes images of another size."""
    check_pipeline(pipe)
    height, width, dtype = size_and_dtype(pipe)
    if rectify is not None:
        check_record("rectify", rectify, Rectify, "Rectify(calibration.sensor) makes one")
        if rectify.view.size != (height, width):
            raise ValueError(f"rectify: expected images of {height} x {width} like the pipeline, got {rectify}: of another sensor?")
    return {
        "torchvts": __version__,
        "torch": str(torch.__version__),
        "mode": pipe.mode,
        "normals": type(pipe.normals).__name__,
        "height": height,
        "width": width,
        "mm_per_pixel": pipe.mm_per_pixel,
        "dtype": str(dtype).removeprefix("torch."),
        "input": f"images (B, 3, H, W) in [0, 1], channels R, G, B, {'rectified' if rectify is None else 'raw frames'}",
        "raw_size_px": [] if rectify is None else [list(size) for size in rectify.view.raw_sizes],
        "outputs": list(OUTPUTS),
    }


def check_pipeline(pipe: object) -> None:
    """Raise unless ``pipe`` is a DepthPipeline that a file can hold."""
    check_record("pipe", pipe, DepthPipeline, "DepthPipeline.from_calibration makes one")
    assert isinstance(pipe, DepthPipeline)
    if isinstance(pipe.integrate, AdaptiveIntegration):
        raise TypeError(
            "pipe: expected an integrator without loops over what it finds, got AdaptiveIntegration: "
            "no file can hold it; export with PoissonDCT"
        )


def export_torchscript(pipe: DepthPipeline, path: str | Path, rectify: Rectify | None = None) -> Path:
    """Write a pipeline as TorchScript (.pt), for ``torch.jit.load`` and C++ libtorch. It stays differentiable.

    Its extra file ``torchvts.json`` is :func:`describe`. Returns the path.

    Args:
        pipe: the pipeline.
        path: the file.
        rectify: what makes its images of raw frames, which the file then takes; None for images that are rectified.
    Raises:
        RuntimeError: a module of the pipeline does not script; says what to do, and where TorchScript stopped.
        TypeError: no pipeline, or no Rectify.
        ValueError: a Rectify that makes images of another size.
    """
    path, metadata = check_target(path), {f"{METADATA_KEY}.json": json.dumps(describe(pipe, rectify))}
    with warnings.catch_warnings(), write_atomically(path) as temporary:
        warnings.simplefilter("ignore")  # that TorchScript is deprecated
        whole = copy.deepcopy(pipe if rectify is None else torch.nn.Sequential(rectify, pipe)).eval()
        try:
            scripted = torch.jit.script(whole)
        except Exception as error:  # of many kinds, none of them a RuntimeError where the source of a module is not understood
            raise RuntimeError(
                "pipe: expected modules that torch.jit.script takes, got one that it does not: give a network as "
                f"normals=torch.jit.trace(network.eval(), images), or write pt2 or ONNX: {error}"
            ) from error
        scripted.save(str(temporary), _extra_files=metadata)  # type: ignore[no-untyped-call]
    return path


def export_program(
    pipe: DepthPipeline, path: str | Path | None = None, rectify: Rectify | None = None
) -> torch.export.ExportedProgram:
    """Trace a pipeline by torch.export, in any mode, for any batch, and write it (.pt2) for ``torch.export.load``.

    Args:
        pipe: the pipeline.
        path: the file; without one the program is returned and not written.
        rectify: as :func:`export_torchscript`; of a sensor of one raw size, since a graph has one.
    Raises:
        TypeError, ValueError: as :func:`export_torchscript`.
        Exception: what torch.export raises for a module of yours that it cannot trace.
    """
    metadata = {f"{METADATA_KEY}.json": json.dumps(describe(pipe, rectify))}
    if path is not None:
        check_target(path)
    program = trace(pipe, by_matrix=False, rectify=rectify)
    if path is not None:
        with write_atomically(path) as temporary, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.export.save(program, temporary, extra_files=metadata)
    return program


def export_onnx(pipe: DepthPipeline, path: str | Path, rectify: Rectify | None = None) -> Path:
    """Write a pipeline as ONNX, for ONNX Runtime and other readers. Its metadata entry ``torchvts`` is :func:`describe`.

    Returns the path.

    Args:
        pipe: the pipeline.
        path: the file.
        rectify: as :func:`export_program`.
    Raises:
        ModuleNotFoundError: the extra ``onnx`` is not installed.
        TypeError, ValueError: as :func:`export_program`.
    """
    path, metadata = check_target(path), json.dumps(describe(pipe, rectify))
    if complaint := missing("onnx"):
        raise ModuleNotFoundError(complaint)
    with InOnnxOperators():
        program = trace(pipe, by_matrix=True, rectify=rectify)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names: dict[str, Any] = {"input_names": ["images"], "output_names": list(OUTPUTS)}
        model: Any = torch.onnx.export(program, dynamo=True, external_data=False, verbose=False, optimize=False, **names)
        simplify(model.model)
        model.model.metadata_props[METADATA_KEY] = metadata
        with write_atomically(path) as temporary:
            model.save(temporary, external_data=False)
    return path


@dataclass(frozen=True)
class Format:
    """A file format: its file in a folder of exports, its writer, and the largest difference of depth to the pipeline, mm."""

    file_name: str
    write: Callable[[DepthPipeline, Path], object]
    tolerance_mm: float


FORMATS = {
    "torchscript": Format("pipeline.pt", export_torchscript, 1e-5),
    "pt2": Format("pipeline.pt2", export_program, 1e-5),
    "onnx": Format("pipeline.onnx", export_onnx, 1e-3),
    "plan": Format("pipeline.plan", lambda pipe, path: pipe.freeze().save(path), 1e-5),
}
"""The formats by name; the plan is that of :meth:`torchvts.FrozenPipeline.save`, without networks."""


def missing(name: str) -> str:
    """What a format needs and this machine lacks, as a sentence; empty if nothing; ValueError for an unknown format."""
    check_choice("format", name, list(FORMATS))
    needed = ("onnx", "onnxscript", "onnxruntime") if name == "onnx" else ()
    absent = [package for package in needed if find_spec(package) is None]
    return f"onnx: {', '.join(absent)} not found: pip install 'torchvts[onnx]'" if absent else ""
