"""Find what is wrong with a frame or with the calibration for it; docs/diagnose.md explains every finding.

Exit status 1 where there is a warning or a fault, 0 where there is none.

examples:
  torchvts diagnose unit.safetensors image.png
  torchvts diagnose unit.safetensors image.png --background now.png --json
"""

import argparse
import dataclasses
import json
from pathlib import Path

from torch import Tensor

from ..core.files import read_image
from ..core.recordings import is_film
from ..diagnose import diagnose
from ..stream import read_background
from .options import load_calibration

USAGE = "CALIBRATION IMAGE [--background IMAGE] [--json]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("calibration", type=Path, metavar="CALIBRATION", help="what torchvts calibrate wrote, .safetensors")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="the frame in question, as the camera gives it")
    parser.add_argument("--background", type=Path, metavar="IMAGE", help="without contact, of now, if there is one; or a video")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the findings."""
    calibration = load_calibration(arguments.calibration)

    def read(path: Path) -> Tensor:
        if path == arguments.background and is_film(path):
            return read_background([path], calibration.sensor)
        image = read_image(path)
        try:
            return calibration.sensor.rectify(image[None])[0]  # raw frames are cut, as by torchvts reconstruct
        except ValueError:
            if tuple(image.shape[1:]) == (calibration.sensor.height, calibration.sensor.width):
                raise  # it seems to be cut already, and torchvts reconstruct would leave it out
            return image  # of another size: that is a finding

    background = None if arguments.background is None else read(arguments.background)
    diagnosis = diagnose(background, read(arguments.image), calibration)
    if arguments.json:
        print(json.dumps({"ok": diagnosis.ok, "findings": [dataclasses.asdict(finding) for finding in diagnosis]}, indent=1))
    else:
        print(diagnosis)
    return 0 if diagnosis.ok else 1
