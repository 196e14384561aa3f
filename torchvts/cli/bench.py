"""Measure speed as a user meets it, then speed and error of all methods together; print the tables, and draw the second.

Methods of other libraries are timed in the same run. Rows of a real sensor need ../shared/data or the folder in TORCHVTS_DATA.

example:
  torchvts bench --out out/bench --threads 2
"""

import argparse
import dataclasses
import json
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from .. import viz
from ..compiled import library
from ..core.checks import check_integer
from ..evaluation import figures, rows, speed, user_speed
from ..evaluation.sets import data_folder
from .options import add_out

USAGE = "[--out FOLDER] [--threads N] [--only user|methods] [--long] [--chart FILE]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    add_out(parser, "for the tables and the chart (out/bench)", "out/bench")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), metavar="N", help="all cores if not given")
    parser.add_argument("--only", choices=("user", "methods"), help="measure one of the two tables")
    parser.add_argument("--calls", type=int, default=100, metavar="N", help="frames of each row of the user's table (100)")
    parser.add_argument("--long", action="store_true", help="10,000 frames every 20 ms too, for the 99th percentile")
    parser.add_argument("--chart", type=Path, metavar="FILE", help="write the chart of errors here too")


def run(arguments: argparse.Namespace) -> int:
    """Measure, write tables and the chart, and print the tables."""
    torch.set_num_threads(check_integer("--threads", arguments.threads, 1))
    folder = data_folder(str(Path(__file__).parent))
    data = folder if (folder / "gelsight_mini_a").is_dir() else None
    if library() is None:
        print("no compiled kernels: PyTorch does all the work, which takes 4 to 17 times as long")
    if arguments.only != "methods":
        _as_user(arguments, data)
    if arguments.only != "user":
        _methods(arguments, data)
    return 0


def _as_user(arguments: argparse.Namespace, data: Path | None) -> None:
    """The table of frames as a user runs them."""
    with tqdm(unit="row", disable=None) as bar:
        measured = user_speed.run(data, partial(_show, bar), arguments.calls, arguments.long)
    text = user_speed.table(measured)
    rows.write_files(
        arguments.out, {"user.md": text + "\n", "user.json": json.dumps(measured, default=dataclasses.asdict, indent=1)}
    )
    print(text)
    print(f"\nuser.md and user.json in {arguments.out}")


def _methods(arguments: argparse.Namespace, data: Path | None) -> None:
    """The table of all methods with their errors, and error against time."""
    command = f"torchvts bench --threads {arguments.threads}"
    with tqdm(unit="row", disable=None) as bar:
        measured = speed.run(command, partial(_show, bar), data)
    time = measured[0].time
    machine = f"{time.machine}, {arguments.threads} threads, float32" if time else ""
    text = "\n".join([speed.table(measured), "", machine, *speed.peer_ratios(measured)])
    rows.write_files(arguments.out, {"bench.md": text + "\n", "bench.json": rows.to_json(measured)})
    print(text)
    figure = figures.speed_figure(measured)
    for path in filter(None, (arguments.out / "speed_accuracy.png", arguments.chart)):
        viz.save_figure(figure, path)
    print(f"\nbench.md, bench.json and speed_accuracy.png in {arguments.out}")


def _show(bar: Any, name: str) -> None:
    bar.set_postfix_str(name)
    bar.update()
