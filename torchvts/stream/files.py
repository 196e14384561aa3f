"""What a stream leaves in files beside its video: the figures of every frame."""

import csv
import json
import math
import time
from pathlib import Path
from typing import Any

from ..core.checks import check_record, check_switch
from ..core.files import write_atomically
from ..skin import DotMotion, SkinMotion
from .live import TactileFrame, TactileStream


def summary_of(stream: TactileStream, frames: int) -> dict[str, Any]:
    """What summary.json says of every stream, in the words of data sets; ``frames`` are the rows of its table."""
    return {
        "source": stream.reader.name,
        "source_fps": stream.fps,
        "frames": frames,
        "left_out": len(stream.left_out),
        "left_out_because": [[number, reason] for number, reason in stream.left_out],
        "sensor": stream.calibration.sensor.name,
        "metric": stream.metric,
        "doubts": list(stream.calibration.report.get("doubts", [])),
        "mm_per_pixel": stream.calibration.sensor.mm_per_pixel,
        "calibration_note": stream.calibration.report.get("reason", ""),
    }


class StreamReport:
    """Keeps the contact area, the largest depth, the light and the doubt of every frame, for a table and two files.

    Args:
        stream: whose frames are added.
        motion: also how the object moves that drags the skin, by its printed dots (:class:`torchvts.SkinMotion`): its shift, its
            turn, and the share of the contact that sticks.
    Raises:
        ValueError: ``motion`` of a skin without dots.
    """

    HEADER = ("frame", "time_s", "contact_mm2", "deepest_mm", "light_r", "light_g", "light_b", "unseen_deg")
    OF_OBJECT = ("shift_x_mm", "shift_y_mm", "turn_deg", "stuck_share")

    def __init__(self, stream: TactileStream, motion: bool = False) -> None:
        check_record("stream", stream, TactileStream)
        self.stream = stream
        self._follow = SkinMotion.from_calibration(stream.calibration) if check_switch("motion", motion) else None
        self._moved: DotMotion | None = None
        self._of_object: list[list[float]] = []
        self.rows: list[tuple[int, float, float, float, list[float], float, str]] = []
        self._begin = self._end = time.perf_counter()
        self._pixel_mm2 = stream.calibration.sensor.mm_per_pixel**2

    def add(self, frame: TactileFrame) -> list[str]:
        """Add a frame; returns its figures as lines of text."""
        self._end = time.perf_counter()
        area = float(frame.output.contact.sum()) * self._pixel_mm2
        deepest = float(frame.output.depth_mm.max())
        conditions, doubt = self.stream.conditions, self.stream.doubt
        assert conditions is not None
        light, unseen = conditions.light[0, :, 0].tolist(), float(conditions.unseen_deg)
        self.rows.append((frame.number, frame.time_s, area, deepest, light, unseen, doubt))
        if self._follow is not None:
            with self.stream.stages.stage("motion"):
                self._of_object.append(self._object(self._follow, frame))
        dropped = f", {self.stream.dropped} dropped" if self.stream.dropped else ""
        in_doubt = "  IN DOUBT" if doubt else ""
        figures = f"contact {area:.1f} mm2  deepest {deepest:.2f}{in_doubt}"
        return [f"frame {frame.number}  {frame.time_s:.2f} s  {figures}", f"{self.fps:.0f} fps{dropped}"]

    def _object(self, follow: SkinMotion, frame: TactileFrame) -> list[float]:
        """Shift, turn and stuck share of the object; NaN without contact."""
        self._moved = follow(frame.image[None], frame.output.depth_mm, self._moved)
        slip = self._moved.slip(frame.output.contact)
        return [*slip.shift_mm[0].tolist(), float(slip.turn_deg[0]), float(slip.stuck_share[0])]

    @property
    def fps(self) -> float:
        """Frames a second from the start to the last frame, drawing and writing included."""
        return len(self.rows) / max(self._end - self._begin, 1e-9)

    @property
    def doubted(self) -> int:
        """Number of frames in doubt."""
        return sum(row[6] != "" for row in self.rows)

    def summary(self) -> dict[str, Any]:
        """For JSON: :func:`summary_of`, frames and dropped ones, fps, stages_ms, contact, frames in doubt."""
        stream = self.stream
        return {
            **summary_of(stream, len(self.rows)),
            "dropped": stream.dropped,
            "fps": round(self.fps, 2),
            "stages_ms": {name: round(ms, 3) for name, ms in stream.stages.median_ms().items()},
            "contact_frames": sum(row[2] > 0 for row in self.rows),
            "deepest_mm": max((row[3] for row in self.rows), default=0.0),
            "doubted_frames": self.doubted,
        }

    def table(self) -> str:
        """The summary as text."""
        values = self.summary()
        lines = [f"{values['frames']} frames, {values['dropped']} dropped, {values['fps']:.1f} frames a second"]
        if values["left_out"]:
            lines.append(f"{values['left_out']} left out, named above")
        lines.append("median ms: " + ", ".join(f"{name} {ms:.1f}" for name, ms in values["stages_ms"].items()))
        unit = "mm" if values["metric"] else "(not in mm)"
        lines.append(f"contact in {values['contact_frames']} frames, deepest {values['deepest_mm']:.3f} {unit}")
        if moved := [row for row in self._of_object if not math.isnan(row[0])]:
            shift, turn = max(math.hypot(*row[:2]) for row in moved), max(abs(row[2]) for row in moved)
            lines.append(f"the object moved the skin in {len(moved)} frames, by at most {shift:.3f} {unit} and {turn:.1f} degrees")
        if values["doubted_frames"]:
            first = next(row for row in self.rows if row[6])
            count = f"{values['doubted_frames']} of {values['frames']} frames"
            lines.append(f"in doubt: {count} (column doubt of frames.csv), the first {first[0]}: {first[6]}")
        return "\n".join(lines)

    def save(self, folder: Path) -> None:
        """Write summary.json and frames.csv, each whole or not at all."""
        with write_atomically(folder / "summary.json") as temporary:
            temporary.write_text(json.dumps(self.summary(), indent=2) + "\n", encoding="utf-8")
        of_object = [[("" if math.isnan(v) else f"{v:.4f}") for v in row] for row in self._of_object] or [[]] * len(self.rows)
        rows: dict[int, list[Any]] = {}
        for (number, time_s, area, deepest, light, unseen, doubt), of in zip(self.rows, of_object, strict=True):
            figures = [f"{time_s:.4f}", f"{area:.4f}", f"{deepest:.6f}", *(f"{v:.4f}" for v in light), f"{unseen:.2f}"]
            rows[number] = [number, *figures, *of, doubt]
        header = (*self.HEADER, *(self.OF_OBJECT if self._follow is not None else ()), "doubt")
        rows |= {number: [number, *[""] * (len(header) - 2), f"left out: {reason}"] for number, reason in self.stream.left_out}
        with write_atomically(folder / "frames.csv") as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            csv.writer(file, lineterminator="\n").writerows([header, *(rows[number] for number in sorted(rows))])
