"""Data sets larger than memory: a folder, an image or a video into depth files and one table, over processes, resumable.

Every process lists the source in the same order, takes each N-th image and each N-th frame of every video, and passes over what is
done already (:mod:`.records`). At the end rank 0 writes ``frames.csv``. Only the names of one folder are in memory at a time.

Frames of a video go the way of a stream (:class:`torchvts.stream.Recording`): every process follows the light of all of them, and
finds the depth of its own. An image is a recording of one frame. A frame's result does not depend on batch size, loader workers or
processes: each goes through the pipeline by itself, on the same number of threads everywhere. (More threads split sums otherwise:
depth then differs by up to 3e-7 mm.)
"""

import hashlib
import os
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..core import __version__
from ..core.checks import check_choice, check_integer, check_path, check_sequence, in_one_line
from ..core.containers import open_film
from ..core.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from ..core.recordings import count_frames, cut_short, video_codec
from ..model import Calibration
from ..pipeline import MODES, DepthOutput, unit_pipeline
from ..pose.output_frame import MM_OF
from ..skin import ContactSettings, motion_of_unit
from ..stream import FIRST_FRAMES, Recording, check_device
from .items import Item, Source, list_items
from .loading import Entry, load_frames
from .processes import share, sum_over_processes
from .records import FORMATS, Records, Settings, begin, join, locked
from .writing import Writer

CLOUD_FORMATS = ("ply", "obj", "pcd", "none")
"""Kinds of files for the contact of a frame."""


class Report(NamedTuple):
    """What a run did; known to rank 0 only.

    Attributes:
        rank: rank of this process.
        rows: frames in the table.
        before: how many of them an earlier run had done.
        failed: (name, reason) of the frames that were left out.
        seconds: from the first frame until all processes had finished.
        notes: (name, text) of what else is to be known: videos whose first frames were not used, or that are cut short.
        doubted: (name, doubt) of the frames in which less may have been seen than is there.
    """

    rank: int
    rows: int
    before: int
    failed: list[tuple[str, str]]
    seconds: float
    notes: Sequence[tuple[str, str]] = ()
    doubted: Sequence[tuple[str, str]] = ()


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
    batch: int = 8,
    workers: int | None = None,
    threads: int = 1,
    overwrite: bool = False,
    strict: bool = False,
) -> Report:
    """Reconstruct every image and video frame of a source, and continue where an earlier run was stopped.

    Under ``torchrun`` (or any launcher that sets RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT) the processes share the work; ``out``
    must then be one folder that all of them see. Files keep their folders: ``sub/a.png`` becomes ``out/sub/a.npz``; where two
    files of a folder share a stem, the suffix stays in the name: ``a.png.npz``. ``frames.csv`` is the table of all frames,
    ``summary.json`` says what the files are.

    Args:
        calibration: file of a calibrated unit.
        source: image, video, recording in a container, or folder with all below it, or several of these; hidden files, links to
            folders and results of runs are passed over. Containers are named, not looked for in folders.
        out: folder for results, made if missing.
        mode: "fast" or "precise".
        format: "npz" (depth, normals, gradient, masks, units; :func:`torchvts.read_result`), "video-npz" (the same, one file a
            video), "png16" (depth in 16 bits), "npy" (depth) or "none".
        cloud: contact as points, "ply" or "pcd", as a surface, "obj", or "none".
        length_unit: of the clouds, "mm" or "m"; they have the axes of the robot where the sensor has ``sensor_to_robot``.
        pictures: whether to draw each frame; None draws where there are at most ``PICTURES_UP_TO``.
        every: take each N-th frame of a video, each N-th image of a folder.
        network: gs_sdk's ``nnmodel.pth`` or what ``torchvts train`` wrote, in place of the calibration's model.
        device: of the pipeline, "cpu" or "cuda".
        contact: thresholds of contact; None for the usual ones.
        background_frames: first frames of a video, which show the skin without contact; 0 uses the calibration as it is, and so
            does a video where they show contact or that is shorter, with a note.
        batch: frames that a loader worker hands over at once.
        workers: loader processes of each rank; None chooses.
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
    for name, value, allowed in (
        ("mode", mode, MODES),
        ("format", format, tuple(FORMATS)),
        ("cloud", cloud, CLOUD_FORMATS),
        ("length_unit", length_unit, tuple(MM_OF)),
    ):
        check_choice(name, value, allowed)
    for name, number, least in (
        ("batch", batch, 1),
        ("threads", threads, 1),
        ("every", every, 1),
        ("background_frames", background_frames, 0),
    ):
        check_integer(name, number, least)
    if workers is not None:
        check_integer("workers", workers, 0)
    unit = Calibration.load(calibration)
    check_device(device)
    if network is not None:
        unit_pipeline(unit, mode, network, contact)  # a bad one is refused before anything is written
    _check_source(source, out)
    settings = Settings(
        _digest(calibration), _digest(network), _names(source), mode, format, cloud, pictures, every, device, threads,
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
            return _Worker(unit, Path(calibration).name, network, records, (rank, world), strict).run(batch, workers)
    finally:
        torch.set_num_threads(before)


def _source(source: str | Path | Sequence[str | Path]) -> Source:
    """One path as it is, several as a tuple."""
    if isinstance(source, str | Path):
        return Path(source)
    check_sequence("source", source, "paths of images, videos or folders")
    paths = tuple(check_path("source", path) for path in source)
    if not paths:
        raise ValueError("source: expected one path or more, got none")
    return paths[0] if len(paths) == 1 else paths


def _names(source: Source) -> str:
    return os.pathsep.join(str(path.resolve()) for path in (source if isinstance(source, tuple) else (source,)))


def _digest(path: str | Path | None) -> str:
    return "" if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _check_source(source: Source, out: Path) -> None:
    for path in source if isinstance(source, tuple) else (source,):
        if open_film(path) is not None:
            continue
        if not path.exists():
            raise FileNotFoundError(f"{path}: no such file or folder")
        if path.is_dir() and out.resolve() == path.resolve():
            raise ValueError(f"out: {out} is the source itself, its results would be read as images: give another folder")
        if next(list_items(path), None) is None:
            raise ValueError(f"{path}: no images or videos in this folder ({', '.join(IMAGE_SUFFIXES + VIDEO_SUFFIXES)})")


NAMED = 5
"""So many frames that cannot be used are named at once, by each process; a folder of another sensor's has thousands."""

_Reconstructed = tuple[Entry, Tensor | None, DepthOutput | None]
"""A frame, its image, and its depth."""


class _Worker:
    """One rank's share of a data set: read, reconstruct, write."""

    def __init__(
        self, unit: Calibration, name: str, network: str | Path | None, records: Records, share: tuple[int, int], strict: bool
    ) -> None:
        self.unit, self.records, self.settings, self.share, self.strict = unit, records, records.settings, share, strict
        self.sensor, self.writer = unit.sensor, Writer(records, unit, name)
        self.writer.motion = motion_of_unit(unit) if records.settings.pictures else None
        thresholds = None if self.settings.contact is None else ContactSettings(**self.settings.contact)
        self.recording = partial(
            Recording, unit, self.settings.mode, network=network, device=self.settings.device, contact=thresholds
        )
        self.image = self.recording()
        self.notes: list[tuple[str, str]] = []
        self.done = self.failed = 0

    def run(self, batch: int, workers: int | None) -> Report:
        """Do the whole share; rank 0 then writes the tables. Files are written by threads: most of that is waiting for the disk."""
        rank, world = self.share
        source = self.records.source
        items = list_items(source, self.settings.every)
        total = sum(count_frames(item.file) if item.is_film else 1 for item in items) // world
        if workers is None:
            cores = (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
            workers = 0 if total < 4 * batch else max(1, min(4, cores // 2))
        writers = 1 if self.settings.pictures else 4  # matplotlib draws in one thread only
        waiting: deque[tuple[Entry, Future[str]]] = deque()
        start = time.perf_counter()
        with tqdm(total=total, unit="frame", disable=rank > 0 or None, smoothing=0.05) as bar, ThreadPoolExecutor(writers) as pool:
            for frame, image, output in self._depths(load_frames(self.records, self.sensor, self.share, batch, workers)):
                bar.update(frame.length is None)
                if not frame.done:
                    waiting.append((frame, pool.submit(self._write, frame, image, output)))
                while len(waiting) > 4 * writers:
                    self._settle(*waiting.popleft())
            while waiting:
                self._settle(*waiting.popleft())
        done = sum_over_processes(self.done)
        seconds = time.perf_counter() - start
        if rank > 0:
            return Report(rank, 0, 0, [], seconds)
        self.records.join_videos()
        rows, failed, doubted = self.records.write_tables()
        self.writer.write_summary(rows, len(failed), len(doubted))
        return Report(0, rows, rows - done, failed, seconds, self.notes, doubted)

    def _depths(self, loaded: Iterable[tuple[Entry, Tensor | None]]) -> Iterator[_Reconstructed]:
        """The frames of this rank with image and depth; those of a video once its first frames are there."""
        recording: Recording | None = None
        held: list[tuple[Entry, Tensor]] = []
        video: Item | None = None
        for frame, image in loaded:
            if not frame.item.is_film or (image is None and frame.length is None):
                if frame.mine:
                    yield self._depth(self.image, frame, image)
                continue
            if frame.item != video:
                video, recording, held = frame.item, None, []
            if image is not None:
                held.append((frame, image))
            if recording is None and (frame.length is not None or len(held) >= self.settings.background_frames):
                recording = self._recording(frame.item, held)
            if recording is not None:
                for one, of_video in held:
                    if one.mine:
                        yield self._depth(recording, one, of_video)
                held = []
            if frame.length is not None:
                if text := cut_short(frame.item.file, frame.length):
                    self.notes.append((frame.item.path, text))
                yield frame, None, None

    def _recording(self, item: Item, held: Sequence[tuple[Entry, Tensor]]) -> Recording:
        """The recording of a video that begins with these frames."""
        count = self.settings.background_frames
        try:
            if 0 < count <= len(held):
                first = torch.cat([image for _, image in held])
                return self.recording(first, codec=video_codec(item.file))
            reason = f"background_frames: expected at least {count} frames, got {len(held)}" if count > 0 else ""
        except ValueError as error:
            reason = in_one_line(error)
        if reason:
            self.notes.append((item.path, f"first frames not used, the calibration is used as it is: {reason}"))
        return self.recording()

    def _depth(self, recording: Recording, frame: Entry, image: Tensor | None) -> _Reconstructed:
        """Depth of one frame if it is wanted, or why there is none."""
        if image is None:
            return frame, None, None
        try:
            reason = recording.unusable(image)
            if reason:
                return frame._replace(failed=reason), None, None
            if frame.done:
                return frame, None, None
            output = recording(image)
            return frame._replace(doubt=recording.doubt), image, output
        except ValueError as error:
            return frame._replace(failed=in_one_line(error)), None, None

    def _settle(self, frame: Entry, written: "Future[str]") -> None:
        """Count a frame whose files are in place, or report why there are none."""
        failed = written.result()  # a full disk is an OSError and stops the run
        if failed:
            name = frame.item.frame_name(frame.number)
            if self.strict:
                raise ValueError(f"{name}: {failed}")
            self.failed += 1
            if self.failed <= NAMED:
                more = "" if self.failed < NAMED else "; further ones are named in failed.csv, at the end"
                tqdm.write(f"left out {name}: {failed}{more}", file=sys.stderr)
        else:
            self.done += frame.length is None

    def _write(self, frame: Entry, image: Tensor | None, result: DepthOutput | None) -> str:
        """Write a frame's files, then its record; returns why there are none, or an empty text."""
        figures: dict[str, Any] = {"failed": frame.failed}
        if frame.length is not None:
            figures = {"frames": frame.length}
        elif image is not None and result is not None:
            area = float(result.contact.double().sum()) * self.sensor.mm_per_pixel**2
            figures = {"deepest_mm": float(result.depth_mm.max()), "contact_mm2": area, "doubt": frame.doubt}
            try:
                self.writer.write(frame, image, result)
            except ValueError as error:  # a depth that its format does not hold
                figures = {"failed": in_one_line(error)}
        self.records.write(frame.item, frame.number, **figures)
        return str(figures.get("failed", ""))
