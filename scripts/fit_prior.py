"""Fit a sensor type's prior to the presses on one unit, and write it into the sensor's YAML file.

python scripts/fit_prior.py ../shared/data/gelsight_mini_a --sensor gelsight_mini --out configs/sensors/gelsight_mini.yaml

python scripts/fit_prior.py background.png --press 1.png 4.7 --press 2.png 4.7 ... --sensor digit --out configs/sensors/digit.yaml

python scripts/fit_prior.py --units gelsight_mini_a gelsight_mini_c --sensor gelsight_mini --out configs/sensors/gelsight_mini.yaml

python scripts/fit_prior.py another_unit --sensor configs/sensors/digit.yaml --score --out configs/sensors/digit.yaml

The file says how good the prior is (held_out_deg, degrees): on presses that were held out; of several units on each by the others;
by --score on the presses of another unit, which the prior sees by its background alone. --units names real sets of the data folder.

The folder is one of gs_sdk's (catalog.csv, background.png, N/gelsight.png); centers come from label.npz or labels.csv where they
exist, otherwise they are found. Without a folder: an image without contact, several (their median), or a video, and presses.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torchvts as vts
from lab import sets
from lab.commands import main_of, parser_of
from lab.prior import PriorUnit, fit_prior, score_prior
from torchvts.model.response_field import SensorPrior
from torchvts.stream import read_background, read_press_images


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument(
        "background", type=Path, nargs="*", help="folder in gs_sdk's layout, or image without contact, several, a video"
    )
    parser.add_argument(
        "--press", nargs=2, action="append", default=[], metavar=("IMAGE", "MM"), help="a ball pressed in, and its diameter"
    )
    parser.add_argument("--sensor", required=True, help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--source", default="", help="whose images these are; kept in the file")
    parser.add_argument("--units", nargs="+", default=[], metavar="SET", help="real sets to fit to, each unit alike")
    parser.add_argument(
        "--score", action="store_true", help="score the sensor's prior on this other unit, and add that to the file"
    )
    parser.add_argument("--out", type=Path, required=True, help="sensor file to write, .yaml; its leading comment is kept")
    arguments = parser.parse_args(argv)
    sensor = vts.Sensor.load(arguments.sensor)
    if bool(arguments.units) == bool(arguments.background):
        parser.error("expected either a background or --units")
    others = [unit_of(name) for name in arguments.units]
    if others:
        background, presses = others[0].background, others[0].presses
    elif len(arguments.background) == 1 and arguments.background[0].is_dir():
        background, presses = vts.read_presses(arguments.background[0])
    else:
        background, presses = read_background(arguments.background, sensor), read_press_images(arguments.press, sensor)
    if arguments.score:
        prior = with_score(sensor, score_prior(background, sensor, presses))
    else:
        names = arguments.units or [arguments.background[0].name]
        count = sum(len(unit.presses) for unit in others) or len(presses)
        source = arguments.source or f"{count} presses of {', '.join(names)}"
        prior = fit_prior(background, sensor, presses, source, others[1:])
    before = arguments.out.read_text() if arguments.out.is_file() else ""
    comment = [line for line in before.splitlines() if line.startswith("#")]
    dataclasses.replace(sensor, prior=prior).save(arguments.out, comment)
    print(f"{prior.source}; {2 * prior.response.field.size()} parameters of the field")
    angles = ", ".join(f"{angle:.2f}" for angle in prior.held_out_deg)
    print(f"error of normals, each unit by what it was not fitted to: {angles or 'not measured, too few presses'} deg")
    print(f"wrote {arguments.out}")
    return 0


def unit_of(name: str) -> PriorUnit:
    """All presses of a real set."""
    data = sets.load(name, sets.data_folder())
    presses = {(press.name, press.ball_diameter_mm): press for fold in data.folds for press in fold.learned}
    return PriorUnit(data.background, data.folds[0].sensor, list(presses.values()))


def with_score(sensor: vts.Sensor, error_deg: float) -> SensorPrior:
    """The sensor's prior with its error on one more unit, degrees."""
    assert sensor.prior is not None  # it was scored
    return dataclasses.replace(sensor.prior, held_out_deg=(*sensor.prior.held_out_deg, error_deg))


if __name__ == "__main__":
    main_of(main)
