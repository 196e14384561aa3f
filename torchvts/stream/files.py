"""What a stream leaves in files: a video, and the figures of every frame."""

import json
import os
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.checks import check_path, check_positive, check_record
from ..core.files import check_text_name, count_packets, write_atomically
from .live import TactileFrame, TactileStream
from .sources import Pixels

CODES = {".webm": ("VP80",), ".mp4": ("avc1", "mp4v"), ".avi": ("MJPG",)}
"""Suffixes of the videos that can be written, and OpenCV's codes for each: the first that it has here is taken."""

MOST_WAITING = 8
"""So many pictures wait to be encoded before :meth:`VideoFile.write` waits."""


class VideoFile:
    """Writes a video whole or not at all: under a temporary name, renamed when the block ends and all frames can be read back.

    OpenCV reports no error of a write, as on a full disk. A thread encodes while the next frame is worked on.

    Args:
        path: .webm (VP8, which browsers play), .mp4 (H.264 where this OpenCV has it, as browsers need; else mp4v) or .avi (MJPG).
        fps: frames a second.
    Raises:
        ValueError: another suffix, or pictures of several sizes.
        OSError: OpenCV cannot write it, or not all of it: the disk is full.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path, self.fps = check_path("video", path), check_positive("fps", fps)
        if self.path.suffix.lower() not in CODES:
            raise ValueError(f"video: expected a name ending in {', '.join(CODES)}, got {self.path.name!r}")
        check_text_name("video", self.path)
        self._file: Any = None
        self._writer: Any = None
        self._temporary, self._size, self._count = self.path, (0, 0), 0
        self._pool, self._waiting = ThreadPoolExecutor(1), deque[Future[Any]]()

    def __enter__(self) -> "VideoFile":
        self._file = write_atomically(self.path)
        self._temporary = self._file.__enter__()
        return self

    def write(self, picture: Pixels) -> None:
        """Append a frame, (H, W, 3) B, G, R, 8 bits, which must not be changed any more; all of one size."""
        if self._writer is None:
            self._size = picture.shape[:2]
            self._writer = self._open()
        if picture.shape[:2] != self._size:
            raise ValueError(f"video: expected pictures of {self._size} like the first, got {picture.shape[:2]}")
        self._waiting.append(self._pool.submit(self._encode, picture))
        while len(self._waiting) > MOST_WAITING:
            self._waiting.popleft().result()

    def _encode(self, picture: Pixels) -> None:
        self._writer.write(picture)
        self._count += 1

    def _open(self) -> Any:
        import cv2

        for code in CODES[self.path.suffix.lower()]:
            with _silent():
                writer = cv2.VideoWriter(str(self._temporary), cv2.VideoWriter.fourcc(*code), self.fps, self._size[::-1])
            if writer.isOpened():
                return writer
        raise OSError(f"video: {self.path}: OpenCV cannot write this kind of file here: try .avi")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        self._pool.shutdown()
        if self._writer is not None:
            self._writer.release()
        there = count_packets(self._temporary) if kind is None and self._count else 0
        if there and there == self._count:
            self._file.__exit__(None, None, None)
            return
        self._file.__exit__(Exception, Exception(), None)  # removes the temporary file
        if kind is None and self._count:
            raise OSError(
                f"video: {self.path}: cannot be written: {there} of {self._count} frames can be read back: is the disk full?"
            )


@contextmanager
def _silent() -> Iterator[None]:
    """Drop what OpenCV prints, not by Python, of codecs that it does not have."""
    try:
        kept = os.dup(2)
    except OSError:  # there is no such stream
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


class StreamReport:
    """Keeps the contact area, the largest depth and the state of the light of every frame, for a table and two files.

    Args:
        stream: whose frames are added.
    """

    HEADER = "frame,time_s,contact_mm2,deepest_mm,light"

    def __init__(self, stream: TactileStream) -> None:
        check_record("stream", stream, TactileStream)
        self.stream = stream
        self.rows: list[tuple[int, float, float, float, str]] = []
        self._begin = self._end = time.perf_counter()
        self._pixel_mm2 = stream.calibration.sensor.mm_per_pixel**2

    def add(self, frame: TactileFrame) -> list[str]:
        """Add a frame; returns its figures as lines of text."""
        self._end = time.perf_counter()
        area = float(frame.output.contact.sum()) * self._pixel_mm2
        deepest = float(frame.output.depth_mm.max())
        state = self.stream.light.state
        self.rows.append((frame.number, frame.time_s, area, deepest, state))
        dropped = f", {self.stream.dropped} dropped" if self.stream.dropped else ""
        times = [f"{name} {ms:.1f}" for name, ms in self.stream.stages.last.items()]
        half = (len(times) + 1) // 2
        light = "  LIGHT HAS CHANGED: start again without contact" if state == "stepped" else ""
        return [
            f"frame {frame.number}  {frame.time_s:.2f} s  contact {area:.1f} mm2  deepest {deepest:.2f}{light}",
            f"{self.fps:.0f} fps{dropped}, ms: {' '.join(times[:half])}",
            " ".join(times[half:]),
        ]

    @property
    def fps(self) -> float:
        """Frames a second from the start to the last frame, drawing and writing included."""
        return len(self.rows) / max(self._end - self._begin, 1e-9)

    def summary(self) -> dict[str, Any]:
        """For JSON: the source, frames, dropped, fps, stages_ms, light and calibration."""
        stream = self.stream
        return {
            "source": stream.reader.name,
            "source_fps": stream.fps,
            "frames": len(self.rows),
            "dropped": stream.dropped,
            "left_out": [[number, reason] for number, reason in stream.left_out],
            "fps": round(self.fps, 2),
            "stages_ms": {name: round(ms, 3) for name, ms in stream.stages.median_ms().items()},
            "contact_frames": sum(row[2] > 0 for row in self.rows),
            "deepest_mm": max((row[3] for row in self.rows), default=0.0),
            "light_level": [round(v, 5) for v in stream.light.level],
            "light_steps": stream.light.steps,
            "metric": stream.metric,
            "calibration": stream.note,
        }

    def table(self) -> str:
        """The summary as text."""
        values = self.summary()
        lines = [f"{values['frames']} frames, {values['dropped']} dropped, {values['fps']:.1f} frames a second"]
        lines += [f"left out frame {number}: {reason}" for number, reason in values["left_out"][:20]]
        if len(values["left_out"]) > 20:
            lines.append(f"{len(values['left_out'])} frames left out, all of them in summary.json")
        lines.append("median ms: " + ", ".join(f"{name} {ms:.1f}" for name, ms in values["stages_ms"].items()))
        unit = "mm" if values["metric"] else "mm (NOT METRIC)"
        lines.append(f"contact in {values['contact_frames']} frames, deepest {values['deepest_mm']:.3f} {unit}")
        lines.append("light at the end, R G B: " + " ".join(f"{v:.3f}" for v in values["light_level"]) + " of the background's")
        if values["light_steps"]:
            lines.append(f"the light stepped {values['light_steps']} times (frames marked 'stepped' in frames.csv): not learned")
        return "\n".join(lines)

    def save(self, folder: Path) -> None:
        """Write summary.json and frames.csv, each whole or not at all."""
        with write_atomically(folder / "summary.json") as temporary:
            temporary.write_text(json.dumps(self.summary(), indent=2) + "\n", encoding="utf-8")
        with write_atomically(folder / "frames.csv") as temporary:
            rows = {i: f"{i},{t:.4f},{area:.4f},{deepest:.6f},{state}\n" for i, t, area, deepest, state in self.rows}
            rows |= {i: f"{i},,,,left out\n" for i, _ in self.stream.left_out}
            temporary.write_text(f"{self.HEADER}\n" + "".join(rows[i] for i in sorted(rows)), encoding="utf-8")
