"""The proof that an exported file agrees with its pipeline: it is run in a process without torchvts and compared."""

import copy
import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..core.checks import check_batch, check_choice, check_integer, check_path, check_sequence
from ..core.files import make_folder
from ..core.geometry import pixel_grid_mm
from ..model.calibration import Calibration, check_calibration
from ..pipeline import DepthPipeline, FrozenPipeline
from . import bare_process
from .formats import FORMATS, check_pipeline


def sample_frames(calibration: Calibration) -> Tensor:
    """Frames of a unit to compare exports on, (4, 3, H, W), 8 bits: one contact, none, two contacts, and random values."""
    check_calibration("calibration", calibration)
    random = torch.Generator().manual_seed(0)
    height, width, pitch = calibration.sensor.height, calibration.sensor.width, calibration.sensor.mm_per_pixel
    x, y = pixel_grid_mm(height, width, pitch)
    reach = 0.12 * min(height, width) * pitch
    background = calibration.background_value
    frames = []
    for contacts in (1, 0, 2):
        change = torch.zeros_like(background)
        for _ in range(contacts):
            x_0, y_0 = (0.5 * (torch.rand(2, generator=random) - 0.5) * torch.tensor([width, height]) * pitch).tolist()
            u, v = (x - x_0) / reach, (y - y_0) / reach
            for j in range(3):  # each light from its side, as on a ball
                angle = 2.0 * math.pi * j / 3.0
                change[j] += 0.6 * (math.cos(angle) * u + math.sin(angle) * v) * torch.exp(-((u * u + v * v) ** 2))
        frames.append(background * (1.0 + change) + 0.004 * torch.randn(background.shape, generator=random))
    frames.append(torch.rand(background.shape, generator=random))
    images = (torch.stack(frames).clamp(0.0, 1.0) * 255.0).round() / 255.0
    return images.to(calibration.background.dtype)


@dataclass(frozen=True)
class ExportCheck:
    """The result of an export.

    Attributes:
        size_kb: size of the file, kB; NaN without one.
        difference_mm: largest difference of depth to the pipeline, mm; NaN if it could not be compared.
        reason: why the export failed; empty if it did not.
    """

    format: str
    path: Path
    size_kb: float
    difference_mm: float
    reason: str

    @property
    def ok(self) -> bool:
        """Whether the file exists and agrees with the pipeline."""
        return not self.reason


def export_checked(pipe: DepthPipeline, folder: str | Path, formats: Sequence[str], images: Tensor) -> list[ExportCheck]:
    """Write a pipeline in several formats, and check each file by :func:`compare`: one row per format.

    A format that fails, by whatever exception, does not keep the others from being written; its row gives the reason.

    Args:
        pipe: the pipeline.
        folder: where to write; made if it does not exist.
        formats: names from :data:`FORMATS`.
        images: (B, 3, H, W).
    Raises:
        ValueError: unknown format.
    """
    check_pipeline(pipe)
    check_batch("images", images, 3)
    check_sequence("formats", formats, "formats")
    for name in formats:
        check_choice("format", name, list(FORMATS))
    folder = check_path("folder", folder)
    make_folder(folder)
    return [_export_one(pipe, folder, name, images) for name in formats]


def _export_one(pipe: DepthPipeline, folder: Path, name: str, images: Tensor) -> ExportCheck:
    form, difference, reason = FORMATS[name], math.nan, ""
    path = folder / form.file_name
    try:
        form.write(pipe, path)
        difference = compare(path, pipe, images, name)
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
    if difference > form.tolerance_mm:
        reason = f"depth is {difference:.3g} mm off, at most {form.tolerance_mm:g} is allowed"
    return ExportCheck(name, path, path.stat().st_size / 1024 if path.is_file() else math.nan, difference, reason)


def compare(path: str | Path, pipe: DepthPipeline, images: Tensor, name: str) -> float:
    """Largest difference of depth, mm, between an exported file and the pipeline, over batches of 1, 2, 3 and all images.

    The file of format ``name`` is run by a process in which torchvts cannot be imported, a plan by the compiled library here.

    Raises:
        RuntimeError: the process failed; the message ends with the last line of its output.
        FileNotFoundError: no such file.
    """
    check_pipeline(pipe)
    check_batch("images", images, 3)
    batches = sorted({size for size in (1, 2, 3, images.shape[0]) if size <= images.shape[0]})
    if name == "plan":
        plan = FrozenPipeline.load(path)
        found = [plan(images[:size]).depth_mm for size in batches]
    else:
        found = run_bare(path, images, name, batches)
    used = copy.deepcopy(pipe).eval()
    with torch.no_grad():
        expected = [used(images[:size]).depth_mm for size in batches]
    differences = [float((one.double() - two.double()).abs().max()) for one, two in zip(found, expected, strict=True)]
    return max(differences) if all(np.isfinite(differences)) else math.inf


def run_bare(path: str | Path, images: Tensor, name: str, batches: Sequence[int]) -> list[Tensor]:
    """Depth (n, 1, H, W), mm, of the first n images (B, 3, H, W), for each n of ``batches``, from a process without torchvts.

    Raises:
        RuntimeError: the process failed.
        FileNotFoundError: no such file.
    """
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
        command = [sys.executable, "-I", "-W", "ignore", str(Path(bare_process.__file__).resolve()), json.dumps(job)]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            output = done.stderr.strip().splitlines() or ["no output"]
            raise RuntimeError(f"{path}: could not be run without torchvts: {output[-1]}")
        return [torch.from_numpy(np.load(Path(folder) / f"depth_{size}.npy")) for size in batches]
