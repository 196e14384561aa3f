"""How often errors lie within the bounds that confidence states: a table and a picture.

python scripts/confidence.py --frames 10
python scripts/confidence.py --drawn 700 701 702 703 704 705 706 707
python scripts/confidence.py --sets gelsight_mini_a gelsight_mini_b gelsight_mini_c gelsight_pale digit_a

The first: random exact scenes of four kinds of units. The second: objects inside and outside of the range of slopes and depths of
the calibration's presses. The third: real sets by 1 to 12 presses, and frames of other cameras.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch

from lab import coverage, sets
from lab.commands import main_of, parser_of
from lab.figures import coverage_figure
from lab.random_scenes import UNITS
from lab.rows import to_json, write_files
from torchvts.pipeline import MODES
from torchvts.viz import save_figure


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=100, help="random scenes of each kind of unit")
    parser.add_argument("--out", type=Path, default=Path("out/confidence.png"), help="the picture; its table beside it, .json")
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
        first = 10000 + number * arguments.frames
        found = coverage.of_scenes(range(first, first + arguments.frames), unit, progress=True)
        rows += [coverage.mean(found, f"scenes, {unit}")] if found else []
        every += found
    curve = coverage.mean(every, "scenes")
    write_files(arguments.out.parent, {f"{arguments.out.stem}.json": to_json([curve])})
    save_figure(coverage_figure(curve), arguments.out)
    return coverage.table([*rows, curve])


if __name__ == "__main__":
    main_of(main)
