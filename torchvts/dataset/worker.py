"""One process's share of a data set: read, reconstruct, write.

Frames of a video go the way of a stream (:class:`torchvts.stream.Recording`): every process begins it by the first ones, and finds
the depth of its own. An image is a recording of one frame.
"""

import os
import sys
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..core.checks import NAMED, in_one_line
from ..core.recordings import count_frames
from ..model import Calibration
from ..pipeline import DepthOutput
from ..skin import ContactSettings
from ..stream import Recording
from .items import Item, list_items
from .loading import Entry, Loader
from .processes import sum_over_processes
from .records import Records
from .writing import Writer


class RunReport(NamedTuple):
    """What a run did; known to rank 0 only.

    Attributes:
        rank: rank of this process.
        rows: frames in the table.
        before: how many of them an earlier run had done.
        failed: (name, reason) of the frames that were left out.
        notes: (name, text) of what else is to be known: videos whose first frames were not used.
        doubted: (name, doubt) of the frames in which less may have been seen than is there.
    """

    rank: int
    rows: int
    before: int
    failed: list[tuple[str, str]]
    notes: Sequence[tuple[str, str]] = ()
    doubted: Sequence[tuple[str, str]] = ()


class Worker:
    """One rank's share of a data set: read, reconstruct, write."""

    def __init__(
        self, unit: Calibration, name: str, network: str | Path | None, records: Records, share: tuple[int, int], strict: bool
    ) -> None:
        self.unit, self.records, self.settings, self.share, self.strict = unit, records, records.settings, share, strict
        self.sensor, self.writer = unit.sensor, Writer(records, unit, name)
        thresholds = None if self.settings.contact is None else ContactSettings(**self.settings.contact)
        self.recording = partial(
            Recording, unit, self.settings.mode, network=network, device=self.settings.device, contact=thresholds
        )
        self.image = self.recording()
        self.notes: list[tuple[str, str]] = []
        self.done = self.failed = 0

    def run(self, workers: int | None) -> RunReport:
        """Do the whole share; rank 0 then writes the tables. Files are written by threads: most of that is waiting for the disk."""
        rank, world = self.share
        source = self.records.source
        items = list_items(source, self.settings.every)
        total = sum(count_frames(item.file) if item.is_film else 1 for item in items) // world
        if workers is None:
            cores = (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
            workers = max(1, min(4, cores // 2))
        writers = 1 if self.settings.pictures else 4  # matplotlib draws in one thread only
        waiting: deque[tuple[Entry, Future[str]]] = deque()
        loader = Loader(self.records, self.sensor, self.share, self._begin)
        with tqdm(total=total, unit="frame", disable=rank > 0 or None, smoothing=0.05) as bar, ThreadPoolExecutor(writers) as pool:
            for frame in loader.frames(workers):
                if frame.done:
                    bar.update()
                else:
                    waiting.append((frame, pool.submit(self._write, *self._depth(frame))))
                while len(waiting) > 4 * writers:
                    bar.update(self._settle(*waiting.popleft()))
            while waiting:  # pictures take longer than depth
                bar.update(self._settle(*waiting.popleft()))
        done = sum_over_processes(self.done)
        if rank > 0:
            return RunReport(rank, 0, 0, [])
        self.records.join_videos()
        rows, failed, doubted = self.records.write_tables()
        self.writer.write_summary(rows, len(failed), len(doubted))
        return RunReport(0, rows, rows - done, failed, self.notes, doubted)

    def _begin(self, item: Item, first: list[Tensor]) -> Recording:
        """The recording of a video by its first frames that can be read, rectified."""
        count = self.settings.background_frames
        reason = "" if count <= len(first) else f"background_frames: expected at least {count} frames, got {len(first)}"
        try:
            if first and not reason:
                return self.recording(torch.cat(first))
        except ValueError as error:
            reason = in_one_line(error)
        if reason:
            self.notes.append((item.path, f"first frames not used, the calibration is used as it is: {reason}"))
        return self.recording()

    def _depth(self, frame: Entry) -> tuple[Entry, DepthOutput | None, str]:
        """A frame, its depth, and why less may have been seen in it than is there; or a frame that says why there is none."""
        if frame.image is None:
            return frame, None, ""
        recording = frame.recording or self.image
        try:
            if reason := recording.unusable(frame.image):
                raise ValueError(reason)
            return frame, recording(frame.image), recording.doubt
        except ValueError as error:
            return frame._replace(failed=in_one_line(error)), None, ""

    def _settle(self, frame: Entry, written: Future[str]) -> bool:
        """Count a frame whose files are in place, or report why there are none; whether it is a frame, not the end of a video."""
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
        return frame.length is None

    def _write(self, frame: Entry, result: DepthOutput | None, doubt: str) -> str:
        """Write a frame's files, then its record; returns why there are none, or an empty text."""
        figures: dict[str, Any] = {"failed": frame.failed}
        if frame.length is not None:
            figures = {"frames": frame.length}
        elif result is not None:
            area = float(result.contact.double().sum()) * self.sensor.mm_per_pixel**2
            figures = {"deepest_mm": float(result.depth_mm.max()), "contact_mm2": area, "doubt": doubt}
            try:
                self.writer.write(frame, result, doubt)
            except ValueError as error:  # a depth that its format does not hold
                figures = {"failed": in_one_line(error)}
        self.records.write(frame.item, frame.number, **figures)
        return str(figures.get("failed", ""))
