"""Pictures of frames: depth as contours and as a shaded surface, registered clouds; made without a display."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import patheffects
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource, LinearSegmentedColormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator
from torch import Tensor

from .calibration import Press
from .calibration.contacts import INSIDE
from .core.files import write_atomically
from .model import Calibration
from .model.report import COUNTS_LITTLE, PressRow
from .model.stated_error import error_over_skin, press_next
from .pipeline import DepthPipeline
from .skin import DotMotion

Array = np.ndarray[Any, Any]

_BELOW = ("#5c2503", "#b35806", "#f1a340", "#f6e0c3")
_ABOVE = ("#b5dfe3", "#55b1c5", "#1f78b4", "#28428f", "#1b1650")
_MAP = LinearSegmentedColormap.from_list(
    "depth",
    [
        *((0.5 * k / len(_BELOW), color) for k, color in enumerate(_BELOW)),
        (0.5, "#f7f7f7"),
        *((0.5 + 0.5 * (k + 1) / len(_ABOVE), color) for k, color in enumerate(_ABOVE)),
    ],
    N=1025,
)
"""Zero is near white at 0.5, depth above it blue, below it brown; nothing depends on red against green."""

SOURCE, TARGET = "#d55e00", "#0072b2"
"""Colours of the two clouds of a pose; blue and vermilion, which all readers distinguish."""

DOUBT = "#a63603"
"""Colour of doubts in the picture of a frame."""

NAME_SHOWN = 22
"""Characters of a name in a title."""

PRESSES_SHOWN = 6
"""Presses in the picture of a calibration."""

MOST_POINTS = 160
"""Largest number of points of a surface in each direction."""

ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
"""Round values, between two powers of ten."""

_HALO = [patheffects.withStroke(linewidth=2.0, foreground="black")]


def new_figure(width: float, height: float, dpi: int = 150) -> Figure:
    """An empty figure of so many inches, with a canvas that needs no display; text of 10 points is readable up to 10 inches."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def depth_colors(low: float, high: float) -> tuple[ListedColormap, Normalize]:
    """Colours of depth from ``low`` to ``high`` in which zero is always the same near white, and equal steps are equal.

    Args:
        low: at most 0.
        high: above 0, the same unit.
    Returns:
        Colour map and norm for Matplotlib: a part of one diverging map, as long as the range.
    Example:
        >>> import numpy as np
        >>> zeros = [colors(norm(0.0)) for colors, norm in (depth_colors(-1.0, 4.0), depth_colors(-300.0, 300.0))]
        >>> bool(np.allclose(zeros[0], zeros[1], atol=0.02))
        True
    """
    most = max(-low, high)
    return ListedColormap(_MAP(0.5 + 0.5 * np.linspace(low, high, 512) / most)), Normalize(low, high)


def depth_range(*depths: Array) -> tuple[float, float]:
    """Range of the colours that several maps of depth share: it holds zero, and more than that."""
    return min(0.0, *(float(d.min()) for d in depths)), max(1e-3, *(float(d.max()) for d in depths))


def depth_figure(
    depth_mm: Tensor,
    mm_per_pixel: float,
    image: Tensor,
    contact: Tensor | None = None,
    title: str = "",
    exaggeration: float | None = None,
    metric: bool = True,
    doubts: Sequence[str] = (),
    moved: DotMotion | None = None,
) -> Figure:
    """One frame as three panels of one extent: the camera's image with the contact outlined, depth contours, the shaded surface.

    Args:
        depth_mm: one frame, (1, 1, H, W) or (H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        image: (1, 3, H, W) or (3, H, W) in [0, 1].
        contact: bool, the same shape as depth.
        title: text above the panels.
        exaggeration: of the surface's heights; None takes :func:`exaggeration_of` this depth.
        metric: whether depth is in mm; otherwise the title and the bar say that it is not.
        doubts: why not to trust it, a sentence each, above the panels.
        moved: of one frame, whose printed dots are drawn as arrows over the image; None for none.
    """
    depth = _plane(depth_mm)
    title += "" if metric else ", NOT METRIC"
    ratio = depth.shape[0] / depth.shape[1]
    wide = 2.45 if ratio < 1.0 else 2.0
    text = _wrapped(doubts)
    above = (0.62 if title else 0.32) + (0.05 + 0.16 * (text.count("\n") + 1) if text else 0.0)
    high, left = wide * ratio, 0.6 + wide + 0.5
    lower, size = 0.5, (left + wide + 0.95 + 3.4, high + above + 0.5)
    figure = new_figure(*size)
    figure.set_layout_engine("none")

    def panel(x: float, y: float, width: float, height: float, **options: Any) -> Any:
        return figure.add_axes((x / size[0], y / size[1], width / size[0], height / size[1]), **options)

    axes = panel(0.6, lower, wide, high)
    axes.imshow(_picture(image.reshape(3, *depth.shape)), extent=_extent(depth, mm_per_pixel))
    if contact is not None and bool(contact.any()):
        draw_outline(axes, _plane(contact.float()), mm_per_pixel)
    if moved is not None:
        draw_motion(axes, moved)
    axes.set_title("image" if contact is None else "image, contact outlined", fontsize=10)
    _millimetres(axes)
    axes = panel(left, lower, wide, high)
    draw_contours(figure, axes, depth, mm_per_pixel, metric=metric)
    axes.set_ylabel("")
    space = panel(left + wide + 0.55, 0.0, size[0] - left - wide - 0.75, lower + high, projection="3d")
    draw_surface(space, depth, mm_per_pixel, exaggeration=exaggeration)
    if title:
        figure.suptitle(title, fontsize=11, y=1.0 - 0.08 / size[1], va="top")
    if text:
        figure.text(0.5, 1.0 - (0.34 if title else 0.06) / size[1], text, fontsize=9, color=DOUBT, ha="center", va="top")
    return figure


def draw_outline(axes: Any, mask: Array, mm_per_pixel: float, color: str = "white", style: str = "-") -> None:
    """Outline a mask (H, W) of 0 and 1, with a dark edge so that it shows on any image."""
    drawn = axes.contour(
        mask, [0.5], colors=color, linewidths=1.0, linestyles=style, extent=_extent(mask, mm_per_pixel), origin="upper"
    )
    drawn.set_path_effects(_HALO)


def draw_motion(axes: Any, moved: DotMotion) -> None:
    """Arrows of one frame's printed dots from rest over an image in mm, in true length, and a bar of the largest one's decade.

    A dot that is not seen has none; a short arrow is a point.
    """
    seen = moved.seen[0].cpu()
    rest = moved.rest_mm.detach().cpu()[seen]
    step = moved.displacement_mm[0].detach().cpu()[seen, :2]
    origin = torch.tensor([moved.width, moved.height]) * (0.5 * moved.mm_per_pixel)  # extents begin at the image's corner
    x, y = (rest + origin).T.numpy()
    axes.quiver(x, y, *step.T.numpy(), angles="xy", scale_units="xy", scale=1.0, color=SOURCE, width=0.006, minlength=0.5)
    longest = float(step.norm(dim=1).max()) if len(step) else 0.0
    if longest > 0.0:
        bar = 10.0 ** math.floor(math.log10(longest))
        left, low = 0.04 * moved.width * moved.mm_per_pixel, 0.94 * moved.height * moved.mm_per_pixel
        axes.plot([left, left + bar], [low, low], color="white", lw=2.5, path_effects=_HALO)
        axes.text(left, 0.985 * low, f"{bar:g} mm", color="white", fontsize=7, va="bottom", path_effects=_HALO)


def draw_contours(
    figure: Figure,
    axes: Any,
    depth: Array,
    mm_per_pixel: float,
    range_mm: tuple[float, float] | None = None,
    metric: bool = True,
) -> None:
    """Draw depth in colour, with contour lines every round part of a millimetre and a colour bar.

    Args:
        figure: the figure, for the colour bar.
        axes: the panel.
        depth: (H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        range_mm: range of the colours, for panels that are compared; None takes that of the depth (:func:`depth_range`).
        metric: whether depth is in mm; otherwise the bar says that it is not.
    """
    low, high = range_mm or depth_range(depth)
    colors, norm = depth_colors(low, high)
    picture = axes.imshow(depth, cmap=colors, norm=norm, extent=_extent(depth, mm_per_pixel))
    step = _round_step(high - low)
    _draw_lines(axes, depth.clip(low, high), mm_per_pixel, step, colors, norm)
    draw_bar(figure, axes, picture, "depth, mm" if metric else "depth, NOT METRIC")
    axes.set_title(f"depth, a line every {step:g} mm", fontsize=10)
    _millimetres(axes)


def _draw_lines(axes: Any, depth: Array, mm_per_pixel: float, step: float, colors: ListedColormap, norm: Normalize) -> None:
    """Contour lines every ``step``, in the unit of depth, white on dark colours and dark on light ones."""
    levels = np.arange(np.ceil(depth.min() / step), np.ceil(depth.max() / step)) * step
    levels = levels[np.abs(levels) > 0.25 * step]  # no line on the undeformed skin
    if len(levels):
        shades = ["white" if np.dot(colors(norm(level))[:3], (0.3, 0.59, 0.11)) < 0.5 else "0.25" for level in levels]
        extent = _extent(depth, mm_per_pixel)
        axes.contour(depth, levels, colors=shades, linewidths=0.5, linestyles="-", extent=extent, origin="upper")


def draw_bar(figure: Figure, axes: Any, picture: Any, label: str) -> None:
    """A colour bar as high as its panel."""
    figure.colorbar(picture, cax=axes.inset_axes((1.03, 0.0, 0.04, 1.0)), label=label)


def exaggeration_of(height_mm: float, width_mm: float) -> float:
    """The round factor that makes a relief about a seventh as high as its frame is wide; pictures of one run share it.

    Example:
        >>> exaggeration_of(0.4, 20.0)
        6.0
    """
    factors = [power * value for power in (1.0, 10.0, 100.0) for value in ROUND]
    return max((factor for factor in factors if factor * height_mm <= 0.15 * width_mm), default=1.0)


def draw_surface(axes: Any, depth: Array, mm_per_pixel: float, exaggeration: float | None = None) -> None:
    """Draw depth as a surface lit from the upper left, coloured as the contours are; the title states the exaggeration of height.

    Args:
        axes: a 3D panel.
        depth: (H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        exaggeration: of heights; None takes :func:`exaggeration_of` this depth.
    """
    stride = max(1, int(np.ceil(max(depth.shape) / MOST_POINTS)))
    z = depth[::stride, ::stride]
    left, _, lower, _ = _extent(depth, mm_per_pixel)
    rows, columns = np.mgrid[0 : z.shape[0], 0 : z.shape[1]] * mm_per_pixel * stride
    x, y = left + columns, rows - lower
    low, high = depth_range(depth)
    exaggeration = exaggeration or exaggeration_of(max(float(np.ptp(z)), 0.02 * high, 1e-6), -2.0 * left)
    colors, norm = depth_colors(low, high)
    step = mm_per_pixel * stride
    light = LightSource(azdeg=315, altdeg=50)
    shades = light.shade_rgb(colors(norm(z))[..., :3], z * exaggeration, blend_mode="soft", vert_exag=1.0, dx=step, dy=step)
    axes.plot_surface(x, y, z, facecolors=shades, rstride=1, cstride=1, linewidth=0, antialiased=False, shade=False)
    axes.set(xlim=(left, -left), ylim=(lower, -lower), zlim=(float(z.min()), max(float(z.max()), float(z.min()) + 1e-6)))
    axes.plot([left, -left, -left, left, left], [lower, lower, -lower, -lower, lower], 0.0, color="0.6", lw=0.8)
    axes.set_box_aspect(
        (-2.0 * left, 2.0 * lower, exaggeration * max(float(np.ptp(z)), 1e-6)), zoom=1.12 if lower <= -left else 1.0
    )
    axes.view_init(elev=42, azim=-65)
    axes.set_title(f"surface, height x {exaggeration:g}", fontsize=10)
    _space_labels(axes)


def sheet_figure(
    frames: Sequence[tuple[float | str, Array, str]],
    mm_per_pixel: float,
    title: str = "",
    metric: bool = True,
    doubts: Sequence[str] = (),
) -> Figure:
    """Depth of a few frames in one range of colours, with contour lines and one colour bar.

    Args:
        frames: time, s, or name, depth (H, W), mm, and why it is in doubt ("" for nothing), of each.
        mm_per_pixel: pixel pitch, mm.
        title: text above the panels, as which of how many frames they are.
        metric: whether depth is in mm; otherwise the title and the bar say that it is not.
        doubts: why not to trust any of them, a sentence each, below the panels; the first doubt of a frame follows.
    """
    names = [name if isinstance(name, str) else f"{name:.2f} s" for name, _, _ in frames]
    in_doubt = [f"{name} IN DOUBT: {doubt}" for name, (_, _, doubt) in zip(names, frames, strict=True) if doubt]
    text = _wrapped([*doubts, *in_doubt[:1]], 140)
    columns = min(3, len(frames))
    rows = -(-len(frames) // columns)
    height, width = frames[0][1].shape
    lines = 0.17 * (text.count("\n") + 1) if text else 0.0
    figure = new_figure(9.5, 0.5 + 0.3 * bool(title) + lines + rows * (0.3 + 7.5 / columns * height / width))
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    span = depth_range(*(depth for _, depth, _ in frames))
    colors, norm = depth_colors(*span)
    step = _round_step(span[1] - span[0])
    for k, ((_, depth, doubt), panel) in enumerate(zip(frames, axes.flat)):
        picture = panel.imshow(depth, cmap=colors, norm=norm, extent=_extent(depth, mm_per_pixel))
        _draw_lines(panel, depth, mm_per_pixel, step, colors, norm)
        panel.set_title(names[k] + (", IN DOUBT" if doubt else ""), fontsize=10, color=DOUBT if doubt else "black")
        panel.set(xlabel="x, mm" if k >= len(frames) - columns else "", ylabel="" if k % columns else "y, mm (down)")
    for panel in axes.flat[len(frames) :]:
        panel.remove()
    unit = "mm" if metric else "mm, NOT METRIC"
    figure.colorbar(picture, ax=axes.ravel()[: len(frames)], aspect=30, shrink=0.9, label=f"depth, {unit}; a line every {step:g}")
    if title:
        figure.suptitle(title + ("" if metric else ", NOT METRIC"), fontsize=11)
    if text:
        figure.supxlabel(text, fontsize=8, color=DOUBT, x=0.01, ha="left")
    return figure


def pose_figure(source: Tensor, target: Tensor, T_target_source: Tensor, title: str = "") -> Figure:
    """Two clouds (N, 3) before and after registration, each from above and in space, as in figure 8 of the paper, in one scale."""
    clouds = [points.detach().cpu().double()[:: max(1, len(points) // 4000)] for points in (source, target)]
    T = T_target_source.detach().cpu().double()
    states = {"before": clouds[0], "after": clouds[0] @ T[:3, :3].T + T[:3, 3]}
    everything = torch.cat((clouds[1], *states.values())).numpy()
    low, high = everything.min(0), everything.max(0)
    low, high = low - 0.04 * (high - low), high + 0.04 * (high - low)
    spans = high - low
    exaggeration = exaggeration_of(max(float(spans[2]), 1e-6), float(max(spans[:2])))
    figure = new_figure(10.0, 3.1)
    for k, (name, points) in enumerate(states.items()):
        above = figure.add_subplot(1, 4, 2 * k + 1)
        space = figure.add_subplot(1, 4, 2 * k + 2, projection="3d")
        for cloud, color, label in ((clouds[1], TARGET, "target"), (points, SOURCE, "source")):
            x, y, z = cloud.numpy().T
            above.scatter(x, y, s=1.2, c=color, label=label, alpha=0.6, linewidths=0)
            space.scatter(x, y, z, s=0.8, c=color, alpha=0.6, linewidths=0)
        above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x, mm", ylabel="y, mm (up)")
        above.set_title(f"{name}, from above", fontsize=10)
        _few_ticks(above)
        space.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        space.set_box_aspect((spans[0], spans[1], exaggeration * spans[2]), zoom=1.0)
        space.view_init(elev=35, azim=-65)
        space.set_title(f"{name}, height x {exaggeration:g}", fontsize=10, y=0.93)
        _space_labels(space)
    above.set_ylabel("")  # it is that of the first panel
    figure.legend(*above.get_legend_handles_labels(), loc="outside lower center", ncols=2, markerscale=8, frameon=False)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def calibration_figure(calibration: Calibration, presses: Sequence[Press]) -> Figure:
    """What a calibration was made of: the background with the balls where they were found, the error of normals that it states over
    the skin with a cross where to press next, up to :data:`PRESSES_SHOWN` presses beside what they leave, and all doubts.

    Args:
        calibration: of the unit.
        presses: that were given; those of the report are drawn.
    """
    rows = {row["name"]: row for row in calibration.report.get("presses", [])}
    given = [press for press in presses if press.name in rows]
    even = given[:: max(1, -(-len(given) // PRESSES_SHOWN))]
    little = {press for press in given if rows[press.name]["weight"] < COUNTS_LITTLE}
    shown = sorted({*even, *given}, key=lambda press: (press not in little, press not in even))[:PRESSES_SHOWN]
    doubts = calibration.report.get("doubts") or ["no doubts"]
    text = _wrapped(doubts)
    height, width = calibration.background.shape[1:]
    lines, side = -(-len(shown) // 2), 2.35 * min(1.4, height / width)
    figure = new_figure(10.4, (lines + 1) * (side + 0.35) + 0.7 + 0.17 * (text.count("\n") + 1))
    ratios = ((lines + 1) * (side + 0.35) + 0.4, 0.3 + 0.17 * (text.count("\n") + 1))
    parts: Any = figure.subfigures(2, 1, height_ratios=ratios)
    top, bottom = parts
    bottom.text(0.01, 0.98, text, fontsize=8, va="top")
    axes = top.subplots(lines + 1, 4, squeeze=False)
    for panel in axes.flat:
        panel.set_axis_off()
    axes[0, 0].imshow(_picture(calibration.background_value))
    axes[0, 0].set_title("balls found (dashed: left out)" if rows else "background", fontsize=9)
    for row in rows.values():
        _circle(axes[0, 0], row)
    if (found := error_over_skin(calibration)) is not None:
        error, _, _ = found
        least = float(error.min())
        most = max(1.5 * least, float(error.flatten().quantile(0.9)))  # corners, where no ball fits, would take all colours
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        drawn = axes[0, 1].imshow(error.numpy(), cmap="cividis", vmin=least, vmax=most, extent=extent)
        axes[0, 1].set_title("error in a contact's middle, deg", fontsize=9)
        axes[0, 1].set(xlim=extent[:2], ylim=extent[2:])  # circles may reach beyond
        if calibration.metric and (least_known := press_next(calibration)) is not None:
            axes[0, 1].plot(*least_known[0], "+", color="white", markersize=9, path_effects=_HALO)
        figure.colorbar(drawn, ax=axes[0, 1], shrink=0.7, extend="max")
        for row in rows.values():
            _circle(axes[0, 1], row)
    facts = _facts(calibration) + (f"\n{len(shown)} of {len(given)} presses below" if len(shown) < len(given) else "")
    axes[0, 2].text(0.0, 1.0, facts, fontsize=9, va="top", transform=axes[0, 2].transAxes)
    for k, press in enumerate(shown):
        image, left = axes[1 + k // 2, 2 * (k % 2)], axes[1 + k // 2, 2 * (k % 2) + 1]
        row = rows[press.name]
        image.imshow(_picture(press.image))
        _circle(image, row)
        name = press.name if len(press.name) <= NAME_SHOWN else f"...{press.name[-NAME_SHOWN:]}"
        counts = "" if row["weight"] >= COUNTS_LITTLE else f", counts {row['weight']:.2f}"
        image.set_title(name + (counts if row["used"] else ", left out"), fontsize=9)
        if "center_px" not in row:
            continue
        off, inner_deg = _left_deg(calibration, press, row)
        drawn = left.imshow(off, cmap="cividis", vmin=0.0, vmax=10.0)
        left.set_title(f"off the ball by {inner_deg:.1f} degrees", fontsize=9)
        (x, y), reach = row["center_px"], 1.2 * row["contact_radius_px"]
        left.set(xlim=(x - reach, x + reach), ylim=(y + reach, y - reach))
        _circle(left, row)
        figure.colorbar(drawn, ax=left, shrink=0.7, ticks=[0, 5, 10], extend="max")
    return figure


def _facts(calibration: Calibration) -> str:
    report = calibration.report
    words = {"held_out_deg": "on each press by the others", "stated_deg": "expected anywhere"}
    errors = [(text, report.get(key)) for key, text in words.items()]
    figures = [f"{text}: {value:.2f} degrees" for text, value in errors if isinstance(value, float)]
    return "\n".join(
        [*textwrap.wrap(str(report.get("reason", "")), 46), *figures, "metric" if calibration.metric else "NOT METRIC"]
    )


def _picture(image: Tensor) -> Array:
    picture: Array = image.detach().cpu().permute(1, 2, 0).clamp(0, 1).float().numpy()
    return picture


def _circle(axes: Any, row: PressRow) -> None:
    if "center_px" not in row:
        return
    color, style = ("white", "-") if row["used"] else ("#f1a340", "--")
    drawn = axes.add_patch(Circle(row["center_px"], row["contact_radius_px"], fill=False, color=color, linestyle=style))
    drawn.set_path_effects(_HALO)


def _left_deg(calibration: Calibration, press: Press, row: PressRow) -> tuple[Array, float]:
    """(H, W): angle between the normals found and the ball's in its contact, degrees, NaN elsewhere; and its mean well inside."""
    pitch_mm, radius_mm = calibration.sensor.mm_per_pixel, 0.5 * press.ball_diameter_mm
    with torch.no_grad():
        out = DepthPipeline.from_calibration(calibration, "fast")(press.image.detach().cpu().to(calibration.background.dtype)[None])
    height, width = press.image.shape[1:]
    x = (torch.arange(width) - row["center_px"][0]) * pitch_mm / radius_mm
    y = (torch.arange(height)[:, None] - row["center_px"][1]) * pitch_mm / radius_mm
    square = x.square() + y.square()
    ball = torch.stack((x.expand(height, width), y.expand(height, width), (1.0 - square).clamp_min(0.0).sqrt()))
    angle = torch.rad2deg(torch.acos((out.normal[0] * ball).sum(0).clamp(-1.0, 1.0)))
    reach = row["contact_radius_px"] * pitch_mm / radius_mm
    return angle.masked_fill(square >= reach**2, math.nan).numpy(), float(angle[square < (INSIDE * reach) ** 2].mean())


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format of the suffix; an interrupted write leaves no file."""
    with write_atomically(path) as temporary:
        figure.savefig(str(temporary))


def _wrapped(doubts: Sequence[str], width: int = 150) -> str:
    """Doubts as lines of so many characters, each doubt from its own line on."""
    return "\n".join("\n".join(textwrap.wrap(doubt, width, subsequent_indent="    ")) for doubt in doubts)


def _plane(tensor: Tensor) -> Array:
    height, width = tensor.shape[-2:]
    if tensor.numel() != height * width:
        raise ValueError(f"depth: expected one frame, got {tuple(tensor.shape)}: draw the frames of a batch one by one")
    return tensor.detach().to(device="cpu", dtype=torch.float64).reshape(height, width).numpy()


def _extent(depth: Array, mm_per_pixel: float) -> tuple[float, float, float, float]:
    half_y, half_x = (0.5 * n * mm_per_pixel for n in depth.shape)
    return -half_x, half_x, half_y, -half_y


def _millimetres(axes: Any) -> None:
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm (down)")
    _few_ticks(axes)


def _few_ticks(axes: Any) -> None:
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))


def _space_labels(axes: Any) -> None:
    """Few ticks and close labels on the axes of a surface or cloud."""
    axes.set_xlabel("x, mm", labelpad=-6)
    axes.set_ylabel("y, mm", labelpad=-6)
    axes.tick_params(labelsize=8, pad=-2)
    _few_ticks(axes)
    low, high = axes.get_zlim()
    top = f"{high:.2g} mm".rjust(16)  # labels are centred: the spaces keep it off the axis
    ticks = {0.0: "0", high: top} if low <= 0.0 < 0.8 * high else {high: top}
    axes.set_zticks(list(ticks), list(ticks.values()))


def _round_step(span: float) -> float:
    """A step of 1, 2 or 5 times a power of ten that divides ``span`` into about ten parts, 7 to 14."""
    raw = span / 10.0
    power = 10.0 ** np.floor(np.log10(raw))
    return float(min((s for s in (power, 2 * power, 5 * power, 10 * power) if s >= 0.7 * raw), default=10 * power))
