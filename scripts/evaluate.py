"""Score methods on presses of balls of known size: a table, JSON rows, error maps.

python scripts/evaluate.py ../shared/data/gelsight_mini_a --out out/evaluate
python scripts/evaluate.py presses --test other_presses --methods "response precise" MLP

The folder is in gs_sdk's layout (catalog.csv, background.png, N/gelsight.png). True centers and contact radii come from label.npz
or labels.csv, and without these from calibrate. Methods do not use them: they learn from the balls that calibrate finds.
"""

import argparse
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torchvts as vts
from torchvts import viz
from torchvts.core.files import write_atomically
from torchvts.evaluation import evaluate as ev
from torchvts.evaluation.figures import error_figure, error_map_name, press_figure


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="presses of balls, in gs_sdk's layout")
    parser.add_argument("--sensor", default="gelsight_mini", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--methods", nargs="+", default=[], metavar="METHOD", help=", ".join(f'"{m}"' for m in ev.COMPARED))
    parser.add_argument("--folds", type=int, default=5, help="cross-validation over presses; 1 scores what was learned from")
    parser.add_argument("--test", type=Path, help="a second folder: learn from all of the first, score on this one")
    parser.add_argument("--network", type=Path, help="a trained network to score too: gs_sdk's nnmodel.pth, or .safetensors")
    parser.add_argument("--limit", type=int, help="use only so many presses, spread over the catalog")
    parser.add_argument("--seed", type=int, default=0, help="seed of the network that is trained")
    parser.add_argument("--out", type=Path, default=Path("out/evaluate"), help="folder for table.md, scores.json and pictures")
    arguments = parser.parse_args(argv)
    sensor = vts.Sensor.load(arguments.sensor)
    start = time.perf_counter()
    result = ev.evaluate(
        arguments.folder,
        sensor,
        arguments.methods,
        folds=arguments.folds,
        test=arguments.test,
        network_path=arguments.network,
        limit=arguments.limit,
        seed=arguments.seed,
        progress=True,
    )
    command = f"python {shlex.join(sys.argv if argv is None else ['scripts/evaluate.py', *argv])}"
    lines = [ev.table(result), "", f"{result.how}; {result.rows[0].frames} presses scored"]
    lines.append("means over presses; medians for radius and center of the sphere fitted to depth; absolute error of the apex")
    if result.not_scored:
        lines.append(f"not scored, no contact radius: {', '.join(result.not_scored)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, text in (("table.md", "\n".join([*lines, "", f"`{command}`"])), ("scores.json", ev.to_json(result, command))):
        with write_atomically(arguments.out / name) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
    for row in result.rows:
        viz.save_figure(error_figure(result, row.method), arguments.out / error_map_name(row.method))
    compared = [name for name in ("response precise", "MLP") if name in result.outputs] or list(result.outputs)[:2]
    viz.save_figure(press_figure(result, compared), arguments.out / "press.png")
    print("\n".join(lines))
    print(f"{time.perf_counter() - start:.0f} s; table.md, scores.json and pictures in {arguments.out}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
