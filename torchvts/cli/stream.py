"""Live depth of a camera or a recording: a view beside the image, or files; late frames of a camera are dropped.

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
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch

from ..calibration import Press
from ..core.files import check_target
from ..model import Calibration, Sensor
from ..stream import (
    Overlay,
    StreamReport,
    TactileStream,
    VideoFile,
    Window,
    calibrate_background,
    has_display,
    read_background,
    read_press_images,
)
from .options import add_background_frames, add_device, add_mode, add_network, add_press, add_sensor, load_calibration
from .parser import UsageError

USAGE = "--source SOURCE (--sensor NAME | --calibration FILE) [--out FOLDER]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("--source", required=True, help="a camera's index (digits), a video file, or a folder of images")
    add_sensor(parser, "the first frames calibrate: ")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="what torchvts calibrate wrote, in place of --sensor")
    parser.add_argument("--background", type=Path, nargs="+", metavar="IMAGE", help="to calibrate: without contact; or a video")
    add_press(parser)
    add_background_frames(parser)
    parser.add_argument("--save-calibration", type=Path, metavar="FILE", help="write the calibration, .safetensors")
    parser.add_argument("--corners", help='in place of the sensor\'s: "x y x y x y x y", from top left, clockwise')
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="for overlay video, frames.csv and summary.json")
    parser.add_argument("--video", choices=["mp4", "avi", "none"], default="mp4", help="kind of overlay video in --out")
    add_mode(parser)
    add_network(parser)
    add_device(parser)
    parser.add_argument("--realtime", action="store_true", help="play a recording at its own rate, dropping late frames")
    parser.add_argument("--no-follow", action="store_true", help="do not follow slow drift of the light")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of PyTorch and OpenCV (1)")


def run(arguments: argparse.Namespace) -> int:
    """Stream until the source ends, and print a summary."""
    if (arguments.sensor is None) == (arguments.calibration is None):
        raise UsageError("expected either --sensor or --calibration")
    if arguments.calibration is not None and (arguments.background or arguments.press):
        raise UsageError("--background, --press: they are to calibrate with --sensor, not beside --calibration")
    torch.set_num_threads(max(1, arguments.threads))
    cv2.setNumThreads(max(1, arguments.threads))
    if arguments.save_calibration is not None:
        check_target(arguments.save_calibration)
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    show = has_display()
    if not show:
        print("no display: no live view" + ("" if arguments.out else "; give --out for an overlay video"))
    started = time.perf_counter()
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(open_stream(arguments))
        print(f"{stream.reader.name}: {stream.fps:g} frames a second; the first {arguments.background_frames} are without contact")
        print(f"{stream.note}\nready after {time.perf_counter() - started:.1f} s")
        if arguments.save_calibration is not None:
            stream.calibration.save(arguments.save_calibration)
            print(f"wrote {arguments.save_calibration}")
        report = StreamReport(stream)
        video = None
        if arguments.out is not None and arguments.video != "none":
            video = stack.enter_context(VideoFile(arguments.out / f"overlay.{arguments.video}", stream.fps))
        overlay = Overlay(stream.metric) if show or video is not None else None
        play(stream, report, overlay, Window() if show else None, video)
    print(report.table())
    if arguments.out is not None:
        report.save(arguments.out)
        print(f"wrote {len(report.rows)} frames to {arguments.out}")
    return 1 if stream.left_out else 0


def open_stream(arguments: argparse.Namespace) -> TactileStream:
    """The stream that the arguments name, its unit calibrated."""
    unit: Sensor | Calibration
    unit = Sensor.load(arguments.sensor) if arguments.sensor else load_calibration(arguments.calibration)
    if arguments.corners is not None:
        unit = with_corners(unit, arguments.corners)
    presses: Sequence[Press] = ()
    if isinstance(unit, Sensor):
        presses = read_press_images(arguments.press, unit)
        if arguments.background:
            image = read_background(arguments.background, unit, arguments.background_frames)
            found = calibrate_background(image, unit, presses)
            print(found.note)
            unit, presses = found.calibration, ()
    return TactileStream(
        arguments.source,
        unit,
        mode=arguments.mode,
        background_frames=arguments.background_frames,
        presses=presses,
        realtime=arguments.realtime,
        follow=not arguments.no_follow,
        network=arguments.network,
        device=arguments.device,
    )


def play(
    stream: TactileStream, report: StreamReport, overlay: Overlay | None, window: Window | None, video: VideoFile | None
) -> None:
    """Show every frame until the source ends, the window is closed, or Ctrl-C; the next frame stands in for dropped ones."""
    shown = -1
    asked: list[int] = []

    def interrupt(number: int, _: object) -> None:
        asked.append(number)  # the exception is lost if a destructor or a callback is running
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, interrupt)
    try:
        for frame in stream:
            if asked:
                raise KeyboardInterrupt
            lines = report.add(frame)
            if overlay is not None:
                with stream.stages.stage("draw"):
                    picture = overlay(frame, lines)
                if video is not None:
                    with stream.stages.stage("write"):
                        for _ in range(max(1, frame.number - shown)):
                            video.write(picture)
                    shown = frame.number
                if window is not None and not window.show(picture):
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
