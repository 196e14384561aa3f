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
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image
from torch import Tensor

from ..core.files import write_atomically
from ..pipeline import ConfidentPipeline
from ..viz import draw_contours, draw_surface, new_figure
from .coverage import LEVELS, Coverage
from .evaluate import Evaluation
from .gallery import CORRUPTIONS, Corruption
from .methods import MASK_STYLE, METHODS
from .metrics import normal_angle_deg
from .random_scenes import random_frame
from .rows import Row
from .score import Truth
from .speed import GS_SDK, front, ms
from .stability import DEPTH_LIMIT, MASK, MASK_LIMIT, NORMAL_LIMIT_DEG, Breaking, depth_share, in_words
from .user_speed import OWN, PACES, Measured


def save_small(figure: Figure, path: Path) -> None:
    """Write a figure as PNG of at most 256 colours: a third of the size."""
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
    with write_atomically(path) as temporary:
        Image.fromarray(pixels).quantize(256).save(temporary, optimize=True)


# error against time


class _Panel(NamedTuple):
    """A panel of error against time."""

    axes: Any
    rows: list[Row]
    error: str
    label: str
    title: str


def speed_figure(rows: Sequence[Row]) -> Figure:
    """Error against time on an exact scene, on a real sensor if it was measured, and on walls; and cost against size."""
    sensor = [row for row in rows if row.kind == "sensor"]
    figure = new_figure(17.0 if sensor else 13.0, 4.8)
    axes = figure.subplots(1, 4 if sensor else 3)
    scenes = [row for row in rows if row.kind == "scene" and "press 1 mm" in row.data]
    large = [row for row in scenes if row.size is not None and row.size.height == 480]
    stamps = [row for row in rows if row.kind == "wall" and row.data.startswith("stamp")]
    panels = [
        _Panel(axes[0], large, "rms_um", "depth RMS, um", "Exact scene, 640x480: ball pressed 1 mm"),
        _Panel(axes[-2], stamps, "rms_um", "depth RMS, um", "Exact scene, 320x240: stamp with upright walls, 1 mm"),
    ]
    if sensor:
        title = "GelSight Mini, 320x240: balls not learned from"
        panels.append(_Panel(axes[1], sensor, "normal_deg", "mean error of normals, degrees", title))
    drawn = [panel._replace(rows=_error_against_time(panel)) for panel in panels]
    for legend_of in axes[: 2 if sensor else 1]:
        legend_of.legend(fontsize=7, loc="center left")
    _cost_against_size(axes[-1], scenes)
    time = rows[0].time
    figure.suptitle(f"{time.machine}, {time.threads} threads, one frame" if time else "", fontsize=9)
    figure.draw_without_rendering()  # sets the places of the panels
    for panel in drawn:
        _name_points(panel)
    return figure


def _error_against_time(panel: _Panel) -> list[Row]:
    """Draw a panel, and return the rows in it: they are named when the place of the panel is known."""
    axes, error = panel.axes, panel.error
    known = [row for row in panel.rows if row.error(error) is not None]
    limit = 4.0 * statistics.median(row.errors[error] or 0.0 for row in known)  # larger errors, such as flat's, become a text
    shown = sorted((row for row in known if (row.errors[error] or 0.0) <= limit), key=ms)
    best = front(shown, error)
    axes.step(*_points(best, error), where="post", color="0.6", lw=1, label="Pareto front")
    for ours, color, marker, name in ((True, "tab:blue", "o", "torchvts"), (False, "tab:red", "s", "peers")):
        for seen, fill in ((False, color), (True, "none")):
            points = [row for row in shown if row.ours == ours and row.seen == seen]
            text = f"{name}, has seen these frames" if seen else name
            if points:
                axes.plot(*_points(points, error), marker, color=color, markerfacecolor=fill, label=text, ls="none")
    beyond = [f"{row.method}: {row.error(error):.0f} at {ms(row):.2g} ms" for row in known if row not in shown]
    if beyond:
        axes.text(0.02, 0.02, "\n".join(["not drawn:", *beyond]), transform=axes.transAxes, fontsize=6.5, color="0.35")
    axes.set(xscale="log", yscale="log", xlabel="ms a frame", ylabel=panel.label)
    axes.set_title(panel.title, fontsize=9)
    axes.margins(x=0.3, y=0.2)
    axes.grid(which="both", alpha=0.25)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    return shown


def _points(rows: Sequence[Row], error: str) -> tuple[list[float], list[float | None]]:
    return [ms(row) for row in rows], [row.error(error) for row in rows]


Box = tuple[float, float, float, float]
"""Left, lower, right and upper side, display pixels."""


def _name_points(panel: _Panel) -> None:
    """Write method names beside their points, where they overlap least with other names and points."""
    size, scale = 6.5, panel.axes.figure.dpi / 72.0
    points = [panel.axes.transData.transform((ms(row), row.error(panel.error))) for row in panel.rows]
    taken: list[Box] = [(x - 4.0, y - 4.0, x + 4.0, y + 4.0) for x, y in points]
    frame = panel.axes.bbox
    for row, (x, y) in zip(panel.rows, points, strict=True):
        wide, high = 0.6 * size * scale * len(row.method), 1.3 * size * scale
        choices = []
        for k, (right, up) in enumerate((r, u) for u in (8, -14, 22, -28, 36, -42, 50, -56) for r in (True, False)):
            left = x + 6 * scale if right else x - 6 * scale - wide
            box = (left, y + up * scale, left + wide, y + up * scale + high)
            covered = sum(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken)
            outside = box[0] < frame.x0 or box[2] > frame.x1 or box[1] < frame.y0 or box[3] > frame.y1
            choices.append((covered + 2 * outside, k, right, up, box))
        _, _, right, up, box = min(choices)
        taken.append(box)
        arrow = {"arrowstyle": "-", "lw": 0.4, "color": "0.5"}
        offset = {"xytext": (6 if right else -6, up), "textcoords": "offset points", "ha": "left" if right else "right"}
        panel.axes.annotate(row.method, (ms(row), row.error(panel.error)), fontsize=size, arrowprops=arrow, **offset)


def _cost_against_size(axes: Any, rows: Sequence[Row]) -> None:
    for method in ("fast", "precise", "auto", "fast, SciPy's DCT", "look-up table", "gs_sdk's pipeline"):
        line = sorted((r.size.height * r.size.width, ms(r), r.ours) for r in rows if r.method == method and r.size)
        if line:
            style = "o-" if line[0][2] else "s--"
            axes.plot([pixels for pixels, _, _ in line], [time for _, time, _ in line], style, ms=4, lw=1, label=method)
    axes.set(xscale="log", yscale="log", xlabel="pixels of a frame", ylabel="ms a frame")
    axes.set_title("Cost against size", fontsize=9)
    axes.grid(which="both", alpha=0.25)
    axes.legend(fontsize=7)


def user_speed_figure(measured: Measured) -> Figure:
    """Time of a frame against size, a panel for each unit, real ones first: tight loops, frames every 20 ms, and the peer."""
    units = list(dict.fromkeys(row.unit for row in measured.frames))
    figure = new_figure(6.2 * len(units), 4.6)
    panels = figure.subplots(1, len(units), squeeze=False, sharey=True)[0]
    styles = {PACES[0]: "o-", PACES[1]: "^--", PACES[2]: "s:"}
    colors = {"fast": "tab:blue", "precise": "tab:green", GS_SDK: "tab:red"}
    for axes, unit in zip(panels, units, strict=True):
        shown = [row for row in measured.frames if row.unit == unit and row.threads == OWN and row.size.batch == 1]
        for method, pace in dict.fromkeys((row.method, row.pace) for row in shown):
            line = sorted((r.size.height * r.size.width, r.median_ms) for r in shown if (r.method, r.pace) == (method, pace))
            style = {"color": colors[method], "ms": 4, "lw": 1, "label": method if method == GS_SDK else f"{method}, {pace}"}
            axes.plot([pixels for pixels, _ in line], [time for _, time in line], styles.get(pace, "D-"), **style)
        sizes = sorted({(row.size.height * row.size.width, f"{row.size.width}x{row.size.height}") for row in shown})
        axes.set(xscale="log", yscale="log", title=unit, ylabel="ms a frame, median")
        axes.set_xticks([pixels for pixels, _ in sizes], [text for _, text in sizes])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_formatter("{x:g}")
        axes.grid(which="both", alpha=0.25)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7)  # beside the panels, where no point lies
    figure.suptitle(measured.machine, fontsize=8)
    return figure


# breaking points


def corruption_figure(corruption: Corruption, rows: Sequence[Row], points: Sequence[Breaking]) -> Figure:
    """Three frames of a corruption, and the errors of each method against severity, with limits and breaking points.

    Args:
        corruption: the corruption.
        rows: its rows.
        points: its breaking points.
    """
    figure = new_figure(11.0, 3.3, 100)
    grid = figure.add_gridspec(3, 5, width_ratios=(0.75, 2, 2, 1.5, 1.55))
    last = len(corruption.severities) - 1
    for k, place in enumerate((0, last // 2 + 1, last)):
        axes = figure.add_subplot(grid[k, 0])
        axes.imshow(corruption.make(corruption.severities[place], 0).image[0].permute(1, 2, 0).mul(1.4).clamp(0, 1).numpy())
        axes.set_title(f"{corruption.severities[place]:g} {corruption.unit}", fontsize=7, pad=2)
        axes.set_axis_off()
    panels = [figure.add_subplot(grid[:, k]) for k in (1, 2, 3)]
    for method in dict.fromkeys(row.method for row in rows):
        own = [[row for row in rows if row.method == method and row.severity == s] for s in corruption.severities]
        style = dict(METHODS[method].style)
        _draw_means(panels[0], [[row.error("normal_deg") for row in group] for group in own], style, 0.2)
        shares = [[None if (share := depth_share(row)) is None else 100.0 * share for row in group] for group in own]
        _draw_means(panels[1], shares, style, 0.1)
        if method == "fast":
            _draw_means(panels[2], [[row.error("iou") for row in group] for group in own], dict(MASK_STYLE), 0.0)
    _label_severities(panels, corruption)
    for point in points:
        if not isinstance(point.at, str):
            for axes in panels[2:] if point.method == MASK else panels[:2]:
                axes.axvline(last * point.held, ymax=0.06, color=_style(point.method)["color"], lw=2)
    _list_breaking_points(figure.add_subplot(grid[:, 4]), corruption, points)
    return figure


def _style(method: str) -> dict[str, Any]:
    return dict(MASK_STYLE if method == MASK else METHODS[method].style)


def _label_severities(panels: Sequence[Any], corruption: Corruption) -> None:
    """Limits, ticks and titles of the panels of normals, depth and mask."""
    titles = ("mean error of normals in contact, deg", "depth RMS, % of the press", "contact mask, IoU")
    for axes, limit, title in zip(panels, (NORMAL_LIMIT_DEG, 100 * DEPTH_LIMIT, MASK_LIMIT), titles):
        axes.axhline(limit, color="black", lw=0.8, ls=(0, (5, 3)))
        axes.text(0.0, limit, "limit", fontsize=7, va="bottom")
        axes.set_xticks(range(len(corruption.severities)), [f"{s:g}" for s in corruption.severities], fontsize=7)
        axes.tick_params(labelsize=7)
        axes.set_xlabel(f"{corruption.name}, {corruption.unit}".rstrip(", "), fontsize=8)
        axes.set_title(title, fontsize=8)
        axes.grid(alpha=0.25)
    for axes in panels[:2]:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
    panels[2].set_ylim(-0.03, 1.05)


def _list_breaking_points(legend: Any, corruption: Corruption, points: Sequence[Breaking]) -> None:
    legend.set_axis_off()
    legend.text(0.0, 1.0, f"breaks at{f', {corruption.unit}' if corruption.unit else ''}", fontsize=8, weight="bold", va="top")
    for k, point in enumerate(points):
        color = _style(point.method)["color"]
        legend.text(0.0, 0.9 - 0.085 * k, point.text, color=color, fontsize=8, va="top", weight="bold")
        legend.text(0.3, 0.9 - 0.085 * k, point.method, color=color, fontsize=8, va="top")


def _draw_means(axes: Any, groups: Sequence[Sequence[float | None]], style: dict[str, Any], least: float) -> None:
    """Means over seeds without failed runs; a cross at the top where all failed."""
    means = []
    for group in groups:
        good = [value for value in group if value is not None]
        means.append(max(least, sum(good) / len(good)) if good else np.nan)
    axes.plot(range(len(means)), means, **style)
    failed = [k for k, mean in enumerate(means) if np.isnan(mean)]
    axes.plot(failed, [0.97] * len(failed), "x", color=style["color"], ms=6, transform=axes.get_xaxis_transform())


def overview_figure(points: Sequence[Breaking]) -> Figure:
    """Share of the severities of each corruption before each method breaks."""
    methods = [m for m in dict.fromkeys(p.method for p in points) if m not in ("flat", MASK)] + [MASK]
    names = list(dict.fromkeys(p.corruption for p in points))
    by_place = {(p.corruption, p.method): p for p in points}
    held = np.array([[by_place[name, method].held for method in methods] for name in names])
    figure = new_figure(2.6 + 0.95 * len(methods), 1.3 + 0.24 * len(names), 88)
    axes = figure.subplots()
    picture = axes.imshow(held, cmap="RdBu", vmin=0.0, vmax=1.0, aspect="auto", alpha=0.7)
    for row, name in enumerate(names):
        for column, method in enumerate(methods):
            text = by_place[name, method].text
            text = {"never": "holds", "always": "broken"}.get(text, text)
            axes.text(column, row, text, ha="center", va="center", fontsize=7.5)
    axes.set_xticks(range(len(methods)), [m.replace(", ", ",\n") for m in methods], fontsize=8)
    axes.set_yticks(range(len(names)), [in_words(CORRUPTIONS[name]) for name in names], fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    bar = figure.colorbar(picture, ax=axes, location="bottom", shrink=0.6, aspect=40, pad=0.01)
    bar.set_label("share of the severities before the method breaks; in the cells, the severity where it breaks", fontsize=8)
    bar.ax.tick_params(labelsize=7)
    return figure


# presses


def set_figure(evaluation: Evaluation, methods: Sequence[str] = ()) -> Figure:
    """The shown frame by several methods, a row each: depth contours with the contact, the shaded surface, the error of relief.

    Args:
        evaluation: with a shown frame.
        methods: names of methods; empty for all but zero depth.
    Raises:
        ValueError: a method without a result.
    """
    shown, pitch = evaluation.shown, evaluation.data.folds[0].sensor.mm_per_pixel
    chosen = list(methods) or [name for name in evaluation.outputs if name != "flat"]
    if shown is None or not chosen or any(name not in evaluation.outputs for name in chosen):
        raise ValueError(f"methods: expected some of {', '.join(evaluation.outputs) or 'none'}, got {', '.join(chosen) or 'none'}")
    figure = new_figure(13.5, 3.9 * len(chosen))
    errors = {name: _relief_error(evaluation.outputs[name].depth_mm, shown.truth) for name in chosen}
    most = max(float(error.nan_to_num().abs().quantile(0.998)) for error in errors.values()) or 1.0
    depths = {name: evaluation.outputs[name].depth_mm[0, 0].double().numpy() for name in chosen}
    low, high = (1000.0 * float(of([of(depth) for depth in depths.values()])) for of in (np.min, np.max))
    for k, (name, depth) in enumerate(depths.items()):
        contours, panel = (figure.add_subplot(len(chosen), 3, 3 * k + column) for column in (1, 3))
        draw_contours(figure, contours, depth, pitch)
        contours.get_images()[0].set_clim(min(low, 0.0), max(high, 1.0))
        extent = contours.get_images()[0].get_extent()
        for mask, style in ((evaluation.outputs[name].contact, "-"), (shown.truth.contact if shown.truth else None, ":")):
            if mask is not None and bool(mask.any()) and not bool(mask.all()):
                lines: dict[str, Any] = {"colors": "tab:red", "linestyles": style, "extent": extent, "origin": "upper"}
                contours.contour(mask[0, 0].float().numpy(), [0.5], linewidths=1.2, **lines)
        contours.set_title(f"{name}: {contours.get_title()}")
        surface = figure.add_subplot(len(chosen), 3, 3 * k + 2, projection="3d")
        draw_surface(surface, depth, pitch)
        _draw_error(panel, errors[name], most, extent)
    figure.suptitle(f"{evaluation.data.name}, {shown.name}; contact in red, the true one dotted")
    return figure


def _draw_error(panel: Any, error: Tensor, most: float, extent: Sequence[float]) -> None:
    """The error of relief in colour, cut to the pixels that are scored."""
    known = ~error.isnan()
    if not bool(known.any()):
        panel.set_axis_off()
        panel.text(0.5, 0.5, "no truth", ha="center")
        return
    picture = panel.imshow(error.numpy(), cmap="RdBu_r", vmin=-most, vmax=most, extent=extent)
    panel.figure.colorbar(picture, ax=panel, shrink=0.75, label="um")
    (left, right, low, high), (rows, columns) = extent, error.shape
    x = [left + (right - left) * float(k) / columns for k in known.any(0).nonzero()[[0, -1], 0]]
    y = [high + (low - high) * float(k) / rows for k in known.any(1).nonzero()[[0, -1], 0]]
    reach = 0.6 * max(x[1] - x[0], y[1] - y[0]) + 0.02 * (right - left)
    panel.set(xlim=(sum(x) / 2 - reach, sum(x) / 2 + reach), ylim=(sum(y) / 2 + reach, sum(y) / 2 - reach))
    panel.set(xlabel="x, mm", ylabel="y, mm (down)", title=f"error of relief, RMS {float(error.square().nanmean().sqrt()):.1f} um")


def _relief_error(depth_mm: Tensor, truth: Truth | None) -> Tensor:
    """Depth less truth, less their mean, micrometres, (H, W); NaN where nothing is scored."""
    if truth is None:
        return torch.full(depth_mm.shape[2:], math.nan)
    error = 1000.0 * (depth_mm.double() - truth.depth_mm)
    return torch.where(truth.region, error - error[truth.region].mean(), math.nan)[0, 0]


# coverage of confidence


def coverage_figure(curves: Sequence[Coverage], seed: int = 1) -> Figure:
    """Measured against stated shares, and on one random scene the bounds beside the errors.

    Args:
        curves: means, a line each.
        seed: seed of the scene.
    """
    figure = new_figure(11.0, 7.2)
    parts = figure.subfigures(2, 1, height_ratios=[1.15, 1.0], squeeze=False)
    for panel, what in zip(list(parts[0, 0].subplots(1, 2)), ("normal", "depth")):
        panel.fill_between([45, 100], [40, 95], [50, 105], color="0.9", label="within 5 points")
        panel.plot([45, 100], [45, 100], color="0.5", linewidth=1.0)
        for curve in curves:
            shares = (100.0 * (curve.normal if what == "normal" else curve.depth)).tolist()
            panel.plot([100.0 * level for level in LEVELS], shares, marker="o", markersize=4, label=curve.name)
        panel.set_xlim(47, 98)
        panel.set_ylim(30, 101)
        panel.set_xlabel("stated, % of pixels")
        panel.set_ylabel("measured, % of pixels")
        panel.set_title(f"{what} within its bound")
        panel.grid(alpha=0.3)
    panel.legend(loc="lower right", fontsize=8)
    _draw_bounds(parts[1, 0], seed)
    return figure


def _draw_bounds(figure: Any, seed: int) -> None:
    frame = random_frame(seed, "lights known, background", "letters")
    out = ConfidentPipeline.from_calibration(frame.calibration, "precise")(frame.image)
    maps = [
        ("bound of the normal (95 %), deg", out.normal_95_deg[0, 0]),
        ("its error, deg", normal_angle_deg(out.normal, frame.scene.normal)[0]),
        ("bound of the depth (95 %), um", 1000.0 * out.depth_95_mm[0, 0]),
        ("its error, um", 1000.0 * (out.depth_mm - frame.scene.depth_mm).abs()[0, 0]),
    ]
    inside = (out.contact | frame.scene.contact)[0, 0]
    for k, (panel, (title, values)) in enumerate(zip(figure.subplots(1, 4), maps)):
        most = float(maps[k - k % 2][1][inside].quantile(0.99))
        drawn = panel.imshow(torch.where(inside, values, math.nan).numpy(), cmap="viridis", vmin=0.0, vmax=most)
        panel.set_title(title, fontsize=9)
        panel.set_xticks([]), panel.set_yticks([])
        figure.colorbar(drawn, ax=panel, shrink=0.75, orientation="horizontal")
