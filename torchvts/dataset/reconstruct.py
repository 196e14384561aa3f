"""Data sets larger than memory: a folder, an image or a video into depth files and one table, over processes, resumable.

Rank 0 lists the source and writes a plan; every rank takes its share of it, and after each frame's files are in place adds a line
to a log of its own. What is done is what has a line and its files. At the end rank 0 merges the logs into ``frames.csv``. Plan and
logs are read line by line and in one order, by folder and name, so nothing grows with the data set but the names of one folder.

A frame's result does not depend on batch size, loader workers or processes: each frame goes through the pipeline by itself, on the
same number of threads everywhere. (More threads split sums otherwise: depth then differs by up to 3e-7 mm.)
"""

import csv
import hashlib
import heapq
import json
import os
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, IterableDataset
from tqdm import tqdm

from ..core import __version__
from ..core.checks import check_integer, check_positive
from ..core.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, count_frames, read_image, rgb_from_bgr, write_atomically, write_depth_png
from ..core.geometry import depth_to_points
from ..model.calibration import Calibration
from ..model.sensor import Sensor
from ..pipeline import MODES, DepthOutput, DepthPipeline
from .ranks import Ranks

STATE = ".torchvts"
"""Folder inside the results that holds settings, plan and logs; a folder that has one is never read as a source."""
PICTURES_UP_TO = 20
"""Sources of at most so many frames get pictures unless told otherwise: one picture takes longer than a hundred frames."""
DEPTH_FORMATS = ("png", "npy", "none")
CLOUD_FORMATS = ("pcd", "ply", "none")


@dataclass(frozen=True)
class Settings:
    """What the files of a run depend on; a run is only continued with the same."""

    calibration_sha256: str
    source: str
    mode: str
    depth: str
    cloud: str
    pictures: bool
    threads: int
    torchvts: str
    torch: str


class Item(NamedTuple):
    """One file of a source: its path in it, the stem of its results, its size and time; of a video also which frames are done."""

    path: str
    stem: str
    mark: tuple[int, int]
    done: tuple[tuple[int, int], ...] = ()
    complete: bool = False

    @property
    def is_video(self) -> bool:
        """Whether it has frames."""
        return self.is_text and self.path.lower().endswith(VIDEO_SUFFIXES)

    @property
    def is_text(self) -> bool:
        """Whether the name is UTF-8; OpenCV crashes on others."""
        return not any("\ud800" <= letter <= "\udfff" for letter in self.path)


class Report(NamedTuple):
    """What a run did: rows in the table, how many of them were there before, (name, reason) of those left out, and for each rank
    frames, failures and seconds. Rows, and what was left out, are known to rank 0 only."""

    rank: int
    rows: int
    before: int
    failed: list[tuple[str, str]]
    ranks: list[tuple[float, float, float]]


def reconstruct_dataset(
    calibration: str | Path,
    source: str | Path,
    out: str | Path,
    *,
    mode: str = "auto",
    depth: str = "png",
    cloud: str = "none",
    pictures: bool | None = None,
    batch: int = 8,
    workers: int | None = None,
    threads: int = 1,
    overwrite: bool = False,
    strict: bool = False,
    timeout_s: float = 60.0,
) -> Report:
    """Reconstruct every image and video frame of a source, and continue where an earlier run was stopped.

    Under ``torchrun`` (or any launcher that sets RANK, WORLD_SIZE, MASTER_ADDR, MASTER_PORT) the processes share the work; ``out``
    must then be one folder that all of them see. Files keep their folders: ``sub/a.png`` becomes ``out/sub/a_depth.png``; where
    two files of a folder share a stem, the suffix stays in the name: ``a.png_depth.png``.

    Args:
        calibration: file of a calibrated unit.
        source: image, video, or folder (with all below it; hidden files, links to folders and results of runs are passed over).
        out: folder for results, made if missing.
        mode: "fast", "precise" or "auto". depth: "png", "npy" or "none". cloud: "pcd", "ply" or "none".
        pictures: whether to draw each frame; None draws where there are at most ``PICTURES_UP_TO``.
        batch: frames that a loader worker hands over at once. workers: loader processes for each rank; None chooses.
        threads: of each rank. Results are bit for bit the same only for the same number, so it is one of the settings kept.
        overwrite: begin anew, whatever ``out`` holds. strict: stop at the first frame that cannot be used.
        timeout_s: seconds without a sign of life after which another process counts as dead.
    Raises:
        FileNotFoundError: no calibration or source. ValueError: nothing to do in the source, an option that does not exist, or
        ``out`` was begun with other settings. RuntimeError: another process failed, or another run writes there.
    """
    source, out = Path(source), Path(out)
    for name, value, allowed in (("mode", mode, MODES), ("depth", depth, DEPTH_FORMATS), ("cloud", cloud, CLOUD_FORMATS)):
        if value not in allowed:
            raise ValueError(f"{name}: expected one of {', '.join(allowed)}, got {value!r}")
    check_integer("batch", batch, 1), check_integer("threads", threads, 1), check_positive("timeout_s", timeout_s)
    if workers is not None:
        check_integer("workers", workers, 0)
    unit = Calibration.load(calibration)
    if not source.exists():
        raise FileNotFoundError(f"{source}: no such file or folder")
    if source.is_dir() and out.resolve() == source.resolve():
        raise ValueError(f"out: {out} is the source itself, its results would be read as images: give another folder")
    if cloud != "none":
        from ..pose.clouds import open3d

        open3d()  # said now, not after the first frame
    torch.set_num_threads(threads)
    settings = _settings(calibration, source, mode, depth, cloud, bool(pictures), threads)
    with Ranks(timeout_s) as ranks:
        if ranks.rank > 0:
            ranks.wait("planned", "planning")
            begun = _read_settings(out)
            _refuse_other(
                out, begun, settings if pictures is not None or begun is None else _with_pictures(settings, begun.pictures)
            )
            return _reconstruct(unit, source, out, begun or settings, ranks, batch, workers, strict)
        with _locked(out):
            settings = _begin(source, out, settings, pictures, overwrite)
            _plan(source, out, settings)
            ranks.tell("planned")
            return _reconstruct(unit, source, out, settings, ranks, batch, workers, strict)


def _reconstruct(
    unit: Calibration, source: Path, out: Path, settings: Settings, ranks: Ranks, batch: int, workers: int | None, strict: bool
) -> Report:
    pending, before = _count_plan(source, out)
    if workers is None:
        cores = (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        workers = 0 if pending < 4 * batch else max(1, min(4, cores // 2))
    work = _Worker(unit, source, out, settings, ranks, strict)
    start = time.perf_counter()
    with tqdm(total=pending, unit="frame", disable=ranks.rank > 0, smoothing=0.05) as bar:
        work.run(batch, workers, bar)
        seconds = time.perf_counter() - start
        ranks.tell(f"finished/{ranks.rank}")
        for rank in range(ranks.world):
            ranks.wait(f"finished/{rank}", f"the share of rank {rank}", bar)
    figures = ranks.gather((float(work.frames), float(work.failed), seconds))
    rows, failed = _merge(out) if ranks.rank == 0 else (0, [])
    return Report(ranks.rank, rows, before, failed, figures)


# ---- what a source holds -------------------------------------------------------------------------------------------------------


def list_items(source: str | Path) -> Iterator[Item]:
    """Images and videos of a source, folder by folder and by name; only one folder's names are held at a time.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("b.png", "a.png", "a.jpg", "notes.txt"):
        ...         Path(folder, name).touch()
        ...     [(item.path, item.stem) for item in list_items(folder)]
        [('a.jpg', 'a.jpg'), ('a.png', 'a.png'), ('b.png', 'b')]
    """
    source = Path(source)
    if source.is_dir():
        yield from _walk(source, "")
    else:
        status = source.stat()
        yield Item(source.name, source.stem, (status.st_size, status.st_mtime_ns))


def _walk(folder: Path, prefix: str) -> Iterator[Item]:
    with os.scandir(folder) as entries:
        kept = sorted((entry for entry in entries if not entry.name.startswith(".")), key=lambda entry: entry.name)
    suffixes = IMAGE_SUFFIXES + VIDEO_SUFFIXES
    stems = output_stems([entry.name for entry in kept if entry.name.lower().endswith(suffixes) and entry.is_file()])
    for entry in kept:
        if entry.name in stems:
            status = entry.stat()
            yield Item(prefix + entry.name, prefix + stems[entry.name], (status.st_size, status.st_mtime_ns))
        elif entry.is_dir(follow_symlinks=False) and not (folder / entry.name / STATE).is_dir():
            yield from _walk(folder / entry.name, f"{prefix}{entry.name}/")


def output_stems(names: list[str]) -> dict[str, str]:
    """Stem of the results of each file of one folder; no two share one. Frame n of a video adds ``_n`` in six digits.

    Example:
        >>> output_stems(["a.png", "b.png", "b.jpg"])
        {'a.png': 'a', 'b.png': 'b.png', 'b.jpg': 'b.jpg'}
    """
    plain = {name: os.path.splitext(name)[0] for name in names}
    count = Counter(stem.casefold() for stem in plain.values())
    videos = {plain[name].casefold() for name in names if name.lower().endswith(VIDEO_SUFFIXES)}

    def clashes(name: str) -> bool:
        stem = plain[name].casefold()
        return count[stem] > 1 or (re.sub(r"_\d{6,}$", "", stem) in videos and re.search(r"_\d{6,}$", stem) is not None)

    stems = {name: name if clashes(name) else stem for name, stem in plain.items()}
    return stems if len(set(stems.values())) == len(stems) else {name: name for name in names}


def _order(path: str) -> list[str]:
    return path.split("/")


def _name(path: str, frame: int) -> str:
    return path if frame < 0 else f"{path}/{frame:06d}"


# ---- settings, plan, logs, table -----------------------------------------------------------------------------------------------


def _settings(calibration: str | Path, source: Path, mode: str, depth: str, cloud: str, pictures: bool, threads: int) -> Settings:
    digest = hashlib.sha256(Path(calibration).read_bytes()).hexdigest()
    return Settings(digest, str(source.resolve()), mode, depth, cloud, pictures, threads, __version__, str(torch.__version__))


def _with_pictures(settings: Settings, pictures: bool) -> Settings:
    return Settings(**{**asdict(settings), "pictures": pictures})


def _read_settings(out: Path) -> Settings | None:
    path = out / STATE / "settings.json"
    if not path.is_file():
        return None
    try:
        return Settings(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: not the settings of a run ({error}): give another --out, or --overwrite") from error


def _refuse_other(out: Path, begun: Settings | None, settings: Settings) -> None:
    if begun is None:
        return
    names = {"calibration_sha256": "calibration file"}
    other = [
        f"{names.get(field.name, field.name)} {str(getattr(begun, field.name))[:60]!r} then, "
        f"{str(getattr(settings, field.name))[:60]!r} now"
        for field in fields(Settings)
        if getattr(begun, field.name) != getattr(settings, field.name)
    ]
    if other:
        raise ValueError(
            f"out: {out} was begun with other settings: {'; '.join(other)}: give another --out, or --overwrite to begin anew"
        )


def _begin(source: Path, out: Path, settings: Settings, pictures: bool | None, overwrite: bool) -> Settings:
    """Keep the settings of a run, or hold them against those it was begun with; clear away what a killed run left half written."""
    if overwrite:
        for path in [*(out / STATE).glob("*.json*"), out / "frames.csv", out / "failed.csv"]:
            path.unlink(missing_ok=True)
    begun = _read_settings(out)
    if pictures is None:
        pictures = _few(source) if begun is None else begun.pictures
    settings = _with_pictures(settings, pictures)
    _refuse_other(out, begun, settings)
    if begun is None:
        with write_atomically(out / STATE / "settings.json") as temporary:
            temporary.write_text(json.dumps(asdict(settings), indent=1), encoding="utf-8")
        if not overwrite:
            return settings
    temporary_name = re.compile(r"\..+-[a-z0-9_]{8}\.(png|npy|pcd|ply|csv|json|jsonl)")  # as write_atomically makes them
    for folder, _, names in os.walk(out):
        for name in names:
            if name.startswith(".") and temporary_name.fullmatch(name):
                Path(folder, name).unlink(missing_ok=True)
    return settings


def _few(source: Path) -> bool:
    total = 0
    for item in islice(list_items(source), PICTURES_UP_TO + 1):
        total += count_frames(_file(source, item)) if item.is_video else 1
    return total <= PICTURES_UP_TO


def _file(source: Path, item: Item) -> Path:
    return source / item.path if source.is_dir() else source


def _plan(source: Path, out: Path, settings: Settings) -> None:
    """Write what the source holds and which of it is done, and the lines of earlier logs that still count as one log."""
    state = out / STATE
    logs = sorted(state.glob("log-*.jsonl"))
    items = 0
    with (
        write_atomically(state / "plan.jsonl") as plan,
        write_atomically(state / f"log-{time.time_ns()}-kept.jsonl") as kept,
        plan.open("w", encoding="utf-8") as plan_stream,
        kept.open("w", encoding="utf-8") as kept_stream,
    ):
        for item, records in _joined(list_items(source), _read_logs(logs)):
            items += 1
            good = [r for r in records if "failed" not in r and r["mark"] == list(item.mark) and _is_there(out, item, r, settings)]
            for record in good:
                kept_stream.write(json.dumps(record) + "\n")
            frames = [r["frame"] for r in good if "end" not in r]
            ends = [r["frame"] for r in good if "end" in r]
            complete = len(frames) == ends[0] if item.is_video and ends else bool(frames) and not item.is_video
            done = _ranges(frames) if item.is_video else ()
            plan_stream.write(json.dumps([*item[:3], done, complete]) + "\n")
    for log in logs:
        log.unlink()
    if items == 0:
        raise ValueError(f"{source}: no images or videos in this folder ({', '.join(IMAGE_SUFFIXES + VIDEO_SUFFIXES)})")


def _is_there(out: Path, item: Item, record: dict[str, Any], settings: Settings) -> bool:
    if "end" in record:
        return True
    stem = _stem(out, item, record["frame"])
    names = [f"_depth.{settings.depth}"] * (settings.depth != "none")
    names += [f".{settings.cloud}"] * (settings.cloud != "none" and record["cloud"])
    names += ["_picture.png"] * settings.pictures
    return all(os.path.isfile(f"{stem}{name}") for name in names)


def _stem(out: Path, item: Item, frame: int) -> Path:
    return out / (item.stem if frame < 0 else f"{item.stem}_{frame:06d}")


def _ranges(frames: list[int]) -> tuple[tuple[int, int], ...]:
    """Sorted numbers as half-open ranges.

    Example:
        >>> _ranges([0, 1, 2, 5])
        ((0, 3), (5, 6))
    """
    runs = (list(group) for _, group in groupby(enumerate(frames), key=lambda pair: pair[1] - pair[0]))
    return tuple((run[0][1], run[-1][1] + 1) for run in runs)


def _read_plan(out: Path) -> Iterator[Item]:
    with (out / STATE / "plan.jsonl").open(encoding="utf-8") as stream:
        for line in stream:
            path, stem, mark, done, complete = json.loads(line)
            yield Item(path, stem, (mark[0], mark[1]), tuple((a, b) for a, b in done), complete)


def _count_plan(source: Path, out: Path) -> tuple[int, int]:
    """Frames to do (of videos, as many as they claim) and frames done."""
    pending = before = 0
    for item in _read_plan(out):
        done = sum(stop - first for first, stop in item.done) if item.is_video else int(item.complete)
        before += done
        if not item.complete:
            pending += max(0, count_frames(_file(source, item)) - done) if item.is_video else 1
    return pending, before


def _read_logs(paths: Iterable[Path]) -> Iterator[dict[str, Any]]:
    """Lines of all logs in the order of the plan, one for each frame: a good one where there is any."""
    merged = heapq.merge(*(_read_log(path) for path in paths), key=_record_order)
    for _, group in groupby(merged, key=lambda record: (_record_order(record), tuple(record["mark"]))):
        records = list(group)
        yield next((record for record in records if "failed" not in record), records[0])


def _record_order(record: dict[str, Any]) -> tuple[list[str], int, list[int]]:
    return _order(record["item"]), record["frame"], record["mark"]


def _read_log(path: Path) -> Iterator[dict[str, Any]]:
    """Whole lines of a log; one that a kill has torn is passed over, its frame counts as not done."""
    last: tuple[list[str], int, list[int]] | None = None
    with path.open("rb") as stream:
        for line in stream:
            try:
                record = json.loads(line) if line.endswith(b"\n") else None
                order = _record_order(record) if isinstance(record, dict) else None
            except (ValueError, KeyError):
                continue
            if record is None or order is None:
                continue
            if last is not None and order < last:
                raise ValueError(f"{path}: lines out of order, damaged or edited: delete it, and its frames are computed again")
            last = order
            yield record


def _joined(items: Iterable[Item], records: Iterator[dict[str, Any]]) -> Iterator[tuple[Item, list[dict[str, Any]]]]:
    """Each item with its records; both come in the same order, so neither is held."""
    groups = groupby(records, key=lambda record: _order(record["item"]))
    head = next(groups, None)
    for item in items:
        place = _order(item.path)
        while head is not None and head[0] < place:
            head = next(groups, None)
        if head is not None and head[0] == place:
            yield item, list(head[1])
            head = next(groups, None)
        else:
            yield item, []


def _merge(out: Path) -> tuple[int, list[tuple[str, str]]]:
    """The logs of all ranks as frames.csv, and what was left out as failed.csv; rows of the one, rows of the other."""
    rows, failed, missing = 0, [], []
    logs = _read_logs(sorted((out / STATE).glob("log-*.jsonl")))
    with (
        write_atomically(out / "frames.csv") as temporary,
        temporary.open("w", encoding="utf-8", errors="surrogateescape", newline="") as stream,
    ):
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(("frame", "deepest_mm", "contact_mm2"))
        for item, records in _joined(_read_plan(out), logs):
            records = [record for record in records if record["mark"] == list(item.mark)]
            ends = [record["frame"] for record in records if "end" in record]
            frames = [record for record in records if "end" not in record]
            for record in frames:
                name = _name(item.path, record["frame"])
                if "failed" in record:
                    failed.append((name, str(record["failed"])))
                else:
                    table.writerow((name, f"{record['deepest_mm']:.6f}", f"{record['contact_mm2']:.6f}"))
                    rows += 1
            whole = [r["frame"] for r in frames] == list(range(ends[0])) if ends else len(frames) == 1 and frames[0]["frame"] < 0
            if not whole:
                missing.append(item.path)
        if missing:
            raise RuntimeError(f"{len(missing)} files have no result, the first is {missing[0]}: run the same command again")
    if failed:
        with (
            write_atomically(out / "failed.csv") as temporary,
            temporary.open("w", encoding="utf-8", errors="surrogateescape", newline="") as stream,
        ):
            csv.writer(stream, lineterminator="\n").writerows([("frame", "reason"), *failed])
    else:
        (out / "failed.csv").unlink(missing_ok=True)
    return rows, failed


@contextmanager
def _locked(out: Path, patience_s: float = 15.0) -> Iterator[None]:
    """Hold ``out`` for one run. The system lets go of it when the process dies, its loader workers some seconds later."""
    (out / STATE).mkdir(parents=True, exist_ok=True)
    try:
        import fcntl
    except ImportError:  # no such locks here
        yield
        return
    with (out / STATE / "lock").open("w") as stream:
        deadline = time.monotonic() + patience_s
        while True:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() > deadline:
                    raise RuntimeError(f"out: another run is writing into {out}: wait for it, or stop it") from error
                time.sleep(0.2)
        yield


# ---- reading, in loader workers ------------------------------------------------------------------------------------------------


class _Frame(NamedTuple):
    """A frame as a loader hands it over: where it is from, and why it cannot be used. ``end``: their number, no frame."""

    item: Item
    number: int
    reason: str = ""
    end: bool = False


_Batch = tuple[list[_Frame], Tensor]
"""Frames, and the images of the usable ones in one tensor: one shared-memory file a batch, however large the data set."""


def _load(read: Any, sensor: Sensor) -> tuple[Tensor | None, str]:
    """One frame rectified, or why there is none."""
    import cv2

    try:
        return sensor.rectify(read()[None])[0], ""
    except (OSError, ValueError, cv2.error) as error:
        return None, " ".join(str(error).split()) or type(error).__name__


def _as_is(batch: Any) -> Any:
    return batch


def _stack(images: list[Tensor]) -> Tensor:
    return torch.stack(images) if images else torch.empty(0)


class _Images(Dataset[_Batch]):
    """Image files, fetched by item instead of by number, so that no list of them is needed."""

    def __init__(self, source: Path, sensor: Sensor) -> None:
        self.source, self.sensor = source, sensor

    def __getitems__(self, items: list[Item]) -> _Batch:
        frames, images = [], []
        for item in items:
            path = _file(self.source, item)
            image, reason = None, "its name is not UTF-8: rename it"
            if item.is_text:
                image, reason = _load(lambda path=path: read_image(path), self.sensor)
            frames.append(_Frame(item, -1, reason))
            images += [] if image is None else [image]
        return frames, _stack(images)


class _Video(IterableDataset[_Batch]):
    """Every world-th frame of a video. All of it is decoded in order, which is exact for any codec; seeking is not."""

    def __init__(self, path: Path, item: Item, sensor: Sensor, rank: int, world: int, batch: int) -> None:
        self.path, self.item, self.sensor = path, item, sensor
        self.rank, self.world, self.batch = rank, world, batch

    def __iter__(self) -> Iterator[_Batch]:
        import cv2

        capture = cv2.VideoCapture(str(self.path))
        frames: list[_Frame] = []
        images: list[Tensor] = []
        number = 0
        try:
            while capture.grab():
                if number % self.world == self.rank and not any(first <= number < stop for first, stop in self.item.done):
                    there, pixels = capture.retrieve()
                    image, reason = (
                        _load(lambda pixels=pixels: rgb_from_bgr(pixels), self.sensor) if there else (None, "not decoded")
                    )
                    frames.append(_Frame(self.item, number, reason))
                    images += [] if image is None else [image]
                    if len(frames) == self.batch:
                        yield frames, _stack(images)
                        frames, images = [], []
                number += 1
        finally:
            capture.release()
        if number == 0:
            frames.append(_Frame(self.item, -1, "not a video, or cut short: no frame could be read"))
        else:
            frames.append(_Frame(self.item, number, end=True))
        yield frames, _stack(images)


def _batches(items: Iterator[Item], size: int) -> Iterator[list[Item]]:
    while batch := list(islice(items, size)):
        yield batch


class _Worker:
    """One rank's share: read, reconstruct, write, log."""

    def __init__(self, unit: Calibration, source: Path, out: Path, settings: Settings, ranks: Ranks, strict: bool) -> None:
        self.sensor, self.source, self.out = unit.sensor, source, out
        self.settings, self.ranks, self.strict = settings, ranks, strict
        self.pipe = DepthPipeline.from_calibration(unit, settings.mode)
        self.frames = self.failed = 0

    def run(self, batch: int, workers: int, bar: "tqdm[Any]") -> None:
        """All of the share. Files are written by threads, because most of that is waiting for the disk; lines keep their order."""
        log = self.out / STATE / f"log-{time.time_ns()}-{self.ranks.rank}.jsonl"
        writers = 1 if self.settings.pictures else 4  # matplotlib draws in one thread only
        waiting: deque[tuple[_Frame, dict[str, Any], Future[None] | None]] = deque()
        with log.open("x", encoding="utf-8") as stream, ThreadPoolExecutor(writers) as pool:
            for loader in self._loaders(batch, workers):
                for frames, images in loader:
                    place = 0
                    for frame in frames:
                        self.ranks.check()
                        usable = not frame.reason and not frame.end
                        waiting.append(self._frame(frame, images[place : place + 1] if usable else None, pool))
                        place += usable
                        if len(waiting) > 4 * writers:
                            self._settle(*waiting.popleft(), stream)
                    bar.update(self.ranks.total() - bar.n)
                while waiting:  # the next loader forks: no thread may be busy then
                    self._settle(*waiting.popleft(), stream)
        bar.update(self.ranks.total() - bar.n)

    def _settle(self, frame: _Frame, record: dict[str, Any], written: "Future[None] | None", stream: TextIO) -> None:
        """Log a frame whose files are in place, or why there are none."""
        if written is not None:
            try:
                written.result()
            except ValueError as error:  # a depth that its format does not hold; a full disk is an OSError and stops the run
                record = _failure(record, error)
        stream.write(json.dumps(record) + "\n")
        stream.flush()
        self.frames += "deepest_mm" in record
        self.failed += "failed" in record
        self.ranks.count = self.frames + self.failed
        if "failed" in record:
            name = _name(frame.item.path, frame.number)
            if self.strict:
                raise ValueError(f"{name}: {record['failed']}")
            tqdm.write(f"left out {name}: {record['failed']}", file=sys.stderr)

    def _loaders(self, batch: int, workers: int) -> Iterator[Iterable[_Batch]]:
        images = _Images(self.source, self.sensor)
        for is_video, items in groupby(self._share(), key=lambda item: item.is_video):
            if is_video:
                for item in items:
                    video = _Video(_file(self.source, item), item, self.sensor, self.ranks.rank, self.ranks.world, batch)
                    yield DataLoader(video, batch_size=None, num_workers=min(1, workers), collate_fn=_as_is)
            else:
                lazily: Any = _batches(items, batch)
                yield DataLoader(images, batch_sampler=lazily, num_workers=workers, collate_fn=_as_is)

    def _share(self) -> Iterator[Item]:
        """Every world-th image that is not done, and all videos that are not: of those every rank does some frames."""
        place = 0
        for item in _read_plan(self.out):
            if item.complete:
                continue
            if item.is_video or place % self.ranks.world == self.ranks.rank:
                yield item
            place += not item.is_video

    def _frame(
        self, frame: _Frame, image: Tensor | None, pool: ThreadPoolExecutor
    ) -> tuple[_Frame, dict[str, Any], "Future[None] | None"]:
        record: dict[str, Any] = {"item": frame.item.path, "frame": frame.number, "mark": list(frame.item.mark)}
        if frame.end:
            return frame, {**record, "end": True}, None
        if image is None:
            return frame, {**record, "failed": frame.reason}, None
        try:
            with torch.inference_mode():
                result = self.pipe(image)
        except ValueError as error:
            return frame, _failure(record, error), None
        area = float(result.contact.double().sum()) * self.sensor.mm_per_pixel**2
        touched = bool(result.contact.any())
        record |= {"deepest_mm": float(result.depth_mm.max()), "contact_mm2": area, "cloud": touched}
        stem, name = _stem(self.out, frame.item, frame.number), _name(frame.item.path, frame.number)
        return frame, record, pool.submit(self._write, stem, name, image, result)

    def _write(self, stem: Path, name: str, image: Tensor, frame: DepthOutput) -> None:
        stem.parent.mkdir(parents=True, exist_ok=True)
        pitch = self.sensor.mm_per_pixel
        if self.settings.depth == "png":
            write_depth_png(f"{stem}_depth.png", frame.depth_mm)
        elif self.settings.depth == "npy":
            with write_atomically(f"{stem}_depth.npy") as temporary:
                np.save(temporary, frame.depth_mm[0, 0].numpy())
        if self.settings.cloud != "none" and bool(frame.contact.any()):
            from ..pose import write_point_cloud

            inside = frame.contact[0, 0]
            normals = frame.normal[0].permute(1, 2, 0)[inside] * torch.tensor([1.0, -1.0, 1.0])  # y up
            write_point_cloud(f"{stem}.{self.settings.cloud}", depth_to_points(frame.depth_mm, pitch, frame.contact), normals)
        if self.settings.pictures:
            from .. import viz

            viz.save_figure(viz.depth_figure(frame.depth_mm, pitch, image, frame.contact, name), f"{stem}_picture.png")


def _failure(record: dict[str, Any], error: ValueError) -> dict[str, Any]:
    return {name: record[name] for name in ("item", "frame", "mark")} | {"failed": " ".join(str(error).split())}
