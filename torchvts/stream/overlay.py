"""Shows a stream: the image beside depth with contours, as a video or a sheet of frames, and a report of all frames."""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ..core.checks import check_path, check_positive, check_record
from ..core.files import check_text_name, write_atomically
from .live import TactileFrame, TactileStream
from .sources import Pixels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CODES = {".mp4": "mp4v", ".avi": "MJPG"}
"""Suffixes of the videos that can be written, and OpenCV's code for each."""

_RANGES = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


class Overlay:
    """Draws a frame: the image with its contact outlined, beside it depth in colour with contour lines, text and a bar beneath.

    The range of colours grows with the deepest press so far, over round values; ten lines fill it. Zero keeps its colour, and depth
    below zero has another one (:func:`torchvts.viz.depth_colors`).

    Args:
        metric: whether depth is in mm; otherwise the overlay says that it is not.
        mm_per_pixel: pixel pitch, mm, for a scale in the image; None draws none.
    """

    TEXT_HEIGHT = 86

    def __init__(self, metric: bool = True, mm_per_pixel: float | None = None) -> None:
        from ..viz import depth_colors  # Matplotlib is slow to import

        self.metric, self.range_mm = metric, 0.1
        self.mm_per_pixel = None if mm_per_pixel is None else check_positive("mm_per_pixel", mm_per_pixel)
        colors, _ = depth_colors(-1.0, 1.0)
        self._table = np.ascontiguousarray((255.0 * colors(np.linspace(0.0, 1.0, 256))[:, None, 2::-1] + 0.5).astype(np.uint8))
        self._line = np.where(self._table.mean(2, keepdims=True) < 128, 255, 60).astype(np.uint8).repeat(3, 2)

    def depth(self, depth_mm: Tensor) -> Pixels:
        """Depth (1, 1, H, W) as colours with contour lines, (H, W, 3) B, G, R."""
        import cv2

        depth = depth_mm[0, 0].float().numpy()
        high = float(depth.max())
        self.range_mm = round_up(self.range_mm, high)
        level = np.clip(127.5 * (1.0 + depth / self.range_mm) + 0.5, 0.0, 255.0).astype(np.uint8)
        picture: Pixels = cv2.applyColorMap(level, self._table)
        if high > 0.02 * self.range_mm:
            smooth = cv2.blur(np.maximum(depth, 0.0), (3, 3))
            step = cv2.convertScaleAbs(smooth, alpha=10.0 / self.range_mm, beta=-0.5)  # ten lines over the range
            lines = np.zeros(step.shape, np.uint8)
            lines[:, 1:] |= (step[:, 1:] != step[:, :-1]).view(np.uint8)
            lines[1:] |= (step[1:] != step[:-1]).view(np.uint8)
            on = lines.astype(bool)
            picture[on] = self._line[level[on], 0]
        return picture

    def __call__(self, frame: TactileFrame, lines: Sequence[str] = ()) -> Pixels:
        """The overlay, B, G, R, with up to three lines of text; images narrower than 300 pixels are shown larger."""
        import cv2

        height, width = frame.image.shape[1:]
        left, right = _outlined(frame), self.depth(frame.output.depth_mm)
        larger = -(-300 // width)
        height, width = height * larger, width * larger
        out = np.zeros((height + self.TEXT_HEIGHT + height % 2, 2 * width, 3), np.uint8)
        for picture, x in ((left, 0), (right, width)):
            if larger > 1:
                picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_NEAREST)
            out[:height, x : x + width] = picture
        if self.mm_per_pixel is not None:
            _draw_scale(out, self.mm_per_pixel / larger, width, height)
        self._draw_bar(out, width + 6, height + 8, width - 12)
        unit = "mm" if self.metric else "mm, NOT METRIC"
        texts = [f"depth 0 to {self.range_mm:g} {unit}, a line each {self.range_mm / 10:g}", *lines][:4]
        for k, text in enumerate(texts):
            _write(out, text, (6, height + 18 + 20 * k))
        return out

    def _draw_bar(self, out: Pixels, x: int, y: int, width: int) -> None:
        """The colours from zero to the end of the range, beneath the depth."""
        import cv2

        out[y : y + 10, x : x + width] = cv2.resize(self._table[128:].transpose(1, 0, 2), (width, 10))
        end = f"{self.range_mm:g} mm"
        _write(out, "0", (x, y + 26))
        _write(out, end, (x + width - 8 * len(end), y + 26))


def round_up(range_mm: float, high_mm: float) -> float:
    """The next round range that holds ``high_mm``; ``range_mm`` where it holds it already."""
    while high_mm > range_mm:
        power = 10.0 ** np.floor(np.log10(range_mm) + 1e-9)
        range_mm = float(power * next(s for s in _RANGES if s > range_mm / power + 1e-6))
    return range_mm


def outlines(contact: Pixels) -> list[Pixels]:
    """Outlines of a mask (H, W), smoothed, each (n, 1, 2) whole pixels, x and y."""
    import cv2

    if not contact.any():
        return []
    smooth = (cv2.blur(contact.view(np.uint8) * 255, (7, 7)) > 127).view(np.uint8)
    return list(cv2.findContours(smooth, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])


def _write(out: Pixels, text: str, place: tuple[int, int], color: int = 230) -> None:
    import cv2

    cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.43, (color,) * 3, 1, cv2.LINE_AA)


def _draw_scale(out: Pixels, mm_per_pixel: float, left: int, bottom: int) -> None:
    """A bar of 1, 2 or 5 times a power of ten mm, a sixth of the image long at most, in the lower left corner of the depth."""
    import cv2

    most = left * mm_per_pixel / 6.0
    power = 10.0 ** np.floor(np.log10(most))
    length = power * max(s for s in (1.0, 2.0, 5.0) if s * power <= most)
    x, y = left + 10, bottom - 10
    cv2.line(out, (x, y), (x + round(length / mm_per_pixel), y), (40, 40, 40), 2)
    _write(out, f"{length:g} mm", (x, y - 6), 40)


def _outlined(frame: TactileFrame) -> Pixels:
    """The image (H, W, 3) B, G, R with the outline of the contact."""
    import cv2

    picture = np.ascontiguousarray((frame.image.flip(0).permute(1, 2, 0) * 255.0 + 0.5).to(torch.uint8).numpy())
    cv2.drawContours(picture, outlines(frame.output.contact[0, 0].numpy()), -1, (255, 255, 255), 1, cv2.LINE_AA)
    return picture


class Sheet:
    """Keeps depth of frames in contact, and draws six of them, evenly spaced in time, in one range of colours.

    Args:
        mm_per_pixel: pixel pitch, mm.
        metric: whether depth is in mm; otherwise the sheet says that it is not.
    """

    _MOST = 48

    def __init__(self, mm_per_pixel: float, metric: bool = True) -> None:
        self.mm_per_pixel, self.metric = check_positive("mm_per_pixel", mm_per_pixel), metric
        self._kept: list[tuple[float, Tensor]] = []
        self._every = self._seen = 0

    def add(self, frame: TactileFrame) -> None:
        """Keep a frame with contact; of a long stream every second, fourth, ... of them."""
        if not bool(frame.output.contact.any()):
            return
        if self._seen % (1 << self._every) == 0:
            self._kept.append((frame.time_s, frame.output.depth_mm[0, 0].half().cpu()))
        self._seen += 1
        if len(self._kept) > self._MOST:
            self._kept, self._every = self._kept[::2], self._every + 1

    @property
    def times(self) -> list[float]:
        """Times of the frames that are kept, s."""
        return [time_s for time_s, _ in self._kept]

    def figure(self) -> "Figure":
        """The sheet.

        Raises:
            ValueError: no frame was in contact.
        """
        if not self._kept:
            raise ValueError("sheet: expected frames with contact, got none: there is nothing to draw")
        from ..viz import sheet_figure

        most = max(float(depth.max()) for _, depth in self._kept)
        deep = [kept for kept in self._kept if float(kept[1].max()) >= 0.1 * most]  # no panel without a visible depth
        places = np.unique(np.linspace(0, len(deep) - 1, 6).round().astype(int))
        chosen = [(time_s, depth.double().numpy()) for time_s, depth in (deep[k] for k in places)]
        return sheet_figure(chosen, self.mm_per_pixel, self.metric)


class VideoFile:
    """Writes a video whole or not at all: under a temporary name, renamed when the block ends without an error.

    Args:
        path: .mp4 (mp4v) or .avi (MJPG).
        fps: frames a second.
    Raises:
        ValueError: another suffix.
        OSError: OpenCV cannot write it.
    """

    def __init__(self, path: str | Path, fps: float) -> None:
        self.path, self.fps = check_path("video", path), check_positive("fps", fps)
        if self.path.suffix.lower() not in CODES:
            raise ValueError(f"video: expected a name ending in {' or '.join(CODES)}, got {self.path.name!r}")
        check_text_name("video", self.path)
        self._file: Any = None
        self._writer: Any = None
        self._temporary = self.path

    def __enter__(self) -> "VideoFile":
        self._file = write_atomically(self.path)
        self._temporary = self._file.__enter__()
        return self

    def write(self, picture: Pixels) -> None:
        """Append a frame, (H, W, 3) B, G, R, 8 bits; all of one size."""
        import cv2

        if self._writer is None:
            code = cv2.VideoWriter.fourcc(*CODES[self.path.suffix.lower()])
            self._writer = cv2.VideoWriter(str(self._temporary), code, self.fps, (picture.shape[1], picture.shape[0]))
            if not self._writer.isOpened():
                raise OSError(f"video: {self.path}: OpenCV cannot write this kind of file here: try .avi")
        self._writer.write(picture)

    def __exit__(self, *error: Any) -> None:
        if self._writer is not None:
            self._writer.release()
        if self._writer is None and error[0] is None:
            nothing = OSError(f"video: {self.path}: there was no frame, so none is written")
            self._file.__exit__(OSError, nothing, None)  # removes the temporary file
            return
        self._file.__exit__(*error)


class StreamReport:
    """Keeps the contact area, the largest depth and the state of the light of every frame, for a table and two files.

    Args:
        stream: whose frames are added.
        clock: for tests.
    """

    HEADER = "frame,time_s,contact_mm2,deepest_mm,light"

    def __init__(self, stream: TactileStream, clock: Callable[[], float] = time.perf_counter) -> None:
        check_record("stream", stream, TactileStream)
        self.stream, self._clock = stream, clock
        self.rows: list[tuple[int, float, float, float, str]] = []
        self._begin = self._end = clock()
        self._pixel_mm2 = stream.calibration.sensor.mm_per_pixel**2

    def add(self, frame: TactileFrame) -> list[str]:
        """Add a frame; returns its figures as lines of text."""
        self._end = self._clock()
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
