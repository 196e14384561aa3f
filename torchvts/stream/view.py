"""Shows a stream in 3D with rerun, live or as a recording: image, depth, normals, contact, surface, and curves over time."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from ..core.checks import check_path, check_positive, check_shape
from ..core.files import check_target
from .live import TactileFrame
from .overlay import outlines, round_up

AXIS_COLOURS = ((230, 60, 50), (60, 200, 80), (60, 90, 240))
"""Of x, y and z."""

EXAGGERATION = 3.0
"""Heights are so many times as large on the screen."""


def has_screen() -> bool:
    """Whether a window can be opened: under Linux a screen must be named."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def require_rerun() -> Any:
    """The package rerun; ImportError where it is not installed."""
    try:
        import rerun
    except ImportError as error:
        raise ImportError("rerun-sdk: expected it for the live view, got none: pip install 'torchvts[view]'") from error
    return rerun


class LiveView:
    """Logs the frames of a stream to rerun: to its viewer, which is started, to a file, or to both.

    Entities: ``image`` with ``image/contact``, ``depth`` (mm), ``normals``, ``surface`` (points, mm: x right, y up, z to camera),
    ``curves/area_mm2`` and ``curves/deepest_mm``, on the timelines ``frame`` and ``time``; ``surface/axes``, where poses are added.

    Args:
        mm_per_pixel: pixel pitch, mm.
        metric: whether depth is in mm; otherwise the titles say that it is not.
        save: file to record to, .rrd; None for none.
        viewer: start the viewer, which needs a screen.
        exaggeration: factor of the height of the surface on the screen; its points are true.
    Raises:
        ImportError: rerun is not installed.
        ValueError: a file with another suffix; neither file nor viewer.
    """

    def __init__(
        self,
        mm_per_pixel: float,
        metric: bool = True,
        *,
        save: str | Path | None = None,
        viewer: bool = False,
        exaggeration: float = EXAGGERATION,
    ) -> None:
        self._rr = require_rerun()
        self.mm_per_pixel, self.metric = check_positive("mm_per_pixel", mm_per_pixel), metric
        self.exaggeration = check_positive("exaggeration", exaggeration)
        if save is None and not viewer:
            raise ValueError("save: expected a file, or the viewer, got neither: nothing would be shown or kept")
        self.recording_to: Path | None = None
        self._viewer, self._range_mm = viewer, 0.1
        self._stream = self._rr.RecordingStream("torchvts")
        if viewer:
            self._rr.spawn(connect=False)
        self.record(save)

    def record(self, path: str | Path | None) -> None:
        """Record to a file from now on, .rrd; None ends a recording, and only the viewer is left."""
        if path is not None:
            path = check_path("save", path)
            if path.suffix.lower() != ".rrd":
                raise ValueError(f"save: expected a name ending in .rrd, got {path.name!r}")
            check_target(path)
        sinks = [self._rr.GrpcSink()] if self._viewer else []
        sinks += [self._rr.FileSink(path)] if path is not None else []
        self.recording_to = path
        if not sinks:
            self._stream.disconnect()
            return
        self._stream.set_sinks(*sinks, default_blueprint=self._blueprint())
        self._size: tuple[int, int] | None = None  # what never changes is logged again, into the new file
        rr = self._rr
        self._stream.log("surface", rr.Transform3D(scale=[1.0, 1.0, self.exaggeration]), static=True)
        self._stream.log("surface", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, color in (("area_mm2", (0, 114, 178)), ("deepest_mm", (213, 94, 0))):
            self._stream.log(f"curves/{name}", rr.SeriesLines(colors=color), static=True)

    def add(self, frame: TactileFrame) -> None:
        """Log a frame."""
        rr, stream, output = self._rr, self._stream, frame.output
        if self.recording_to is None and not self._viewer:
            return
        stream.set_time("frame", sequence=frame.number)
        stream.set_time("time", duration=frame.time_s)
        image = (255.0 * frame.image.permute(1, 2, 0) + 0.5).byte().numpy()
        stream.log("image", rr.Image(image))
        contact = output.contact[0, 0].numpy()
        lines = [outline.reshape(-1, 2) for outline in outlines(contact)]
        closed = [np.concatenate((line, line[:1])) + 0.5 for line in lines]
        stream.log("image/contact", rr.LineStrips2D(closed, colors=(255, 255, 255), radii=0.5))
        depth = output.depth_mm[0, 0].float().numpy()
        self._range_mm = round_up(self._range_mm, float(depth.max()))
        stream.log("depth", rr.DepthImage(depth, meter=1000.0, colormap="viridis", depth_range=(0.0, self._range_mm)))
        normal = output.normal[0].permute(1, 2, 0)
        stream.log("normals", rr.Image((127.5 * (normal + 1.0) + 0.5).clamp(0, 255).byte().numpy()))
        self._log_surface(depth, normal)
        stream.log("curves/area_mm2", rr.Scalars(float(contact.sum()) * self.mm_per_pixel**2))
        stream.log("curves/deepest_mm", rr.Scalars(float(depth.max())))

    def add_axes(self, ends: Tensor | None) -> None:
        """Log the axes of an object: (4, 3) origin and ends of x (red), y (green), z (blue), mm, y up; None for no pose."""
        rr = self._rr
        if self.recording_to is None and not self._viewer:
            return
        if ends is None:
            self._stream.log("surface/axes", rr.Clear(recursive=False))
            return
        check_shape("ends", ends, (4, 3))
        origin = ends[:1].float().numpy()
        arrows = rr.Arrows3D(origins=np.repeat(origin, 3, 0), vectors=ends[1:].float().numpy() - origin, colors=AXIS_COLOURS)
        self._stream.log("surface/axes", arrows)

    def close(self) -> None:
        """Write what is left, and let go of the viewer, which stays open."""
        self._stream.flush()
        self._stream.disconnect()

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _log_surface(self, depth: np.ndarray[Any, Any], normal: Tensor) -> None:
        from ..viz import MOST_POINTS, depth_colors

        stride = max(1, -(-max(depth.shape) // MOST_POINTS))
        z = depth[::stride, ::stride]
        height, width = z.shape
        if self._size != (height, width):
            self._size = height, width
            self._stream.log("surface", self._rr.Mesh3D.from_fields(triangle_indices=_triangles(height, width)), static=True)
        x = (np.arange(width) * stride - 0.5 * (depth.shape[1] - 1)) * self.mm_per_pixel
        y = (0.5 * (depth.shape[0] - 1) - np.arange(height) * stride) * self.mm_per_pixel
        points = np.stack((*np.meshgrid(x, y), z), 2).astype(np.float32)
        colors, norm = depth_colors(-self._range_mm, self._range_mm)
        shades = (255.0 * colors(norm(z))[..., :3] + 0.5).astype(np.uint8)
        upward = normal[::stride, ::stride].numpy() * np.array([1.0, -1.0, 1.0], np.float32)  # y up
        surface = self._rr.Mesh3D.from_fields(
            vertex_positions=points.reshape(-1, 3), vertex_normals=upward.reshape(-1, 3), vertex_colors=shades.reshape(-1, 3)
        )
        self._stream.log("surface", surface)

    def _blueprint(self) -> Any:
        import rerun.blueprint as rrb

        unit = "mm" if self.metric else "mm, NOT METRIC"
        pictures: Sequence[Any] = [
            rrb.Spatial2DView(origin="image", name="image, contact outlined"),
            rrb.Spatial2DView(origin="depth", name=f"depth, {unit}"),
            rrb.Spatial2DView(origin="normals", name="normals: red x right, green y down, blue to the camera"),
        ]
        curves = [
            rrb.TimeSeriesView(origin="curves/area_mm2", name="contact area, mm2"),
            rrb.TimeSeriesView(origin="curves/deepest_mm", name=f"deepest point, {unit}"),
        ]
        surface = rrb.Spatial3DView(origin="surface", name=f"surface, {unit}, height x {self.exaggeration:g}")
        return rrb.Blueprint(
            rrb.Horizontal(rrb.Vertical(*pictures), rrb.Vertical(surface, *curves, row_shares=[2, 1, 1]), column_shares=[1, 2]),
            collapse_panels=True,
        )


def _triangles(height: int, width: int) -> np.ndarray[Any, Any]:
    """Two triangles for each cell of a grid of points, row by row, that face the camera; (n, 3)."""
    first = (np.arange(height - 1)[:, None] * width + np.arange(width - 1)).reshape(-1)
    right, below = first + 1, first + width
    return np.concatenate((np.stack((first, below, right), 1), np.stack((right, below, below + 1), 1))).astype(np.uint32)
