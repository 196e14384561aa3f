"""Measure speed as a user meets it, then speed and error together; print the tables, and draw both.

python scripts/bench.py [--out out/bench] [--threads 2] [--chart docs/speed_accuracy.png] [--only user] [--long]

Methods of other libraries are timed in the same run. Rows of a real sensor need ../shared/data, or the folder in TORCHVTS_DATA.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from tqdm import tqdm

from torchvts import viz
from torchvts.accelerated import library
from torchvts.evaluation import figures, rows, speed, user_speed
from torchvts.evaluation.sets import data_folder


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench"), help="folder for bench.md, bench.json and the chart")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--chart", type=Path, help="write the chart here too")
    parser.add_argument("--only", choices=("user", "methods"), help="measure one of the two tables only")
    parser.add_argument("--calls", type=int, default=100, help="frames of each row of the user's table")
    parser.add_argument("--long", action="store_true", help="10,000 frames every 20 ms too, for the 99th percentile")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    data: Path | None = data_folder(__file__)
    data = data if data is not None and (data / "gelsight_mini_a").is_dir() else None
    if library() is None:
        print("no compiled kernels: PyTorch does all the work, two to three times as slowly")
    if arguments.only != "methods":
        as_user(arguments, data)
    if arguments.only != "user":
        methods(arguments, data)
    return 0


def as_user(arguments: argparse.Namespace, data: Path | None) -> None:
    """The table and the chart of frames as a user runs them."""
    with tqdm(unit="row") as bar:
        measured = user_speed.run(data, partial(_show, bar), arguments.calls, arguments.long)
    text = user_speed.table(measured)
    rows.write_files(
        arguments.out, {"user.md": text + "\n", "user.json": json.dumps(measured, default=dataclasses.asdict, indent=1)}
    )
    print(text)
    viz.save_figure(figures.user_speed_figure(measured), arguments.out / "speed.png")
    print(f"\nuser.md, user.json and speed.png in {arguments.out}")


def methods(arguments: argparse.Namespace, data: Path | None) -> None:
    """The table of all methods with their errors, and error against time."""
    command = f"python scripts/bench.py --threads {arguments.threads}"
    with tqdm(unit="row") as bar:
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


def _show(bar: "tqdm[object]", name: str) -> None:
    bar.set_postfix_str(name)
    bar.update()


if __name__ == "__main__":
    sys.exit(main())
