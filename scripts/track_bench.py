"""Tracking bench: objects that move, rendered and measured, tracked against their first frame; table and JSON.

python scripts/track_bench.py --out out/track_bench
python scripts/track_bench.py --motions slow --noises "slopes off by 3 degrees" --seeds 1 4 11 --sensors 1 2 3 --out out/wrong
"""

import dataclasses
import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
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
    parser.add_argument(
        "--normalflow", type=Path, metavar="FOLDER", help="a checkout of NormalFlow, to track the same frames by it"
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(arguments.threads)
    normalflow = None if arguments.normalflow is None else load_normalflow(arguments.normalflow)
    arguments.out.mkdir(parents=True, exist_ok=True)
    rows = []
    chosen = (arguments.objects, arguments.motions, arguments.noises, arguments.seeds, arguments.sensors)
    with tqdm(unit="track", disable=None) as bar:
        for row, track in tracking.run_tracking(*chosen):
            rows.append(row)
            if normalflow is not None:
                peer = dataclasses.replace(row, method="NormalFlow", each={key: [] for key in tracking.EACH})
                rows.append(tracking.follow_by_normalflow(track, normalflow, peer))
            bar.update()
    text = (
        f"320 x 240, 8 bits, seeds {arguments.seeds}, sensors {arguments.sensors}; {machine()}\n\n{tracking.tracking_table(rows)}\n"
    )
    write_files(arguments.out, {"table.md": text, "tracks.json": to_json(rows)})
    print(text)
    return 0


def load_normalflow(folder: Path) -> tracking.NormalFlow:
    """The code of a checkout of github.com/rpl-cmu/normalflow; OpenCV 5 reads its lines of coordinates as columns then."""
    if not (folder / "normalflow" / "registration.py").is_file():
        raise FileNotFoundError(f"{folder}: expected a checkout of NormalFlow, found no normalflow/registration.py there")
    sys.path.insert(0, str(folder))
    remap = cv2.remap

    def by_columns(image: Any, x: Any, y: Any, *rest: Any) -> Any:
        x, y = (np.asarray(place, dtype=np.float32) for place in (x, y))
        return remap(image, x.reshape(len(x), -1), y.reshape(len(y), -1), *rest)

    cv2.remap = by_columns
    registration, utils = (importlib.import_module(f"normalflow.{name}") for name in ("registration", "utils"))
    if not hasattr(utils, "Frame"):
        raise ValueError(f"{folder}: expected a NormalFlow whose utils.py has a class Frame, this one is older")
    return tracking.NormalFlow(utils.Frame, registration.normalflow, registration.LoseTrackError)


if __name__ == "__main__":
    main_of(main)
