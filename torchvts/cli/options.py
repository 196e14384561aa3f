"""Options that several subcommands share, each defined once."""

import argparse
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from ..calibration import CalibrationWarning, Press, calibrate, read_presses
from ..core.containers import open_film
from ..model import Calibration, Sensor, shipped_sensors
from ..model.summary import NOT_METRIC
from ..pipeline import MODES
from ..pose.output_frame import MM_OF
from ..stream import FIRST_FRAMES
from ..training.presses import without_labels
from .parser import UsageError


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
    """The unit and the inputs that the arguments of :func:`add_unit` name."""
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
    text = "a ball pressed in, and its diameter; repeat"
    parser.add_argument("--press", nargs=2, action="append", default=[], metavar=("IMAGE", "MM"), help=text)


def add_background_frames(parser: argparse._ActionsContainer) -> None:
    """``--background-frames N``, of a video."""
    text = f"first frames, without contact ({FIRST_FRAMES})"
    parser.add_argument("--background-frames", type=int, default=FIRST_FRAMES, metavar="N", help=text)


def add_model(parser: argparse._ActionsContainer) -> None:
    """``--mode`` of the pipeline, and ``--network`` in place of the calibration's model."""
    parser.add_argument("--mode", choices=MODES, default="fast", metavar="MODE", help=f"{', '.join(MODES)} (fast)")
    parser.add_argument("--network", type=Path, metavar="FILE", help="nnmodel.pth of gs_sdk, or what torchvts train wrote")


def add_pipeline(parser: argparse._ActionsContainer) -> None:
    """:func:`add_model`, and ``--device``."""
    add_model(parser)
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:1 (cpu)")


def add_length_unit(parser: argparse._ActionsContainer) -> None:
    """``--unit``: of clouds and poses."""
    text = "of length in clouds and poses: mm (if not given), m"
    parser.add_argument("--unit", dest="length_unit", choices=list(MM_OF), default="mm", help=text)


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
