"""What a stream leaves in files beside its video: the figures of every frame."""

import json
import time
from pathlib import Path
from typing import Any

from ..core.checks import check_record
from ..core.files import write_atomically
from .follow_light import NOT_TO_BE_TRUSTED
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
        "mm_per_pixel": stream.calibration.sensor.mm_per_pixel,
        "calibration_note": stream.note,
    }


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
        """For JSON: :func:`summary_of`, frames and dropped ones, fps, stages_ms, contact and light."""
        stream = self.stream
        return {
            **summary_of(stream, len(self.rows)),
            "dropped": stream.dropped,
            "fps": round(self.fps, 2),
            "stages_ms": {name: round(ms, 3) for name, ms in stream.stages.median_ms().items()},
            "contact_frames": sum(row[2] > 0 for row in self.rows),
            "deepest_mm": max((row[3] for row in self.rows), default=0.0),
            "light_level": [round(v, 5) for v in stream.light.level],
            "light_steps": stream.light.steps,
        }

    def table(self) -> str:
        """The summary as text."""
        values = self.summary()
        lines = [f"{values['frames']} frames, {values['dropped']} dropped, {values['fps']:.1f} frames a second"]
        if values["left_out"]:
            lines.append(f"{values['left_out']} left out, named above")
        lines.append("median ms: " + ", ".join(f"{name} {ms:.1f}" for name, ms in values["stages_ms"].items()))
        unit = "mm" if values["metric"] else "mm (NOT METRIC)"
        lines.append(f"contact in {values['contact_frames']} frames, deepest {values['deepest_mm']:.3f} {unit}")
        when = "at the end" if self.stream.light.state == "following" else "when last followed"
        lines.append(f"light {when}, R G B: " + " ".join(f"{v:.3f}" for v in values["light_level"]) + " of the background's")
        if values["light_steps"]:
            lines.append(
                f"the light stepped {values['light_steps']} times (frames marked 'stepped' in frames.csv): not learned, their "
                f"{NOT_TO_BE_TRUSTED}"
            )
        return "\n".join(lines)

    def save(self, folder: Path) -> None:
        """Write summary.json and frames.csv, each whole or not at all."""
        with write_atomically(folder / "summary.json") as temporary:
            temporary.write_text(json.dumps(self.summary(), indent=2) + "\n", encoding="utf-8")
        with write_atomically(folder / "frames.csv") as temporary:
            rows = {i: f"{i},{t:.4f},{area:.4f},{deepest:.6f},{state}\n" for i, t, area, deepest, state in self.rows}
            rows |= {i: f"{i},,,,left out\n" for i, _ in self.stream.left_out}
            temporary.write_text(f"{self.HEADER}\n" + "".join(rows[i] for i in sorted(rows)), encoding="utf-8")
