"""Depth of a camera or a recording, frame by frame, into files; late frames of a camera are dropped. torchvts view shows it live.

The first frames must be without contact. Ctrl-C ends it and finishes the files. Exit status 1 where a frame was left out
or is in doubt, or depth is not metric.

examples:
  torchvts stream 0 --sensor gelsight_mini
  torchvts stream video.avi --sensor gelsight_wedge --out out/ball
  torchvts stream unit.safetensors folder/ --out out/run
"""

import argparse
import contextlib
from pathlib import Path

from ..core.files import check_folder, check_target, make_folder
from ..model.report import warnings_of
from ..stream import Overlay, Sheet, StreamReport, TactileFrame, TactileStream, VideoFile
from ..viz import save_figure
from .options import ended
from .source import add_source, add_video, load_unit, open_stream, play

USAGE = "CALIBRATION SOURCE [--out FOLDER]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_source(parser)
    parser.add_argument("--save-calibration", type=Path, metavar="FILE", help="write the calibration, .safetensors")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for overlay video, sheet.png, frames.csv and summary.json")
    parser.add_argument(
        "--motion", action="store_true", help="of a skin with printed dots: shift, turn and stuck share of the object"
    )
    add_video(parser)


def run(arguments: argparse.Namespace) -> int:
    """Stream until the source ends, and print a summary."""
    unit, source = load_unit(arguments)
    if arguments.save_calibration is not None:
        check_target(arguments.save_calibration)
    if arguments.out is None:
        print("give --out for an overlay video and files; torchvts view shows the stream live")
    else:
        check_folder(arguments.out)
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(open_stream(arguments, unit, source))
        if arguments.save_calibration is not None:
            stream.calibration.save(arguments.save_calibration)
            print(f"wrote {arguments.save_calibration}")
        report = StreamReport(stream, arguments.motion)
        if arguments.out is not None:  # not before: a source that is refused leaves none
            make_folder(arguments.out)
        sheet = Sheet(stream.calibration.sensor.mm_per_pixel, stream.metric, warnings_of(stream.calibration.report))
        video = None
        if arguments.out is not None and arguments.video != "none":
            video = stack.enter_context(VideoFile(arguments.out / f"overlay.{arguments.video}", stream.fps))
        lost = play(stream, _Files(stream, report, sheet, video).add)
        print(report.table())
        if arguments.out is not None:  # before the video is done, which may fail
            report.save(arguments.out)
            if sheet.any_contact:
                save_figure(sheet.figure(), arguments.out / "sheet.png")
    if arguments.out is not None:
        print(f"wrote {len(report.rows)} frames to {arguments.out}")
    if lost is not None:
        raise lost
    step, wrong = "", stream.left_out or report.doubted
    if wrong:
        step = "torchvts diagnose CALIBRATION RECORDING says what is wrong; --record keeps a camera's frames for it"
    elif arguments.out is not None and sheet.any_contact:
        step = f"look at {arguments.out / 'sheet.png'}; frames.csv has depth and area of each frame"
    return ended(stream.metric, wrong, step)


class _Files:
    """Adds each frame to the report, the sheet and the overlay video; the next frame stands in for dropped ones."""

    def __init__(self, stream: TactileStream, report: StreamReport, sheet: Sheet, video: VideoFile | None) -> None:
        self.stream, self.report, self.sheet, self.video = stream, report, sheet, video
        self.overlay = Overlay(stream.calibration.sensor.mm_per_pixel, stream.metric)
        self.shown = -1

    def add(self, frame: TactileFrame) -> bool:
        lines = self.report.add(frame)
        self.sheet.add(frame, self.stream.doubt)
        if self.video is not None:
            with self.stream.stages.stage("draw"):
                picture = self.overlay(frame, lines)
            with self.stream.stages.stage("write"):
                for _ in range(max(1, frame.number - self.shown)):
                    self.video.write(picture)
            self.shown = frame.number
        return True
