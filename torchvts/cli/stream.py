"""Depth of a camera or a recording, frame by frame, into files; late frames of a camera are dropped. torchvts view shows it live.

The first frames must be without contact. Ctrl-C ends it and finishes the files. Exit status 1 where a frame was left out
or is in doubt.

examples:
  torchvts stream 0 --sensor gelsight_mini
  torchvts stream video.avi --sensor gelsight_wedge --out out/ball
  torchvts stream unit.safetensors folder/ --out out/run
"""

import argparse
import contextlib
import dataclasses
from pathlib import Path

from ..core.files import check_target, make_folder
from ..model import Calibration, Sensor
from ..stream import Overlay, Sheet, StreamReport, TactileFrame, TactileStream, VideoFile
from ..viz import save_figure
from .source import add_source, add_video, load_unit, open_stream, play

USAGE = "CALIBRATION SOURCE [--out FOLDER]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_source(parser)
    parser.add_argument("--save-calibration", type=Path, metavar="FILE", help="write the calibration, .safetensors")
    parser.add_argument(
        "--corners",
        help='of the gel in place of the sensor\'s: "x y x y x y x y", from top left, clockwise; straightened first',
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for overlay video, sheet.png, frames.csv and summary.json")
    add_video(parser)


def run(arguments: argparse.Namespace) -> int:
    """Stream until the source ends, and print a summary."""
    unit, source = load_unit(arguments)
    if arguments.corners is not None:
        unit = with_corners(unit, arguments.corners)
    if arguments.save_calibration is not None:
        check_target(arguments.save_calibration)
    if arguments.out is None:
        print("give --out for an overlay video and files; torchvts view shows the stream live")
    else:
        make_folder(arguments.out)
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(open_stream(arguments, unit, source))
        if arguments.save_calibration is not None:
            stream.calibration.save(arguments.save_calibration)
            print(f"wrote {arguments.save_calibration}")
        report, sheet = StreamReport(stream), Sheet(stream.calibration.sensor.mm_per_pixel, stream.metric)
        video = None
        if arguments.out is not None and arguments.video != "none":
            video = stack.enter_context(VideoFile(arguments.out / f"overlay.{arguments.video}", stream.fps))
        lost = play(stream, _Files(stream, report, sheet, video).add)
        print(report.table())
        if arguments.out is not None:  # before the video is done, which may fail
            report.save(arguments.out)
            if sheet.times:
                save_figure(sheet.figure(), arguments.out / "sheet.png")
    if arguments.out is not None:
        print(f"wrote {len(report.rows)} frames to {arguments.out}")
    if lost is not None:
        raise lost
    return 1 if stream.left_out or report.doubted else 0


class _Files:
    """Adds each frame to the report, the sheet and the overlay video; the next frame stands in for dropped ones."""

    def __init__(self, stream: TactileStream, report: StreamReport, sheet: Sheet, video: VideoFile | None) -> None:
        self.stream, self.report, self.sheet, self.video = stream, report, sheet, video
        self.overlay = Overlay(stream.metric, stream.calibration.sensor.mm_per_pixel)
        self.shown = -1

    def add(self, frame: TactileFrame) -> bool:
        lines = self.report.add(frame)
        self.sheet.add(frame)
        if self.video is not None:
            with self.stream.stages.stage("draw"):
                picture = self.overlay(frame, lines)
            with self.stream.stages.stage("write"):
                for _ in range(max(1, frame.number - self.shown)):
                    self.video.write(picture)
            self.shown = frame.number
        return True


def with_corners(unit: Sensor | Calibration, text: str) -> Sensor | Calibration:
    """The sensor or calibration with other corners, of the gel in frames as they come (straightened, if it has a lens): they turn
    and mirror these too."""
    try:
        numbers = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise ValueError(f"corners: expected eight numbers, x and y of four corners, got {text!r}")
    sensor = unit if isinstance(unit, Sensor) else unit.sensor
    corners = tuple(zip(numbers[::2], numbers[1::2]))
    sensor = dataclasses.replace(sensor, corners_px=corners, roi_px=None, raw_size_px=(), raw_crop=0.0, turn_deg=0, mirror=False)
    return sensor if isinstance(unit, Sensor) else dataclasses.replace(unit, sensor=sensor)
