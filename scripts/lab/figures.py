"""All pictures of an evaluation: error against time, breaking points, errors on presses, and coverage of confidence."""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from torch import Tensor

from torchvts.core.checks import check_same_size
from torchvts.core.files import write_atomically
from torchvts.pipeline import ConfidentPipeline
from torchvts.training.balls import Truth
from torchvts.viz import depth_colors, depth_range, draw_bar, draw_contours, draw_outline, new_figure

from .coverage import LEVELS
from .evaluate import Evaluation
from .metrics import normal_angle_deg
from .random_scenes import random_frame
from .rows import Row, Size
from .speed import front, ms


def save_small(figure: Figure, path: Path, table: str = "") -> None:
    """Write a figure as PNG of at most 256 colours, a third of the size; "Description" in it holds the table that it shows."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
    with write_atomically(path) as temporary:
        held = PngInfo()
        if table:
            held.add_text("Description", table)
        Image.fromarray(pixels).quantize(256).save(temporary, optimize=True, pnginfo=held)


# error against time

OURS, PEERS = "#0072b2", "#d55e00"
"""Blue and vermilion, which all readers distinguish."""

AGAINST_SIZE = ("fast", "precise", "look-up table", "gs_sdk's pipeline")
"""Methods whose cost is drawn against size: the others lie on one of these lines."""


class _Panel(NamedTuple):
    """A panel of error against time."""

    axes: Any
    rows: list[Row]
    error: str
    label: str
    title: str


def speed_figure(rows: Sequence[Row]) -> Figure:
    """Error against time on a real sensor if it was measured, then on an exact scene; and cost against size."""
    scenes = [row for row in rows if row.kind == "scene"]
    large = [row for row in scenes if row.size is not None and row.size.height == 480]
    sensor = [row for row in rows if row.kind == "sensor" and row.size == _usual_size(rows)]
    kinds = (
        (sensor, "normal_deg", "mean error of normals, deg", "balls not learned from"),
        (large, "rms_um", "depth RMS, um", "ball of 10 mm radius, 1 mm deep"),
    )
    drawn = [kind for kind in kinds if kind[0]]
    figure = new_figure(3.4 * len(drawn) + 3.2, 3.7)
    axes = figure.subplots(1, len(drawn) + 1)
    panels = []
    for place, (own, error, label, what) in zip(axes, drawn):
        size = own[0].size
        where = "exact scene" if own is large else own[0].data.split(",")[0]
        title = f"{where}, {size.width}x{size.height}:\n{what}" if size else what
        panel = _Panel(place, own, error, label, title)
        panels.append(panel._replace(rows=_error_against_time(panel)))
    _cost_against_size(axes[-1], scenes)
    handles = {label: handle for panel in panels for handle, label in zip(*panel.axes.get_legend_handles_labels())}
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9)
    time = rows[0].time
    figure.suptitle(f"{time.machine}, one frame" if time else "", fontsize=9)
    figure.draw_without_rendering()  # sets the places of the panels
    for panel in panels:
        _name_points(panel)
    return figure


def _usual_size(rows: Sequence[Row]) -> Size | None:
    """The size of most rows of the real sensor."""
    sizes = [row.size for row in rows if row.kind == "sensor"]
    return max(sizes, key=sizes.count, default=None)


def _error_against_time(panel: _Panel) -> list[Row]:
    """Draw a panel, and return the rows in it: they are named when the place of the panel is known."""
    axes, error = panel.axes, panel.error
    known = [row for row in panel.rows if row.error(error) is not None]
    limit = 4.0 * statistics.median(row.errors[error] or 0.0 for row in known)  # larger errors, such as flat's, become a text
    shown = sorted((row for row in known if (row.errors[error] or 0.0) <= limit), key=ms)
    best = front(shown, error)
    axes.step(*_points(best, error), where="post", color="0.6", lw=1, label="Pareto front")
    for ours, color, marker, name in ((True, OURS, "o", "torchvts"), (False, PEERS, "s", "peers")):
        for seen, fill in ((False, color), (True, "white")):
            points = [row for row in shown if row.ours == ours and row.seen == seen]
            text = f"{name}, learned from these frames" if seen else name
            if points:
                axes.plot(*_points(points, error), marker, color=color, markerfacecolor=fill, label=text, ls="none")
    beyond = "".join(f"\nnot drawn: {row.method}, {row.error(error):.0f} at {ms(row):.2g} ms" for row in known if row not in shown)
    axes.set(xscale="log", yscale="log", ylabel=panel.label)
    axes.set_xlabel(f"ms a frame{beyond}", fontsize=9)
    axes.set_title(panel.title, fontsize=9)
    axes.margins(x=0.4, y=0.2)
    _log_ticks(axes)
    return shown


def _log_ticks(axes: Any) -> None:
    axes.grid(which="both", alpha=0.25)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def _points(rows: Sequence[Row], error: str) -> tuple[list[float], list[float | None]]:
    return [ms(row) for row in rows], [row.error(error) for row in rows]


Box = tuple[float, float, float, float]
"""Left, lower, right and upper side, display pixels."""


def _name_points(panel: _Panel) -> None:
    """Write method names beside their points, where they overlap least with other names and points."""
    size, scale = 8.0, panel.axes.figure.dpi / 72.0
    points = [panel.axes.transData.transform((ms(row), row.error(panel.error))) for row in panel.rows]
    taken: list[Box] = [(x - 4.0 * scale, y - 4.0 * scale, x + 4.0 * scale, y + 4.0 * scale) for x, y in points]
    frame = panel.axes.bbox
    for row, (x, y) in zip(panel.rows, points, strict=True):
        wide, high = 0.56 * size * scale * len(row.method), 1.3 * size * scale
        choices = []
        places = [(side, up) for up in (-4, 8, -16, 20, -28, 32, -40, 46, -54, 60, -68) for side in ("left", "right", "center")]
        for k, (side, up) in enumerate(places):
            inside = min(max(x - 0.5 * wide, frame.x0 + 4.0), frame.x1 - wide - 4.0)  # above or below, moved into the panel
            left = {"left": x + 7 * scale, "right": x - 7 * scale - wide, "center": inside}[side]
            box = (left, y + up * scale, left + wide, y + up * scale + high)
            covered = sum(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken)
            outside = box[0] < frame.x0 or box[2] > frame.x1 or box[1] < frame.y0 or box[3] > frame.y1
            choices.append((covered + 2 * outside, k, side, up, box))
        _, _, side, up, box = min(choices)
        taken.append(box)
        arrow = {"arrowstyle": "-", "lw": 0.4, "color": "0.5"}
        along = {"left": 7.0, "right": -7.0, "center": (0.5 * (box[0] + box[2]) - x) / scale}[side]
        offset = {"xytext": (along, up), "textcoords": "offset points", "ha": side}
        panel.axes.annotate(row.method, (ms(row), row.error(panel.error)), fontsize=size, arrowprops=arrow, **offset)


def _cost_against_size(axes: Any, rows: Sequence[Row]) -> None:
    """A line for each method, named at its end."""
    sizes = {r.size.height * r.size.width: f"{r.size.width}x\n{r.size.height}" for r in rows if r.size}
    for method, marker, dashes in zip(AGAINST_SIZE, "ovs^", ("-", "--", "-", "--")):
        line = sorted((r.size.height * r.size.width, ms(r), r.ours) for r in rows if r.method == method and r.size)
        if line:
            x, y, ours = zip(*line)
            axes.plot(x, y, color=OURS if ours[0] else PEERS, marker=marker, ls=dashes, ms=4)
            whole = len(x) == len(sizes)  # a line that ends early is named above its end, clear of the others
            place = {"xytext": (6, 0), "va": "center"} if whole else {"xytext": (0, 6), "ha": "right"}
            axes.annotate(method, (x[-1], y[-1]), textcoords="offset points", fontsize=8, **place)
    axes.set(xscale="log", yscale="log", ylabel="ms a frame")
    axes.set_xlabel("size of the frame, pixels", fontsize=9)
    axes.set_title("exact scene:\ncost against size", fontsize=9)
    axes.margins(x=0.1, y=0.12)  # the upper name clear of the title
    _log_ticks(axes)
    axes.set_xticks(list(sizes), list(sizes.values()), fontsize=9)
    axes.set_xlim(right=axes.get_xlim()[1] * 8.0)  # room for the names


# presses


def set_figure(evaluation: Evaluation) -> Figure:
    """The shown frame by each method but zero depth, a column each: depth with the contact, and the error of relief."""
    shown, pitch = evaluation.shown, evaluation.data.folds[0].sensor.mm_per_pixel
    depths = {name: out.depth_mm[0, 0].double().numpy() for name, out in evaluation.outputs.items() if name != "flat"}
    if shown is None or not depths:
        raise ValueError("evaluation: expected results of a method on a frame, got none: every method failed")
    figure = new_figure(4.2 * len(depths), 6.4, 100)
    panels = figure.subplots(2, len(depths), squeeze=False)
    limit = 4.0 * statistics.median_low([float(np.abs(depth).max()) for depth in depths.values()])  # a method that fails is cut off
    span = depth_range(*(depth for depth in depths.values() if np.abs(depth).max() <= limit))
    for (upper, lower), (name, depth) in zip(panels.T, depths.items()):
        draw_contours(figure, upper, depth, pitch, range_mm=span)
        for mask, style in ((evaluation.outputs[name].contact, "-"), (shown.truth.contact if shown.truth else None, ":")):
            if mask is not None and bool(mask.any()) and not bool(mask.all()):
                draw_outline(upper, mask[0, 0].double().numpy(), pitch, "#e69f00", style)
        upper.set_title(f"{name}: {upper.get_title()}", fontsize=9)
        error = _relief_error(evaluation.outputs[name].depth_mm, shown.truth)
        most = float(error.nan_to_num().abs().quantile(0.998)) or 1.0
        colors, norm = depth_colors(-most, most)
        extent = (*upper.get_xlim(), *upper.get_ylim())  # mm, as above
        draw_bar(figure, lower, lower.imshow(error.numpy(), cmap=colors, norm=norm, extent=extent), "um")
        lower.set_title(f"error of relief, RMS {float(error.square().nanmean().sqrt()):.1f} um", fontsize=9)
    figure.suptitle(f"{evaluation.data.name}, {shown.name}; contact in orange, the true one dotted", fontsize=11)
    return figure


def comparison_figure(
    depth_mm: Tensor, truth_mm: Tensor, mm_per_pixel: float, title: str = "", names: tuple[str, str] = ("measured", "truth")
) -> Figure:
    """Depth and truth, or another depth by its name, in the same colours, and their difference in pixels of pitch, side by side."""
    check_same_size("truth_mm", truth_mm, "depth_mm", depth_mm.shape[-2], depth_mm.shape[-1])
    depth, truth = (one.double().numpy().reshape(one.shape[-2:]) for one in (depth_mm, truth_mm))
    figure = new_figure(10.5, 2.9)
    one, other, difference = figure.subplots(1, 3)
    for panel, values, name in ((one, truth, names[1]), (other, depth, names[0])):
        draw_contours(figure, panel, values, mm_per_pixel, range_mm=depth_range(depth, truth))
        panel.set_title(panel.get_title().replace("depth", name, 1), fontsize=10)
    error = (depth - truth) / mm_per_pixel
    most = max(float(np.abs(error).max()), 1e-6)
    colors, norm = depth_colors(-most, most)
    picture = difference.imshow(error, cmap=colors, norm=norm, extent=(*one.get_xlim(), *one.get_ylim()))  # mm
    what = "error" if names[1] == "truth" else "difference"
    draw_bar(figure, difference, picture, f"{what}, px")
    difference.set_title(f"{what}, px: RMS {float(np.sqrt((error**2).mean())):.4f}, largest {most:.3f}", fontsize=10)
    difference.set_xlabel("x, mm")
    if title:
        figure.suptitle(title)
    return figure


def _relief_error(depth_mm: Tensor, truth: Truth | None) -> Tensor:
    """Depth less truth, less their mean, micrometres, (H, W); NaN where nothing is scored."""
    if truth is None:
        return torch.full(depth_mm.shape[2:], math.nan)
    error = 1000.0 * (depth_mm.double() - truth.depth_mm)
    return torch.where(truth.region, error - error[truth.region].mean(), math.nan)[0, 0]


# coverage of confidence


def coverage_figure(curve: Row) -> Figure:
    """Measured against stated shares with the quartiles over frames, and on one random scene the bounds beside the errors."""
    figure = new_figure(10.0, 6.4, 110)
    parts = figure.subfigures(2, 1, height_ratios=[1.7, 1.0], squeeze=False)
    panels = list(parts[0, 0].subplots(1, 2, sharey=True))
    for panel, what in zip(panels, ("normal", "depth")):
        panel.fill_between([45, 100], [40, 95], [50, 105], color="0.9", label="within 5 points")
        panel.plot([45, 100], [45, 100], color="0.5", linewidth=1.0)
        levels, ends = [100.0 * level for level in LEVELS], ("", ", lower quartile", ", upper quartile")
        shares, low, high = ([curve.errors[f"{what} {level:.0%}{end}"] for level in LEVELS] for end in ends)
        panel.plot(levels, shares, marker="o", color=OURS, markersize=4, lw=1.4, label=curve.data)
        panel.vlines(levels, low, high, color=OURS, lw=1.2, alpha=0.6)
        panel.set(xlim=(46, 99), ylim=(30, 101.5), xlabel="stated share of pixels, %", title=f"{what} within its bound")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("measured share of pixels, %")
    handles, labels = panels[0].get_legend_handles_labels()
    parts[0, 0].legend(handles, labels, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    parts[0, 0].suptitle("means over frames; vertical lines: quartiles over frames", fontsize=9)
    _draw_bounds(parts[1, 0])
    return figure


_LINES = tuple(zip(("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00"), "osv^D"))
"""Colours of Okabe and Ito's palette, and markers."""


def _draw_bounds(figure: Any) -> None:
    """Bound and error of normals and of depth in one range each, cut to the contact."""
    frame = random_frame(1, "lights known, background", "letters")
    out = ConfidentPipeline.from_calibration(frame.calibration, "precise")(frame.image)
    maps = {
        ("normals, deg", "normal"): (out.normal_95_deg[0, 0], normal_angle_deg(out.normal, frame.scene.normal)[0]),
        ("depth, um", "depth"): (1000.0 * out.depth_95_mm[0, 0], 1000.0 * (out.depth_mm - frame.scene.depth_mm).abs()[0, 0]),
    }
    inside = (out.contact | frame.scene.contact)[0, 0]
    rows, columns = inside.nonzero().T
    window = slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)
    panels, pitch = list(figure.subplots(1, 4)), frame.scene.mm_per_pixel
    for k, ((label, what), pair) in enumerate(maps.items()):
        most = float(torch.cat([values[inside] for values in pair]).quantile(0.98))
        colors, norm = depth_colors(0.0, most)
        for panel, values, title in zip(panels[2 * k :], pair, (f"95 % bound of {what}", f"error of {what}")):
            shown = torch.where(inside, values, math.nan)[window]
            size = (0.0, shown.shape[1] * pitch, shown.shape[0] * pitch, 0.0)
            drawn = panel.imshow(shown.numpy(), cmap=colors, norm=norm, extent=size)
            panel.set_title(title, fontsize=9)
            panel.set_xlabel("mm", fontsize=9)
            panel.tick_params(labelsize=8)
        figure.colorbar(
            drawn, ax=panels[2 * k : 2 * k + 2], shrink=0.8, aspect=30, orientation="horizontal", extend="max", label=label
        )


# learning curves


def learning_figure(rows: Sequence[Row]) -> Figure:
    """Error against the number of presses: means over the frames of all draws of presses, with the smallest and the largest draw.

    Args:
        rows: one for each draw, ``seed``: ``method`` names the line, the error "count" is the number of presses;
            where it is None, the row is a level line for comparison.
    """
    figure = new_figure(10.0, 4.2, 110)
    panels = figure.subplots(1, 2)
    levels = [row for row in rows if row.errors["count"] is None]
    rows = [row for row in rows if row.errors["count"] is not None]
    lines = list(dict.fromkeys((row.data, row.method) for row in rows))
    several = len({data for data, _ in lines}) > 1
    for axes, error, label in zip(panels, ("normal_deg", "relief_um"), ("mean error of normals, deg", "error of relief, um")):
        for k, line in enumerate(lines):
            own = [row for row in rows if (row.data, row.method) == line and row.error(error) is not None]
            counts = sorted({row.errors["count"] or 0.0 for row in own})
            rows_of = [[row for row in own if row.errors["count"] == count] for count in counts]
            draws = [[row.errors[error] or 0.0 for row in some] for some in rows_of]
            means = [statistics.fmean(d, [row.frames for row in some]) for d, some in zip(draws, rows_of, strict=True)]
            places = [count + 0.08 * (k - 0.5 * (len(lines) - 1)) for count in counts]  # so that bars stand side by side
            color, marker = _LINES[k % len(_LINES)]
            dashes = ("-", "--", ":")[k // len(_LINES) % 3]
            name = ", ".join(line) if several else line[1]
            axes.plot(places, means, color=color, marker=marker, ls=dashes, label=name)
            axes.vlines(places, [min(d) for d in draws], [max(d) for d in draws], color=color, lw=1.4, alpha=0.6)
        for row in levels:
            if (level := row.error(error)) is not None:
                axes.axhline(level, color="black", lw=1.2, ls=(0, (5, 3)), label=row.method)
        axes.set(xlabel="presses given", ylabel=label, ylim=(0, None))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    title = f"means over the frames of {len({row.seed for row in rows})} draws of presses; lines: smallest and largest draw"
    figure.suptitle(title if several else f"{lines[0][0]}: {title}", fontsize=9)
    return figure
