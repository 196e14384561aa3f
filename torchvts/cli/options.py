"""Options that several subcommands share, each defined once."""

import argparse
from pathlib import Path

from ..model import shipped_sensors
from ..pipeline import MODES
from ..stream import FIRST_FRAMES


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
        help=f"first frames of a video without contact ({FIRST_FRAMES})",
    )


def add_mode(parser: argparse._ActionsContainer, default: str = "auto") -> None:
    """``--mode``: of the pipeline."""
    parser.add_argument("--mode", choices=MODES, default=default, help=f"{default} if not given")


def add_pipeline(parser: argparse._ActionsContainer) -> None:
    """``--network`` and ``--device``: what finds the normals, and where."""
    parser.add_argument(
        "--network", type=Path, metavar="FILE", help="normals by gs_sdk's nnmodel.pth, or by what torchvts train wrote"
    )
    parser.add_argument("--device", default="cpu", help="cpu (if not given), cuda, cuda:1")


def add_out(parser: argparse._ActionsContainer, text: str, default: str | None = None) -> None:
    """``--out``: where results go; required where there is no default."""
    path = None if default is None else Path(default)
    parser.add_argument("--out", type=Path, metavar="FOLDER", required=default is None, default=path, help=text)
