"""Motion of printed dots: errors against drawn truth beside other ways, slip, films, and real sensors there and back; tables.

python scripts/motion.py [pairs field slip film real] [--seeds 10] [--out out/motion]
python scripts/motion.py --picture docs/motion.gif
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from lab import motion
from lab.commands import main_of, parser_of
from lab.rows import write_files
from lab.sets import data_folder

PARTS = ("pairs", "field", "slip", "film", "real")


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--pairs", nargs="+", choices=list(motion.PAIRS), default=list(motion.PAIRS), metavar="PAIR")
    parser.add_argument("--seeds", type=int, default=10, help="noises of each pair, on two skins")
    parser.add_argument("--frames", type=int, default=40, help="of a film")
    parser.add_argument("--limit", type=int, default=8, help="frames of each real sensor")
    parser.add_argument("--data", type=Path, default=data_folder(), help="folder of the real sensors")
    parser.add_argument("--picture", type=Path, metavar="FILE.gif", help="only draw a film")
    parser.add_argument("--out", type=Path, default=Path("out/motion"))
    arguments = parser.parse_args(argv)
    if unknown := set(arguments.parts) - set(PARTS):
        parser.error(f"parts: expected some of {', '.join(PARTS)}, got {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    if arguments.picture is not None:
        motion.picture(arguments.picture, arguments.frames)
        print(f"wrote {arguments.picture}")
        return 0
    arguments.out.mkdir(parents=True, exist_ok=True)
    run: dict[str, Callable[[], Iterable[Any]]] = {
        "pairs": lambda: motion.run_pairs(arguments.pairs, arguments.seeds),
        "field": lambda: motion.run_fields(max(1, arguments.seeds // 3)),
        "slip": motion.run_slips,
        "film": lambda: (row for gone in (0.0, 0.5) for row in motion.run_film(arguments.frames, gone)),
        "real": lambda: motion.run_real(arguments.data, arguments.limit),
    }
    for part in arguments.parts:
        rows = list(run[part]())
        text = motion.table(part, rows)
        write_files(arguments.out, {f"{part}.md": text + "\n", f"{part}.json": motion.to_json(rows)})
        print(f"{text}\n", flush=True)
    return 0


if __name__ == "__main__":
    main_of(main)
