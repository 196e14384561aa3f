"""Pictures of where methods break: a corruption in frames and curves, and all breaking points at once."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from torchvts.viz import depth_colors, new_figure

from .gallery import CORRUPTIONS, Corruption
from .methods import MASK_STYLE, METHODS
from .rows import Row, mean
from .stability import DEPTH_LIMIT, MASK, MASK_LIMIT, NORMAL_LIMIT_DEG, Breaking, depth_share, in_words


def corruption_figure(corruption: Corruption, rows: Sequence[Row], points: Sequence[Breaking]) -> Figure:
    """Three frames of a corruption, and the errors of each method against severity, with limits and breaking points.

    Methods whose errors agree within a tenth at every severity are one line; the list beside the panels names them all.
    """
    figure = new_figure(11.0, 3.4, 100)
    grid = figure.add_gridspec(3, 5, width_ratios=(0.75, 2, 2, 1.3, 1.9))
    last = len(corruption.severities) - 1
    for k, place in enumerate((0, last // 2 + 1, last)):
        axes = figure.add_subplot(grid[k, 0])
        axes.imshow(corruption.make(corruption.severities[place], 0).image[0].permute(1, 2, 0).mul(1.4).clamp(0, 1).numpy())
        axes.set_title(f"{corruption.severities[place]:g} {corruption.unit}", fontsize=8, pad=2)
        axes.set_axis_off()
    panels = [figure.add_subplot(grid[:, k]) for k in (1, 2, 3)]
    curves = {method: _Curves.of(method, corruption, rows) for method in dict.fromkeys(row.method for row in rows)}
    line_of = _lines(curves)
    for method in dict.fromkeys(line_of.values()):
        _draw_means(panels[0], curves[method].normal_deg, _style(method), 0.2)
        _draw_means(panels[1], curves[method].depth_percent, _style(method), 0.1)
    if "fast" in curves:
        _draw_means(panels[2], curves["fast"].iou, _style(MASK), 0.0)
    _label_severities(panels, corruption)
    for point in points:
        if not isinstance(point.at, str):
            for axes in panels[2:] if point.method == MASK else panels[:2]:
                axes.axvline(last * point.held, ymax=0.06, color=_style(line_of.get(point.method, MASK))["color"], lw=2)
    _list_breaking_points(figure.add_subplot(grid[:, 4]), corruption, points, line_of)
    return figure


class _Curves(NamedTuple):
    """Means over seeds of a method at each severity; NaN where every run failed."""

    normal_deg: list[float]
    depth_percent: list[float]
    iou: list[float]

    @classmethod
    def of(cls, method: str, corruption: Corruption, rows: Sequence[Row]) -> "_Curves":
        groups = [[row for row in rows if row.method == method and row.severity == s] for s in corruption.severities]

        def means(value: Callable[[Row], float | None]) -> list[float]:
            return [math.nan if (found := mean(value(row) for row in group)) is None else found for group in groups]

        shares = means(depth_share)
        return cls(
            means(lambda row: row.error("normal_deg")), [100.0 * share for share in shares], means(lambda row: row.error("iou"))
        )


def _lines(curves: Mapping[str, _Curves]) -> dict[str, str]:
    """For each method the one whose line stands for it: the first with the same errors, within a tenth."""
    line_of: dict[str, str] = {}
    for method, own in curves.items():
        same = (
            other
            for other in dict.fromkeys(line_of.values())
            if np.allclose(own.normal_deg, curves[other].normal_deg, rtol=0.1, atol=0.02, equal_nan=True)
            and np.allclose(own.depth_percent, curves[other].depth_percent, rtol=0.1, atol=0.02, equal_nan=True)
        )
        line_of[method] = next(same, method)
    return line_of


def _style(method: str) -> dict[str, Any]:
    return dict(MASK_STYLE if method == MASK else METHODS[method].style)


def _label_severities(panels: Sequence[Any], corruption: Corruption) -> None:
    """Limits, ticks and titles of the panels of normals, depth and mask."""
    titles = ("mean error of normals in contact, deg", "depth RMS, % of the press", "contact mask, IoU")
    for axes, limit, title in zip(panels, (NORMAL_LIMIT_DEG, 100 * DEPTH_LIMIT, MASK_LIMIT), titles):
        axes.axhline(limit, color="black", lw=0.8, ls=(0, (5, 3)))
        axes.text(0.0, limit, "limit", fontsize=8, va="bottom")
        labels = [f"{s:g}" for s in corruption.severities]
        axes.set_xticks(range(len(labels)), labels)
        axes.tick_params(labelsize=8)
        if axes is panels[2] and len("".join(labels)) > 18:  # the narrow one
            axes.tick_params(axis="x", rotation=40)
        axes.set_xlabel(f"{corruption.name}, {corruption.unit}".rstrip(", "), fontsize=9)
        axes.set_title(title, fontsize=9)
        axes.grid(alpha=0.25)
    for axes in panels[:2]:
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_formatter("{x:g}")
    panels[2].set_ylim(-0.03, 1.05)


def _list_breaking_points(legend: Any, corruption: Corruption, points: Sequence[Breaking], line_of: Mapping[str, str]) -> None:
    """Line, breaking point and name of each method; methods of one line stand together, with one piece of it."""
    legend.set_axis_off()
    legend.set(xlim=(0.0, 1.0), ylim=(0.0, 1.0))
    legend.text(0.0, 1.0, f"breaks at{f', {corruption.unit}' if corruption.unit else ''}", fontsize=9, weight="bold", va="top")
    lines = [line_of.get(point.method, MASK) for point in points]
    ordered = sorted(zip(points, lines), key=lambda pair: lines.index(pair[1]))
    for k, (point, line) in enumerate(ordered):
        y, style = 0.87 - 0.088 * k, _style(line)
        if k == 0 or ordered[k - 1][1] != line:
            legend.plot((0.0, 0.13), (y, y), **style)
        legend.text(0.17, y, point.text, fontsize=9, va="center", weight="bold")
        legend.text(0.43, y, point.method, fontsize=9, va="center")


def _draw_means(axes: Any, means: Sequence[float], style: dict[str, Any], least: float) -> None:
    """Means over seeds without failed runs; a cross at the top where all failed."""
    values = np.maximum(np.asarray(means), least)
    axes.plot(range(len(values)), values, **style)
    failed = np.flatnonzero(np.isnan(values))
    axes.plot(failed, [0.97] * len(failed), "x", color=style["color"], ms=6, transform=axes.get_xaxis_transform())


def overview_figure(points: Sequence[Breaking]) -> Figure:
    """The normalised severity at which each method breaks: methods from the most to the least stable, the worst corruptions first.

    Severity is 0 at the first step of a corruption and 1 at the last one; a cell that is white holds to the end.
    """
    by_place = {(p.corruption, p.method): p for p in points}
    names = list(dict.fromkeys(p.corruption for p in points))
    methods = [m for m in dict.fromkeys(p.method for p in points) if m not in ("flat", MASK)]
    methods.sort(key=lambda method: -sum(by_place[name, method].held for name in names))
    names.sort(key=lambda name: sum(by_place[name, method].held for method in methods))
    methods.append(MASK)
    held = np.array([[by_place[name, method].held for method in methods] for name in names])
    figure = new_figure(3.0 + 0.74 * len(methods), 1.5 + 0.215 * len(names), 100)
    axes = figure.subplots()
    colors, norm = depth_colors(-1.0, 0.0)
    picture = axes.pcolormesh(held - 1.0, cmap=colors, norm=norm, edgecolors="0.85", linewidth=0.4)
    for row, name in enumerate(names):
        for column, method in enumerate(methods):
            at = by_place[name, method].at
            text = {"never": "", "always": "always"}[at] if isinstance(at, str) else f"{float(f'{at:.2g}'):g}"
            color = "white" if held[row, column] < 0.35 else "black"
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=8.5, color=color)
    axes.axvline(len(methods) - 1, color="black", lw=1.5)
    axes.invert_yaxis()
    labels = [
        f"{m.replace(', ', ',' + chr(10)).replace(MASK, 'contact' + chr(10) + 'mask')}\n({share:.0%})"
        for m, share in zip(methods, held.mean(0))
    ]
    axes.set_xticks(np.arange(len(methods)) + 0.5, labels, fontsize=8.5)
    axes.set_yticks(np.arange(len(names)) + 0.5, [in_words(CORRUPTIONS[name]) for name in names], fontsize=8.5)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    bar = figure.colorbar(picture, ax=axes, location="bottom", shrink=0.7, aspect=40, pad=0.01)
    bar.set_ticks([-1.0, -0.75, -0.5, -0.25, 0.0], labels=["0: first step", "0.25", "0.5", "0.75", "1: holds"], fontsize=8.5)
    bar.set_label("normalised severity at which the method breaks (in brackets: mean); in cells: the severity itself", fontsize=8.5)
    return figure
