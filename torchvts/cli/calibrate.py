"""Calibrate a unit from its own images: without contact, and better with presses of a ball of known diameter.

SOURCE is an image without contact, several (their median), a video whose first frames are without contact, or a
calibration folder of gs_sdk (catalog.csv, background.png, N/gelsight.png). Centers of the balls are found.
With --camera it guides: untouched skin first, then press where it says; each press is kept in a folder.

examples:
  torchvts calibrate background.png --sensor gelsight_mini --out unit.safetensors
  torchvts calibrate background.png --press 1.png 6.31 --sensor gelsight_mini
  torchvts calibrate first_frames.mp4 --mm-per-pixel 0.05
  torchvts calibrate --camera 0 --ball 6.31 --sensor gelsight_mini
"""

import argparse
import dataclasses
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from ..calibration import Press
from ..calibration.presses import check_presses
from ..core.checks import check_positive
from ..core.containers import find_container
from ..core.files import check_folder, make_folder
from ..model import Calibration, Sensor, shipped_sensors
from ..model.summary import summary_of
from ..stream import StageClock, frames, open_source, read_background, read_press_images
from ..stream.numbered import SourceFrames
from .guide import Guide, Session, Watch, draw
from .options import add_background_frames, add_press, add_sensor, calibrated, ended, load_sensor, read_folder
from .parser import UsageError
from .source import add_camera_settings, play, settings_of

SMALL_PLACE = 0.3
"""Share of the camera's frame: gels take 0.42 and more; places measured in a preview of half the size at most a quarter."""

USAGE = "(SOURCE... | --camera SOURCE --ball MM) (--sensor NAME | --mm-per-pixel MM) [--press IMAGE MM]... [--out FILE]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("source", type=Path, nargs="*", metavar="SOURCE", help="images without contact, a video, or a folder")
    add_sensor(parser)
    parser.add_argument("--mm-per-pixel", type=float, metavar="MM", help="pitch of a sensor without a file")
    parser.add_argument("--gamma", type=float, metavar="G", help="beside it: value = light^(1/gamma)")
    add_press(parser)
    parser.add_argument("--camera", metavar="SOURCE", help="guide by a camera; a film stands in for one")
    parser.add_argument("--ball", type=float, metavar="MM", help="with --camera: diameter of the ball that is pressed")
    parser.add_argument("--until-deg", type=float, default=3.0, metavar="D", help="end where normals are expected to so many (3)")
    parser.add_argument("--session", type=Path, metavar="FOLDER", help="keeps the presses (UNIT_presses); goes on")
    add_camera_settings(parser)
    parser.add_argument("--use-labels", action="store_true", help="centers from label.npz or labels.csv")
    parser.add_argument("--force", action="store_true", help="go on where presses contradict all sizes")
    parser.add_argument("--no-prior", action="store_true", help="ignore the prior of the sensor file")
    add_background_frames(parser)
    out = Path("unit.safetensors")
    parser.add_argument("--out", type=Path, default=out, metavar="FILE", help=f"calibration to write ({out})")
    parser.add_argument("--candidates", action="store_true", help="also print all models and presses")


def run(arguments: argparse.Namespace) -> int:
    """Calibrate, write the file, and print what was chosen."""
    if (arguments.sensor is None) == (arguments.mm_per_pixel is None):
        raise UsageError(f"expected either --sensor or --mm-per-pixel; shipped sensors: {', '.join(shipped_sensors())}")
    if arguments.sensor is not None and arguments.gamma is not None:
        raise UsageError("--gamma: expected it beside --mm-per-pixel, --sensor has the file's: write gamma into the sensor file")
    if arguments.out.suffix != ".safetensors":
        raise UsageError(f"--out: expected a name ending in .safetensors, got {arguments.out}")
    check_folder(arguments.out.parent)
    picture = arguments.out.with_name(f"{arguments.out.stem}_calibration.png")  # not the name of a background
    if arguments.camera is not None:
        return by_hand(arguments, picture)
    if not arguments.source:
        raise UsageError("expected images without contact, a video or a folder; or --camera, which guides")
    image, sensor, presses = read_given(arguments)
    presses += read_press_images(arguments.press, sensor)
    return write(calibrated(image, sensor, presses, arguments.force), presses, arguments, picture)


def by_hand(arguments: argparse.Namespace, picture: Path) -> int:
    """Guide a person with a ball, until the error that was asked for is stated, or the camera or the user ends it."""
    if arguments.source or arguments.press or arguments.use_labels:
        raise UsageError("--camera: expected no images beside it: they are taken as you press")
    if arguments.ball is None:
        raise UsageError("--camera: expected --ball MM beside it, the diameter of the ball that you press")
    ball_mm, until_deg = check_positive("--ball", arguments.ball, 1000.0), check_positive("--until-deg", arguments.until_deg, 90.0)
    camera = SourceFrames(open_source(arguments.camera, settings=settings_of(arguments)), False, StageClock())
    try:
        size = camera.read_first(1)[0].shape[:2]
        sensor = sensor_of(arguments, lambda: size)
        session = Session(arguments.session or arguments.out.with_name(f"{arguments.out.stem}_presses"), sensor)
        guide = Guide(session, Watch(sensor), ball_mm, until_deg, picture, arguments.force)
        lost = None if guide.reached else play(camera, guide.add)
    finally:
        camera.close()
    session.read()  # whole, wherever it was interrupted
    if session.background is None:
        raise lost or ValueError(f"--camera: expected a still, untouched skin first, got none: {guide.watch.why_not_at_rest()}")
    unit = guide.unit or calibrated(session.background, sensor, session.presses, arguments.force)
    judged = {row["name"] for row in unit.report.get("presses", [])}
    if waiting := [press.name for press in session.presses if press.name not in judged]:
        print(f"press {', '.join(waiting)}: stored, and not yet in the file")
    if not guide.reached:
        print(f"ended before {until_deg:g} degrees were stated; the same command goes on")
    status = write(unit, session.presses, arguments, picture)
    if lost is not None:
        raise lost
    return status


def write(calibration: Calibration, presses: Sequence[Press], arguments: argparse.Namespace, picture: Path) -> int:
    """Write a calibration and its picture, and print what it is; the exit status."""
    make_folder(arguments.out.parent)
    calibration.save(arguments.out)
    draw(calibration, check_presses(presses, calibration.sensor), picture)
    print(summary_of(calibration, arguments.candidates))
    print(f"wrote {arguments.out} ({arguments.out.stat().st_size / 1000:.0f} kB), and {picture}: what it was made of")
    step = f"torchvts reconstruct {arguments.out} IMAGE --out FOLDER, or torchvts view {arguments.out} 0 for a camera, live"
    return ended(calibration.metric, False, step)


def read_given(arguments: argparse.Namespace) -> tuple[Tensor, Sensor, list[Press]]:
    """Background, sensor and presses that the arguments name."""
    first = arguments.source[0]
    sensor = sensor_of(arguments, lambda: size_of(first))
    for path in arguments.source:
        check_there(path)
    if len(arguments.source) == 1 and first.is_dir():
        background, presses = read_folder(first, sensor, arguments.use_labels)
        return background, sensor, presses
    return read_background(arguments.source, sensor, arguments.background_frames), sensor, []


def sensor_of(arguments: argparse.Namespace, size: Callable[[], tuple[int, int]]) -> Sensor:
    """The sensor that the arguments name, which knows of what height and width the frames are that a place is cut from."""
    if arguments.sensor is not None:
        sensor = load_sensor(arguments.sensor)
    else:
        sensor = Sensor("own sensor", *size(), arguments.mm_per_pixel, gamma=arguments.gamma)
    if sensor.cuts_a_place and not sensor.raw_size_px:
        sensor = dataclasses.replace(sensor, raw_size_px=(size(),))
        warn_of_a_small_place(sensor)
    return sensor.without_prior() if arguments.no_prior else sensor


def warn_of_a_small_place(sensor: Sensor) -> None:
    """Say where the gel takes so little of the frame that its place was perhaps measured in a smaller picture."""
    ((height, width),) = sensor.raw_size_px
    corners, name = sensor.place_px or (), "corners_px" if sensor.roi_px is None else "roi_px"
    area = 0.5 * abs(sum(x * v - u * y for (x, y), (u, v) in zip(corners, (*corners[1:], *corners[:1]), strict=True)))
    if (share := area / (height * width)) < SMALL_PLACE:
        text = f"{name}: the gel takes {share:.0%} of frames of {height} x {width}: was its place measured in a smaller picture?"
        warnings.warn(text, UserWarning, stacklevel=1)


def check_there(source: Path) -> None:
    """Raise unless there is such a file, folder or recording of a container."""
    if not source.exists() and find_container(source) is None:
        raise FileNotFoundError(f"{source}: no such file or folder")


def size_of(source: Path) -> tuple[int, int]:
    """Height and width of the first image of a source; of a calibration folder, of its background."""
    check_there(source)
    _, image = next(iter(frames(source / "background.png" if source.is_dir() else source)))
    return image.shape[1], image.shape[2]
