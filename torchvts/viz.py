"""Pictures of frames: depth as contours and as a shaded surface, errors, registered clouds; made without a display."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource, LinearSegmentedColormap
from matplotlib.figure import Figure
from torch import Tensor

from .core.files import write_atomically

Array = np.ndarray[Any, Any]

_MAP = "viridis"
_SKIN = LinearSegmentedColormap.from_list("skin", ["#9a8f86", "#d9cfc5"])


def new_figure(width: float, height: float, dpi: int = 110) -> Figure:
    """An empty figure of so many inches, with a canvas that needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def depth_figure(
    depth_mm: Tensor, mm_per_pixel: float, image: Tensor | None = None, contact: Tensor | None = None, title: str = ""
) -> Figure:
    """One frame as three panels: the camera's image with the contact outlined, depth contours, the shaded surface.

    Args:
        depth_mm: one frame, (1, 1, H, W) or (H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        image: (1, 3, H, W) or (3, H, W) in [0, 1]; None leaves its panel out.
        contact: bool, the same shape as depth.
        title: text above the panels.
    Returns:
        The figure.
    """
    depth = _plane(depth_mm)
    figure = new_figure(13.5 if image is not None else 9.0, 4.1)
    panels = 3 if image is not None else 2
    extent = _extent(depth, mm_per_pixel)
    if image is not None:
        axes = figure.add_subplot(1, panels, 1)
        axes.imshow(image.detach().cpu().reshape(3, *depth.shape).permute(1, 2, 0).clamp(0, 1).numpy(), extent=extent)
        if contact is not None and bool(contact.any()):
            axes.contour(_plane(contact.float()), [0.5], colors="white", linewidths=1.0, extent=extent, origin="upper")
        axes.set_title("image, contact outlined")
        _millimetres(axes)
    axes = figure.add_subplot(1, panels, panels - 1)
    draw_contours(figure, axes, depth, mm_per_pixel)
    surface = figure.add_subplot(1, panels, panels, projection="3d")
    draw_surface(surface, depth, mm_per_pixel)
    if title:
        figure.suptitle(title)
    return figure


def draw_contours(figure: Figure, axes: Any, depth: Array, mm_per_pixel: float, step_um: float | None = None) -> None:
    """Draw depth in colour, with contour lines every round number of micrometres and a colour bar.

    Args:
        figure: the figure, for the colour bar.
        axes: the panel.
        depth: (H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        step_um: distance of the lines, micrometres; None chooses it.
    """
    extent = _extent(depth, mm_per_pixel)
    low, high = float(depth.min()) * 1000.0, float(depth.max()) * 1000.0
    picture = axes.imshow(depth * 1000.0, cmap=_MAP, extent=extent, vmin=min(low, 0.0), vmax=max(high, 1.0))
    step = step_um or _round_step(max(high, 1.0) - min(low, 0.0))
    levels = np.arange(np.ceil(low / step) * step, high, step)
    levels = levels[np.abs(levels) > 0.25 * step]  # no line on the undeformed skin
    if len(levels):
        axes.contour(depth * 1000.0, levels, colors="white", linewidths=0.6, extent=extent, origin="upper")
    figure.colorbar(picture, ax=axes, shrink=0.75, label="depth, um")
    axes.set_title(f"depth, a line each {step:g} um")
    _millimetres(axes)


def draw_surface(axes: Any, depth: Array, mm_per_pixel: float, most: int = 220) -> None:
    """Draw depth as a surface lit from the upper left, with exaggerated relief.

    Args:
        axes: a 3D panel.
        depth: (H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        most: largest number of points in each direction.
    """
    stride = max(1, int(np.ceil(max(depth.shape) / most)))
    z = depth[::stride, ::stride]
    y, x = np.mgrid[0 : z.shape[0], 0 : z.shape[1]] * mm_per_pixel * stride
    shades = LightSource(azdeg=315, altdeg=45).shade(
        z, cmap=_SKIN, vert_exag=1.0, dx=mm_per_pixel * stride, dy=mm_per_pixel * stride, blend_mode="soft"
    )
    axes.plot_surface(x, y.max() - y, z, facecolors=shades, rstride=1, cstride=1, linewidth=0, antialiased=False, shade=False)
    axes.set_box_aspect((x.max(), y.max(), max(0.22 * x.max(), float(np.ptp(z)))))
    axes.view_init(elev=42, azim=-65)
    axes.set_title("surface")
    axes.set_xlabel("mm")
    axes.set_zlabel("mm")
    axes.tick_params(labelsize=7)


def comparison_figure(depth_mm: Tensor, truth_mm: Tensor, mm_per_pixel: float, title: str = "") -> Figure:
    """Depth, truth, and their difference in pixels of pitch, side by side."""
    depth, truth = _plane(depth_mm), _plane(truth_mm)
    figure = new_figure(13.5, 3.9)
    axes = figure.subplots(1, 3)
    step = _round_step(max(1000.0 * float(truth.max()), 1.0))
    for panel, values, name in ((axes[0], truth, "truth"), (axes[1], depth, "measured")):
        draw_contours(figure, panel, values, mm_per_pixel, step)
        panel.set_title(f"{name}: {panel.get_title()}")
    error = (depth - truth) / mm_per_pixel
    most = max(float(np.abs(error).max()), 1e-6)
    picture = axes[2].imshow(error, cmap="RdBu_r", vmin=-most, vmax=most, extent=_extent(depth, mm_per_pixel))
    figure.colorbar(picture, ax=axes[2], shrink=0.75, label="error, px")
    axes[2].set_title(f"error: largest {most:.3f} px, RMS {float(np.sqrt((error**2).mean())):.4f} px")
    _millimetres(axes[2])
    if title:
        figure.suptitle(title)
    return figure


def pose_figure(source: Tensor, target: Tensor, T_target_source: Tensor, title: str = "", most: int = 4000) -> Figure:
    """Two clouds (N, 3) before and after registration, each from above and in space, as in figure 8 of the paper."""
    clouds = [points.detach().cpu().double()[:: max(1, len(points) // most)] for points in (source, target)]
    T = T_target_source.detach().cpu().double()
    moved = clouds[0] @ T[:3, :3].T + T[:3, 3]
    figure = new_figure(13.5, 3.8)
    for k, (name, points) in enumerate((("before", clouds[0]), ("after", moved))):
        above = figure.add_subplot(1, 4, 2 * k + 1)
        space = figure.add_subplot(1, 4, 2 * k + 2, projection="3d")
        for cloud, colour, label in ((clouds[1], "#1b6ca8", "target"), (points, "#d1495b", "source")):
            x, y, z = cloud.numpy().T
            above.scatter(x, y, s=1.2, c=colour, label=label, alpha=0.6, linewidths=0)
            space.scatter(x, y, z, s=0.8, c=colour, alpha=0.6, linewidths=0)
        above.set_aspect("equal")
        above.set_title(f"{name}, from above")
        above.set_xlabel("x, mm")
        above.set_ylabel("y, mm (up)")
        above.legend(markerscale=6, fontsize=7, loc="upper right")
        spans = np.ptp(np.concatenate((clouds[1].numpy(), points.numpy())), axis=0)
        space.set_box_aspect((spans[0], spans[1], max(spans[2], 0.3 * spans[0])))
        space.view_init(elev=35, azim=-65)
        space.set_title(name)
        space.tick_params(labelsize=6)
    if title:
        figure.suptitle(title)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure in the format of the suffix; an interrupted write leaves no file."""
    with write_atomically(path) as temporary:
        figure.savefig(str(temporary))


def _plane(tensor: Tensor) -> Array:
    height, width = tensor.shape[-2:]
    return tensor.detach().to(device="cpu", dtype=torch.float64).reshape(height, width).numpy()


def _extent(depth: Array, mm_per_pixel: float) -> tuple[float, float, float, float]:
    half_y, half_x = (0.5 * n * mm_per_pixel for n in depth.shape)
    return -half_x, half_x, half_y, -half_y


def _millimetres(axes: Any) -> None:
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm (down)")


def _round_step(span: float) -> float:
    """A step of 1, 2 or 5 times a power of ten that divides ``span`` into about ten parts."""
    raw = span / 10.0
    power = 10.0 ** np.floor(np.log10(raw))
    return float(min((s for s in (power, 2 * power, 5 * power, 10 * power) if s >= raw - 1e-12), default=10 * power))
