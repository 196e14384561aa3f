"""Tracking bench: objects that move, rendered and measured, tracked against their first frame; table and JSON.

python scripts/track_bench.py --out out/track_bench
python scripts/track_bench.py --motions slow --noises "slopes off by 3 degrees" --seeds 1 4 11 --sensors 1 2 3 --out out/wrong
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from lab import tracking
from lab.commands import main_of, parser_of
from lab.rows import to_json, write_files
from lab.timing import machine


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--objects", nargs="+", default=tracking.OBJECTS, metavar="NAME", help="of torchvts.scenes.objects")
    parser.add_argument("--motions", nargs="+", default=list(tracking.MOTIONS), choices=list(tracking.MOTIONS))
    parser.add_argument("--noises", nargs="+", default=list(tracking.NOISES), choices=list(tracking.NOISES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[1], help="of motions and noise of the images")
    parser.add_argument("--sensors", nargs="+", type=int, default=[1], help="seeds of errors of slopes, from 1")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    chosen = (arguments.objects, arguments.motions, arguments.noises, arguments.seeds, arguments.sensors)
    with tqdm(unit="track", disable=None) as bar:
        for row, _ in tracking.run_tracking(*chosen):
            rows.append(row)
            bar.update()
    text = (
        f"320 x 240, 8 bits, seeds {arguments.seeds}, sensors {arguments.sensors}; {machine()}\n\n{tracking.tracking_table(rows)}\n"
    )
    write_files(arguments.out, {"table.md": text, "tracks.json": to_json(rows)})
    print(text)
    return 0


if __name__ == "__main__":
    main_of(main)
