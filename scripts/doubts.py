"""What calibrations say of genuine presses, and of mistakes: a table, and every answer as JSON.

python scripts/doubts.py --out out/doubts
python scripts/doubts.py --units digit_a drawn_0 --parts genuine --draws 2
"""

import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from lab import doubts
from lab.commands import main_of, parser_of
from lab.rows import write_files

PARTS = ("genuine", "mistakes", "backgrounds")


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--units", nargs="+", default=doubts.UNITS, choices=doubts.UNITS, help="real sets and drawn ones")
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS, help="what is given")
    parser.add_argument("--mistakes", nargs="+", default=list(doubts.MISTAKES), choices=doubts.MISTAKES, help="of mistakes")
    parser.add_argument("--draws", type=int, default=4, metavar="N", help="subsets of each size")
    parser.add_argument("--out", type=Path, default=Path("out/doubts"), help="for table.md and answers.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    answers = []
    for part in arguments.parts:
        for name in tqdm(arguments.units, desc=part, unit="set", disable=None):
            answers += _of(part, name, arguments.draws, arguments.mistakes)
    text, command = doubts.table(answers), shlex.join(["python", "scripts/doubts.py", *(argv or sys.argv[1:])])
    rows = json.dumps([one._asdict() for one in answers], indent=1)
    write_files(arguments.out, {"table.md": f"{text}\n\n`{command}`\n", "answers.json": rows + "\n"})
    print(f"{text}\n\ntable.md and answers.json in {arguments.out}")
    return 0


def _of(part: str, name: str, draws: int, mistakes: Sequence[str]) -> Iterator[doubts.Answer]:
    if part == "genuine":
        return doubts.genuine(name, draws)
    return doubts.every_background(name) if part == "backgrounds" else doubts.mistaken(name, draws, mistakes)


if __name__ == "__main__":
    main_of(main)
