"""Depth of a live or recorded tactile video: a view beside the image, or a video of it; late frames of a camera are dropped.

python scripts/stream.py --source 0 --sensor gelsight_mini
python scripts/stream.py --source video.avi --sensor gelsight_wedge --out out/ball
python scripts/stream.py --source folder/ --calibration unit.safetensors --out out/run
python scripts/stream.py --source 0 --sensor gelsight_mini --press ball.png 6.31 --save-calibration unit.safetensors

The first frames must be without contact. Ctrl-C ends it and finishes the files. Exit status 1 if a frame had to be left out.
"""

import argparse
import contextlib
import dataclasses
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import torch

import torchvts as vts
from torchvts.core.files import check_target
from torchvts.stream import (
    FIRST_FRAMES,
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


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", required=True, help="a camera's index (digits), a video file, or a folder of images")
    parser.add_argument("--sensor", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--calibration", type=Path, help="file that calibrate.py wrote; by default the first frames calibrate")
    parser.add_argument(
        "--background", type=Path, nargs="+", help="calibrate by this image without contact, by several, or by a video"
    )
    parser.add_argument(
        "--press",
        nargs=2,
        action="append",
        default=[],
        metavar=("IMAGE", "MM"),
        help="calibrate by a ball pressed in, its diameter too",
    )
    parser.add_argument(
        "--save-calibration", type=Path, help="write the calibration, .safetensors, for reconstruct.py and later streams"
    )
    parser.add_argument(
        "--corners", help='in place of the sensor\'s: "x y x y x y x y", top left, top right, bottom right, bottom left'
    )
    parser.add_argument("--out", type=Path, help="folder for overlay video, frames.csv and summary.json")
    parser.add_argument("--video", choices=["mp4", "avi", "none"], default="mp4", help="kind of overlay video in --out")
    parser.add_argument("--mode", choices=["fast", "precise", "auto"], default="auto")
    parser.add_argument("--background-frames", type=int, default=FIRST_FRAMES, help="first frames, without contact")
    parser.add_argument("--realtime", action="store_true", help="play a recording at its own rate, dropping late frames")
    parser.add_argument("--no-follow", action="store_true", help="do not follow slow drift of the light")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch and OpenCV; one leaves a core for reading")
    arguments = parser.parse_args(argv)
    if (arguments.sensor is None) == (arguments.calibration is None):
        parser.error("give either --sensor or --calibration")
    if arguments.calibration is not None and (arguments.background or arguments.press):
        parser.error("--background, --press: they are to calibrate with --sensor, not beside --calibration")
    return arguments


def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(argv)
    torch.set_num_threads(max(1, arguments.threads))
    cv2.setNumThreads(max(1, arguments.threads))
    unit = vts.Sensor.load(arguments.sensor) if arguments.sensor else vts.Calibration.load(arguments.calibration)
    if arguments.corners is not None:
        unit = with_corners(unit, arguments.corners)
    if arguments.save_calibration is not None:
        check_target(arguments.save_calibration)
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    show = has_display()
    if not show:
        print("no display: no live view" + ("" if arguments.out else "; give --out for an overlay video"))
    started = time.perf_counter()
    presses: Sequence[vts.Press] = ()
    if isinstance(unit, vts.Sensor):
        presses = read_press_images(arguments.press, unit)
    if isinstance(unit, vts.Sensor) and arguments.background:
        found = calibrate_background(read_background(arguments.background, unit, arguments.background_frames), unit, presses)
        print(found.note)
        unit, presses = found.calibration, ()
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(
            TactileStream(
                arguments.source,
                unit,
                mode=arguments.mode,
                background_frames=arguments.background_frames,
                presses=presses,
                realtime=arguments.realtime,
                follow=not arguments.no_follow,
            )
        )
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


def with_corners(unit: vts.Sensor | vts.Calibration, text: str) -> vts.Sensor | vts.Calibration:
    """The sensor or calibration with other corners."""
    try:
        numbers = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        raise ValueError(f"corners: expected eight numbers, x and y of four corners, got {text!r}")
    corners = tuple(zip(numbers[::2], numbers[1::2]))
    if isinstance(unit, vts.Sensor):
        return dataclasses.replace(unit, corners_px=corners, roi_px=None)
    return dataclasses.replace(unit, sensor=dataclasses.replace(unit.sensor, corners_px=corners, roi_px=None))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
