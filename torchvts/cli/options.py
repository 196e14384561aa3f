"""Options that several subcommands share, each defined once."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import NoReturn

from torch import Tensor
from tqdm import tqdm

from ..calibration import CalibrationWarning, Press, calibrate, read_presses
from ..core.checks import parse_number
from ..core.containers import open_film
from ..core.spelling import suggest
from ..model import Calibration, Sensor, shipped_sensors
from ..model.summary import NOT_METRIC
from ..pipeline import MODES
from ..pose.output_frame import MM_OF
from ..skin import ContactSettings
from ..stream import FIRST_FRAMES
from ..training.presses import without_labels
from .parser import UsageError

_CONTACT = " ".join(f"{key}={'own' if value is None else format(value, 'g')}" for key, value in asdict(ContactSettings()).items())


def add_sensor(parser: argparse._ActionsContainer, text: str = "") -> None:
    """``--sensor``: a YAML file or the name of a shipped one."""
    parser.add_argument("--sensor", metavar="NAME", help=f"{text}YAML file, or one of {', '.join(shipped_sensors())}")


def add_unit(parser: argparse._ActionsContainer, inputs: str, required: bool = True) -> None:
    """The files of a command that reads frames: a calibration, then ``inputs``; or inputs alone, and ``--sensor`` calibrates."""
    count, what = "+" if required else "*", f"calibration, then {inputs}; with --sensor only these"
    parser.add_argument("files", nargs=count, metavar="FILE", help=what)
    add_sensor(parser, "calibrate first: ")
    parser.add_argument("--background", type=Path, nargs="+", metavar="IMAGE", help="to calibrate: without contact; or a video")
    add_press(parser)
    add_background_frames(parser)


def split_files(arguments: argparse.Namespace) -> tuple[Sensor | Calibration, list[str]]:
    """The unit and the inputs that the arguments of :func:`add_unit` name.

    Raises:
        UsageError: a calibration beside ``--sensor`` or behind the inputs, neither of both, no input, or what calibrates beside a
            calibration.
    """
    first, *inputs = arguments.files
    if arguments.sensor is not None:
        if first.endswith(".safetensors"):
            raise UsageError(f"expected inputs only beside --sensor, which calibrates, got {first}: leave one of them out")
        return load_sensor(arguments.sensor), arguments.files
    if arguments.background or arguments.press:
        raise UsageError("--background, --press: they are to calibrate with --sensor, not beside a calibration file")
    if not inputs:
        open_film(Path(first))  # a container of several recordings: names them
        raise UsageError(f"expected a calibration file and an input, got {first}: name both, or --sensor to calibrate")
    late = [name for name in inputs if name.endswith(".safetensors")]
    if late and not first.endswith(".safetensors"):
        raise UsageError(f"expected the calibration first, then what it reads, got {first} before {late[0]}")
    return load_calibration(Path(first)), inputs


def add_press(parser: argparse._ActionsContainer) -> None:
    """``--press IMAGE DIAMETER_MM``, repeated."""
    parser.add_argument(
        "--press", nargs=2, action="append", default=[], metavar=("IMAGE", "MM"), help="a ball pressed in, and its diameter; repeat"
    )


def add_background_frames(parser: argparse._ActionsContainer) -> None:
    """``--background-frames N``, of a video."""
    parser.add_argument(
        "--background-frames",
        type=int,
        default=FIRST_FRAMES,
        metavar="N",
        help=f"first frames, without contact ({FIRST_FRAMES})",
    )


def add_mode(parser: argparse._ActionsContainer, default: str = "fast") -> None:
    """``--mode``: of the pipeline."""
    parser.add_argument("--mode", choices=MODES, default=default, metavar="MODE", help=f"{', '.join(MODES)} ({default})")


def add_network(parser: argparse._ActionsContainer) -> None:
    """``--network``: what finds the normals in place of the calibration's model."""
    parser.add_argument("--network", type=Path, metavar="FILE", help="nnmodel.pth of gs_sdk, or what torchvts train wrote")


def add_pipeline(parser: argparse._ActionsContainer) -> None:
    """``--mode``, ``--network``, ``--device`` and ``--contact KEY=VALUE``, thresholds for :func:`contact_of`."""
    add_mode(parser)
    add_network(parser)
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:1 (cpu)")
    parser.add_argument("--contact", nargs="+", metavar="KEY=VALUE", help=f"thresholds: {_CONTACT}")


def contact_of(given: Sequence[str] | None) -> ContactSettings | None:
    """The thresholds in ``--contact``; None where it was not given.

    Example:
        >>> contact_of(["sigmas=6"])
        ContactSettings(sigmas=6.0, share=None, decay_mm=None)
    """
    if not given:
        return None
    values = {}
    for text in given:
        key, _, number = text.partition("=")
        if key not in asdict(ContactSettings()):
            raise UsageError(f"--contact: expected {_CONTACT}, got {text!r}{suggest(key, asdict(ContactSettings()))}")
        try:
            values[key] = parse_number(number)
        except ValueError as error:
            raise UsageError(f"--contact: {key}: {error}") from None
    return ContactSettings(**values)


def add_length_unit(parser: argparse._ActionsContainer) -> None:
    """``--unit``: of clouds and poses."""
    parser.add_argument(
        "--unit", dest="length_unit", choices=list(MM_OF), default="mm", help="of length in clouds and poses: mm (if not given), m"
    )


def load_sensor(name: str) -> Sensor:
    """A shipped sensor or that of a file; errors name the option."""
    try:
        return Sensor.load(name)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"--sensor: {str(error).removeprefix('source: ')}") from None


def cut_frames(background: Tensor, presses: Sequence[Press], sensor: Sensor) -> tuple[Tensor, list[Press]]:
    """The background and presses of a folder, cut and resized as the sensor file says; labels, of cut frames, go with raw ones."""
    cut_already = tuple(background.shape[1:]) == (sensor.height, sensor.width)
    if cut_already and sensor.raw_size_px and not sensor.cuts_a_place:
        return background, list(presses)  # gs_sdk keeps cropped images, also where raw frames have that size
    given = presses if cut_already else [without_labels(press) for press in presses]
    return sensor.rectify(background[None])[0], [replace(press, image=sensor.rectify(press.image[None])[0]) for press in given]


def read_folder(folder: Path, sensor: Sensor, use_labels: bool = False) -> tuple[Tensor, list[Press]]:
    """Background and presses of a folder in gs_sdk's layout, cut as by :func:`cut_frames`; with its labels, or without."""
    image, presses = read_presses(folder)
    if not use_labels:
        presses = [without_labels(press) for press in presses]
    elif all(press.center_px is None for press in presses):
        raise UsageError(f"--use-labels: {folder} has neither label.npz nor labels.csv: leave --use-labels out, centers are found")
    elif tuple(image.shape[1:]) != (sensor.height, sensor.width):
        raise UsageError(f"--use-labels: the images of {folder} are raw frames, labels are for cut ones: leave --use-labels out")
    return cut_frames(image, presses, sensor)


def load_calibration(path: Path) -> Calibration:
    """The calibration in a file; what is none is refused with what was probably meant."""
    meant = ""
    if str(path) in shipped_sensors() or path.suffix in (".yaml", ".yml"):
        meant = f": a sensor: calibrate it first, torchvts calibrate background.png --sensor {path}"
    elif path.suffix in (".pth", ".pt"):
        meant = ": a network: give it by --network, beside the calibration of its unit"
    elif path.suffix != ".safetensors":
        meant = ": torchvts calibrate makes one"
    if meant:
        raise UsageError(f"calibration: expected a file that torchvts calibrate wrote, .safetensors, got {path}{meant}")
    return Calibration.load(path)


def add_out(parser: argparse._ActionsContainer, text: str) -> None:
    """``--out``: where results go."""
    parser.add_argument("--out", type=Path, metavar="FOLDER", required=True, help=text)


def working(what: str) -> "tqdm[NoReturn]":
    """For a ``with`` block that takes seconds: a line that says what it does, where a person looks on."""
    return tqdm(desc=what, bar_format="{desc} ...", leave=False, disable=None)


def ended(metric: bool, wrong: object, step: str = "") -> int:
    """Print what to do next, and give the exit status: 1 where depth is not metric or something is wrong with the frames."""
    if not metric:
        step = f"{NOT_METRIC}, in no known unit: mend what the doubts name, and calibrate again"
    if step:
        print(f"next: {step}")
    return 1 if wrong or not metric else 0


def calibrated(background: Tensor, sensor: Sensor, presses: Sequence[Press], force: bool = False) -> Calibration:
    """:func:`torchvts.calibrate`; warnings become lines on stderr, save the doubts, which the summary prints."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CalibrationWarning)
        calibration = calibrate(background, sensor, presses, progress=True, force=force)
    for text in dict.fromkeys(str(warning.message) for warning in caught):
        if text not in calibration.report.get("doubts", []):
            print(f"torchvts: warning: {text}", file=sys.stderr)
    return calibration
