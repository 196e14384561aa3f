"""Raw frames of a camera for later: a lossless video or a folder of PNG images, and the times of the frames in a table."""

import csv
import io
import threading
import time
from pathlib import Path

import numpy as np

from ..core.checks import check_path
from ..core.files import VIDEO_SUFFIXES, Pixels, make_folder, write_atomically, write_pixels
from ..core.recordings import image_files
from .sources import Unreadable, times_file
from .video import InTurn, VideoFile

LOSSLESS = ".mkv"
"""Suffix of a recording in one file, coded by FFV1."""


class Recorder:
    """Writes the frames of a live source as they come; :func:`open_source` reads them again bit for bit, with their times.

    Args:
        path: a new name ending in .mkv for FFV1 (8 bits), or a folder without images for PNG (8 or 16 bits).
        fps: frames a second that a video states.
    Attributes:
        times: of the frames written, s, from 0; the table has those of the clock too (``unix_s``, seconds since 1970).
    Raises:
        ValueError: a file or a folder with images that is there already, or frames that FFV1 does not hold.
        OSError: by :meth:`add` or :meth:`close`: not all can be written; what can be read of it is kept.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path = check_path("record", path)
        self.times: list[float] = []
        self._lock, self._closed = threading.Lock(), False
        self._start = self._clock = 0.0
        self._video: VideoFile | None = None
        self._images = InTurn()
        if self.path.is_file():
            raise ValueError(f"record: {self.path}: expected a new name, got a file that is there already: name another")
        if self.path.suffix.lower() == LOSSLESS:
            self._video = VideoFile(self.path, fps, keep=True).__enter__()
        elif self.path.suffix.lower() in VIDEO_SUFFIXES:
            raise ValueError(f"record: expected a name ending in {LOSSLESS} or that of a folder, got {self.path.name!r}")
        elif image_files(make_folder(self.path)):
            raise ValueError(f"record: {self.path}: expected a folder without images, got one with some: name another")

    def add(self, pixels: Pixels | Unreadable) -> None:
        """Write a frame that has just come; it waits where too many are being written."""
        with self._lock:
            if not isinstance(pixels, np.ndarray) or self._closed:
                return
            now = time.monotonic()
            if self._video is None:
                self._images.submit(write_pixels, self.path / f"{len(self.times):06d}.png", pixels)
            elif pixels.dtype != np.uint8 or pixels.shape[0] % 2 or pixels.shape[1] % 2:
                got = f"{pixels.dtype} {pixels.shape[:2]}"
                raise ValueError(f"record: expected 8 bits and an even size for {LOSSLESS}, got {got}: name a folder")
            else:
                self._video.write(pixels)
            if not self.times:
                self._start, self._clock = now, time.time()
            self.times.append(now - self._start)

    def close(self) -> None:
        """Finish the recording."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            failed = None
            try:
                self._images.finish()
                if self._video is not None:
                    self._video.__exit__(None, None, None)
            except OSError as error:
                failed = error
            try:
                self._write_times()  # of the frames that were written, too
            except OSError as error:
                raise OSError(f"{failed}; {error}" if failed else str(error)) from failed
            if failed is not None:
                raise failed

    def _write_times(self) -> None:
        if not self.times:
            return
        table = io.StringIO()
        lines = ((f"{k:06d}", f"{t:.6f}", f"{self._clock + t:.6f}") for k, t in enumerate(self.times))
        csv.writer(table, lineterminator="\n").writerows([("frame", "time_s", "unix_s"), *lines])
        with write_atomically(times_file(self.path)) as temporary:
            temporary.write_text(table.getvalue(), encoding="utf-8")
