"""Frames as the aligner takes them: checked, and as height, slopes and a mask on a fine and a coarse grid, right-handed."""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..compiled import library, tracking
from ..core.morphology import dilate
from .rigid import Array

LEAST_DEPTH_MM = 0.03
"""Skin less deep than this counts as the transition zone around a contact, where it does not lie on the object."""

LEAST_CELLS = 12
"""A pose needs so many cells of a contact on the coarse grid, points of a cloud, and pixels along the shorter side of a frame."""

HUGE = 1e6
"""Depth, mm, and slopes beyond this are no measurement; their squares would overflow."""

LEAST_ALIKE = 0.3
"""Correlation of slopes and differences of depth, below which they are not those of the same frame."""

Image = npt.NDArray[Any]
Mask = npt.NDArray[Any]


class DepthFrame(Protocol):
    """The fields of :class:`torchvts.DepthOutput` that a registration uses; a scene has no ``deformed``."""

    @property
    def depth_mm(self) -> Tensor: ...
    @property
    def gradient(self) -> Tensor: ...
    @property
    def contact(self) -> Tensor: ...


class Surface(NamedTuple):
    """One frame on the CPU, float32: depth (1, 1, H, W), mm, gradient (1, 2, H, W), y down, contact and deformed skin, bool."""

    depth_mm: Tensor
    gradient: Tensor
    contact: Tensor
    skin: Tensor


class Grid(NamedTuple):
    """A frame on one grid, y up.

    Attributes:
        channels: (H, W, 4), z (mm), slopes p and q, and a mask: 1 where the skin surely lies on the object, 0 where it surely does
            not, between them where it may.
        x0: position of the upper left pixel, mm.
        y0: the same, y up.
        pitch: distance of pixels, mm.
    """

    channels: Tensor
    x0: float
    y0: float
    pitch: float

    def pixels(self) -> tuple[Array, Array]:
        """Rows (N,) and columns (N,) of the pixels that surely lie on the object."""
        row, column = np.nonzero(self.channels[..., 3].numpy() > 0.999)
        return row, column

    def points(self, row: Array, column: Array) -> Image:
        """x, y, z, p and q of pixels, (5, N) float32."""
        values = np.empty((5, len(row)), np.float32)
        values[0], values[1] = self.x0 + column * self.pitch, self.y0 - row * self.pitch
        values[2:] = self.channels.numpy()[row, column, :3].T
        return values


class Grids(NamedTuple):
    """A frame on the fine and the coarse grid, and the number of fine pixels on the object."""

    fine: Grid
    coarse: Grid
    touching: int


class Resolution(NamedTuple):
    """How a frame is put on grids.

    Attributes:
        times: pixels a side of a cell of the fine and of the coarse grid, of at most 330 and about 80 columns.
        least_mm: depth from which skin surely lies on the object, mm.
        noise: of the slopes of the coarse grid.
    """

    times: tuple[int, int]
    least_mm: float
    noise: float


class Unusable(ValueError):
    """A frame that has no pose; ``reason`` says in a few words why."""

    def __init__(self, name: str, expected: str, reason: str) -> None:
        super().__init__(f"{name}: expected {expected}, got {reason}")
        self.reason = reason.partition(":")[0]


def check_frame(name: str, frame: DepthFrame) -> tuple[int, int]:
    """Height and width of one frame.

    Raises:
        TypeError: no DepthOutput, or one of integers.
        ValueError: not one frame, or parts of several sizes.
    """
    for part in ("depth_mm", "gradient", "contact"):
        value = getattr(frame, part, None)
        if not isinstance(value, Tensor):
            what = f"whose {part} is no tensor but {type(value).__name__}" if hasattr(frame, part) else f"which has no {part}"
            raise TypeError(f"{name}: expected a DepthOutput, as a DepthPipeline returns, got {type(frame).__name__}, {what}")
        if part != "contact" and not value.is_floating_point():
            raise TypeError(f"{name}: expected floating point {part}, got {value.dtype}: raw values of a file?")
    height, width = frame.depth_mm.shape[-2:] if frame.depth_mm.dim() >= 2 else (0, 0)
    for part, channels in (("depth_mm", 1), ("gradient", 2), ("contact", 1), ("deformed", 1)):
        shape = tuple(getattr(frame, part, frame.contact).shape)
        if math.prod(shape) != channels * height * width or shape[-2:] != (height, width):
            several = len(shape) >= 4 and shape[0] > 1
            cause = "loop over the batch" if several else f"depth_mm has {tuple(frame.depth_mm.shape)}"
            raise ValueError(f"{name}: expected one frame, {part} (1, {channels}, H, W), got {shape}: {cause}")
    return height, width


def surface_of(frame: DepthFrame, name: str = "frame", with_skin: bool = False) -> Surface:
    """One frame, checked.

    Args:
        frame: a DepthOutput.
        name: of the frame, for errors.
        with_skin: the contact is all deformed skin: that beside an object, as on the flanks of a stamp, moves with it and shows its
            rotation. Skin that hangs free between two frames of a track does not.
    Raises:
        TypeError: no DepthOutput.
        ValueError: not one frame.
        Unusable: values that are not finite, or a contact of a few pixels.
    """
    height, width = check_frame(name, frame)

    def flat(values: Tensor, dtype: torch.dtype) -> Tensor:
        return values.detach().resolve_neg().to("cpu", dtype).reshape(1, -1, height, width).contiguous()

    depth, gradient = flat(frame.depth_mm, torch.float32), flat(frame.gradient, torch.float32)
    contact, skin = flat(frame.contact, torch.bool), flat(getattr(frame, "deformed", frame.contact), torch.bool)
    surface = Surface(depth, gradient, skin if with_skin else contact, skin)
    z, slopes = depth.numpy(), gradient.numpy()  # in one thread: two of torch's wait for each other where other programs run
    ends = np.abs([z.min(), z.max(), slopes.min(), slopes.max()])  # NaN if any value is
    if not bool((ends <= HUGE).all()):
        raise Unusable(name, "finite depth and gradient", f"depth or gradient that is NaN, infinite or beyond {HUGE:g}")
    touching = int(np.count_nonzero(surface.contact.numpy()))
    if touching < LEAST_CELLS:
        raise Unusable(name, f"a contact of at least {LEAST_CELLS} pixels", "no contact: nothing is touched?")
    return surface


def resolution_of(surface: Surface, mm_per_pixel: float, name: str) -> Resolution:
    """The resolution that a frame has by itself.

    Raises:
        ValueError: too few pixels, or a strip.
    """
    height, width = surface.depth_mm.shape[-2:]
    if min(height, width) < LEAST_CELLS:
        raise ValueError(f"{name}: expected a frame of at least {LEAST_CELLS} x {LEAST_CELLS}, got {height} x {width}")
    fine = math.ceil(max(height, width) / 330)
    coarse = max(fine, round(max(height, width) / 80))
    if min(height, width) < 2 * coarse:
        raise ValueError(f"{name}: expected a frame at most 40 times as long as wide, got {height} x {width}: a cut-out?")
    noise = slope_noise(surface)
    return Resolution((fine, coarse), least_depth_mm(noise, mm_per_pixel), noise / coarse)


def checked_grids(surface: Surface, mm_per_pixel: float, resolution: Resolution, name: str) -> Grids:
    """Both grids of a frame.

    Raises:
        ValueError: a contact too small or too faint.
    """
    made, times = grids(surface, mm_per_pixel, resolution), resolution.times[1]
    cells = min(made.touching, len(made.coarse.pixels()[0]))
    if cells < LEAST_CELLS:
        raise ValueError(
            f"{name}: expected a contact deeper than {resolution.least_mm:.3f} mm on {LEAST_CELLS} cells of {times} x {times} "
            f"pixels, got {cells}: pressed too faintly, too small, or depth is not in mm?"
        )
    return made


def grids(surface: Surface, mm_per_pixel: float, resolution: Resolution) -> Grids:
    """Both grids of a frame."""
    height, width = surface.depth_mm.shape[-2:]
    by = tracking.track_grids if library() is not None else track_grids
    *made, touching = by(surface.depth_mm, surface.gradient, surface.contact, resolution.least_mm, resolution.times)
    fine, coarse = (
        Grid(channels, (n - width) * 0.5 * mm_per_pixel, (height - n) * 0.5 * mm_per_pixel, n * mm_per_pixel)
        for channels, n in zip(made, resolution.times, strict=True)
    )
    return Grids(fine, coarse, touching)


def track_grids(
    depth: Tensor, slopes: Tensor, contact: Tensor, least_mm: float, times: tuple[int, int]
) -> tuple[Tensor, Tensor, int]:
    """Channels of both grids, and how many fine pixels lie on the object: ``compiled.tracking.track_grids`` in the plain way."""
    inside = contact & (depth > least_mm)
    perhaps = contact | (depth > 0.3 * float(depth.max()))  # flat faces that the image border cuts may be missing from the mask
    values = torch.cat((depth, slopes[:, :1], -slopes[:, 1:]), 1)

    def pooled(n: int, least: float) -> Tensor:
        """Means over the part of each cell of n x n pixels that lies on the object, which must be more than a share of it."""
        part = avg_pool2d(inside.float(), n)
        near = dilate(avg_pool2d(perhaps.float(), n) > 0.01)
        mask = torch.where(part > least, 1.0, 0.25 * near.float())
        return torch.cat((avg_pool2d(values * inside, n) / part.clamp_min(0.01), mask), 1)

    whole = torch.cat((values, 0.75 * (~dilate(~inside)).float() + 0.25 * dilate(perhaps).float()), 1)
    made = (whole if times[0] == 1 else pooled(times[0], 0.99), pooled(times[1], 0.5))
    fine, coarse = (one[0].permute(1, 2, 0).contiguous() for one in made)
    return fine, coarse, int(torch.count_nonzero(fine[..., 3] > 0.999))


def least_depth_mm(noise: float, mm_per_pixel: float) -> float:
    """Least depth that is certainly contact: above the transition zone, and above the noise of slopes summed over some pixels."""
    return max(LEAST_DEPTH_MM, 4.0 * noise * mm_per_pixel)


def slope_noise(surface: Surface) -> float:
    """Noise of slopes inside the contact, from second differences along rows, as in :func:`torchvts.core.noise.noise_std`."""
    gradient, contact = surface.gradient[0], surface.contact[0, 0]
    whole = contact[:, :-2] & contact[:, 1:-1] & contact[:, 2:]
    second = (gradient[..., 1:-1] - 0.5 * (gradient[..., :-2] + gradient[..., 2:]))[:, whole].abs()
    return float(second.median()) / (0.6745 * math.sqrt(1.5)) if second.numel() else 0.0


def pitch_by_slopes(surface: Surface) -> float:
    """The pixel pitch under which a frame's depth has its slopes, mm; 0 where these have little to do with each other.

    It is the ratio of their root mean squares: both are noisy, and differences over coarse pixels are no slopes at edges.
    """
    depth, slope, contact = surface.depth_mm[0, 0], surface.gradient[0], surface.contact[0, 0]
    by_pixel = torch.stack((depth[1:-1, 2:] - depth[1:-1, :-2], depth[2:, 1:-1] - depth[:-2, 1:-1]))
    whole = contact[1:-1, 2:] & contact[1:-1, :-2] & contact[2:, 1:-1] & contact[:-2, 1:-1]
    steps, slope = 0.5 * by_pixel[:, whole].double(), slope[:, 1:-1, 1:-1][:, whole].double()
    size = math.sqrt(float(steps.square().sum()) * float(slope.square().sum()))
    if float((steps * slope).sum()) <= LEAST_ALIKE * size:
        return 0.0
    return float(steps.square().sum()) / size
