"""Depth of images, folders (with all below them) and videos, written into a folder. Stopped, the same command goes on.

The first of the files is the calibration that torchvts calibrate wrote. With --sensor in its place the unit is calibrated
first: from --background and --press, or from the first frames of a video, which must be without contact.
Exit status 1 where a frame was left out or is in doubt, or depth is not metric.

examples:
  torchvts reconstruct unit.safetensors press.png --out out/press
  torchvts reconstruct video.avi --sensor gelsight_mini --out out/video
  torchrun --standalone --nproc_per_node=4 -m torchvts reconstruct unit.safetensors \\
      folder/ --out out/all
"""

import argparse
import csv
import os
from pathlib import Path

from tqdm import tqdm

from ..core.arrays import Array
from ..core.checks import check_integer
from ..core.files import make_folder
from ..core.recordings import is_film
from ..dataset import CLOUD_FORMATS, FORMATS, PICTURES_UP_TO, RunReport, list_items, reconstruct_dataset
from ..diagnose import SEVERITIES, Finding, diagnose
from ..model import Calibration, Sensor
from ..model.report import warnings_of
from ..model.summary import SHOWN, doubts_of
from ..stream import Recording, frames, read_background, read_press_images
from ..viz import NAME_SHOWN, save_figure, sheet_figure
from .options import add_length_unit, add_out, add_pipeline, add_unit, calibrated, ended, split_files
from .parser import UsageError

PASSED = (
    "mode", "format", "cloud", "length_unit", "pictures", "every", "network", "device", "background_frames", "workers",
    "threads", "overwrite", "strict",
)  # fmt: skip
"""Options that :func:`reconstruct_dataset` has under the same names."""

DIAGNOSED = 20
"""So many images are diagnosed; of more, the first of each of so many folders, since each may be of another camera."""

SHEET = 9
"""Images on the sheet."""

USAGE = "CALIBRATION INPUT... --out FOLDER"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_unit(parser, "inputs")
    add_out(parser, "for the results, in the folders of the input")
    add_pipeline(parser)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="each N-th frame of a video, each N-th image")
    kinds = "npz (all), video-npz and video-zarr (one a video), png16, npy, none (npz)"
    parser.add_argument("--format", choices=FORMATS, default="npz", metavar="KIND", help=kinds)
    parser.add_argument(
        "--cloud", choices=CLOUD_FORMATS, default="none", metavar="KIND", help="contact: ply, pcd; surface: obj, x3p (metres)"
    )
    add_length_unit(parser)
    parser.add_argument("--pictures", action=argparse.BooleanOptionalAction, help=f"of each frame (of {PICTURES_UP_TO} at most)")
    parser.add_argument("--workers", type=int, metavar="N", help="threads of each rank that read images (up to 4)")
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="of each rank (1); results vary in last bits")
    parser.add_argument("--overwrite", action="store_true", help="begin anew, whatever --out holds")
    parser.add_argument("--strict", action="store_true", help="stop at the first frame that cannot be used")


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct, and print a summary."""
    check_integer("--every", arguments.every, 1)
    unit, names = split_files(arguments)
    inputs = [Path(name) for name in names]
    calibration = Path(arguments.files[0])
    if isinstance(unit, Sensor):
        calibration, unit = calibrate_first(arguments, inputs, unit)
    passed = {name: getattr(arguments, name) for name in PASSED}
    if arguments.pictures is not False and int(os.environ.get("RANK", "0")) == 0:
        write_sheet(unit, inputs, arguments)
    report = reconstruct_dataset(calibration, inputs, arguments.out, **passed)
    if report.rank > 0:
        return 0
    print_report(report, arguments.out, unit.metric)
    if arguments.sensor is None and warnings_of(unit.report):  # else said where it was calibrated
        print(*doubts_of(unit.report), sep="\n")
    if arguments.pictures is None and report.rows > PICTURES_UP_TO:
        print(f"no pictures of more than {PICTURES_UP_TO} frames: --pictures --overwrite draws all, --every N fewer")
    findings = diagnose_some(unit, inputs, report, arguments.every)
    for name, finding in findings:
        print(f"{name}: {finding}")
    wrong = bool(findings or report.failed or report.doubted)
    faults = any(finding.severity == "fault" for _, finding in findings)
    return ended(unit.metric, report.failed or report.doubted or faults, next_step(calibration, inputs, arguments, wrong))


def write_sheet(unit: Calibration, inputs: list[Path], arguments: argparse.Namespace) -> None:
    """Write sheet.png before all else: depth of the first images in one scale, by which one sees whether all is well."""
    path: Path = arguments.out / "sheet.png"
    if path.exists() and not arguments.overwrite:
        return
    recording = Recording(unit, arguments.mode, network=arguments.network, device=arguments.device)
    items = [item for item in list_items(tuple(inputs), arguments.every) if not item.is_film]
    shown: list[tuple[float | str, Array, str]] = []
    for item in items[:SHEET]:
        try:
            image = unit.sensor.read_image(item.file).clamp(0.0, 1.0)[None]
        except (OSError, ValueError):  # said where it is to be reconstructed
            continue
        if not recording.unusable(image):
            depth = recording(image).depth_mm[0, 0].double().numpy()
            shown.append((item.path[-NAME_SHOWN:], depth, recording.doubt))
    if len(shown) > 1 and max(depth.max() for _, depth, _ in shown) > 0.0:
        make_folder(path.parent)
        few = min(SHEET, len(items))
        left_out = f", {few - len(shown)} of them left out" if few > len(shown) else ""
        title = f"the first {few} of {len(items)} images{left_out}"
        save_figure(sheet_figure(shown, unit.sensor.mm_per_pixel, title, unit.metric, warnings_of(unit.report)), path)
        print(f"wrote {path}: {title} in one scale", flush=True)


def next_step(calibration: Path, inputs: list[Path], arguments: argparse.Namespace, wrong: bool) -> str:
    """What to do after a run in which frames have findings, were left out, or are in doubt, or none."""
    if wrong:
        image = inputs[0] if len(inputs) == 1 else "IMAGE"
        return f"torchvts diagnose {calibration} {image} says what is wrong, the docs/diagnose.md page what to do"
    reads = "; vts.read_result(path) reads those ending in .npz" if arguments.format in ("npz", "video-npz") else ""
    return f"{arguments.out / 'summary.json'} says what the files are{reads}"


def calibrate_first(arguments: argparse.Namespace, inputs: list[Path], unit: Sensor) -> tuple[Path, Calibration]:
    """Calibrate as ``torchvts stream`` does, and keep the file with the results."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise UsageError("--sensor: expected one process, got more: calibrate first, by torchvts calibrate, and give the file")
    video = next((path for path in inputs if is_film(path)), None)
    if arguments.background is None and video is None:
        raise UsageError(f"--background: expected images without contact, got none: {inputs[0]} is no video that begins with them")
    image = read_background(arguments.background or [video], unit, arguments.background_frames)
    calibration = calibrated(image, unit, read_press_images(arguments.press, unit))
    print(calibration)
    path: Path = arguments.out / "calibration.safetensors"
    make_folder(path.parent)
    calibration.save(path)
    return path, calibration


def print_report(report: RunReport, out: Path, metric: bool) -> None:
    """Print the deepest frames, how many were left out, which are in doubt, and where the results are."""
    with (out / "frames.csv").open(encoding="utf-8", errors="replace", newline="") as stream:
        rows = list(csv.DictReader(stream))
    shown = rows  # in the order in which they were given
    if len(rows) > SHOWN:
        shown = sorted(rows, key=lambda row: -float(row["deepest_mm"]))[:SHOWN]
    for row in shown:
        depth = f"deepest {float(row['deepest_mm']):.3f} {'mm' if metric else '(not in mm)'}"
        doubt = ", IN DOUBT" if row["doubt"] else ""
        print(f"{row['frame']}: {depth}, contact {float(row['contact_mm2']):.2f} mm2{doubt}")
    if len(rows) > SHOWN:
        print(f"... the deepest {SHOWN} of {len(rows)}; contact in {sum(float(row['contact_mm2']) > 0 for row in rows)}")
    for name, note in report.notes:
        print(f"{name}: {note}")
    if report.failed:
        print(f"{len(report.failed)} left out, all of them in {out / 'failed.csv'}")
    if report.doubted:
        name, doubt = report.doubted[0]
        print(f"in doubt: {len(report.doubted)} of {report.rows} frames (column doubt of frames.csv), the first {name}: {doubt}")
    before = f", {report.before} of them by an earlier run" if report.before else ""
    frames = f"{report.rows} frame{'s' if report.rows != 1 else ''}"
    print(f"wrote {frames} to {out}{before}; table in frames.csv, units in summary.json")


def diagnose_some(unit: Calibration, inputs: list[Path], report: RunReport, every: int) -> list[tuple[str, Finding]]:
    """What is wrong with :data:`DIAGNOSED` images, and the first frame of each video: each finding once, as the worst has it."""
    left_out, doubted = ({name for name, _ in rows} for rows in (report.failed, report.doubted))
    items = list(list_items(tuple(inputs), every))
    if len(items) > DIAGNOSED:
        items = list({item.file.parent: item for item in reversed(items)}.values())[::-1][:DIAGNOSED]
    found: dict[str, list[tuple[str, Finding]]] = {}
    for item in tqdm(items, desc="diagnosing", leave=False, disable=None):
        name = item.frame_name(0 if item.is_film else -1)
        if name in left_out:
            continue
        try:
            _, raw = next(iter(frames(item.file)))
            image = unit.sensor.rectify(raw[None])[0]
        except (OSError, ValueError, StopIteration):  # named where it was to be reconstructed
            continue
        for finding in diagnose(None, image, unit):
            if finding.severity == "fault" or (finding.severity == "warning" and name not in doubted):
                found.setdefault(finding.name, []).append((name, finding))
    worst = (min(same, key=lambda pair: SEVERITIES.index(pair[1].severity)) for same in found.values())
    more = (f" and {len(same) - 1} more" if len(same) > 1 else "" for same in found.values())
    return [(name + others, finding) for (name, finding), others in zip(worst, more)]
