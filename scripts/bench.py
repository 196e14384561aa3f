"""Measure speed and error together, print the table, and chart one against the other.

python scripts/bench.py [--out out/bench] [--threads 2]
"""

import argparse
from pathlib import Path

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tqdm import tqdm

from torchvts import bench, viz


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arguments.out.mkdir(parents=True, exist_ok=True)
    memory = bench.frame_memory_mb()
    with tqdm(unit="row") as bar:
        rows = bench.run(
            f"python scripts/bench.py --threads {arguments.threads}", lambda name: (bar.set_postfix_str(name), bar.update())
        )
    text = f"{bench.table(rows)}\n\n{rows[0].machine}, {arguments.threads} threads; "
    text += f"one 640x480 frame, pipeline and all: {memory:.0f} MB beside torch"
    (arguments.out / "bench.md").write_text(text + "\n")
    (arguments.out / "bench.json").write_text(bench.to_json(rows))
    print(text)
    viz.save_figure(chart(rows), arguments.out / "speed_accuracy.png")
    print(f"\nbench.md, bench.json and speed_accuracy.png in {arguments.out}")


def chart(rows: list[bench.Row]) -> Figure:
    figure = Figure(figsize=(7.0, 4.6), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for mode, marker in (("fast", "o"), ("precise", "s"), ("auto", "^")):
        for press, style in (("press 1 mm", "-"), ("press 2 mm", "--")):
            line = [r for r in rows if r.method == mode and press in r.scene]
            axes.plot([r.ms_median for r in line], [r.rms_um for r in line], style, marker=marker, label=f"{mode}, {press}")
            for r in line:
                axes.annotate(f"{r.width}", (r.ms_median, r.rms_um or 0.0), fontsize=6, xytext=(3, 3), textcoords="offset points")
    axes.set(
        xscale="log",
        yscale="log",
        xlabel="ms a frame",
        ylabel="depth RMS, um",
        title="Error against time; numbers are image widths",
    )
    axes.grid(which="both", alpha=0.3)
    axes.legend(fontsize=7)
    return figure


if __name__ == "__main__":
    main()
