"""One record per finished frame beside the results of a run, and the tables made of them.

A record is written after the files of its frame are in place, each of them whole. So a frame is done when its record can be read,
was made of the same source file, and its files are there. Nothing else has to be kept or merged, and a kill loses only the
frames that were being worked on.
"""

import csv
import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..core.files import naming, write_atomically
from ..core.recordings import cut_short
from ..core.results import join_results
from ..core.zarr_results import join_as_zarr
from .items import FORMATS, PARTS, STATE, VIDEO_FORMATS, Item, Source, list_items, one_line
from .settings import Settings

Record = dict[str, Any]
"""``mark`` of the source file; then ``deepest_mm``, ``contact_mm2`` and ``doubt`` of a frame, ``frames`` of a whole video, or
``failed``, the reason why there is no result."""


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
        return record if isinstance(record, dict) and record.get("mark") == list(item.mark) else None

    def is_done(self, item: Item, frame: int) -> bool:
        """Whether the result of a frame is there, whole."""
        record = self.read(item, frame)
        if record is None or "bytes" not in record:
            return False
        sizes = [os.path.getsize(file) if os.path.isfile(file) else -1 for file in self._files(item, frame, record)]
        joined = self.joined_file(item) if frame >= 0 else None
        first = 1 if joined is not None and joined.is_file() else 0
        return bool(sizes[first:] == record["bytes"][first:])

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
        folder = self.out / STATE / PARTS if self.settings.format in VIDEO_FORMATS and frame >= 0 else self.out
        return folder / f"{item.frame_stem(frame)}{FORMATS[self.settings.format]}"

    def joined_file(self, item: Item) -> Path | None:
        """The one file of a video's frames; None where the format has one for each frame."""
        suffix = VIDEO_FORMATS.get(self.settings.format)
        return None if suffix is None else self.out / f"{item.stem}{suffix}"

    def join_videos(self) -> None:
        """Make one file of the frames of each video, where that is asked for."""
        for item in list_items(self.source):
            length, path = self.length(item) if item.is_film else None, self.joined_file(item)
            if path is None or length is None:
                continue
            numbers = range(0, length, self.settings.every)
            records = {row: record for row, frame in enumerate(numbers) if (record := self.read(item, frame)) is not None}
            left_out = {str(row): record["failed"] for row, record in records.items() if "failed" in record}
            parts = {row: self.result_file(item, numbers[row]) for row in records if str(row) not in left_out}
            there = [part for part in parts.values() if part.is_file()]
            if not there:
                continue  # joined by an earlier run
            if len(there) < len(parts):
                raise RuntimeError(f"{item.path}: {len(parts) - len(there)} frames have no result: run the same command again")
            if path.suffix == ".npz":
                join_results(path, there)
            else:
                join_as_zarr(path, parts, len(numbers), left_out)
            for part in there:
                part.unlink()

    def write_tables(self) -> tuple[int, list[tuple[str, str]], list[tuple[str, str]]]:
        """Write frames.csv, and failed.csv where frames were left out.

        Returns:
            Number of rows of frames.csv; (name, reason) of the frames that were left out; (name, doubt) of those in doubt.
        """
        count = 0
        failed: list[tuple[str, str]] = []
        doubted: list[tuple[str, str]] = []
        missing: list[str] = []

        def rows() -> Iterator[tuple[str, ...]]:
            nonlocal count
            for item in list_items(self.source, self.settings.every):
                length = self.length(item) if item.is_film else None
                if length is not None and (text := cut_short(item.file, length)):
                    failed.append((item.path, text))
                for frame in (-1,) if length is None else range(0, length, self.settings.every):
                    name, record = item.frame_name(frame), self.read(item, frame)
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


def as_cell(text: str) -> str:
    """A text as a cell of a CSV table, on one line; an apostrophe keeps a spreadsheet from taking it for a formula."""
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
