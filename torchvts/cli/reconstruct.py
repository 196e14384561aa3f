"""Depth of images, folders (with all below them) and videos, written into a folder. Stopped, the same command goes on.

The first of the files is the calibration that torchvts calibrate wrote. With --sensor in its place the unit is calibrated
first: from --background and --press, or from the first frames of a video, which must be without contact.
Exit status 1 where a frame was left out.

examples:
  torchvts reconstruct unit.safetensors press.png --out out/press
  torchvts reconstruct unit.safetensors folder/ --out out/all --cloud ply --mode precise
  torchvts reconstruct video.avi --sensor gelsight_mini --out out/video
  torchrun --standalone --nproc_per_node=4 -m torchvts reconstruct unit.safetensors folder/ --out out/all
"""

import argparse
import os
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from ..core.files import VIDEO_SUFFIXES, read_frames
from ..dataset import CLOUD_FORMATS, DEPTH_FORMATS, PICTURES_UP_TO, Report, list_items, reconstruct_dataset
from ..diagnose import Finding, diagnose
from ..model import Calibration, Sensor
from ..stream import calibrate_background, read_background, read_press_images
from .options import add_background_frames, add_mode, add_out, add_press, add_sensor
from .parser import UsageError

USAGE = "CALIBRATION INPUT... --out FOLDER"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument(
        "files", type=Path, nargs="+", metavar="FILE", help="the calibration, then the inputs; with --sensor, inputs only"
    )
    add_out(parser, "for the results; folders of an input are kept in it")
    add_sensor(parser, "calibrate first: ")
    parser.add_argument("--background", type=Path, nargs="+", metavar="IMAGE", help="to calibrate: without contact; or a video")
    add_press(parser)
    add_background_frames(parser)
    add_mode(parser)
    parser.add_argument("--depth", choices=DEPTH_FORMATS, default="png", help="png: 16 bits, 32768 + depth / 0.0001 mm")
    parser.add_argument("--cloud", choices=CLOUD_FORMATS, default="none", help="contact points in mm, y up")
    parser.add_argument("--pictures", action=argparse.BooleanOptionalAction, help=f"by default for at most {PICTURES_UP_TO} frames")
    parser.add_argument("--batch", type=int, default=8, metavar="N", help="frames that a loader process hands over at once (8)")
    parser.add_argument("--workers", type=int, metavar="N", help="loader processes of each rank; up to 4 if not given")
    parser.add_argument(
        "--threads", type=int, default=1, metavar="N", help="of each rank (1); results depend on it in the last bits"
    )
    parser.add_argument("--overwrite", action="store_true", help="begin anew, whatever --out holds")
    parser.add_argument("--strict", action="store_true", help="stop at the first frame that cannot be used")


def calibrate(
    sensor: str, background: Sequence[Path] | None, presses: Sequence[tuple[str, str]], arguments: argparse.Namespace
) -> Path:
    """Calibrate as stream.py does, and keep the file with the results."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError("--sensor: expected one process, got more: calibrate first, by torchvts calibrate, and give the file")
    if background is None and arguments.source.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(
            f"--background: expected images without contact, got none: {arguments.source} is no video that begins with them"
        )
    unit = Sensor.load(sensor)
    image = read_background(background or [arguments.source], unit, arguments.background_frames)
    found = calibrate_background(image, unit, read_press_images(presses, unit))
    print(found.note)
    path: Path = arguments.out / "calibration.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    found.calibration.save(path)
    return path


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct, and print a summary."""
    read_files(arguments)
    given = vars(arguments).pop("sensor"), vars(arguments).pop("background"), vars(arguments).pop("press")
    if arguments.calibration is None:
        arguments.calibration = calibrate(*given, arguments)
    report = reconstruct_dataset(**vars(arguments))
    if report.rank > 0:
        return 0
    print_report(report, arguments.out)
    for name, note in report.notes:
        print(f"{name}: {note}")
    for finding in diagnose_first(arguments.calibration, arguments.source):
        print(f"first frame: {finding}")
    return 1 if report.failed else 0


def read_files(arguments: argparse.Namespace) -> None:
    """Split the files into the calibration and the input."""
    files = vars(arguments).pop("files")
    if arguments.sensor is None and (arguments.background or arguments.press):
        raise UsageError("--background, --press: they are to calibrate with --sensor, not beside a calibration file")
    if arguments.sensor is None and len(files) < 2:
        raise UsageError(
            f"expected a calibration file and an input, got {files[0]}: name both, or give --sensor to calibrate first"
        )
    arguments.calibration = files.pop(0) if arguments.sensor is None else None
    if len(files) > 1:
        raise UsageError(f"expected one input, got {len(files)}")
    arguments.source = files[0]
    del arguments.debug


def print_report(report: Report, out: Path) -> None:
    """Print the first frames, and what was left out."""
    print("| frame | deepest mm | contact mm^2 |\n|---|---|---|")
    with (out / "frames.csv").open(encoding="utf-8", errors="replace") as stream:
        for line in islice(stream, 1, 21):
            name, deepest, area = line.rstrip("\n").rsplit(",", 2)
            print(f"| {name} | {float(deepest):.3f} | {float(area):.2f} |")
    if report.rows > 20:
        print(f"... {report.rows - 20} more")
    frames = report.rows - report.before
    rate = frames / max(report.seconds, 1e-9)
    print(f"\n{frames} frames in {report.seconds:.1f} s: {rate:.1f} frames/s; {report.before} were there before")
    if report.failed:
        print("\n| left out | reason |\n|---|---|")
        for name, reason in report.failed[:20]:
            print(f"| {name} | {reason} |")
        print(f"{len(report.failed)} left out, all of them in {out / 'failed.csv'}")
    print(f"wrote {report.rows} frames to {out}")


def diagnose_first(calibration: Path, source: Path) -> list[Finding]:
    """What is wrong with the first frame, such as that it is from another unit; one that cannot be read is reported above."""
    unit = Calibration.load(calibration)
    try:
        first = next(list_items(source))
        _, image = next(iter(read_frames(first.file(source))))
        found = diagnose(None, unit.sensor.rectify(image[None])[0], unit)
    except (OSError, ValueError, StopIteration):
        return []
    return [finding for finding in found if finding.severity != "note"]
