"""What ``stream``, ``view`` and ``track`` share: options of a source and a unit, opening it, and going through its frames."""

import argparse
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import torch

from ..calibration import Press
from ..core.checks import check_integer
from ..model import Calibration, Sensor
from ..stream import CameraSettings, TactileStream, read_background, read_press_images
from ..stream.numbered import SourceFrames
from ..stream.sources import FileReader
from .options import add_pipeline, add_unit, calibrated, split_files
from .parser import UsageError


def add_source(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Options of the source, the unit, the camera and the pipeline."""
    add_unit(parser, "a camera, video, folder or URL", required)
    add_camera_settings(parser)
    add_pipeline(parser)
    parser.add_argument("--record", type=Path, metavar="PATH", help="of a camera's raw frames: .mkv, or a folder (PNG)")
    parser.add_argument("--realtime", action="store_true", help="play a recording at its own rate, dropping late frames")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of PyTorch and OpenCV (1)")


def add_camera_settings(parser: argparse._ActionsContainer) -> None:
    """``--size``, ``--fps``, ``--exposure`` and ``--white-balance``, for :func:`settings_of`."""
    parser.add_argument("--size", nargs=2, type=int, metavar=("W", "H"), help="of a camera's frames, where the driver takes it")
    parser.add_argument("--fps", type=float, metavar="F", help="of a camera, where the driver takes it")
    parser.add_argument("--exposure", type=float, metavar="E", help="of a camera, driver's unit; ends automatic exposure")
    parser.add_argument("--white-balance", type=float, metavar="K", help="of a camera, kelvin; ends automatic white balance")


def settings_of(arguments: argparse.Namespace) -> CameraSettings:
    """What is asked of a camera."""
    return CameraSettings(arguments.size and tuple(arguments.size), arguments.fps, arguments.exposure, arguments.white_balance)


def add_video(parser: argparse.ArgumentParser) -> None:
    """``--video``: kind of the video in ``--out``."""
    kinds = "webm (for browsers), mp4, avi, none (webm)"
    parser.add_argument("--video", choices=["webm", "mp4", "avi", "none"], default="webm", metavar="KIND", help=kinds)


def load_unit(arguments: argparse.Namespace) -> tuple[Sensor | Calibration, str]:
    """The sensor or the calibration that was given, and the source; sets the threads that were asked for."""
    unit, sources = split_files(arguments)
    if len(sources) > 1:
        raise UsageError(f"expected one source, got {', '.join(sources)}: a folder holds several images")
    check_integer("--threads", arguments.threads, 1)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    return unit, sources[0]


def open_stream(arguments: argparse.Namespace, unit: Sensor | Calibration, source: str) -> TactileStream:
    """The stream of the source; says what it found."""
    presses: Sequence[Press] = ()
    if isinstance(unit, Sensor):
        presses = read_press_images(arguments.press, unit)
        if arguments.background:
            image = read_background(arguments.background, unit, arguments.background_frames)
            unit, presses = calibrated(image, unit, presses), ()
    stream = TactileStream(
        source,
        unit,
        mode=arguments.mode,
        background_frames=arguments.background_frames,
        presses=presses,
        realtime=arguments.realtime,
        network=arguments.network,
        device=arguments.device,
        record=arguments.record,
        settings=settings_of(arguments),
    )
    first = arguments.background_frames
    note = f"the first {first} are without contact" if first else "the calibration's background is used as it is"
    assumed = " are assumed, without times.csv" if isinstance(stream.reader, FileReader) and stream.reader.fps_assumed else ""
    print(f"{stream.reader.name}: {stream.fps:g} frames a second{assumed}; {note}")
    print(stream.calibration)
    return stream


def play(stream: TactileStream | SourceFrames, take: Callable[[Any], bool]) -> OSError | None:
    """Give every frame to ``take`` until the source ends, it returns False, or Ctrl-C (SIGINT, SIGTERM).

    Returns why the source has stopped, or the recording could not be written, to raise when the files are done.
    """
    lost: OSError | None = None
    asked: list[int] = []

    def interrupt(number: int, _: object) -> None:
        asked.append(number)  # the exception is lost if a destructor or a callback is running
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for frame in stream:
            if asked:
                raise KeyboardInterrupt
            if not take(frame):
                break
    except KeyboardInterrupt:
        print("interrupted: what came until now is kept")
    except OSError as error:
        lost = error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if isinstance(stream, TactileStream) and stream.recorder is not None:
        try:
            stream.close()
            print(f"recorded {len(stream.recorder.times)} raw frames: {stream.recorder.path}")
        except OSError as error:
            lost = lost or error
    return lost
