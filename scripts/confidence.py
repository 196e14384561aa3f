"""How often errors lie within the bounds that confidence states: a table and a picture.

python scripts/confidence.py --presses ../shared/data/gelsight_mini_a --sensor gelsight_mini

python scripts/confidence.py --drawn 700 701 702 703 704 705 706 707
python scripts/confidence.py --sets gelsight_mini_a gelsight_mini_b gelsight_mini_c gelsight_pale digit_a

The second: objects inside and outside of the range of slopes and depths of the calibration's presses. The third: real sets by 1 to
12 presses, and frames of other cameras.

Random exact scenes of four kinds of units, and presses of balls that calibration has not seen.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

import torchvts as vts
from lab import coverage, sets
from lab.commands import main_of, parser_of
from lab.figures import coverage_figure
from lab.random_scenes import SHAPES, UNITS
from lab.rows import to_json, write_files
from torchvts.pipeline import MODES
from torchvts.viz import save_figure


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--presses", type=Path, help="folder of ball presses in gs_sdk's layout, with labels")
    parser.add_argument("--sensor", default="gelsight_mini", help="sensor of the presses: YAML file or shipped name")
    parser.add_argument("--frames", type=int, default=100, help="random scenes of each kind of unit")
    parser.add_argument("--out", type=Path, default=Path("out/confidence.png"), help="the picture; its table beside it, .json")
    parser.add_argument("--units", nargs="+", choices=UNITS, default=UNITS, metavar="UNIT", help=", ".join(UNITS))
    parser.add_argument(
        "--drawn",
        type=int,
        nargs="+",
        default=[],
        metavar="SEED",
        help="instead: drawn sensors, objects inside and outside of the range",
    )
    parser.add_argument("--sets", nargs="+", default=[], choices=list(sets.REAL), help="instead: real sets")
    parser.add_argument("--data", type=Path, default=sets.data_folder(), help="folder of the real sets")
    parser.add_argument("--mode", default="precise", choices=MODES, help="of drawn sensors and real sets")
    arguments = parser.parse_args(argv)
    if arguments.drawn or arguments.sets:
        rows = [row for seed in arguments.drawn for row in coverage.of_drawn(seed, arguments.mode)]
        rows += [row for name in arguments.sets for row in coverage.of_set(name, arguments.data, arguments.mode)]
        print(coverage.range_table(rows))
        return 0
    with torch.no_grad():
        print(measure(arguments))
    return 0


def measure(arguments: argparse.Namespace) -> str:
    """Measure, save the picture, and return the table."""
    rows, every = [], []
    for number, unit in enumerate(UNITS):
        if unit not in arguments.units:
            continue
        first = 10000 + number * arguments.frames
        found = coverage.of_scenes(range(first, first + arguments.frames), unit, progress=True)
        rows += [coverage.mean(found, f"scenes, {unit}")] if found else []
        every += found
    for shape in SHAPES:
        found = [row for row in every if row.method == shape]
        rows += [coverage.mean(found, f"scenes of all units, {shape}")] if found else []
    curves = [coverage.mean(every, "scenes")]
    if arguments.presses is not None:
        sensor = vts.Sensor.load(arguments.sensor)
        kinds = [
            ("presses, no prior", sensor.without_prior(), True, "precise"),
            ("presses, no prior, fast", sensor.without_prior(), True, "fast"),
        ]
        if sensor.prior is not None:
            kinds += [("presses and prior", sensor, True, "precise"), ("prior alone", sensor, False, "precise")]
        for name, kind, learn, mode in kinds:
            found = coverage.of_presses(arguments.presses, kind, learn=learn, mode=mode, progress=True)
            rows.append(coverage.mean(found, f"{arguments.presses.name}, {name}"))
            curves.append(rows[-1])
    drawn = [curve for curve in curves if not curve.data.endswith("fast")]  # it covers the line of mode precise
    write_files(arguments.out.parent, {f"{arguments.out.stem}.json": to_json(drawn)})
    save_figure(coverage_figure(drawn), arguments.out)
    return coverage.table([*rows, curves[0]])


if __name__ == "__main__":
    main_of(main)
