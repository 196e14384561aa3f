"""Measure speed and error together, print the table, and chart one against the other.

python scripts/bench.py [--out out/bench] [--threads 2] [--chart docs/speed_accuracy.png]

Peers are timed in the same run. The real sensor's rows need ../shared/data, or the folder that TORCHVTS_DATA names.
"""

import argparse
import os
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from tqdm import tqdm

from torchvts import viz
from torchvts.core.files import write_atomically
from torchvts.evaluation import speed as bench


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--chart", type=Path, help="write the chart here too")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    data = Path(os.environ.get("TORCHVTS_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    with tqdm(unit="row") as bar:
        rows = bench.run(
            f"python scripts/bench.py --threads {arguments.threads}",
            lambda name: (bar.set_postfix_str(name), bar.update()),
            data if data.is_dir() else None,
        )
    ratios = bench.peer_ratios(rows)
    text = "\n".join([bench.table(rows), "", f"{rows[0].machine}, {arguments.threads} threads, float32", *ratios])
    for name, content in (("bench.md", text + "\n"), ("bench.json", bench.to_json(rows))):
        with write_atomically(arguments.out / name) as temporary:
            temporary.write_text(content)
    print(text)
    figure = chart(rows)
    for path in filter(None, (arguments.out / "speed_accuracy.png", arguments.chart)):
        viz.save_figure(figure, path)
    print(f"\nbench.md, bench.json and speed_accuracy.png in {arguments.out}")


def chart(rows: Sequence[bench.Row]) -> Figure:
    sensor = [row for row in rows if row.kind == "sensor"]
    figure = Figure(figsize=(17.0, 4.8) if sensor else (13.0, 4.8), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4 if sensor else 3)
    scene = [r for r in rows if r.kind == "scene" and r.height == 480 and "press 1 mm" in r.data]
    stamps = [row for row in rows if row.kind == "cliff" and row.data.startswith("stamp")]
    panels = [
        (axes[0], scene, "rms_um", "depth RMS, um", "Exact scene, 640x480: ball pressed 1 mm"),
        (axes[-2], stamps, "rms_um", "depth RMS, um", "Exact scene, 320x240: stamp with upright walls, 1 mm"),
    ]
    if sensor:
        title = "GelSight Mini, 320x240: balls not learned from"
        panels.append((axes[1], sensor, "normal_deg", "normals off by, degrees", title))
    drawn = [(panel[0], errors_against_time(*panel), panel[2]) for panel in panels]
    axes[0].legend(fontsize=7, loc="center left")
    cost(axes[-1], [r for r in rows if r.kind == "scene" and "press 1 mm" in r.data])
    figure.suptitle(f"{rows[0].machine}, {rows[0].threads} threads, one frame", fontsize=9)
    figure.draw_without_rendering()  # places of the panels
    for panel, shown, error in drawn:
        name_points(panel, shown, error)
    return figure


def errors_against_time(axes: Any, rows: Sequence[bench.Row], error: str, label: str, title: str) -> list[bench.Row]:
    """Draws a panel; returns the rows in it, whose names come when its place is known."""
    known = [row for row in rows if getattr(row, error) is not None]
    beyond = 4.0 * statistics.median(getattr(row, error) for row in known)  # such as flat: told, not drawn
    shown = sorted((row for row in known if getattr(row, error) <= beyond), key=lambda row: row.ms_median)
    best = bench.front(shown, error)
    axes.step([r.ms_median for r in best], [getattr(r, error) for r in best], where="post", color="0.6", lw=1, label="Pareto front")
    for ours, color, marker, name in ((True, "tab:blue", "o", "torchvts"), (False, "tab:red", "s", "peers")):
        part = [row for row in shown if row.ours == ours]
        axes.plot([r.ms_median for r in part], [getattr(r, error) for r in part], marker, color=color, label=name, ls="none")
    told = [f"{row.method}: {getattr(row, error):.0f} at {row.ms_median:.2g} ms" for row in known if row not in shown]
    axes.text(0.02, 0.02, "\n".join(["not drawn:", *told] if told else []), transform=axes.transAxes, fontsize=6.5, color="0.35")
    axes.set(xscale="log", yscale="log", xlabel="ms a frame", ylabel=label)
    axes.set_title(title, fontsize=9)
    axes.margins(x=0.3, y=0.2)
    axes.grid(which="both", alpha=0.25)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    return shown


def name_points(axes: Any, rows: Sequence[bench.Row], error: str) -> None:
    """Method names beside their points, where they cover no other name or point and stay in the panel, whose place is known."""
    size, scale = 6.5, axes.figure.dpi / 72.0
    points = [axes.transData.transform((row.ms_median, getattr(row, error))) for row in rows]
    taken = [(x - 4.0, y - 4.0, x + 4.0, y + 4.0) for x, y in points]
    panel = axes.bbox
    for row, (x, y) in zip(rows, points, strict=True):
        wide, high = 0.6 * size * scale * len(row.method), 1.3 * size * scale
        best = None
        for k, (right, up) in enumerate((r, u) for u in (8, -14, 22, -28, 36, -42, 50, -56) for r in (True, False)):
            left = x + 6 * scale if right else x - 6 * scale - wide
            box = (left, y + up * scale, left + wide, y + up * scale + high)
            covered = sum(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken)
            outside = box[0] < panel.x0 or box[2] > panel.x1 or box[1] < panel.y0 or box[3] > panel.y1
            if best is None or (covered + 2 * outside, k) < best[:2]:
                best = (covered + 2 * outside, k, right, up, box)
        assert best is not None
        taken.append(best[4])
        arrow = {"arrowstyle": "-", "lw": 0.4, "color": "0.5"}
        offset = {"xytext": (6 if best[2] else -6, best[3]), "textcoords": "offset points", "ha": "left" if best[2] else "right"}
        axes.annotate(row.method, (row.ms_median, getattr(row, error)), fontsize=size, arrowprops=arrow, **offset)


def cost(axes: Any, rows: Sequence[bench.Row]) -> None:
    for method in ("fast", "precise", "auto", "fast, SciPy's DCT", "look-up table", "gs_sdk's pipeline"):
        line = sorted((r for r in rows if r.method == method), key=lambda row: row.height)
        if line:
            style = "o-" if line[0].ours else "s--"
            axes.plot([r.height * r.width for r in line], [r.ms_median for r in line], style, ms=4, lw=1, label=method)
    axes.set(xscale="log", yscale="log", xlabel="pixels of a frame", ylabel="ms a frame")
    axes.set_title("Cost against size", fontsize=9)
    axes.grid(which="both", alpha=0.25)
    axes.legend(fontsize=7)


if __name__ == "__main__":
    main()
