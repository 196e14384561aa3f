"""How accurate a calibration is after 0, 1, 3, 5, 11, 21 presses of a set: a table and a picture.

python scripts/learning_curve.py gelsight_mini_a digit_a --draws 4

Presses are drawn at random from those to learn from, and given without labels; the frames that are held out are scored. MLP is
gs_sdk's network, trained on the same presses. No prior has seen the presses that are scored.
"""

import dataclasses
import random
from collections.abc import Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from lab import rows as records
from lab import sets
from lab.commands import main_of, parser_of
from lab.evaluate import evaluate
from lab.figures import learning_figure, save_small
from lab.methods import GIVEN_NETWORK
from lab.rows import Column, Row, error_column

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
    parser = parser_of(__doc__)
    parser.add_argument("sets", nargs="+", choices=sets.SETS, metavar="SET", help=", ".join(sets.SETS))
    parser.add_argument("--draws", type=int, default=4, help="choices of presses per row")
    parser.add_argument("--mode", choices=("fast", "precise"), default="precise")
    parser.add_argument("--out", type=Path, default=Path("out/learning_curve"), help="folder for table.md and the picture")
    arguments = parser.parse_args(argv)
    rows = []
    with tqdm(desc="learning curve", leave=False, disable=None) as bar:
        for name in arguments.sets:
            data = sets.load(name, sets.data_folder())
            for row in curve(data, arguments.draws, arguments.mode):
                rows.append(row)
                bar.update()
    text = records.table(means(rows), COLUMNS)
    records.write_files(arguments.out, {"table.md": text + "\n", "rows.json": records.to_json(rows)})
    save_small(learning_figure(rows), arguments.out / "learning_curve.png", text)
    print(f"{text}\n\nwrote {arguments.out}/table.md, rows.json and learning_curve.png")
    return 0


def curve(data: sets.DataSet, draws: int, mode: str) -> Iterator[Row]:
    """Rows of a set, one for each draw: presses with the prior if there is one, presses without, a trained network.

    Last comes the network that belongs to the unit, if there is one: its count is None.
    """
    kinds = [("presses", mode, True), ("MLP", "MLP", False)]
    if data.folds[0].sensor.prior is not None:
        kinds = [("presses, prior", mode, True), ("presses, no prior", mode, False), *kinds[1:]]
    for kind, method, primed in kinds:
        for count in COUNTS:
            fewest = 2 if method == "MLP" else 0 if kind == "presses, prior" else 1  # a network holds one press out
            enough = [fold for fold in data.folds if len(fold.learned) >= count]
            if fewest <= count and enough:
                for k in range(draws):
                    fold = drawn(enough[k * len(enough) // draws], count, k, primed)
                    row = evaluate(dataclasses.replace(data, folds=[fold], methods=()), [method]).rows[0]
                    yield dataclasses.replace(row, method=kind, seed=k, errors={**row.errors, "count": float(count)})
    network = [method for method in data.methods if method.name == GIVEN_NETWORK]
    if network:
        row = evaluate(dataclasses.replace(data, methods=network), ["flat"]).rows[-1]
        yield dataclasses.replace(row, method="gs_sdk's network of this unit, has seen these", errors={**row.errors, "count": None})


def means(rows: Sequence[Row]) -> list[Row]:
    """For each number of presses a row of the means over its draws, every frame counted; of the radius the median of medians."""
    merged = []
    for key in dict.fromkeys((row.data, row.method, row.errors["count"]) for row in rows):
        own = [row for row in rows if (row.data, row.method, row.errors["count"]) == key]
        frames = sum(row.frames for row in own)
        errors = {"count": key[2], "radius_percent": records.median(row.error("radius_percent") for row in own)}
        for name in ("normal_deg", "relief_um", "level_um"):
            errors[name] = records.mean(row.error(name) for row in own for _ in range(row.frames))
        note = "; ".join(dict.fromkeys(row.note for row in own if row.note))
        merged.append(dataclasses.replace(own[0], errors=errors, frames=frames, seed=None, note=note))
    return merged


def drawn(fold: sets.Fold, count: int, seed: int, primed: bool) -> sets.Fold:
    """The fold with so many of its presses, the same at every run."""
    sensor = fold.sensor if primed else fold.sensor.without_prior()
    return fold._replace(sensor=sensor, learned=random.Random(seed).sample(list(fold.learned), count))


if __name__ == "__main__":
    main_of(main)
