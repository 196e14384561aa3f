"""Calibrate a unit from its own images: without contact, and better with presses of a ball of known diameter.

SOURCE is an image without contact, several (their median), a video whose first frames are without contact, or a
calibration folder of gs_sdk (catalog.csv, background.png, N/gelsight.png). Centers of the balls are found.

examples:
  torchvts calibrate background.png --sensor gelsight_mini --out unit.safetensors
  torchvts calibrate background.png --press 1.png 6.31 --sensor gelsight_mini
  torchvts calibrate first_frames.mp4 --mm-per-pixel 0.05
"""

import argparse
import dataclasses
import warnings
from pathlib import Path

import torch

from ..calibration import Press, read_presses
from ..calibration.presses import check_presses
from ..core.files import make_folder
from ..model import Sensor
from ..model.summary import summary_of
from ..stream import frames, read_background, read_press_images
from ..viz import calibration_figure, save_figure
from .options import add_background_frames, add_press, add_sensor, calibrated, cut_frames, load_sensor
from .parser import UsageError

SMALL_PLACE = 0.3
"""Share of the camera's frame: gels take 0.42 and more; places measured in a preview of half the size at most a quarter."""

USAGE = "SOURCE... (--sensor NAME | --mm-per-pixel MM) [--press IMAGE MM]... [--out FILE]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("source", type=Path, nargs="+", metavar="SOURCE", help="images without contact, a video, or a folder")
    add_sensor(parser)
    parser.add_argument(
        "--mm-per-pixel", type=float, metavar="MM", help="pixel pitch of a sensor without a file, in place of --sensor"
    )
    parser.add_argument("--gamma", type=float, help="with --mm-per-pixel: value = light^(1/gamma); chosen if not given")
    add_press(parser)
    parser.add_argument("--use-labels", action="store_true", help="take centers from the folder's label.npz or labels.csv")
    parser.add_argument("--force", action="store_true", help="go on where presses contradict the pitch or all diameters")
    parser.add_argument("--no-prior", action="store_true", help="ignore the prior of the sensor file")
    add_background_frames(parser)
    parser.add_argument(
        "--out", type=Path, default=Path("unit.safetensors"), metavar="FILE", help="calibration to write (unit.safetensors)"
    )
    parser.add_argument("--candidates", action="store_true", help="also print all models that were tried, and all presses")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, write the file, and print what was chosen."""
    if (arguments.sensor is None) == (arguments.mm_per_pixel is None):
        raise UsageError("expected either --sensor or --mm-per-pixel")
    if arguments.sensor is not None and arguments.gamma is not None:
        raise UsageError("--gamma: expected it beside --mm-per-pixel, --sensor has the file's: write gamma into the sensor file")
    check_target_of(arguments.out)
    image, sensor, presses = read_given(arguments)
    presses += read_press_images(arguments.press, sensor)
    calibration = calibrated(image, sensor, presses, arguments.force)
    calibration.save(arguments.out)
    picture = arguments.out.with_name(f"{arguments.out.stem}_calibration.png")  # not the name of a background
    save_figure(calibration_figure(calibration, check_presses(presses, sensor)), picture)
    print(summary_of(calibration, arguments.candidates))
    print(f"wrote {arguments.out} ({arguments.out.stat().st_size / 1000:.0f} kB), and {picture}: what it was made of")
    return 0 if calibration.metric else 1


def check_target_of(out: Path) -> None:
    """Refuse a name that is no calibration's before the work that leads to it."""
    if out.suffix != ".safetensors":
        raise UsageError(f"--out: expected a name ending in .safetensors, got {out}")
    make_folder(out.parent)


def read_given(arguments: argparse.Namespace) -> tuple[torch.Tensor, Sensor, list[Press]]:
    """Background, sensor and presses that the arguments name; the sensor knows the size of the frames that a place is cut from."""
    first = arguments.source[0]
    if arguments.sensor is not None:
        sensor = load_sensor(arguments.sensor)
    else:
        sensor = Sensor("own sensor", *size_of(first), arguments.mm_per_pixel, gamma=arguments.gamma)
    if sensor.cuts_a_place and not sensor.raw_size_px:
        sensor = dataclasses.replace(sensor, raw_size_px=(size_of(first),))
        warn_of_a_small_place(sensor)
    sensor = sensor.without_prior() if arguments.no_prior else sensor
    if not (len(arguments.source) == 1 and first.is_dir()):
        return read_background(arguments.source, sensor, arguments.background_frames), sensor, []
    image, presses = read_presses(first)
    if not arguments.use_labels:
        presses = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]
    elif all(press.center_px is None for press in presses):
        raise UsageError(f"--use-labels: {first} has neither label.npz nor labels.csv: leave --use-labels out, centers are found")
    elif tuple(image.shape[1:]) != (sensor.height, sensor.width):
        raise UsageError(f"--use-labels: the images of {first} are raw frames, labels are for cropped ones: leave --use-labels out")
    image, presses = cut_frames(image, presses, sensor)
    return image, sensor, presses


def warn_of_a_small_place(sensor: Sensor) -> None:
    """Say where the gel takes so little of the frame that its place was perhaps measured in a smaller picture."""
    ((height, width),) = sensor.raw_size_px
    corners, name = sensor.place_px or (), "corners_px" if sensor.roi_px is None else "roi_px"
    area = 0.5 * abs(sum(x * v - u * y for (x, y), (u, v) in zip(corners, (*corners[1:], *corners[:1]), strict=True)))
    if (share := area / (height * width)) < SMALL_PLACE:
        text = f"{name}: the gel takes {share:.0%} of frames of {height} x {width}: was its place measured in a smaller picture?"
        warnings.warn(text, UserWarning, stacklevel=1)


def size_of(source: Path) -> tuple[int, int]:
    """Height and width of the first image of a source; of a calibration folder, of its background."""
    _, image = next(iter(frames(source / "background.png" if source.is_dir() else source)))
    return image.shape[1], image.shape[2]
