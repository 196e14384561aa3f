"""Where each method breaks: all corruptions of the gallery, a table, pictures, and the breaking points that a test checks.

python scripts/stability.py [--out out/stability] [--seeds 3] [--keep]

--keep also writes docs/failures, the table of breaking points in docs/where_methods_fail.md, and tests/breaking_points.json;
--redraw only draws docs/failures/overview.png again, from that file.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from lab import stability
from lab.commands import main_of, parser_of
from lab.failure_figures import corruption_figure, overview_figure
from lab.figures import save_small
from lab.gallery import CORRUPTIONS
from lab.rows import write_files
from lab.stability import SWEPT, Breaking

ROOT = Path(__file__).resolve().parents[1]


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/stability"))
    parser.add_argument("--seeds", type=int, default=3, help="number of noises and places of each press")
    parser.add_argument("--workers", type=int, default=2, help="processes; with 0 this process does the work")
    names = list(CORRUPTIONS)
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="CORRUPTION", help=", ".join(names))
    parser.add_argument("--keep", action="store_true", help="write docs/ and tests/breaking_points.json too")
    parser.add_argument("--redraw", action="store_true", help="measure nothing")
    arguments = parser.parse_args(argv)
    if arguments.redraw:
        points, _ = stability.points_from_json((ROOT / "tests" / "breaking_points.json").read_text(encoding="utf-8"))
        save_small(overview_figure(points), ROOT / "docs" / "failures" / "overview.png")
        return 0
    if arguments.keep and arguments.only != names:
        parser.error("--keep: expected all corruptions, got --only")
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    total = len(SWEPT) * arguments.seeds * sum(len(CORRUPTIONS[name].severities) for name in arguments.only)
    with tqdm(total=total, unit="row", disable=None) as bar:
        rows = stability.sweep(SWEPT, arguments.only, arguments.seeds, arguments.workers, bar.update)
    points = stability.breaking_points(rows)
    print(write_tables(points, arguments.seeds, arguments.out, arguments.keep))
    pictures = ROOT / "docs" / "failures" if arguments.keep else arguments.out
    pictures.mkdir(exist_ok=True)
    save_small(overview_figure(points), pictures / "overview.png")
    for name in tqdm(arguments.only, unit="picture", disable=None):
        here, own = [row for row in rows if row.data == name], [point for point in points if point.corruption == name]
        save_small(corruption_figure(CORRUPTIONS[name], here, own), pictures / f"{name.replace(' ', '_')}.png")
    return 0


def write_tables(points: Sequence[Breaking], seeds: int, out: Path, keep: bool) -> str:
    """Write all text files; returns the table of breaking points."""
    kept = stability.points_to_json(points, "python scripts/stability.py --keep", seeds)
    points, _ = stability.points_from_json(kept)  # rounded
    text = f"{stability.table(points)}\n\n{stability.LIMITS}\n"
    written = {out / "breaking_points.md": text, out / "breaking_points.json": kept}
    if keep:
        page = ROOT / "docs" / "where_methods_fail.md"
        written[ROOT / "tests" / "breaking_points.json"] = kept
        written[page] = stability.updated_page(page.read_text(encoding="utf-8"), points)
    for path, content in written.items():
        write_files(path.parent, {path.name: content})
    return text


if __name__ == "__main__":
    main_of(main)
