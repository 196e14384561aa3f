"""Score methods on presses: tables (Markdown, CSV, LaTeX), JSON, pictures.

python scripts/evaluate.py --all --out out/evaluate
python scripts/evaluate.py --sets digit_a gelsight_pale
python scripts/evaluate.py ../shared/data/gelsight_mini_a --sensor gelsight_mini --methods precise MLP

--all scores every real sensor in ../shared/data, or in the folder TORCHVTS_DATA, and the drawn sensors. A folder of your own is in
gs_sdk's layout (catalog.csv, background.png, N/gelsight.png); true centers and contact radii come from label.npz or labels.csv, and
without these from calibrate. Methods do not use them: they learn from the balls that calibrate finds.
"""

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

import torchvts as vts
from torchvts import viz
from torchvts.evaluation import evaluate as ev
from torchvts.evaluation import sets
from torchvts.evaluation.figures import set_figure


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("folder", nargs="?", type=Path, help="presses of balls, in gs_sdk's layout")
    what.add_argument("--all", action="store_true", help="every real sensor and the drawn sensors")
    what.add_argument("--sets", nargs="+", choices=sets.SETS, metavar="SET", help=", ".join(sets.SETS))
    names = ", ".join(f'"{name}"' for name in ev.COMPARED)
    parser.add_argument("--methods", nargs="+", default=[], choices=ev.COMPARED, metavar="METHOD", help=names)
    parser.add_argument("--limit", type=int, help="use only so many presses (of each ball of --sets), spread over the catalog")
    parser.add_argument("--seed", type=int, default=0, help="seed of the network that is trained")
    parser.add_argument("--out", type=Path, default=Path("out/evaluate"), help="folder for tables, scores.json and pictures")
    own = parser.add_argument_group("of a folder")
    own.add_argument("--sensor", default="gelsight_mini", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    own.add_argument("--folds", type=int, default=5, help="cross-validation over presses; 1 scores what was learned from")
    own.add_argument("--network", type=Path, help="a trained network to score too: gs_sdk's nnmodel.pth, or .safetensors")
    arguments = parser.parse_args(argv)
    start = time.perf_counter()
    command = f"python {shlex.join(sys.argv if argv is None else ['scripts/evaluate.py', *argv])}"
    done = measure(arguments)
    print(ev.write_tables(done, arguments.out, command))
    for evaluation in done:
        if any(name != "flat" for name in evaluation.outputs):
            viz.save_figure(set_figure(evaluation), arguments.out / f"{evaluation.data.name}.png")
    print(f"{time.perf_counter() - start:.0f} s; tables, scores.json and pictures in {arguments.out}")
    return 0


def measure(arguments: argparse.Namespace) -> list[ev.Evaluation]:
    methods, limit, seed = arguments.methods, arguments.limit, arguments.seed
    if arguments.folder is None:
        names = sets.SETS if arguments.all else arguments.sets
        return ev.evaluate_all(names, sets.data_folder(__file__), methods, limit=limit, seed=seed, progress=True)
    sensor = vts.Sensor.load(arguments.sensor)
    data = sets.from_folder(arguments.folder, sensor, folds=arguments.folds, network=arguments.network, limit=limit)
    with tqdm(desc="evaluating", leave=False) as bar:
        return [ev.evaluate(data, methods, seed=seed, bar=bar)]


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
