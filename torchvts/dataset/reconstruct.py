"""Data sets larger than memory: a folder, an image or a video into depth files and one table, over processes, resumable.

Every process lists the source in the same order, takes each N-th image and each N-th frame of every video, and passes over what is
done already (:mod:`.records`). At the end rank 0 writes ``frames.csv``. A frame's result does not depend on reading threads or
processes: each goes through the pipeline by itself, on the same number of threads everywhere.
"""

import hashlib
import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path

import torch

from ..core import __version__
from ..core.checks import check_choice, check_integer, check_path, check_sequence
from ..core.containers import open_film
from ..core.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from ..model import Calibration
from ..pipeline import MODES, unit_pipeline
from ..pose.output_frame import MM_OF
from ..skin import ContactSettings
from ..stream import FIRST_FRAMES, check_device
from .items import FORMATS, Source, list_items
from .processes import share, sum_over_processes
from .records import Records
from .settings import Settings, begin, join, locked
from .worker import RunReport, Worker

CLOUD_FORMATS = ("ply", "obj", "pcd", "x3p", "none")
"""Kinds of files for the contact of a frame."""


def reconstruct_dataset(
    calibration: str | Path,
    source: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    mode: str = "fast",
    format: str = "npz",
    cloud: str = "none",
    length_unit: str = "mm",
    pictures: bool | None = None,
    every: int = 1,
    network: str | Path | None = None,
    device: str = "cpu",
    contact: ContactSettings | None = None,
    background_frames: int = FIRST_FRAMES,
    workers: int | None = None,
    threads: int = 1,
    overwrite: bool = False,
    strict: bool = False,
) -> RunReport:
    """Reconstruct every image and video frame of a source, and continue where an earlier run was stopped.

    Under ``torchrun`` (or any launcher that sets RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT) the processes share the work; ``out``
    must then be one folder that all of them see. docs/datasets.md says which files there are.

    Args:
        calibration: file of a calibrated unit.
        source: image, video, recording in a container, or folder with all below it, or several of these.
        out: folder for results, made if missing.
        mode: "fast" or "precise".
        format: "npz" (depth, normals, gradient, masks, units; :func:`torchvts.read_result`), "video-npz" (the same, one file a
            video), "video-zarr" (the same as a zipped zarr store, row k for frame k), "png16" (depth in 16 bits), "npy" (depth)
            or "none".
        cloud: contact as points, "ply" or "pcd", as a surface, "obj" or "x3p" (metres, of the sensor), or "none".
        length_unit: of the clouds, "mm" or "m"; they have the axes of the robot where the sensor has ``sensor_to_robot``.
        pictures: whether to draw each frame; None draws where there are at most ``PICTURES_UP_TO``.
        every: take each N-th frame of a video, each N-th image of a folder.
        network: gs_sdk's ``nnmodel.pth`` or what ``torchvts train`` wrote, in place of the calibration's model.
        device: of the pipeline, "cpu" or "cuda".
        contact: thresholds of contact; None for the usual ones.
        background_frames: first frames of a video, which show the skin without contact; 0 uses the calibration as it is.
        workers: threads of each rank that read images; None chooses.
        threads: of each rank. Results are bit for bit the same only for the same number, so it is one of the settings kept.
        overwrite: begin anew, whatever ``out`` holds.
        strict: stop at the first frame that cannot be used.
    Raises:
        FileNotFoundError: no calibration or source.
        ImportError: the library of a container is not installed.
        ValueError: nothing to do in the source, an option that does not exist, or ``out`` was begun with other settings.
        RuntimeError: another process failed, or another run writes there.
    """
    source, out = _source(source), Path(out)
    check_choice("mode", mode, MODES)
    check_choice("format", format, tuple(FORMATS))
    check_choice("cloud", cloud, CLOUD_FORMATS)
    check_choice("length_unit", length_unit, tuple(MM_OF))
    check_integer("threads", threads, 1)
    check_integer("every", every, 1)
    check_integer("background_frames", background_frames, 0)
    if workers is not None:
        check_integer("workers", workers, 1)
    unit = Calibration.load(calibration)
    check_device(device)
    if network is not None:
        unit_pipeline(unit, mode, network, contact)  # a bad one is refused before anything is written
    _check_source(source, out)
    names = os.pathsep.join(str(path.resolve()) for path in source)
    settings = Settings(
        _digest(calibration), _digest(network), names, mode, format, cloud, pictures, every, device, threads,
        __version__, str(torch.__version__), background_frames, None if contact is None else asdict(contact), length_unit,
    )  # fmt: skip
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with share() as (rank, world), locked(out) if rank == 0 else nullcontext():
            if rank == 0:
                settings = begin(source, out, settings, overwrite)
            sum_over_processes(0)  # the settings are there for the others to read
            if rank > 0:
                settings = join(out, settings)
            records = Records(source, out, settings)
            return Worker(unit, Path(calibration).name, network, records, (rank, world), strict).run(workers)
    finally:
        torch.set_num_threads(before)


def _source(source: str | Path | Sequence[str | Path]) -> Source:
    if isinstance(source, str | Path):
        return (Path(source),)
    check_sequence("source", source, "paths of images, videos or folders")
    paths = tuple(check_path("source", path) for path in source)
    if not paths:
        raise ValueError("source: expected one path or more, got none")
    return paths


def _digest(path: str | Path | None) -> str:
    return "" if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _check_source(source: Source, out: Path) -> None:
    for path in source:
        if open_film(path) is not None:
            continue
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
        if path.is_dir() and out.resolve() == path.resolve():
            raise ValueError(f"out: {out} is the source itself, its results would be read as images: give another folder")
        if next(list_items(path), None) is None:
            raise ValueError(f"{path}: no images or videos in this folder ({', '.join(IMAGE_SUFFIXES + VIDEO_SUFFIXES)})")
