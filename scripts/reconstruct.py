"""Depth from camera images: an image, a folder (with all below it) or a video in; depth, clouds and pictures out.

python scripts/reconstruct.py unit.safetensors press.png --out out/press
python scripts/reconstruct.py unit.safetensors folder/ --out out/all --depth npy --cloud ply --mode precise
python scripts/reconstruct.py video.avi --sensor gelsight_mini --out out/video
python scripts/reconstruct.py folder/ --sensor gelsight_mini --background background.png --press ball.png 6.31 --out out/all
torchrun --standalone --nproc_per_node=4 scripts/reconstruct.py unit.safetensors folder/ --out out/all

Without a calibration file the unit is calibrated first, from the background and the presses, or from the first frames of the
video, which are without contact; the file is kept as calibration.safetensors in the folder for the results.
Stopped, the same command goes on where it was. Exit status 1 if a frame had to be left out.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import torchvts as vts
from torchvts.core.files import VIDEO_SUFFIXES, read_frames
from torchvts.dataset import CLOUD_FORMATS, DEPTH_FORMATS, PICTURES_UP_TO, Report, list_items, reconstruct_dataset
from torchvts.diagnose import Finding
from torchvts.pipeline import MODES
from torchvts.stream import FIRST_FRAMES, calibrate_background, read_background, read_press_images


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, nargs="?", help="file that calibrate.py wrote; if there is none, give --sensor")
    parser.add_argument("source", type=Path, help="image, folder of images and videos, or video")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results; folders of the source are kept in it")
    parser.add_argument("--sensor", help=f"to calibrate first: YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--background", type=Path, nargs="+", help="to calibrate: image without contact, several, or a video")
    parser.add_argument(
        "--press",
        nargs=2,
        action="append",
        default=[],
        metavar=("IMAGE", "MM"),
        help="to calibrate: a ball pressed in, its diameter",
    )
    parser.add_argument("--background-frames", type=int, default=FIRST_FRAMES, help="first frames of a video, without contact")
    parser.add_argument("--mode", choices=MODES, default="auto")
    parser.add_argument("--depth", choices=DEPTH_FORMATS, default="png", help="png: 16 bits, 32768 + depth / 0.0001 mm")
    parser.add_argument("--cloud", choices=CLOUD_FORMATS, default="none", help="contact points in mm, y up")
    parser.add_argument(
        "--pictures",
        action=argparse.BooleanOptionalAction,
        help=f"contour and surface pictures; by default for at most {PICTURES_UP_TO} frames",
    )
    parser.add_argument("--batch", type=int, default=8, help="frames that a loader worker hands over at once")
    parser.add_argument("--workers", type=int, help="loader processes of each rank; by default up to 4")
    parser.add_argument("--threads", type=int, default=1, help="of each rank; results are bit for bit equal for equal numbers only")
    parser.add_argument("--overwrite", action="store_true", help="begin anew, whatever --out holds")
    parser.add_argument("--strict", action="store_true", help="stop at the first frame that cannot be used")
    arguments = parser.parse_intermixed_args(argv)
    if (arguments.calibration is None) == (arguments.sensor is None):
        parser.error("give either a calibration file or --sensor")
    if arguments.sensor is None and (arguments.background or arguments.press):
        parser.error("--background, --press: they are to calibrate with --sensor, not beside a calibration file")
    return arguments


def calibrate(
    sensor: str, background: Sequence[Path] | None, presses: Sequence[tuple[str, str]], arguments: argparse.Namespace
) -> Path:
    """Calibrate as stream.py does, and keep the file with the results."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise ValueError("--sensor: expected one process, got more: calibrate first, by calibrate.py, and give the file")
    if background is None and arguments.source.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(
            f"--background: expected images without contact, got none: {arguments.source} is no video that begins with them"
        )
    unit = vts.Sensor.load(sensor)
    image = read_background(background or [arguments.source], unit, arguments.background_frames)
    found = calibrate_background(image, unit, read_press_images(presses, unit))
    print(found.note)
    path: Path = arguments.out / "calibration.safetensors"
    path.parent.mkdir(parents=True, exist_ok=True)
    found.calibration.save(path)
    return path


def main(argv: Sequence[str] | None = None) -> int:
    arguments = parse(argv)
    sys.stdout.reconfigure(errors="backslashreplace")  # names of files may not be text
    given = {name: vars(arguments).pop(name) for name in ("sensor", "background", "press")}
    if arguments.calibration is None:
        arguments.calibration = calibrate(*given.values(), arguments)
    report = reconstruct_dataset(**vars(arguments))
    if report.rank > 0:
        return 0
    print_report(report, arguments.out)
    for name, note in report.notes:
        print(f"{name}: {note}")
    for finding in diagnose_first(arguments.calibration, arguments.source):
        print(f"first frame: {finding}")
    return 1 if report.failed else 0


def print_report(report: Report, out: Path) -> None:
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
    unit = vts.Calibration.load(calibration)
    try:
        first = next(list_items(source))
        _, image = next(iter(read_frames(first.file(source))))
        found = vts.diagnose(None, unit.sensor.rectify(image[None])[0], unit)
    except (OSError, ValueError, StopIteration):
        return []
    return [finding for finding in found if finding.severity != "note"]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError, ImportError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("stopped: run the same command again to go on")
