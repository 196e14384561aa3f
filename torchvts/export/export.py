"""A pipeline as one file that runs without torchvts: TorchScript, torch.export, AOTInductor, ONNX; and the proof that it does.

Every file takes images (B, 3, H, W) of the pipeline's size, any B, and gives depth_mm, gradient, normal, contact in that order.
"""

import copy
import json
import math
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..accelerated import reference, reference_only
from ..core import __version__
from ..core.checks import (
    check_batch,
    check_choice,
    check_integer,
    check_path,
    check_record,
    check_sequence,
    check_size,
)
from ..core.files import check_target, write_atomically
from ..core.frame import Crop
from ..core.geometry import pixel_grid_mm
from ..integration import Integrator, PoissonDCT, divergence
from ..integration.base import embedded
from ..integration.transforms import cosine_bases, fold, unfold
from ..model.calibration import Calibration, check_calibration
from ..pipeline import Adaptive, DepthPipeline, Shadows

METADATA_KEY = "torchvts"
"""Under this name the files keep what they are, as JSON: :func:`describe`."""

OUTPUTS = ("depth_mm", "gradient", "normal", "contact")

MAX_BATCH = 1024
"""Largest batch that the graph formats promise to take."""


class PoissonBackgroundByMatrix(Integrator):
    """:class:`PoissonBackground` for one size, by matrix products alone: ONNX has no such FFT.

    Args:
        height, width: pixels. mm_per_pixel: pixel pitch, mm.
        dtype: of the matrices.
        levelled: zero on the skin at rest, as :class:`PoissonBackground`; else zero on average, as :class:`PoissonDCT`.
    Source:
        as :func:`poisson_dct`; tests hold them together.
    Example:
        >>> gradient = torch.randn(2, 2, 24, 32)
        >>> bool((PoissonBackgroundByMatrix(24, 32, 0.5)(gradient) - PoissonBackground(0.5)(gradient)).abs().max() < 1e-5)
        True
    """

    def __init__(
        self, height: int, width: int, mm_per_pixel: float, dtype: torch.dtype = torch.float32, levelled: bool = True
    ) -> None:
        super().__init__()
        check_size(height, width, mm_per_pixel)
        self.size = (height, width)
        self.mm_per_pixel = mm_per_pixel
        self.levelled = levelled
        even_y, odd_y, value_even_y, value_odd_y = cosine_bases(height)
        even_x, odd_x, value_even_x, value_odd_x = cosine_bases(width)
        for name, basis in (("even_y", even_y), ("odd_y", odd_y), ("even_x", even_x), ("odd_x", odd_x)):
            self.register_buffer(name, basis.to(dtype))
        for y, value_y in (("even", value_even_y), ("odd", value_odd_y)):
            for x, value_x in (("even", value_even_x), ("odd", value_odd_x)):
                value = value_y[:, None] + value_x[None, :]
                inverse = torch.where(value == 0.0, torch.zeros_like(value), 1.0 / value)  # zero: the mean
                self.register_buffer(f"inverse_{y}_{x}", inverse.to(dtype))

    def forward(self, gradient: Tensor, window: tuple[int, int] | None = None, size: tuple[int, int] | None = None) -> Tensor:
        check_batch("gradient", gradient, 2)
        if size is not None and size != self.size:
            raise ValueError(f"gradient, window: expected size {self.size}, for which the matrices are, got {size}")
        gradient = embedded(gradient, window, self.size)
        up, down = fold(divergence(gradient), -2)
        rows = []
        for y, part in (("even", up), ("odd", down)):
            basis_y = self.get_buffer(f"{y}_y")
            lines = []
            for x, block in zip(("even", "odd"), fold(part, -1)):
                basis_x, inverse = self.get_buffer(f"{x}_x"), self.get_buffer(f"inverse_{y}_{x}")
                lines.append(basis_y.t() @ ((basis_y @ block @ basis_x.t()) * inverse) @ basis_x)
            rows.append(unfold(lines[0], lines[1], -1))
        depth = self.mm_per_pixel * unfold(rows[0], rows[1], -2)
        if not self.levelled:
            return depth
        rest = ((gradient[:, 0:1] == 0) & (gradient[:, 1:2] == 0)).to(depth.dtype)
        count = rest.sum(dim=(2, 3), keepdim=True)
        mean = (depth * rest).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
        return depth - torch.where(count > 0, mean, depth.amin(dim=(2, 3), keepdim=True))


class _PlainOutput(nn.Module):
    """A pipeline that gives a plain tuple: a file with a NamedTuple of torchvts would need torchvts to be read."""

    def __init__(self, pipe: DepthPipeline) -> None:
        super().__init__()
        self.pipe = pipe

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.pipe(images))


def describe(pipe: DepthPipeline) -> dict[str, Any]:
    """What an exported file says of itself: plain JSON."""
    _check_pipeline(pipe)
    height, width, dtype = _size(pipe)
    return {
        "torchvts": __version__,
        "torch": str(torch.__version__),
        "mode": pipe.mode,
        "normals": type(pipe.normals).__name__,
        "height": height,
        "width": width,
        "mm_per_pixel": pipe.mm_per_pixel,
        "dtype": str(dtype).removeprefix("torch."),
        "input": "images (B, 3, H, W) in [0, 1], channels R, G, B, rectified",
        "outputs": list(OUTPUTS),
    }


def export_torchscript(pipe: DepthPipeline, path: str | Path) -> Path:
    """Write a pipeline as TorchScript (.pt), for ``torch.jit.load`` and C++ libtorch. It stays differentiable.

    The extra file ``torchvts.json`` in it is :func:`describe`.

    Args:
        pipe: the pipeline. path: the file.
    Returns:
        The path.
    Raises:
        RuntimeError: a module of the pipeline does not script. TypeError: no pipeline.
    """
    _check_pipeline(pipe)
    path = check_target(path)
    with warnings.catch_warnings(), write_atomically(path) as temporary:
        warnings.simplefilter("ignore")  # that TorchScript is deprecated
        scripted = torch.jit.script(copy.deepcopy(pipe))
        said = {f"{METADATA_KEY}.json": json.dumps(describe(pipe))}
        scripted.save(str(temporary), _extra_files=said)  # type: ignore[no-untyped-call]
    return path


def export_program(pipe: DepthPipeline, path: str | Path | None = None) -> torch.export.ExportedProgram:
    """Trace a pipeline by torch.export, in any mode, for any batch, and write it (.pt2) for ``torch.export.load``.

    Loops (precise passes, hole filling) become operators of the graph, so the program takes as many turns as the pipeline would.

    Args:
        pipe: the pipeline. path: the file; None writes none.
    Returns:
        The program.
    Raises:
        TypeError: no pipeline. Whatever torch.export raises for a module of your own that it cannot trace.
    """
    _check_pipeline(pipe)
    if path is not None:
        check_target(path)
    program = _trace(pipe, by_matrix=False)
    if path is not None:
        with write_atomically(path) as temporary, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            said = {f"{METADATA_KEY}.json": json.dumps(describe(pipe))}
            torch.export.save(program, temporary, extra_files=said)
    return program


def export_aoti(pipe: DepthPipeline, path: str | Path) -> Path:
    """Compile a pipeline to machine code of this machine's kind (.pt2 package), for ``torch._inductor.aoti_load_package`` and C++.

    Args:
        pipe: the pipeline. path: the file.
    Returns:
        The path.
    Raises:
        RuntimeError: there is no C++ compiler. TypeError: no pipeline.
    """
    _check_pipeline(pipe)
    path = check_target(path)
    complaint = missing("aoti")
    if complaint:
        raise RuntimeError(complaint)
    if path.suffix != ".pt2":
        raise ValueError(f"path: expected a name ending in .pt2, got {path}: AOTInductor packages have no other")
    program = _trace(pipe, by_matrix=False)
    settings: dict[str, Any] = {"aot_inductor.metadata": {METADATA_KEY: json.dumps(describe(pipe))}}
    with warnings.catch_warnings(), write_atomically(path) as temporary:
        warnings.simplefilter("ignore")
        try:
            torch._inductor.aoti_compile_and_package(program, package_path=str(temporary), inductor_configs=settings)
        except Exception as error:
            if "CppCompileError" not in str(error):
                raise
            # Inductor (torch 2.13) writes some vectors of bool that no compiler takes: without vectors it is slower and right
            settings = settings | {"cpp.simdlen": 1}
            torch._inductor.aoti_compile_and_package(program, package_path=str(temporary), inductor_configs=settings)
    return path


def export_onnx(pipe: DepthPipeline, path: str | Path) -> Path:
    """Write a pipeline as ONNX, for ONNX Runtime and what else reads it. The metadata entry ``torchvts`` is :func:`describe`.

    Args:
        pipe: the pipeline. path: the file.
    Returns:
        The path.
    Raises:
        ModuleNotFoundError: the extra ``onnx`` is not installed. TypeError: no pipeline.
    """
    _check_pipeline(pipe)
    path = check_target(path)
    complaint = missing("onnx")
    if complaint:
        raise ModuleNotFoundError(complaint)
    program = _trace(pipe, by_matrix=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = program.run_decompositions(torch.export.default_decompositions() | _onnx_decompositions())
        model = torch.onnx.export(
            program, dynamo=True, input_names=["images"], output_names=list(OUTPUTS), external_data=False, verbose=False
        )
        if model is None:
            raise RuntimeError("onnx: the exporter gave no model")
        model.model.metadata_props[METADATA_KEY] = json.dumps(describe(pipe))
        with write_atomically(path) as temporary:
            model.save(temporary, external_data=False)
    return path


@dataclass(frozen=True)
class Format:
    """How a format is written, and how far its depth may be from the pipeline's."""

    file_name: str
    write: Callable[[DepthPipeline, Path], object]
    tolerance_mm: float


FORMATS = {
    "torchscript": Format("pipeline.pt", export_torchscript, 1e-5),
    "pt2": Format("pipeline.pt2", export_program, 1e-5),
    "aoti": Format("pipeline_aoti.pt2", export_aoti, 1e-5),
    "onnx": Format("pipeline.onnx", export_onnx, 1e-3),
}
"""The formats by name."""


def missing(name: str) -> str:
    """What a format lacks on this machine, as a sentence; empty if nothing.

    Raises:
        ValueError: unknown format.
    """
    check_choice("format", name, list(FORMATS))
    if name == "onnx":
        absent = [package for package in ("onnx", "onnxscript", "onnxruntime") if find_spec(package) is None]
        if absent:
            return f"onnx: {', '.join(absent)} not found: pip install 'torchvts[onnx]'"
    if name == "aoti":
        from torch._inductor.cpp_builder import get_cpp_compiler

        try:
            compiler = get_cpp_compiler()
        except Exception as error:  # InvalidCxxCompiler, whose place in torch has moved
            compiler, reason = "", str(error).splitlines()[0]
        else:
            reason = f"{compiler!r} is not there"
        if not compiler or shutil.which(compiler) is None:
            return f"aoti: expected a C++ compiler, got none ({reason}): install g++ or clang++, or set CXX"
    return ""


def sample_frames(calibration: Calibration, seed: int = 0) -> Tensor:
    """Four frames of a unit to compare exports on, (4, 3, H, W), 8 bits with noise: touched, at rest, touched twice, all random."""
    check_calibration("calibration", calibration)
    random = torch.Generator().manual_seed(seed)
    height, width, pitch = calibration.sensor.height, calibration.sensor.width, calibration.sensor.mm_per_pixel
    x, y = pixel_grid_mm(height, width, pitch)
    reach = 0.12 * min(height, width) * pitch
    at_rest = calibration.background.detach().float().clamp(0.0, 1.0) ** (1.0 / calibration.sensor.exponent)
    frames = []
    for touches in (1, 0, 2):
        change = torch.zeros_like(at_rest)
        for _ in range(touches):
            x_0, y_0 = (0.5 * (torch.rand(2, generator=random) - 0.5) * torch.tensor([width, height]) * pitch).tolist()
            u, v = (x - x_0) / reach, (y - y_0) / reach
            for j in range(3):  # each light from its side, as on a ball
                angle = 2.0 * math.pi * j / 3.0
                change[j] += 0.6 * (math.cos(angle) * u + math.sin(angle) * v) * torch.exp(-((u * u + v * v) ** 2))
        frames.append(at_rest * (1.0 + change) + 0.004 * torch.randn(at_rest.shape, generator=random))
    frames.append(torch.rand(at_rest.shape, generator=random))
    images = (torch.stack(frames).clamp(0.0, 1.0) * 255.0).round() / 255.0
    return images.to(calibration.background.dtype)


@dataclass(frozen=True)
class ExportCheck:
    """How an export went: its file, size, largest difference of depth to the pipeline, and what is wrong, if anything is."""

    format: str
    path: Path
    size_kb: float
    difference_mm: float
    reason: str

    @property
    def ok(self) -> bool:
        """Whether the file is there and agrees with the pipeline."""
        return not self.reason


def export_checked(pipe: DepthPipeline, folder: str | Path, formats: Sequence[str], images: Tensor) -> list[ExportCheck]:
    """Write a pipeline in several formats, and hold each file against it by :func:`compare`.

    One format that fails, by whatever exception, does not keep the others from being written; its row says why.

    Args:
        pipe: the pipeline. folder: where to; made if it is not there.
        formats: names from FORMATS. images: (B, 3, H, W), B at least 3.
    Raises:
        ValueError: unknown format.
    """
    _check_pipeline(pipe)
    check_batch("images", images, 3)
    check_sequence("formats", formats, "formats")
    for name in formats:
        check_choice("format", name, list(FORMATS))
    folder = check_path("folder", folder)
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in formats:
        path, nothing = folder / FORMATS[name].file_name, float("nan")
        try:
            FORMATS[name].write(pipe, path)
            difference = compare(path, pipe, images, name)
        except Exception as error:
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            rows.append(ExportCheck(name, path, path.stat().st_size / 1024 if path.is_file() else nothing, nothing, reason))
            continue
        within = difference <= FORMATS[name].tolerance_mm
        reason = "" if within else f"depth is {difference:.3g} mm off, at most {FORMATS[name].tolerance_mm:g} is allowed"
        rows.append(ExportCheck(name, path, path.stat().st_size / 1024, difference, reason))
    return rows


def compare(path: str | Path, pipe: DepthPipeline, images: Tensor, name: str) -> float:
    """Largest difference of depth, mm, between an exported file and the pipeline, over batches of 1, 2, 3 and all images.

    The file is run by a process in which torchvts cannot be imported, the pipeline by the tensor operators that it was exported as:
    compiled loops round otherwise, which wholly random frames, whose slopes mean nothing, make visible.

    Args:
        path: the file. pipe: what it was made from. images: (B, 3, H, W). name: its format.
    Raises:
        RuntimeError: that process failed; carries the end of what it said. FileNotFoundError: no such file.
    """
    _check_pipeline(pipe)
    check_batch("images", images, 3)
    check_choice("format", name, list(FORMATS))
    path = check_path("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    batches = sorted({size for size in (1, 2, 3, images.shape[0]) if size <= images.shape[0]})
    found = run_bare(path, images, name, batches)
    with torch.no_grad(), reference_only():
        expected = [pipe(images[:size]).depth_mm for size in batches]
    differences = [float((one.double() - two.double()).abs().max()) for one, two in zip(found, expected, strict=True)]
    return max(differences) if all(np.isfinite(differences)) else float("inf")


def run_bare(path: str | Path, images: Tensor, name: str, batches: Sequence[int]) -> list[Tensor]:
    """Depth by an exported file, for the first so many images each, from a process without torchvts."""
    check_batch("images", images, 3)
    check_choice("format", name, list(FORMATS))
    check_sequence("batches", batches, "sizes")
    for size in batches:
        check_integer("batches", size, 1)
    if not check_path("path", path).is_file():
        raise FileNotFoundError(f"{path}: no such file")
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "images.npy", images.detach().cpu().numpy())
        job = {"path": str(Path(path).resolve()), "format": name, "batches": list(batches), "threads": torch.get_num_threads()}
        command = [sys.executable, "-I", "-W", "ignore", "-c", _BARE_PROCESS, json.dumps(job)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            said = done.stderr.strip().splitlines() or ["nothing said"]
            raise RuntimeError(f"{path}: could not be run without torchvts: {said[-1]}")
        return [torch.from_numpy(np.load(Path(folder) / f"depth_{size}.npy")) for size in batches]


_BARE_PROCESS = """
import json, sys
import numpy as np

sys.modules["torchvts"] = None  # an installed one, too, cannot be imported now
try:
    import torchvts
    sys.exit("torchvts can be imported, so this proves nothing")
except ImportError:
    pass
job, images = json.loads(sys.argv[1]), np.load("images.npy")
if job["format"] == "onnx":
    import onnxruntime
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = job["threads"]
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(job["path"], options, providers=["CPUExecutionProvider"])
    run = lambda batch: session.run(["depth_mm"], {"images": batch})[0]
else:
    import torch
    torch.set_num_threads(job["threads"])
    if job["format"] == "torchscript":
        module = torch.jit.load(job["path"])
    elif job["format"] == "pt2":
        module = torch.export.load(job["path"]).module()
    else:
        import torch._inductor
        module = torch._inductor.aoti_load_package(job["path"])
    def run(batch):
        with torch.no_grad():
            return module(torch.from_numpy(batch))[0].numpy()
for size in job["batches"]:
    np.save(f"depth_{size}.npy", run(images[:size].copy()))
"""


def _check_pipeline(pipe: DepthPipeline) -> None:
    check_record("pipe", pipe, DepthPipeline, "DepthPipeline.from_calibration makes one")


def _size(pipe: DepthPipeline) -> tuple[int, int, torch.dtype]:
    """Height, width and dtype that the pipeline was calibrated for."""
    for tensor in (*pipe.contact.buffers(), *pipe.compensate.buffers()):
        if tensor.dim() == 3 and tensor.shape[0] == 3 and tensor.is_floating_point():
            return tensor.shape[1], tensor.shape[2], tensor.dtype
    raise ValueError("pipe: expected blocks that know the size of the calibration, as from_calibration makes them, got none")


def _trace(pipe: DepthPipeline, by_matrix: bool) -> torch.export.ExportedProgram:
    height, width, dtype = _size(pipe)
    pipe = copy.deepcopy(reference(pipe)).eval().requires_grad_(False)
    if by_matrix:
        _use_matrices(pipe, height, width, dtype)
    images = torch.full((2, 3, height, width), 0.5, dtype=dtype)
    batch = torch.export.Dim("batch", min=1, max=MAX_BATCH)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _make_tables(pipe, images)  # which then are constants of the graph
        return torch.export.export(_PlainOutput(pipe), (images,), dynamic_shapes=({0: batch},), strict=False)


def _use_matrices(pipe: DepthPipeline, height: int, width: int, dtype: torch.dtype) -> None:
    """Put matrix products in place of the FFT solvers of a pipeline."""
    solve, policy = pipe.solve, pipe.refine
    if isinstance(solve.integrate, PoissonDCT):
        zero = solve.integrate.zero_in_background
        solve.integrate = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype, zero)
    if isinstance(policy, Shadows):
        policy.residual_integrator = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype)
        policy = policy.policy
    if isinstance(policy, Adaptive):
        rows, columns = (len(range(policy.stride // 2, n, policy.stride)) for n in (height, width))
        policy.coarse_integrate = PoissonBackgroundByMatrix(rows, columns, policy.stride * pipe.mm_per_pixel, dtype)


def _make_tables(pipe: DepthPipeline, images: Tensor) -> None:
    """Let each integrator make the tables of its size."""
    height, width = images.shape[2], images.shape[3]
    pipe(images)
    policy = pipe.refine
    if isinstance(policy, Shadows):
        policy.residual_integrator(images[:, :2], (0, 0), (height, width))
        policy = policy.policy
    if isinstance(policy, Adaptive):
        frame = Crop(policy.stride, False)(images, torch.ones_like(images[:, :1], dtype=torch.bool))
        policy.predicted_change_px(frame, pipe.solve(frame))


def _onnx_decompositions() -> dict[Any, Callable[..., Any]]:
    """Operators that ONNX lacks, in terms of those that it has."""
    aten = torch.ops.aten
    return {aten.median.dim: _median, aten.nanmedian.dim: _nanmedian, aten.cummax.default: _cummax}


def _median(values: Tensor, dim: int, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    ordered, index = torch.sort(values, dim=dim)
    middle = (values.shape[dim] - 1) // 2
    ordered, index = ordered.narrow(dim, middle, 1), index.narrow(dim, middle, 1)
    return (ordered, index) if keepdim else (ordered.squeeze(dim), index.squeeze(dim))


def _nanmedian(values: Tensor, dim: int, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    known = ~torch.isnan(values)
    ordered, index = torch.sort(torch.where(known, values, torch.inf), dim=dim)
    middle = ((known.to(torch.int64).sum(dim, keepdim=True) - 1) // 2).clamp_min(0)
    ordered, index = ordered.gather(dim, middle), index.gather(dim, middle)
    ordered = torch.where(known.any(dim, keepdim=True), ordered, torch.nan)
    return (ordered, index) if keepdim else (ordered.squeeze(dim), index.squeeze(dim))


def _cummax(values: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """By shifts that double; the places of the maxima, which nothing here asks for, stay zero."""
    length, step = values.shape[dim], 1
    while step < length:
        later, earlier = values.narrow(dim, step, length - step), values.narrow(dim, 0, length - step)
        values = torch.cat((values.narrow(dim, 0, step), torch.maximum(later, earlier)), dim=dim)
        step *= 2
    return values, torch.zeros_like(values, dtype=torch.int64)
