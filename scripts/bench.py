"""Measure speed and error together, print the table, and draw one against the other.

python scripts/bench.py [--out out/bench] [--threads 2] [--chart docs/speed_accuracy.png]

Methods of other libraries are timed in the same run. Rows of a real sensor need ../shared/data, or the folder in TORCHVTS_DATA.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from torchvts import viz
from torchvts.evaluation import figures, rows, speed
from torchvts.evaluation.sets import data_folder


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench"), help="folder for bench.md, bench.json and the chart")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--chart", type=Path, help="write the chart here too")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    data = data_folder(__file__)
    command = f"python scripts/bench.py --threads {arguments.threads}"
    with tqdm(unit="row") as bar:
        measured = speed.run(command, lambda name: (bar.set_postfix_str(name), bar.update())[0], data if data.is_dir() else None)
    time = measured[0].time
    machine = f"{time.machine}, {arguments.threads} threads, float32" if time else ""
    text = "\n".join([speed.table(measured), "", machine, *speed.peer_ratios(measured)])
    rows.write_files(arguments.out, {"bench.md": text + "\n", "bench.json": rows.to_json(measured)})
    print(text)
    figure = figures.speed_figure(measured)
    for path in filter(None, (arguments.out / "speed_accuracy.png", arguments.chart)):
        viz.save_figure(figure, path)
    print(f"\nbench.md, bench.json and speed_accuracy.png in {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
