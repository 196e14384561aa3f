"""All pictures of an evaluation: error against time, breaking points, errors on presses, and coverage of confidence."""

import math
import statistics
from collections.abc import Callable, Sequence
from itertools import pairwise
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
from ..core.geometry import normal_from_gradient
from ..pipeline import ConfidentPipeline
from ..viz import draw_contours, new_figure
from .coverage import LEVELS, Coverage
from .evaluate import Evaluation
from .gallery import CORRUPTIONS, Corruption
from .methods import MASK_STYLE, METHODS
from .metrics import normal_angle_deg
from .random_scenes import random_frame
from .rows import Row
from .score import PLACES, RIM_PX, SLOPE_EDGES, ball_truth, label
from .speed import front, ms
from .stability import DEPTH_LIMIT, MASK, MASK_LIMIT, NORMAL_LIMIT_DEG, Breaking, depth_share, in_words


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
    axes[0].legend(fontsize=7, loc="center left")
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
        axes.plot(*_points([row for row in shown if row.ours == ours], error), marker, color=color, label=name, ls="none")
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


# presses of balls


def error_figure(evaluation: Evaluation, method: str) -> Figure:
    """Mean angle between normals of one method, by slope of the ball and by place in the image.

    Raises:
        ValueError: a method that was not evaluated.
    """
    scores = evaluation.of(method)
    if not scores:
        raise ValueError(f"method: expected one that was evaluated, got {method!r}")
    figure = new_figure(9.0, 3.8)
    bars, places = figure.subplots(1, 2)
    _draw_by_slope(bars, _pooled([s.by_slope_deg for s in scores], [s.by_slope_pixels for s in scores]))
    _draw_by_place(places, _pooled([s.by_place_deg for s in scores], [s.by_place_pixels for s in scores]))
    mean = sum(score.normal_deg for score in scores) / len(scores)
    figure.suptitle(f"{method}: {mean:.2f} deg over {len(scores)} presses")
    return figure


def _draw_by_slope(bars: Any, by_slope: list[float]) -> None:
    edges = [f"{edge:g}" for edge in (0.0, *SLOPE_EDGES)]
    names = [f"{low} to {high}" for low, high in pairwise(edges)] + [f"over {edges[-1]}"]
    heights = [0.0 if math.isnan(v) else v for v in by_slope]
    bars.bar(names, heights, color="#4c72b0")
    for k, value in enumerate(by_slope):
        bars.text(k, heights[k], _cell(value), ha="center", va="bottom")
    bars.set_ylim(0.0, 1.15 * max(*heights, 0.1))
    bars.set_xlabel("slope of the ball, mm per mm")
    bars.set_ylabel("mean angle between normals, deg")


def _draw_by_place(places: Any, by_place: list[float]) -> None:
    grid = torch.tensor(by_place, dtype=torch.float64).reshape(PLACES, PLACES).numpy()
    most = max([v for v in by_place if not math.isnan(v)] + [0.1])
    picture = places.imshow(grid, cmap="viridis", vmin=0.0, vmax=most, aspect="auto")
    for k, value in enumerate(by_place):
        color = "black" if value > 0.6 * most or math.isnan(value) else "white"
        places.text(k % PLACES, k // PLACES, _cell(value), ha="center", va="center", color=color)
    places.set_xticks(range(PLACES), ["left", "middle", "right"])
    places.set_yticks(range(PLACES), ["top", "middle", "bottom"])
    places.set_title("by place in the image")
    places.figure.colorbar(picture, ax=places, shrink=0.85, label="deg")


def _cell(value: float) -> str:
    return "no pixels" if math.isnan(value) else f"{value:.1f}"


def _pooled(means: Sequence[tuple[float | None, ...]], counts: Sequence[tuple[int, ...]]) -> list[float]:
    """Mean over the pixels of all presses in each bin; NaN where there is none."""
    pooled = []
    for values, pixels in zip(zip(*means), zip(*counts)):
        total = sum(pixels)
        pooled.append(sum(v * n for v, n in zip(values, pixels) if v is not None) / total if total else math.nan)
    return pooled


class _Maps(NamedTuple):
    """Depth, and inside the region the angle between normals and the error of relief; NaN outside."""

    depth_mm: Tensor
    angle_deg: Tensor
    relief_um: Tensor


def press_figure(evaluation: Evaluation, methods: Sequence[str] = ("response precise", "MLP")) -> Figure:
    """The shown press by several methods, a row each: depth contours, angle between normals, error of relief.

    Raises:
        ValueError: a method that was not evaluated.
    """
    for name in methods:
        if name not in evaluation.outputs:
            raise ValueError(f"methods: expected some of {', '.join(evaluation.outputs)}, got {name!r}")
    press, pitch = evaluation.shown, evaluation.mm_per_pixel
    maps = {name: _error_maps(evaluation, name) for name in methods}
    most_deg = max(float(m.angle_deg.nanquantile(0.99)) for m in maps.values())
    most_um = max(float(m.relief_um.nan_to_num().abs().max()) for m in maps.values())
    figure = new_figure(13.5, 3.7 * len(maps))
    show = _zoomed_on(press.image.shape[1:], *label(press), pitch)
    for axes, (name, m) in zip(figure.subplots(len(maps), 3, squeeze=False), maps.items()):
        draw_contours(figure, axes[0], m.depth_mm.numpy(), pitch)
        axes[0].set_title(f"{name}: {axes[0].get_title()}")
        show(axes[1], m.angle_deg, {"cmap": "magma", "vmin": 0.0, "vmax": most_deg}, "deg")
        show(axes[2], m.relief_um, {"cmap": "RdBu_r", "vmin": -most_um, "vmax": most_um}, "um")
        axes[1].set_title(f"angle between normals, mean {float(m.angle_deg.nanmean()):.2f} deg")
        axes[2].set_title(f"error of relief, RMS {float(m.relief_um.square().nanmean().sqrt()):.1f} um")
    figure.suptitle(f"press {press.name}, ball of {press.ball_diameter_mm:g} mm; scored {RIM_PX:g} px inside the contact radius")
    return figure


def _error_maps(evaluation: Evaluation, method: str) -> _Maps:
    press, out = evaluation.shown, evaluation.outputs[method]
    truth = ball_truth(press, press.image.shape[1], press.image.shape[2], evaluation.mm_per_pixel)
    inside = truth.region[0, 0]
    angle = normal_angle_deg(out.normal.double(), normal_from_gradient(truth.gradient))[0]
    error = 1000.0 * (out.depth_mm.double() - truth.depth_mm)[0, 0]
    error = error - error[inside].mean()
    return _Maps(out.depth_mm[0, 0].double(), *(torch.where(inside, values, math.nan) for values in (angle, error)))


def _zoomed_on(
    size: Sequence[int], center_px: tuple[float, float], radius_px: float, pitch: float
) -> Callable[[Any, Tensor, dict[str, Any], str], None]:
    """A function that draws a map around a contact."""
    height, width = size
    half_x, half_y = 0.5 * width * pitch, 0.5 * height * pitch
    at_x, at_y = ((c - (n - 1) / 2) * pitch for c, n in zip(center_px, (width, height)))
    reach = 1.15 * radius_px * pitch

    def show(panel: Any, values: Tensor, colours: dict[str, Any], unit: str) -> None:
        picture = panel.imshow(values.numpy(), extent=(-half_x, half_x, half_y, -half_y), **colours)
        panel.figure.colorbar(picture, ax=panel, shrink=0.75, label=unit)
        panel.set_xlim(max(at_x - reach, -half_x), min(at_x + reach, half_x))
        panel.set_ylim(min(at_y + reach, half_y), max(at_y - reach, -half_y))
        panel.set_xlabel("x, mm")
        panel.set_ylabel("y, mm (down)")

    return show


def error_map_name(method: str) -> str:
    """File name of the picture of a method.

    Example:
        >>> error_map_name("response precise, prior")
        'errors_response_precise_prior.png'
    """
    return f"errors_{method.replace(',', '').replace(' ', '_').replace('-', '_').lower()}.png"


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
