"""Where each method breaks: every hard scene of the gallery, a table, pictures, and the breaking points that a test keeps.

python scripts/stability.py [--out out/stability] [--seeds 3] [--keep]

Rows are kept in OUT/rows.jsonl; the same command goes on where it was stopped. --keep also writes docs/failures, the lines of
docs/where_methods_fail.md that tell of breaking points, and tests/breaking_points.json.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from tqdm import tqdm

from torchvts.core.files import write_atomically
from torchvts.evaluation import stability
from torchvts.evaluation.gallery import DIALS, Dial
from torchvts.evaluation.stability import DEPTH_LIMIT, MASK, MASK_LIMIT, METHODS, NORMAL_LIMIT_DEG, Breaking, Row

ROOT = Path(__file__).resolve().parents[1]
# the two ways of the paper are broad lines, what goes almost the same way is drawn upon them
STYLES: dict[str, dict[str, Any]] = {
    "flat": {"color": "0.6", "lw": 1.2, "ls": "--"},
    "fast": {"color": "tab:blue", "lw": 4.0, "alpha": 0.55},
    "precise": {"color": "tab:orange", "lw": 4.0, "alpha": 0.7},
    "auto": {"color": "tab:red", "lw": 1.4, "ls": ":"},
    "fast, zero border": {"color": "navy", "lw": 1.2, "ls": "--"},
    "precise, plain inverse": {"color": "tab:purple", "lw": 1.4},
    "precise, blur 1 px": {"color": "tab:green", "lw": 1.4},
    "precise, cliffs": {"color": "saddlebrown", "lw": 1.4, "ls": "-."},
    "precise, pinhole": {"color": "deeppink", "lw": 1.2, "ls": (0, (1, 2))},
    MASK: {"color": "black", "lw": 1.4, "marker": "o", "ms": 3},
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/stability"))
    parser.add_argument("--seeds", type=int, default=3, help="noises and places of each press")
    parser.add_argument("--workers", type=int, default=2, help="processes; 0 for none beside this one")
    parser.add_argument("--only", nargs="+", choices=list(DIALS), default=list(DIALS), metavar="DIAL", help=", ".join(DIALS))
    parser.add_argument("--keep", action="store_true", help="write docs/ and tests/breaking_points.json too")
    arguments = parser.parse_args()
    if arguments.keep and arguments.only != list(DIALS):
        parser.error("--keep: expected all dials, got --only")
    torch.set_num_threads(1)
    arguments.out.mkdir(parents=True, exist_ok=True)
    total = len(METHODS) * arguments.seeds * sum(len(DIALS[name].severities) for name in arguments.only)
    with tqdm(total=total, unit="row") as bar:
        rows = stability.sweep(
            arguments.out / "rows.jsonl", list(METHODS), arguments.only, arguments.seeds, arguments.workers, bar.update
        )
    points = stability.breaking_points(rows)
    text = f"{stability.table(points)}\n\n{stability.LIMITS}\n"
    kept = stability.to_json(points, "python scripts/stability.py --keep", arguments.seeds)
    written = {arguments.out / "breaking_points.md": text, arguments.out / "breaking_points.json": kept}
    written[arguments.out / "rows.md"] = stability.row_table(rows) + "\n"
    if arguments.keep:
        page = ROOT / "docs" / "where_methods_fail.md"
        written |= {
            ROOT / "tests" / "breaking_points.json": kept,
            page: stability.told_in(page.read_text(encoding="utf-8"), points),
        }
    for path, content in written.items():
        with write_atomically(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    pictures = ROOT / "docs" / "failures" if arguments.keep else arguments.out
    pictures.mkdir(exist_ok=True)
    save(overview(points), pictures / "overview.png")
    for name in tqdm(arguments.only, unit="picture"):
        here = [row for row in rows if row.dial == name]
        save(picture(DIALS[name], here, [p for p in points if p.dial == name]), pictures / f"{name.replace(' ', '_')}.png")
    print(text)
    return 0


def picture(dial: Dial, rows: Sequence[Row], points: Sequence[Breaking]) -> Figure:
    """Three frames of a dial, and each method's errors against severity, with the limits and where they are passed."""
    figure = Figure(figsize=(11.0, 3.3), layout="constrained", dpi=100)
    grid = figure.add_gridspec(3, 5, width_ratios=(0.75, 2, 2, 1.5, 1.55))
    last = len(dial.severities) - 1
    for k, place in enumerate((0, last // 2 + 1, last)):
        axes = figure.add_subplot(grid[k, 0])
        axes.imshow(dial.make(dial.severities[place], 0).image[0].permute(1, 2, 0).mul(1.4).clamp(0, 1).numpy())
        axes.set_title(f"{dial.severities[place]:g} {dial.unit}", fontsize=7, pad=2)
        axes.set_axis_off()
    methods = list(dict.fromkeys(row.method for row in rows))
    panels = [figure.add_subplot(grid[:, k]) for k in (1, 2, 3)]
    for method in methods:
        own = [[row for row in rows if row.method == method and row.severity == s] for s in dial.severities]
        style = STYLES[method]
        draw(panels[0], [[row.normal_deg for row in group] for group in own], style, 0.2)
        shares = [[None if row.depth_share is None else 100.0 * row.depth_share for row in group] for group in own]
        draw(panels[1], shares, style, 0.1)
        if method == "fast":
            draw(panels[2], [[row.iou for row in group] for group in own], STYLES[MASK], 0.0)
    titles = ("normals off by, deg (mean in contact)", "depth RMS, % of the press", "contact mask, IoU")
    for axes, limit, title in zip(panels, (NORMAL_LIMIT_DEG, 100 * DEPTH_LIMIT, MASK_LIMIT), titles):
        axes.axhline(limit, color="black", lw=0.8, ls=(0, (5, 3)))
        axes.text(0.0, limit, "limit", fontsize=7, va="bottom")
        axes.set_xticks(range(last + 1), [f"{s:g}" for s in dial.severities], fontsize=7)
        axes.tick_params(labelsize=7)
        axes.set_xlabel(f"{dial.name}, {dial.unit}".rstrip(", "), fontsize=8)
        axes.set_title(title, fontsize=8)
        axes.grid(alpha=0.25)
    for axes in panels[:2]:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    panels[2].set_ylim(-0.03, 1.05)
    for point in points:
        if not isinstance(point.at, str):
            for axes in panels[2:] if point.method == MASK else panels[:2]:
                axes.axvline(last * point.held, ymax=0.06, color=STYLES[point.method]["color"], lw=2)
    legend = figure.add_subplot(grid[:, 4])
    legend.set_axis_off()
    legend.text(0.0, 1.0, f"breaks at{f', {dial.unit}' if dial.unit else ''}", fontsize=8, weight="bold", va="top")
    for k, point in enumerate(points):
        at = point.at if isinstance(point.at, str) else f"{point.at:.3g}"
        legend.text(0.0, 0.9 - 0.085 * k, f"{at}", color=STYLES[point.method]["color"], fontsize=8, va="top", weight="bold")
        legend.text(0.3, 0.9 - 0.085 * k, point.method, color=STYLES[point.method]["color"], fontsize=8, va="top")
    return figure


def draw(axes: Any, groups: Sequence[Sequence[float | None]], style: dict[str, Any], least: float) -> None:
    """Means over seeds, those of runs that failed left out; a cross at the top where all failed."""
    means = []
    for group in groups:
        good = [value for value in group if value is not None]
        means.append(max(least, sum(good) / len(good)) if good else np.nan)
    axes.plot(range(len(means)), means, **style)
    failed = [k for k, mean in enumerate(means) if np.isnan(mean)]
    axes.plot(failed, [0.97] * len(failed), "x", color=style["color"], ms=6, transform=axes.get_xaxis_transform())


def overview(points: Sequence[Breaking]) -> Figure:
    """How far along each dial each method holds."""
    methods = [m for m in dict.fromkeys(p.method for p in points) if m not in ("flat", MASK)] + [MASK]
    dials = list(dict.fromkeys(p.dial for p in points))
    by_place = {(p.dial, p.method): p for p in points}
    held = np.array([[by_place[dial, method].held for method in methods] for dial in dials])
    figure = Figure(figsize=(2.6 + 0.95 * len(methods), 1.3 + 0.24 * len(dials)), layout="constrained", dpi=88)
    axes = figure.subplots()
    picture = axes.imshow(held, cmap="RdYlGn", vmin=0.0, vmax=1.0, aspect="auto", alpha=0.7)
    for row, dial in enumerate(dials):
        for column, method in enumerate(methods):
            at = by_place[dial, method].at
            text = {"never": "holds", "always": "broken"}[at] if isinstance(at, str) else f"{at:.3g}"
            axes.text(column, row, text, ha="center", va="center", fontsize=7.5)
    axes.set_xticks(range(len(methods)), [m.replace(", ", ",\n") for m in methods], fontsize=8)
    axes.set_yticks(range(len(dials)), [stability.in_words(DIALS[dial]) for dial in dials], fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    bar = figure.colorbar(picture, ax=axes, location="bottom", shrink=0.6, aspect=40, pad=0.01)
    bar.set_label("part of the dial that a method holds; in the cells, the severity where it breaks", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write as PNG of at most 256 colors: a third of the size."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
    with write_atomically(path) as temporary:
        Image.fromarray(pixels).quantize(256).save(temporary, optimize=True)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
