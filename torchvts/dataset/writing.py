"""Writes the files of a frame, and what all files of a run are."""

import json
from pathlib import Path

import numpy as np
import torch

from ..core import __version__
from ..core.files import DEPTH_PNG_STEP_MM, DEPTH_PNG_ZERO, write_atomically, write_depth_png
from ..core.geometry import depth_to_points
from ..core.results import UNITS, Facts, write_result
from ..model import Calibration
from ..model.report import warnings_of
from ..pipeline import DepthOutput
from ..pose import OutputFrame, write_point_cloud
from ..pose.surface_files import X3P_AXES, write_obj, write_x3p
from ..skin import motion_of_unit
from .loading import Entry
from .records import Records


class Writer:
    """Writes the results of a run by a calibration, whose file has this name."""

    def __init__(self, records: Records, unit: Calibration, name: str) -> None:
        self.records, self.settings, self.sensor = records, records.settings, unit.sensor
        self.facts = Facts(unit.sensor.mm_per_pixel, name, unit.sensor.name, unit.metric, unit.report.get("doubts", []))
        self.warnings = warnings_of(unit.report)
        self.frame = OutputFrame(records.settings.length_unit, unit.sensor)
        self.motion = motion_of_unit(unit) if records.settings.pictures else None  # of printed dots
        self.exaggeration: float | None = None  # of heights in all pictures, known from the first contact on

    def write(self, frame: Entry, result: DepthOutput, doubt: str) -> None:
        """All files of a frame: its depth, its contact, its picture."""
        pitch, name = self.sensor.mm_per_pixel, frame.item.frame_name(frame.number)
        stem, path = self.records.out / frame.item.frame_stem(frame.number), self.records.result_file(frame.item, frame.number)
        for folder in {stem.parent, path.parent}:
            folder.mkdir(parents=True, exist_ok=True)
        joined = self.records.joined_file(frame.item) if frame.number >= 0 else None
        if joined is not None:
            joined.unlink(missing_ok=True)  # by an earlier run, of other frames
        if path.suffix == ".npz":
            write_result(path, result, self.facts, name, doubt, compressed=joined is None)
        elif path.suffix == ".png":
            write_depth_png(path, result.depth_mm)
        elif path.suffix == ".npy":
            with write_atomically(path) as temporary:
                np.save(temporary, result.depth_mm[0, 0].numpy())
        if self.settings.cloud != "none" and bool(result.contact.any()):
            self._write_contact(Path(f"{stem}.{self.settings.cloud}"), result, doubt)
        if self.settings.pictures:
            from .. import viz

            if self.exaggeration is None and bool(result.contact.any()):
                self.exaggeration = viz.exaggeration_of(float(result.depth_mm.max()), pitch * result.depth_mm.shape[3])
            doubts = [*self.warnings, *([f"IN DOUBT: {doubt}"] if doubt else [])]
            assert frame.image is not None
            moved = None if self.motion is None else self.motion(frame.image, result.depth_mm)
            figure = viz.depth_figure(
                result.depth_mm, pitch, frame.image, result.contact, name, self.exaggeration, self.facts.metric, doubts, moved
            )
            viz.save_figure(figure, f"{stem}_picture.png")

    def _write_contact(self, path: Path, result: DepthOutput, doubt: str) -> None:
        """The contact as points or as a surface; a comment of the file says what is in doubt."""
        pitch = self.sensor.mm_per_pixel
        axes = X3P_AXES if path.suffix == ".x3p" else self.frame.axes
        text = axes + ("" if self.facts.metric else "; NOT METRIC") + (f"; IN DOUBT: {doubt}" if doubt else "")
        if path.suffix == ".x3p":  # a grid of the sensor, whatever the frame of clouds
            write_x3p(path, result.depth_mm, result.contact, pitch, self.sensor.name, text)
            return
        if path.suffix == ".obj":
            write_obj(path, result.depth_mm, result.normal, result.contact, pitch, self.frame, text)
            return
        normals = result.normal[0].permute(1, 2, 0)[result.contact[0, 0]] * torch.tensor([1.0, -1.0, 1.0])  # y up
        points = self.frame.points(depth_to_points(result.depth_mm, pitch, result.contact))
        write_point_cloud(path, points, self.frame.directions(normals), text)

    def write_summary(self, rows: int, failed: int, doubted: int) -> None:
        """summary.json: what the files are, so that they can be read without this package."""
        settings = self.settings
        summary = {
            "frames": rows,
            "left_out": failed,
            "doubted_frames": doubted,
            **self.facts._asdict(),
            "height": self.sensor.height,
            "width": self.sensor.width,
            "mode": settings.mode,
            "format": settings.format,
            "every": settings.every,
            "clouds": self.frame.axes,
            "depth_png": f"depth_mm = (value - {DEPTH_PNG_ZERO}) * {DEPTH_PNG_STEP_MM}",
            "units": UNITS,
            "torchvts": __version__,
        }
        with write_atomically(self.records.out / "summary.json") as temporary:
            temporary.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
