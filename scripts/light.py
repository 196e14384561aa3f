"""What becomes of depth in another light than that at calibration: tables, and every reading as JSON.

python scripts/light.py --out out/light
python scripts/light.py --sets lights digit_a --modes fast --limit 4
"""

import json
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

import torchvts
from lab import light
from lab.commands import main_of, parser_of
from lab.rows import write_files
from torchvts.pipeline import MODES


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--sets", nargs="+", default=light.UNITS, choices=light.UNITS, help="real sets and drawn ones")
    parser.add_argument("--modes", nargs="+", default=["fast", "precise"], choices=MODES, help="of the pipeline")
    parser.add_argument("--limit", type=int, default=10, metavar="N", help="at most so many frames of each set")
    parser.add_argument("--out", type=Path, default=Path("out/light"), help="for table.md and readings.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    start, readings, notes = time.perf_counter(), [], {}
    for name in tqdm(arguments.sets, unit="set", disable=None):
        try:
            for mode in arguments.modes:
                readings += light.measure(name, mode, arguments.limit)
            notes[name] = light.unit_of(name).note
        except (ValueError, OSError, RuntimeError) as error:  # the other sets are still measured
            notes[name] = f"failed: {error}"
    text, command = light.tables(readings, notes), shlex.join(["python", "scripts/light.py", *(argv or sys.argv[1:])])
    rows = [reading._asdict() for reading in readings]
    record = {"command": command, "of": torchvts.__file__, "notes": notes, "readings": rows}
    write_files(arguments.out, {"table.md": f"{text}\n\n`{command}`\n", "readings.json": json.dumps(record, indent=1) + "\n"})
    print(f"{text}\n\n{time.perf_counter() - start:.0f} s, of {torchvts.__file__}; table.md and readings.json in {arguments.out}")
    return 0


if __name__ == "__main__":
    main_of(main)
