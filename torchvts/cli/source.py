"""What ``stream``, ``view`` and ``track`` share: options of a source and a unit, opening it, and going through its frames."""

import argparse
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import torch

from ..calibration import Press
from ..core.checks import check_integer
from ..model import Calibration, Sensor
from ..stream import Camera, CameraSettings, Recorder, TactileFrame, TactileStream, find_camera
from ..stream.sources import FileReader
from .options import add_background_frames, add_pipeline, add_sensor, contact_of, load_calibration, load_sensor
from .parser import UsageError


def add_source(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Options of the source, the unit, the camera and the pipeline."""
    parser.add_argument("--source", required=required, help="camera (index, path, name, serial), video, folder, URL")
    parser.add_argument("--size", nargs=2, type=int, metavar=("W", "H"), help="of a camera's frames, where the driver takes it")
    parser.add_argument("--fps", type=float, metavar="F", help="of a camera, where the driver takes it")
    parser.add_argument("--exposure", type=float, metavar="E", help="of a camera, driver's unit; ends automatic exposure")
    parser.add_argument("--white-balance", type=float, metavar="K", help="of a camera, kelvin; ends automatic white balance")
    add_sensor(parser, "the first frames calibrate: ")
    parser.add_argument("--calibration", type=Path, metavar="FILE", help="what torchvts calibrate wrote, in place of --sensor")
    add_background_frames(parser)
    add_pipeline(parser)
    parser.add_argument("--record", type=Path, metavar="PATH", help="of a camera's raw frames: .mkv, or a folder (PNG)")
    parser.add_argument("--realtime", action="store_true", help="play a recording at its own rate, dropping late frames")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of PyTorch and OpenCV (1)")


def add_video(parser: argparse.ArgumentParser) -> None:
    """``--video``: kind of the video in ``--out``."""
    kinds = "webm (for browsers), mp4, avi, none (webm)"
    parser.add_argument("--video", choices=["webm", "mp4", "avi", "none"], default="webm", metavar="KIND", help=kinds)


def load_unit(arguments: argparse.Namespace) -> Sensor | Calibration:
    """The sensor or the calibration that was given, and the threads that were asked for."""
    if (arguments.sensor is None) == (arguments.calibration is None):
        raise UsageError("expected either --sensor or --calibration")
    check_integer("--threads", arguments.threads, 1)
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    return load_sensor(arguments.sensor) if arguments.sensor else load_calibration(arguments.calibration)


def open_stream(arguments: argparse.Namespace, unit: Sensor | Calibration, presses: Sequence[Press] = ()) -> TactileStream:
    """The stream of the source; says what it found."""
    started = time.perf_counter()
    settings = CameraSettings(arguments.size and tuple(arguments.size), arguments.fps, arguments.exposure, arguments.white_balance)
    camera = find_camera(arguments.source)
    if settings.given and camera is None:
        raise UsageError(f"--size, --fps, --exposure, --white-balance: expected a camera of this machine, got {arguments.source!r}")
    stream = TactileStream(
        arguments.source if camera is None or not settings.given else Camera(camera, settings),
        unit,
        mode=arguments.mode,
        background_frames=arguments.background_frames,
        presses=presses,
        realtime=arguments.realtime,
        network=arguments.network,
        device=arguments.device,
        contact=contact_of(arguments.contact),
        record=arguments.record,
    )
    first = arguments.background_frames
    note = f"the first {first} are without contact" if first else "the calibration's background is used as it is"
    assumed = " are assumed, without times.csv" if isinstance(stream.reader, FileReader) and stream.reader.fps_assumed else ""
    print(f"{stream.reader.name}: {stream.fps:g} frames a second{assumed}; {note}")
    print(f"{stream.calibration}\nready after {time.perf_counter() - started:.1f} s")
    return stream


def play(stream: TactileStream, take: Callable[[TactileFrame], bool]) -> OSError | None:
    """Give every frame to ``take`` until the source ends, it returns False, or Ctrl-C (SIGINT, SIGTERM).

    Returns:
        Why the source has stopped, or the recording could not be written, to raise when the files are done; None where all is well.
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
        print("interrupted: the frames until now are kept")
    except OSError as error:
        lost = error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if isinstance(stream.reader, Recorder):
        try:
            stream.close()
            print(f"recorded {len(stream.reader.times)} raw frames: {stream.reader.path}")
        except OSError as error:
            lost = lost or error
    return lost
