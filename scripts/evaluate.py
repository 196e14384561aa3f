"""Score methods on presses of balls of known size: a table, JSON rows, error maps.

python scripts/evaluate.py ../shared/data/gelsight_mini_a --out out/evaluate
python scripts/evaluate.py presses --test other_presses --methods "response precise" MLP

The folder is one of gs_sdk's (catalog.csv, background.png, N/gelsight.png); true centers and contact radii come from label.npz or
labels.csv, and where there are none from calibrate. Methods do not see them: they learn from the balls that calibrate finds.
"""

import argparse
import shlex
import sys
import time
from pathlib import Path

import torchvts as vts
from torchvts import viz
from torchvts.core.files import write_atomically
from torchvts.evaluation import score as ev


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="presses of balls, in gs_sdk's layout")
    parser.add_argument("--sensor", default="gelsight_mini", help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--methods", nargs="+", default=[], metavar="METHOD", help=", ".join(f'"{m}"' for m in ev.METHODS))
    parser.add_argument("--folds", type=int, default=5, help="cross-validation over presses; 1 judges what was learned from")
    parser.add_argument("--test", type=Path, help="a second folder: learn from all of the first, judge on this one")
    parser.add_argument("--network", type=Path, help="a trained network to judge too: gs_sdk's nnmodel.pth, or .safetensors")
    parser.add_argument("--limit", type=int, help="take only so many presses, spread over the catalog")
    parser.add_argument("--seed", type=int, default=0, help="of the network that is trained")
    parser.add_argument("--out", type=Path, default=Path("out/evaluate"), help="folder for table.md, scores.json and pictures")
    arguments = parser.parse_args()
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
    command = f"python {shlex.join(sys.argv)}"
    lines = [ev.table(result), "", f"{result.how}; {result.summaries[0].presses} presses scored"]
    lines.append("means over presses; medians for radius and center of the sphere fitted to depth; absolute error of the apex")
    if result.not_scored:
        lines.append(f"not scored, no contact radius: {', '.join(result.not_scored)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, text in (("table.md", "\n".join([*lines, "", f"`{command}`"])), ("scores.json", ev.to_json(result, command))):
        with write_atomically(arguments.out / name) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
    for row in result.summaries:
        viz.save_figure(ev.error_figure(result, row.method), arguments.out / ev.error_map_name(row.method))
    compared = [name for name in ("response precise", "MLP") if name in result.outputs] or list(result.outputs)[:2]
    viz.save_figure(ev.press_figure(result, compared), arguments.out / "press.png")
    print("\n".join(lines))
    print(f"{time.perf_counter() - start:.0f} s; table.md, scores.json and pictures in {arguments.out}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
