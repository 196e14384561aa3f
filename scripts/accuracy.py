"""Score methods on presses of balls, never on those they learned from: a table, its figures as JSON, pictures.

FOLDER has gs_sdk's layout (catalog.csv, background.png, N/gelsight.png); true centers and contact radii come from label.npz or
labels.csv, otherwise from calibration. --all scores the drawn sensors and the real ones in ../shared/data or TORCHVTS_DATA.

python scripts/accuracy.py presses/ --sensor gelsight_mini --methods precise MLP
python scripts/accuracy.py --sets digit_a gelsight_pale --out out/accuracy
python scripts/accuracy.py --all --normals my_networks:normals
"""

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tqdm import tqdm

from lab import evaluate as ev
from lab import sets
from lab.commands import main_of, parser_of
from lab.figures import set_figure
from lab.methods import own_methods
from torchvts import Sensor, viz


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="presses of balls")
    parser.add_argument("--all", action="store_true", help="every real sensor and the drawn sensors")
    parser.add_argument("--sets", nargs="+", choices=sets.SETS, metavar="SET", help=f"of {', '.join(sets.SETS)}")
    names = ", ".join(f'"{name}"' for name in ev.COMPARED)
    parser.add_argument("--methods", nargs="+", default=[], choices=ev.COMPARED, metavar="METHOD", help=f"of {names}")
    factory = "MODULE:FACTORY"
    parser.add_argument("--normals", metavar=factory, help="your module: factory(training) gives compensated images to normals")
    parser.add_argument("--depth", metavar=factory, help="your network: factory(training) gives images to depth in mm")
    parser.add_argument("--limit", type=int, metavar="N", help="at most so many presses (of each ball of --sets)")
    parser.add_argument("--out", type=Path, default=Path("out/accuracy"), help="for table.md, scores.json and pictures")
    own = parser.add_argument_group("of a folder")
    own.add_argument("--sensor", default="gelsight_mini", metavar="NAME", help="YAML file or shipped name")
    own.add_argument("--folds", type=int, default=5, metavar="N", help="cross-validation; 1 scores what was learned from")
    own.add_argument("--network", type=Path, metavar="FILE", help="a trained network to score too: nnmodel.pth or .safetensors")
    arguments = parser.parse_args(argv)
    if sum((arguments.folder is not None, arguments.all, arguments.sets is not None)) != 1:
        parser.error("expected one of FOLDER, --all, --sets")
    if arguments.folder is None and arguments.network is not None:
        parser.error("--network: expected FOLDER beside it, the presses of the network's unit")
    start = time.perf_counter()
    methods, limit, own = arguments.methods, arguments.limit, own_methods(arguments.normals, arguments.depth)
    if arguments.folder is None:
        names = sets.SETS if arguments.all else arguments.sets
        done = ev.evaluate_all(names, sets.data_folder(), methods, limit=limit, own=own, progress=True)
    else:
        sensor = Sensor.load(arguments.sensor)
        data = sets.from_folder(arguments.folder, sensor, folds=arguments.folds, network=arguments.network, limit=limit)
        data = replace(data, methods=(*data.methods, *own))
        with tqdm(desc="evaluating", leave=False, disable=None) as bar:
            done = [ev.evaluate(data, methods, bar=bar)]
    print(ev.write_tables(done, arguments.out, shlex.join(["python", "scripts/accuracy.py", *(argv or sys.argv[1:])])))
    for evaluation in done:
        if any(name != "flat" for name in evaluation.outputs):
            viz.save_figure(set_figure(evaluation), arguments.out / f"{evaluation.data.name}.png")
    print(f"{time.perf_counter() - start:.0f} s; table.md, scores.json and pictures in {arguments.out}")
    return 0


if __name__ == "__main__":
    main_of(main)
