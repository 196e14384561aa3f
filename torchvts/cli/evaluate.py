"""Score methods on presses of balls, never on those they learned from: tables (Markdown, CSV, LaTeX), JSON, pictures.

FOLDER has gs_sdk's layout (catalog.csv, background.png, N/gelsight.png); true centers and contact radii come from label.npz or
labels.csv, otherwise from calibration. --all scores the drawn sensors and the real ones in ../shared/data or TORCHVTS_DATA.

examples:
  torchvts evaluate presses/ --sensor gelsight_mini --methods precise MLP
  torchvts evaluate --sets digit_a gelsight_pale --out out/evaluate
"""

import argparse
import shlex
import sys
import time
from pathlib import Path

from tqdm import tqdm

from .. import viz
from ..evaluation import evaluate as ev
from ..evaluation import sets
from ..evaluation.figures import set_figure
from .options import add_out, add_sensor, load_sensor
from .parser import UsageError

USAGE = "(FOLDER --sensor NAME | --all | --sets SET...) [--methods METHOD...]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="presses of balls")
    parser.add_argument("--all", action="store_true", help="every real sensor and the drawn sensors")
    parser.add_argument("--sets", nargs="+", choices=sets.SETS, metavar="SET", help=f"of {', '.join(sets.SETS)}")
    names = ", ".join(f'"{name}"' for name in ev.COMPARED)
    parser.add_argument("--methods", nargs="+", default=[], choices=ev.COMPARED, metavar="METHOD", help=f"of {names}")
    parser.add_argument("--limit", type=int, metavar="N", help="at most so many presses (of each ball of --sets)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the network that is trained (0)")
    add_out(parser, "for tables, scores.json and pictures (out/evaluate)", "out/evaluate")
    own = parser.add_argument_group("of a folder")
    add_sensor(own)
    own.add_argument(
        "--folds", type=int, default=5, metavar="N", help="cross-validation over presses (5); 1 scores what was learned from"
    )
    own.add_argument("--network", type=Path, metavar="FILE", help="a trained network to score too: nnmodel.pth or .safetensors")


def run(arguments: argparse.Namespace) -> int:
    """Score, write the tables, and print them."""
    if sum((arguments.folder is not None, arguments.all, arguments.sets is not None)) != 1:
        raise UsageError("expected one of FOLDER, --all, --sets")
    start = time.perf_counter()
    command = shlex.join(["torchvts", *sys.argv[1:]])
    done = measure(arguments)
    print(ev.write_tables(done, arguments.out, command))
    for evaluation in done:
        if any(name != "flat" for name in evaluation.outputs):
            viz.save_figure(set_figure(evaluation), arguments.out / f"{evaluation.data.name}.png")
    print(f"{time.perf_counter() - start:.0f} s; tables, scores.json and pictures in {arguments.out}")
    return 0


def measure(arguments: argparse.Namespace) -> list[ev.Evaluation]:
    """Score what the arguments name."""
    methods, limit, seed = arguments.methods, arguments.limit, arguments.seed
    if arguments.folder is None:
        if arguments.network is not None:
            raise UsageError("--network: expected FOLDER beside it, the presses of the network's unit")
        names = sets.SETS if arguments.all else arguments.sets
        return ev.evaluate_all(names, sets.data_folder(str(Path(__file__).parent)), methods, limit=limit, seed=seed, progress=True)
    sensor = load_sensor(arguments.sensor or "gelsight_mini")
    data = sets.from_folder(arguments.folder, sensor, folds=arguments.folds, network=arguments.network, limit=limit)
    with tqdm(desc="evaluating", leave=False, disable=None) as bar:
        return [ev.evaluate(data, methods, seed=seed, bar=bar)]
