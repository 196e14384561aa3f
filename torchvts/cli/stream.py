"""Depth of a camera or a recording, frame by frame, into files; late frames of a camera are dropped. torchvts view shows it live.

The first frames must be without contact. Ctrl-C ends it and finishes the files. Exit status 1 where a frame was left out.

examples:
  torchvts stream --source 0 --sensor gelsight_mini
  torchvts stream --source video.avi --sensor gelsight_wedge --out out/ball
  torchvts stream --source folder/ --calibration unit.safetensors --out out/run
"""

import argparse
import contextlib
import dataclasses
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import torch

from ..calibration import Press
from ..core.files import check_target
from ..model import Calibration, Sensor
from ..stream import (
    Camera,
    CameraSettings,
    Overlay,
    Sheet,
    StreamReport,
    TactileFrame,
    TactileStream,
    VideoFile,
    calibrate_background,
    find_camera,
    read_background,
    read_press_images,
)
from ..viz import save_figure
from .options import (
    add_background_frames,
    add_contact,
    add_device,
    add_mode,
    add_network,
    add_press,
    add_sensor,
    contact_of,
    load_calibration,
)
from .parser import UsageError

USAGE = "--source SOURCE (--sensor NAME | --calibration FILE) [--out FOLDER]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_source(parser)
    parser.add_argument("--background", type=Path, nargs="+", metavar="IMAGE", help="to calibrate: without contact; or a video")
    add_press(parser)
    parser.add_argument("--save-calibration", type=Path, metavar="FILE", help="write the calibration, .safetensors")
    parser.add_argument("--corners", help='in place of the sensor\'s: "x y x y x y x y", from top left, clockwise')
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for overlay video, sheet.png, frames.csv and summary.json")
    parser.add_argument("--video", choices=["mp4", "avi", "none"], default="mp4", help="kind of overlay video in --out")


def add_source(parser: argparse.ArgumentParser) -> None:
    """What ``stream`` and ``view`` share: the source, the unit, the camera's settings and the pipeline."""
    parser.add_argument("--source", required=True, help="camera (index, /dev path, name), URL, video file, or folder of images")
    parser.add_argument("--size", nargs=2, type=int, metavar=("W", "H"), help="of a camera's frames, where the driver takes it")
    parser.add_argument("--fps", type=float, metavar="F", help="of a camera, where the driver takes it")
    parser.add_argument("--exposure", type=float, metavar="E", help="of a camera, in the driver's unit; ends automatic exposure")
    add_sensor(parser, "the first frames calibrate: ")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="what torchvts calibrate wrote, in place of --sensor")
    add_background_frames(parser)
    add_mode(parser)
    add_network(parser)
    add_device(parser)
    add_contact(parser)
    parser.add_argument("--realtime", action="store_true", help="play a recording at its own rate, dropping late frames")
    parser.add_argument("--no-follow", action="store_true", help="do not follow slow drift of the light")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of PyTorch and OpenCV (1)")


def run(arguments: argparse.Namespace) -> int:
    """Stream until the source ends, and print a summary."""
    unit = load_unit(arguments)
    if arguments.calibration is not None and (arguments.background or arguments.press):
        raise UsageError("--background, --press: they are to calibrate with --sensor, not beside --calibration")
    if arguments.corners is not None:
        unit = with_corners(unit, arguments.corners)
    if arguments.save_calibration is not None:
        check_target(arguments.save_calibration)
    if arguments.out is None:
        print("give --out for an overlay video and files; torchvts view shows the stream live")
    else:
        arguments.out.mkdir(parents=True, exist_ok=True)
    presses: Sequence[Press] = ()
    if isinstance(unit, Sensor):
        presses = read_press_images(arguments.press, unit)
    if isinstance(unit, Sensor) and arguments.background:
        found = calibrate_background(read_background(arguments.background, unit, arguments.background_frames), unit, presses)
        print(found.note)
        unit, presses = found.calibration, ()
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(open_stream(arguments, unit, presses))
        if arguments.save_calibration is not None:
            stream.calibration.save(arguments.save_calibration)
            print(f"wrote {arguments.save_calibration}")
        report, sheet = StreamReport(stream), Sheet(stream.calibration.sensor.mm_per_pixel, stream.metric)
        video = None
        if arguments.out is not None and arguments.video != "none":
            video = stack.enter_context(VideoFile(arguments.out / f"overlay.{arguments.video}", stream.fps))
        play(stream, _Files(stream, report, sheet, video).add)
    print(report.table())
    if arguments.out is not None:
        report.save(arguments.out)
        if sheet.times:
            save_figure(sheet.figure(), arguments.out / "sheet.png")
        print(f"wrote {len(report.rows)} frames to {arguments.out}")
    return 1 if stream.left_out else 0


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


def load_unit(arguments: argparse.Namespace) -> Sensor | Calibration:
    """The sensor or the calibration that was given, and the threads that were asked for."""
    if (arguments.sensor is None) == (arguments.calibration is None):
        raise UsageError("expected either --sensor or --calibration")
    torch.set_num_threads(max(1, arguments.threads))
    cv2.setNumThreads(max(1, arguments.threads))
    return Sensor.load(arguments.sensor) if arguments.sensor else load_calibration(arguments.calibration)


def open_stream(arguments: argparse.Namespace, unit: Sensor | Calibration, presses: Sequence[Press] = ()) -> TactileStream:
    """The stream of the source; says what it found."""
    started = time.perf_counter()
    settings = CameraSettings(arguments.size and tuple(arguments.size), arguments.fps, arguments.exposure)
    camera = find_camera(arguments.source)
    if settings.given and camera is None:
        raise UsageError(f"--size, --fps, --exposure: expected a camera of this machine, got {arguments.source!r}")
    source: str | int | Camera = arguments.source
    if camera is not None:
        source = Camera(camera, settings) if settings.given else camera
    stream = TactileStream(
        source,
        unit,
        mode=arguments.mode,
        background_frames=arguments.background_frames,
        presses=presses,
        realtime=arguments.realtime,
        follow=not arguments.no_follow,
        network=arguments.network,
        device=arguments.device,
        contact=contact_of(arguments.contact),
    )
    first = arguments.background_frames
    note = f"the first {first} are without contact" if first else "the calibration's background is used as it is"
    print(f"{stream.reader.name}: {stream.fps:g} frames a second; {note}")
    print(f"{stream.note}\nready after {time.perf_counter() - started:.1f} s")
    return stream


def play(stream: TactileStream, take: Callable[[TactileFrame], bool]) -> None:
    """Give every frame to ``take`` until the source ends, it returns False, or Ctrl-C."""
    asked: list[int] = []

    def interrupt(number: int, _: object) -> None:
        asked.append(number)  # the exception is lost if a destructor or a callback is running
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        for frame in stream:
            if asked:
                raise KeyboardInterrupt
            if not take(frame):
                break
    except KeyboardInterrupt:
        print("interrupted: the frames until now are kept")
    finally:
        signal.signal(signal.SIGINT, before)


def with_corners(unit: Sensor | Calibration, text: str) -> Sensor | Calibration:
    """The sensor or calibration with other corners."""
    try:
        numbers = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise ValueError(f"corners: expected eight numbers, x and y of four corners, got {text!r}")
    corners = tuple(zip(numbers[::2], numbers[1::2]))
    if isinstance(unit, Sensor):
        return dataclasses.replace(unit, corners_px=corners, roi_px=None)
    return dataclasses.replace(unit, sensor=dataclasses.replace(unit.sensor, corners_px=corners, roi_px=None))
