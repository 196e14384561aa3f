"""Measure speed and error of all methods together, print the table, and draw one against the other.

Methods of other libraries are timed in the same run. Rows of a real sensor need ../shared/data or the folder in TORCHVTS_DATA.

example:
  torchvts bench --out out/bench --threads 2
"""

import argparse
from pathlib import Path

import torch
from tqdm import tqdm

from .. import viz
from ..evaluation import figures, rows, speed
from ..evaluation.sets import data_folder
from .options import add_out

USAGE = "[--out FOLDER] [--threads N] [--chart FILE]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_out(parser, "for bench.md, bench.json and the chart (out/bench)", "out/bench")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), metavar="N", help="all cores if not given")
    parser.add_argument("--chart", type=Path, metavar="FILE", help="write the chart here too")


def run(arguments: argparse.Namespace) -> int:
    """Measure, write table and chart, and print the table."""
    torch.set_num_threads(arguments.threads)
    data = data_folder(str(Path(__file__).parent))
    command = f"torchvts bench --threads {arguments.threads}"

    def step(name: str) -> None:
        bar.set_postfix_str(name)
        bar.update()

    with tqdm(unit="row", disable=None) as bar:
        measured = speed.run(command, step, data if data.is_dir() else None)
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
