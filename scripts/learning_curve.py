"""How accurate a calibration is after 0, 1, 3, 5, 11, 21 presses or touches of a set: a table and a picture.

python scripts/learning_curve.py gelsight_mini_a digit_a --draws 4

Presses are drawn at random from those to learn from, and given without labels; the frames that are held out are scored. Touches are
presses given by their images alone, and one press for the scale. No prior has seen the presses that are scored.
"""

import argparse
import dataclasses
import random
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from tqdm import tqdm

from torchvts.evaluation import rows as records
from torchvts.evaluation import sets
from torchvts.evaluation.evaluate import evaluate
from torchvts.evaluation.rows import Column, Row, error_column
from torchvts.viz import new_figure, save_figure

COUNTS = (0, 1, 3, 5, 11, 21)

COLUMNS = (
    Column("data", lambda row: row.data),
    Column("given", lambda row: row.method),
    error_column("number", "count", 0),
    error_column("normals deg", "normal_deg", 2),
    error_column("relief um", "relief_um", 1),
    error_column("without tilt um", "level_um", 1),
    error_column("radius %, median", "radius_percent", 1),
    Column("frames", lambda row: str(row.frames)),
    Column("note", lambda row: row.note),
)


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", choices=sets.SETS, metavar="SET", help=", ".join(sets.SETS))
    parser.add_argument("--draws", type=int, default=4, help="choices of presses per row")
    parser.add_argument("--mode", choices=("fast", "precise"), default="precise")
    parser.add_argument("--out", type=Path, default=Path("out/learning_curve"), help="folder for table.md and the picture")
    arguments = parser.parse_args(argv)
    rows = []
    with tqdm(desc="learning curve", leave=False) as bar:
        for name in arguments.sets:
            data = sets.load(name, sets.data_folder(__file__))
            for row in curve(data, arguments.draws, arguments.mode):
                rows.append(row)
                bar.update()
    text = records.table(rows, COLUMNS)
    records.write_files(arguments.out, {"table.md": text + "\n"})
    save_figure(figure(rows), arguments.out / "learning_curve.png")
    print(f"{text}\n\nwrote {arguments.out}/table.md and learning_curve.png")
    return 0


def curve(data: sets.DataSet, draws: int, mode: str) -> Iterator[Row]:
    """Rows of a set: presses with the prior if there is one, presses without, and touches."""
    kinds = [("presses", mode, True), ("touches, and one press for the scale", "touches", False)]
    if data.folds[0].sensor.prior is not None:
        kinds = [("presses, prior", mode, True), ("presses, no prior", mode, False), kinds[1]]
    for kind, method, primed in kinds:
        for count in COUNTS:
            given = count + (method == "touches")
            enough = [fold for fold in data.folds if len(fold.learned) >= given]
            if enough and (count or kind == "presses, prior"):
                folds = [drawn(enough[k * len(enough) // draws], given, k, primed) for k in range(draws)]
                row = evaluate(dataclasses.replace(data, folds=folds, methods=()), [method]).rows[0]
                yield dataclasses.replace(row, method=kind, errors={**row.errors, "count": float(count)})


def drawn(fold: sets.Fold, count: int, seed: int, primed: bool) -> sets.Fold:
    """The fold with so many of its presses, the same at every run."""
    sensor = fold.sensor if primed else fold.sensor.without_prior()
    return fold._replace(sensor=sensor, learned=random.Random(seed).sample(list(fold.learned), count))


def figure(rows: Sequence[Row]) -> Figure:
    made = new_figure(9.0, 3.6)
    for axes, error, label in zip(made.subplots(1, 2), ("normal_deg", "relief_um"), ("mean angle of normals, deg", "relief, um")):
        for line in dict.fromkeys((row.data, row.method) for row in rows):
            points = [row for row in rows if (row.data, row.method) == line and row.error(error) is not None]
            axes.plot([p.errors["count"] for p in points], [p.errors[error] for p in points], marker="o", label=", ".join(line))
        axes.set(xlabel="presses or touches", ylabel=label, ylim=(0, None))
        axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=7)
    return made


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
