"""Fit a sensor type's prior to the presses on one unit, and write it into the sensor's YAML file.

python scripts/fit_prior.py ../shared/data/gelsight_mini_a --sensor gelsight_mini --out configs/sensors/gelsight_mini.yaml

The folder is one of gs_sdk's (catalog.csv, background.png, N/gelsight.png); centers come from label.npz or labels.csv where they
exist, otherwise they are found.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import torchvts as vts
from torchvts.calibration import fit_prior


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="presses of balls, in gs_sdk's layout")
    parser.add_argument("--sensor", required=True, help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--source", default="", help="whose images these are; kept in the file")
    parser.add_argument("--out", type=Path, required=True, help="sensor file to write, .yaml; its leading comment is kept")
    arguments = parser.parse_args(argv)
    sensor = vts.Sensor.load(arguments.sensor)
    background, presses = vts.read_presses(arguments.folder)
    prior = fit_prior(background, sensor, presses, arguments.source or f"{len(presses)} presses of {arguments.folder.name}")
    before = arguments.out.read_text() if arguments.out.is_file() else ""
    comment = [line for line in before.splitlines() if line.startswith("#")]
    dataclasses.replace(sensor, prior=prior).save(arguments.out, comment)
    print(f"{len(presses)} presses; {2 * prior.response.field.size()} parameters of the field")
    print(f"wrote {arguments.out}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
