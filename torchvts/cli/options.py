"""Options that several subcommands share, each defined once."""

import argparse
from pathlib import Path

from ..model import Calibration, shipped_sensors
from ..pipeline import MODES
from ..stream import FIRST_FRAMES
from .parser import UsageError


def add_sensor(parser: argparse._ActionsContainer, text: str = "") -> None:
    """``--sensor``: a YAML file or the name of a shipped one."""
    parser.add_argument("--sensor", metavar="NAME", help=f"{text}YAML file, or one of {', '.join(shipped_sensors())}")


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
        help=f"first of a video, without contact ({FIRST_FRAMES})",
    )


def add_mode(parser: argparse._ActionsContainer, default: str = "auto") -> None:
    """``--mode``: of the pipeline."""
    parser.add_argument("--mode", choices=MODES, default=default, metavar="MODE", help=f"{', '.join(MODES)} ({default})")


def add_network(parser: argparse._ActionsContainer) -> None:
    """``--network``: what finds the normals in place of the calibration's model."""
    parser.add_argument("--network", type=Path, metavar="FILE", help="nnmodel.pth of gs_sdk, or what torchvts train wrote")


def add_device(parser: argparse._ActionsContainer) -> None:
    """``--device``: where the pipeline runs."""
    parser.add_argument("--device", default="cpu", help="cpu, cuda, cuda:1 (cpu)")


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


def add_out(parser: argparse._ActionsContainer, text: str, default: str | None = None) -> None:
    """``--out``: where results go; required where there is no default."""
    path = None if default is None else Path(default)
    parser.add_argument("--out", type=Path, metavar="FOLDER", required=default is None, default=path, help=text)
