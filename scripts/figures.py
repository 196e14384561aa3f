"""Draw a picture of docs/ again from the table that its script saved; nothing is measured.

python scripts/figures.py speed out/bench/bench.json docs/speed_accuracy.png
python scripts/figures.py overview tests/breaking_points.json docs/failures/overview.png
python scripts/figures.py confidence out/confidence.json docs/confidence.png
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from lab import failure_figures, figures, rows, stability
from lab.commands import main_of, parser_of

DRAW: dict[str, Callable[[str], Figure]] = {
    "speed": lambda text: figures.speed_figure(rows.from_json(text)),
    "overview": lambda text: failure_figures.overview_figure(stability.points_from_json(text)[0]),
    "confidence": lambda text: figures.coverage_figure(rows.from_json(text)),
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("kind", choices=DRAW)
    parser.add_argument("table", type=Path, help="JSON")
    parser.add_argument("picture", type=Path, help="PNG, at most 256 colours")
    arguments = parser.parse_args(argv)
    figures.save_small(DRAW[arguments.kind](arguments.table.read_text(encoding="utf-8")), arguments.picture)
    print(f"wrote {arguments.picture}")
    return 0


if __name__ == "__main__":
    main_of(main)
