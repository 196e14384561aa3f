"""Depth of a live or recorded tactile video: a view beside the image, or a video of it; late frames of a camera are dropped.

python scripts/stream.py --source 0 --sensor gelsight_mini
python scripts/stream.py --source video.avi --sensor gelsight_wedge --out out/ball
python scripts/stream.py --source folder/ --calibration unit.safetensors --out out/run

The first frames must be without contact. Ctrl-C ends it and finishes the files.
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
from torchvts.stream import Overlay, StreamReport, TactileStream, VideoFile, Window, has_display


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", required=True, help="a camera's index (digits), a video file, or a folder of images")
    parser.add_argument("--sensor", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--calibration", type=Path, help="file that calibrate.py wrote; by default the first frames calibrate")
    parser.add_argument(
        "--corners", help='in place of the sensor\'s: "x y x y x y x y", top left, top right, bottom right, bottom left'
    )
    parser.add_argument("--out", type=Path, help="folder for overlay video, frames.csv and summary.json")
    parser.add_argument("--video", choices=["mp4", "avi", "none"], default="mp4", help="kind of overlay video in --out")
    parser.add_argument("--mode", choices=["fast", "precise", "auto"], default="auto")
    parser.add_argument("--background-frames", type=int, default=12, help="number of first frames, which are without contact")
    parser.add_argument("--realtime", action="store_true", help="play a recording at its own rate, dropping late frames")
    parser.add_argument("--no-follow", action="store_true", help="do not follow slow drift of the light")
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch and OpenCV; one leaves a core for reading")
    arguments = parser.parse_args(argv)
    if (arguments.sensor is None) == (arguments.calibration is None):
        parser.error("give either --sensor or --calibration")
    return arguments


def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(argv)
    torch.set_num_threads(max(1, arguments.threads))
    cv2.setNumThreads(max(1, arguments.threads))
    unit = vts.Sensor.load(arguments.sensor) if arguments.sensor else vts.Calibration.load(arguments.calibration)
    if arguments.corners is not None:
        unit = with_corners(unit, arguments.corners)
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    show = has_display()
    if not show:
        print("no display: no live view" + ("" if arguments.out else "; give --out for an overlay video"))
    started = time.perf_counter()
    with contextlib.ExitStack() as stack:
        stream = stack.enter_context(
            TactileStream(
                arguments.source,
                unit,
                mode=arguments.mode,
                background_frames=arguments.background_frames,
                realtime=arguments.realtime,
                follow=not arguments.no_follow,
            )
        )
        print(f"{stream.reader.name}: {stream.fps:g} frames a second; the first {arguments.background_frames} are without contact")
        print(f"{stream.note}\nready after {time.perf_counter() - started:.1f} s")
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
    return 0


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
