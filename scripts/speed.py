"""Speed as a user meets it; then speed and error of all methods together; exported files beside the library: tables and a chart.

python scripts/speed.py --out out/bench --threads 2
python scripts/speed.py --only export --threads 2

Methods of other libraries are timed in the same run. Rows of a real sensor need ../shared/data or the folder in TORCHVTS_DATA.
Exported files are timed of the real sensor, without one of the drawn rig.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from lab import figures, frames, rows, speed
from lab.commands import main_of, parser_of
from lab.sets import data_folder
from torchvts import viz


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/bench"), help="for the tables and the chart")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help="all cores if not given")
    parser.add_argument("--only", choices=("user", "methods", "export"), help="measure one table; export only where asked for")
    parser.add_argument("--calls", type=int, default=100, help="frames of each row of the tables of the user and of exported files")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    data = data_folder() if (data_folder() / "gelsight_mini_a").is_dir() else None
    if arguments.only == "export":
        unit = frames.drawn((240, 320)) if data is None else frames.mini(data, (240, 320))
        print(f"{unit.name}, 320x240, {arguments.threads} threads, median ms of a frame")
        print(frames.export_table(unit, arguments.calls))
        return 0
    with tqdm(unit="row", disable=None) as bar:

        def show(name: str) -> None:
            bar.set_postfix_str(name)
            bar.update()

        if arguments.only != "methods":
            measured = frames.as_user(show, data, arguments.calls)
            keep(arguments.out, "user", frames.user_table(measured), measured)
        if arguments.only != "user":
            measured = speed.methods(show, data)
            keep(arguments.out, "bench", speed.methods_table(measured), measured)
            viz.save_figure(figures.speed_figure(measured), arguments.out / "speed_accuracy.png")
    return 0


def keep(out: Path, name: str, text: str, measured: list[rows.Row]) -> None:
    """Print a table, and write it as Markdown beside its rows in JSON."""
    command = f"python scripts/speed.py {' '.join(sys.argv[1:])}".rstrip()
    rows.write_files(out, {f"{name}.md": f"{text}\n\n`{command}`\n", f"{name}.json": rows.to_json(measured)})
    print(f"{text}\n\n{name}.md and {name}.json in {out}\n")


if __name__ == "__main__":
    main_of(main)
