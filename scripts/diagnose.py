"""Find what is wrong with an image or with the calibration for it; docs/diagnose.md explains every finding.

python scripts/diagnose.py unit.safetensors image.png
python scripts/diagnose.py unit.safetensors image.png --background now.png --json

Exits with 1 if there is a warning or a fault, with 0 if there is none.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

import torchvts as vts


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calibration", type=Path, help="calibration file, .safetensors")
    parser.add_argument("image", type=Path, help="the frame in question, as the camera gives it")
    parser.add_argument("--background", type=Path, help="an image without contact of now, if there is one")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args(argv)
    calibration = vts.Calibration.load(arguments.calibration)

    def read(path: Path) -> torch.Tensor:
        image = vts.read_image(path)
        cut = calibration.sensor.roi_px is not None or calibration.sensor.corners_px is not None
        return calibration.sensor.rectify(image[None])[0] if cut else image

    background = None if arguments.background is None else read(arguments.background)
    diagnosis = vts.diagnose(background, read(arguments.image), calibration)
    if arguments.json:
        print(json.dumps({"ok": diagnosis.ok, "findings": [dataclasses.asdict(finding) for finding in diagnosis]}, indent=1))
    else:
        print(diagnosis)
    return 0 if diagnosis.ok else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
