"""What a run keeps beside its results: the settings that it began with, one record per finished frame, and the tables made of them.

A record is written after the files of its frame are in place, each of them whole. So a frame is done when its record can be read,
was made of the same source file, and its files are there. Nothing else has to be kept or merged, and a kill loses only the
frames that were being worked on.
"""

import csv
import json
import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from ..core.checks import brief
from ..core.files import make_folder, naming, write_atomically
from ..core.results import join_results
from ..stream import FIRST_FRAMES
from .items import STATE, Item, Source, has_few_frames, list_items, one_line

VIDEO_FORMAT = "video-npz"
FORMATS = {"npz": ".npz", VIDEO_FORMAT: ".npz", "png16": "_depth.png", "npy": "_depth.npy", "none": ""}
"""Kinds of results, and how the names of their files end."""

SUFFIXES = (*filter(None, dict.fromkeys(FORMATS.values())), ".ply", ".obj", ".pcd", "_picture.png")
"""How the names of all files of a frame end."""

PARTS = "parts"
"""Folder beside the records where the frames of a video wait until it is done."""

Record = dict[str, Any]
"""``mark`` of the source file; then ``deepest_mm``, ``contact_mm2`` and ``doubt`` of a frame, ``frames`` of a whole video, or
``failed``, the reason why there is no result."""


@dataclass(frozen=True)
class Settings:
    """What the results of a run depend on; a run is only continued with the same. ``pictures`` may be None when it begins."""

    calibration_sha256: str
    network_sha256: str
    source: str
    mode: str
    format: str
    cloud: str
    pictures: bool | None
    every: int
    device: str
    threads: int
    torchvts: str
    torch: str
    background_frames: int = FIRST_FRAMES
    contact: dict[str, float] | None = None
    length_unit: str = "mm"


def begin(source: Source, out: Path, settings: Settings, overwrite: bool) -> Settings:
    """Begin or continue a run in ``out``: write the settings, or compare them with those that are there; remove incomplete files.

    With ``overwrite`` the files of the frames that an earlier run wrote go too, whatever its settings were.

    Raises:
        ValueError: the run was begun with other settings.
    """
    if overwrite:
        _remove_results(out)
        shutil.rmtree(out / STATE / "frames", ignore_errors=True)
        shutil.rmtree(out / STATE / PARTS, ignore_errors=True)
        for path in (out / STATE / "settings.json", out / "frames.csv", out / "failed.csv", out / "summary.json"):
            path.unlink(missing_ok=True)
    if (out / STATE / "settings.json").exists():
        settings = join(out, settings)
    else:
        if settings.pictures is None:
            settings = replace(settings, pictures=has_few_frames(source, settings.every))
        with write_atomically(out / STATE / "settings.json") as temporary:
            temporary.write_text(json.dumps(asdict(settings), indent=1), encoding="utf-8")
    incomplete = re.compile(r"\..+-[0-9a-f]{8}\.(png|npy|npz|pcd|ply|obj|csv|json)")  # names of write_atomically
    for folder, folders, names in os.walk(out):
        folders[:] = [name for name in folders if name != STATE]
        for name in filter(incomplete.fullmatch, names):
            Path(folder, name).unlink(missing_ok=True)
    return settings


def _remove_results(out: Path) -> None:
    """Remove the files of every frame that an earlier run recorded, whatever its formats were."""
    frames = out / STATE / "frames"
    for record in frames.rglob("*.json"):
        stem = out / record.relative_to(frames).with_suffix("")
        for suffix in SUFFIXES:
            stem.with_name(stem.name + suffix).unlink(missing_ok=True)


def _is_record(record: object) -> bool:
    """Whether this is a record as :meth:`Records.write` writes it."""
    if not isinstance(record, dict) or not isinstance(record.get("mark"), list):
        return False
    if "failed" in record:
        return isinstance(record["failed"], str)
    if "frames" in record:
        return isinstance(record["frames"], int) and record["frames"] >= 0
    figures = [record.get(name) for name in ("deepest_mm", "contact_mm2")]
    sound = all(isinstance(value, float | int) and not isinstance(value, bool) and math.isfinite(value) for value in figures)
    return sound and isinstance(record.get("doubt"), str) and isinstance(record.get("bytes"), list)


def join(out: Path, settings: Settings) -> Settings:
    """The settings with which a run was begun.

    Raises:
        ValueError: they differ from ``settings``, or cannot be read.
    """
    path = out / STATE / "settings.json"
    try:
        begun = Settings(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: not the settings of a run ({error}): give another --out, or --overwrite") from error
    if settings.pictures is None:
        settings = replace(settings, pictures=begun.pictures)
    if begun.source != settings.source:
        raise ValueError(
            f"out: {out} holds the results of {brief(begun.source)}, not of {brief(settings.source)}: give each input another "
            "--out, or name all inputs in one command, with --overwrite to begin anew"
        )
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
    return begun


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Hold ``out`` for one run; the system releases it when the process ends, however that happens.

    Raises:
        RuntimeError: another run holds it.
    """
    make_folder(out / STATE)
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    with (out / STATE / "lock").open("w") as stream:
        try:
            fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RuntimeError(f"out: another run is writing into {out}: wait for it, or stop it") from error
        yield


@dataclass(frozen=True)
class Records:
    """The records of a run, and the files that each frame must have."""

    source: Source
    out: Path
    settings: Settings

    def write(self, item: Item, frame: int, **figures: Any) -> None:
        """Write the record of a frame (-1 for an image, or for a whole video) after its files are in place."""
        path = self._path(item, frame)
        with naming(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            if "deepest_mm" in figures:
                figures["bytes"] = [os.path.getsize(file) for file in self._files(item, frame, figures)]
            path.write_text(json.dumps({"mark": item.mark, **figures}), encoding="utf-8")

    def read(self, item: Item, frame: int) -> Record | None:
        """The record of a frame; None where there is none, it is damaged, or the source file has changed since."""
        try:
            record = json.loads(self._path(item, frame).read_bytes())
        except (OSError, ValueError, RecursionError):
            return None
        return record if _is_record(record) and record["mark"] == list(item.mark) else None

    def is_done(self, item: Item, frame: int) -> bool:
        """Whether the result of a frame is there, whole."""
        record = self.read(item, frame)
        if record is None or "failed" in record or "bytes" not in record:
            return False
        files = list(self._files(item, frame, record))
        if self.settings.format == VIDEO_FORMAT and frame >= 0 and _size(f"{self.out / item.stem}.npz") > 0:  # joined already
            return bool([_size(file) for file in files[1:]] == record["bytes"][1:])
        return bool([_size(file) for file in files] == record["bytes"])

    def length(self, video: Item) -> int | None:
        """Number of frames of a video; None where no process has decoded it to its end."""
        record = self.read(video, -1)
        return None if record is None else record.get("frames")

    def _path(self, item: Item, frame: int) -> Path:
        return self.out / STATE / "frames" / f"{item.frame_stem(frame)}.json"

    def _files(self, item: Item, frame: int, record: Record) -> Iterator[str]:
        stem = self.out / item.frame_stem(frame)
        if self.settings.format != "none":
            yield str(self.result_file(item, frame))
        if self.settings.cloud != "none" and record["contact_mm2"] > 0.0:
            yield f"{stem}.{self.settings.cloud}"
        if self.settings.pictures:
            yield f"{stem}_picture.png"

    def result_file(self, item: Item, frame: int) -> Path:
        """Where the depth of a frame is written; for one file a video, where it waits until the video is done."""
        folder = self.out / STATE / PARTS if self.settings.format == VIDEO_FORMAT and frame >= 0 else self.out
        return folder / f"{item.frame_stem(frame)}{FORMATS[self.settings.format]}"

    def join_videos(self) -> None:
        """Make one npz of the frames of each video, where that is asked for."""
        for item in list_items(self.source):
            length = self.length(item) if item.is_film else None
            if self.settings.format != VIDEO_FORMAT or length is None:
                continue
            records = ((frame, self.read(item, frame)) for frame in range(0, length, self.settings.every))
            parts = [self.result_file(item, frame) for frame, record in records if record is not None and "failed" not in record]
            there = [part for part in parts if part.is_file()]
            if not there:
                continue  # joined by an earlier run
            if len(there) < len(parts):
                raise RuntimeError(f"{item.path}: {len(parts) - len(there)} frames have no result: run the same command again")
            join_results(f"{self.out / item.stem}.npz", parts)
            for part in parts:
                part.unlink()

    def _rows(self, item: Item) -> Iterator[tuple[str, Record | None]]:
        frames: Iterable[int] = (-1,)
        if item.is_film and (length := self.length(item)) is not None:
            frames = range(0, length, self.settings.every)
        return ((item.frame_name(frame), self.read(item, frame)) for frame in frames)

    def write_tables(self) -> tuple[int, list[tuple[str, str]], list[tuple[str, str]]]:
        """Write frames.csv, and failed.csv where frames were left out.

        Returns:
            Number of rows of frames.csv; (name, reason) of the frames that were left out; (name, doubt) of those in doubt.
        Raises:
            RuntimeError: frames without a record, which a process that died was to do.
        """
        count = 0
        failed: list[tuple[str, str]] = []
        doubted: list[tuple[str, str]] = []
        missing: list[str] = []

        def rows() -> Iterator[tuple[str, ...]]:
            nonlocal count
            for item in list_items(self.source, self.settings.every):
                for name, record in self._rows(item):
                    if record is None:
                        missing.append(name)
                    elif "failed" in record:
                        failed.append((name, record["failed"]))
                    else:
                        count += 1
                        if record["doubt"]:
                            doubted.append((name, record["doubt"]))
                        yield name, f"{record['deepest_mm']:.6f}", f"{record['contact_mm2']:.6f}", record["doubt"]
            if missing:
                raise RuntimeError(f"{len(missing)} frames have no result, the first is {missing[0]}: run the same command again")

        _write_csv(self.out / "frames.csv", ("frame", "deepest_mm", "contact_mm2", "doubt"), rows())
        if failed:
            _write_csv(self.out / "failed.csv", ("frame", "reason"), failed)
        else:
            (self.out / "failed.csv").unlink(missing_ok=True)
        return count, failed, doubted


def _size(path: str) -> int:
    """Bytes of a file, -1 where there is none."""
    return os.path.getsize(path) if os.path.isfile(path) else -1


def as_cell(text: str) -> str:
    """A text as a cell of a CSV table: one line, and none that a spreadsheet takes for a formula.

    Before =, +, - and @ stands an apostrophe, which spreadsheets hide.

    Example:
        >>> as_cell("=1+2.png"), as_cell("a.png")
        ("'=1+2.png", 'a.png')
    """
    line = one_line(text)
    return f"'{line}" if line.startswith(("=", "+", "-", "@")) else line


def _write_csv(path: Path, head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> None:
    with (
        write_atomically(path) as temporary,
        temporary.open("w", encoding="utf-8", errors="surrogateescape", newline="") as stream,
    ):
        table = csv.writer(stream, lineterminator="\n")
        table.writerow(head)
        table.writerows((as_cell(row[0]), *row[1:]) if head[1] != "reason" else tuple(map(as_cell, row)) for row in rows)
