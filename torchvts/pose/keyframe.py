"""Frames of a track: the grids of a new frame, and keyframes, which hold everything that is computed once of a reference."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..compiled import library, tracking
from .alignment import twist_units
from .ambiguity import field_with_fitted_curvature, find_unknown, information_of_noise
from .height_errors import HeightErrors, height_errors
from .inverse import Field, Pixels, reference_pixels
from .jackknife import shared_error
from .relief import HUGE, LEAST_PIXELS, DepthFrame, Levels, Relief, check_frame, least_depth_mm, levels
from .rigid import Array

SOME, MANY = 2000, 8000
"""Pixels of a reference for all steps of a refinement but the last, and for the last. They are evenly spread: pixels chosen by what
they say of the motion lie on steep flanks, where slopes err most; with 4,000 of these the median rotation error of six objects was
0.024 to 0.071 degrees, with 4,000 spread ones 0.018 to 0.036, with the two stages 0.012 to 0.024."""

CELL = 2
"""Pixels of the coarse grid a side of a cell of :mod:`.height_errors`, 0.5 mm of 20."""

PARTS = 8
"""Parts of a contact, a power of two: a pose is as uncertain as it depends on which of them is left out."""

LEAST_ALIKE = 0.3
"""Correlation of slopes and differences of depth, below which they are not those of the same frame."""

Image = npt.NDArray[Any]
Mask = npt.NDArray[Any]

_NEIGHBOURS = np.ones((3, 3), np.uint8)


class Contact(NamedTuple):
    """One frame whose contact takes the place of its deformed area, ``skin``: what hangs free does not move with the object."""

    depth_mm: Tensor
    gradient: Tensor
    contact: Tensor
    skin: Tensor


class Grids(NamedTuple):
    """A new frame on the fine and the coarse grid, and the number of fine pixels on the object."""

    fine: Field
    coarse: Field
    touching: int


class Unusable(ValueError):
    """A frame that has no pose; the message says why."""


def contact_frame(frame: DepthFrame, name: str = "frame") -> Contact:
    """Depth, gradient and contact of one frame, on the CPU, float32.

    Raises:
        TypeError: no DepthOutput.
        ValueError: not one frame.
        Unusable: values that are not finite, or a contact of a few pixels.
    """
    height, width = check_frame(name, frame)
    deformed: Tensor = getattr(frame, "deformed", frame.contact)  # a scene has none
    depth = frame.depth_mm.detach().resolve_neg().to("cpu", torch.float32).reshape(1, 1, height, width).contiguous()
    gradient = frame.gradient.detach().resolve_neg().to("cpu", torch.float32).reshape(1, 2, height, width).contiguous()
    contact = frame.contact.detach().to("cpu", torch.bool).reshape(1, 1, height, width).contiguous()
    skin = deformed.detach().to("cpu", torch.bool).reshape(1, 1, height, width)
    touching = _contact_pixels(depth, gradient, contact)
    if touching < 0:
        raise Unusable(f"depth or gradient is not finite, or beyond {HUGE:g}")
    if touching < LEAST_PIXELS:
        raise Unusable("no contact")
    return Contact(depth, gradient, contact, skin)


def _contact_pixels(depth: Tensor, gradient: Tensor, contact: Tensor) -> int:
    """How many pixels of a frame touch; -1 where depth or gradient is not finite, or beyond :data:`HUGE`."""
    z, slopes = depth.numpy(), gradient.numpy()  # in one thread: two of torch's wait for each other where other programs run
    ends = np.abs([z.min(), z.max(), slopes.min(), slopes.max()])  # NaN if any value is
    return int(np.count_nonzero(contact.numpy())) if bool((ends <= HUGE).all()) else -1


def grids(frame: Contact, mm_per_pixel: float, least_mm: float, times: tuple[int, int]) -> Grids:
    """A frame on both grids, of ``times`` pixels a side; skin deeper than ``least_mm`` within its contact lies on the object."""
    if library() is None:
        return _grids_by_opencv(frame, mm_per_pixel, least_mm, times)
    height, width = frame.depth_mm.shape[-2:]
    *made, touching = tracking.track_grids(frame.depth_mm, frame.gradient, frame.contact, least_mm, times)
    fine, coarse = (
        Field(channels, (n - width) * 0.5 * mm_per_pixel, (height - n) * 0.5 * mm_per_pixel, n * mm_per_pixel)
        for channels, n in zip(made, times, strict=True)
    )
    return Grids(fine, coarse, touching)


def _grids_by_opencv(frame: Contact, mm_per_pixel: float, least_mm: float, times: tuple[int, int]) -> Grids:
    import cv2

    z, contact = frame.depth_mm[0, 0].numpy(), frame.contact[0, 0].numpy().view(np.uint8)
    p, q = frame.gradient[0].numpy()
    height, width = z.shape
    grid = (-0.5 * (width - 1) * mm_per_pixel, 0.5 * (height - 1) * mm_per_pixel, mm_per_pixel)
    inside = contact & (z > least_mm)
    perhaps = contact | (z > 0.3 * float(z.max()))  # flat faces whose outline the image border cuts may be missing from the mask
    up = -q
    if times[0] > 1:
        fine = _pooled((z, p, up), inside, perhaps, times[0], grid, 0.99)
    else:
        mask = cv2.addWeighted(cv2.erode(inside, _NEIGHBOURS), 0.75, cv2.dilate(perhaps, _NEIGHBOURS), 0.25, 0.0, dtype=cv2.CV_32F)
        fine = Field(torch.from_numpy(cv2.merge((z, p, up, mask))), *grid)
    coarse = _pooled((z, p, up), inside, perhaps, times[1], grid, 0.5)
    return Grids(fine, coarse, int(torch.count_nonzero(fine.channels[..., 3] > 0.999)))


def _pooled(
    values: tuple[Image, Image, Image], inside: Mask, perhaps: Mask, times: int, grid: tuple[float, float, float], share: float
) -> Field:
    """Means over the part of each cell of ``times`` x ``times`` pixels that lies on the object, which must be ``share`` of it."""
    import cv2

    x0, y0, pitch = grid
    rows, columns = (length // times * times for length in inside.shape)
    size = (columns // times, rows // times)

    def mean(one: Image) -> Image:
        return cv2.resize(one[:rows, :columns], size, interpolation=cv2.INTER_AREA)

    within = inside.astype(np.float32)
    part = mean(within)
    scale = 1.0 / np.maximum(part, 0.01)
    near = cv2.dilate((mean(perhaps.astype(np.float32)) > 0.01).astype(np.float32), _NEIGHBOURS)
    means = [mean(cv2.multiply(one, within)) * scale for one in values]
    channels = cv2.merge((*means, np.where(part > share, np.float32(1.0), np.float32(0.25) * near)))
    half = 0.5 * (times - 1) * pitch
    return Field(torch.from_numpy(channels), x0 + half, y0 - half, times * pitch)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that others are registered to.

    Attributes:
        levels: its reliefs, for the global search.
        grids: its grids, which new frames are compared with backwards.
        least_mm: depth from which skin surely lies on the object, mm.
        times: pixels a side of a cell of the fine and of the coarse grid.
        touching: number of pixels of the fine grid on the object.
        coarse: pixels of the coarse grid, whose derivatives are those of fitted planes, which have the least noise.
        some: pixels of the fine grid for most steps, and
        many: for the last one; part after part.
        heights: cells of ``some``, and how their heights err.
        spread: (4, 4), mean of the products of points (x, y, z, 1) of the contact, mm.
        held: (6, k) scaled twists that the whole contact does not determine.
        bias: (6, 6), the part of the information of a coarse pixel that noise causes.
        shared_error: how many times larger the variance of a pose is than its parts show.
    """

    levels: Levels
    grids: Grids
    least_mm: float
    times: tuple[int, int]
    touching: int
    coarse: Pixels
    some: Pixels
    many: Pixels
    heights: HeightErrors
    spread: Array
    held: Array
    bias: Tensor
    shared_error: float

    @cached_property
    def most_bias(self) -> float:
        """The largest of that part over all directions."""
        return float(self.bias.diagonal().max())

    @cached_property
    def known(self) -> Array:
        """Orthonormal scaled twists (6, k) that slopes may show: neither those held, nor the shift along z, which heights show."""
        beside = np.hstack((self.held, np.eye(6)[:, 5:]))
        return np.linalg.qr(beside, mode="complete")[0][:, beside.shape[1] :]


def make_keyframe(frame: Contact, mm_per_pixel: float) -> Keyframe:
    """Everything that is computed once of a reference.

    Raises:
        ValueError: a contact too small or too faint, or a pitch that depth and slopes contradict.
    """
    made = levels(frame, mm_per_pixel, "reference")
    times = round(made.fine.pitch / mm_per_pixel), round(made.coarse.pitch / mm_per_pixel)
    least = least_depth_mm(made.noise * times[1], mm_per_pixel)
    fine, bent = made.fine, made.coarse._replace(field=field_with_fitted_curvature(made.coarse))
    center, units = fine.points.double().mean(0), twist_units(fine)
    some, many = (_thinned(fine, most) for most in (SOME, MANY))
    steps = reference_pixels(some, fine, center, units)
    unknown = find_unknown(made.coarse, made.coarse, torch.eye(4, dtype=torch.float64)[None], made.noise).motions
    unknown = unknown.clone()
    unknown[3:] += torch.linalg.cross(unknown[:3], center[:, None].expand_as(unknown[:3]), dim=0)  # about the contact's center
    held = torch.linalg.qr(unknown / units[:, None]).Q.numpy() if unknown.shape[1] else np.zeros((6, 0))
    return Keyframe(
        levels=made,
        grids=grids(frame, mm_per_pixel, least, times),
        least_mm=least,
        times=times,
        touching=len(fine.points),
        coarse=reference_pixels(made.coarse, bent, center, units),
        some=steps,
        many=reference_pixels(many, fine, center, units),
        heights=height_errors(frame.gradient, frame.skin, mm_per_pixel, CELL * times[1], steps),
        spread=_spread(fine.points[:: max(1, len(fine.points) // 64)].double().numpy()),
        held=held,
        bias=information_of_noise(made.noise, made.coarse.pitch),
        shared_error=shared_error(many.points[:, :2].double().numpy(), PARTS),
    )


def _spread(points: Array) -> Array:
    """Mean of the products (4, 4) of points (N, 3) with a one beside."""
    beside = np.column_stack((points, np.ones(len(points))))
    spread: Array = beside.T @ beside / len(points)
    return spread


def _thinned(relief: Relief, most: int) -> Relief:
    """The relief with at most so many of its pixels, evenly spread, those of each of :data:`PARTS` compact parts in a run."""
    number = min(most, len(relief.points)) // PARTS * PARTS  # so that parts are the same number exactly
    chosen = torch.linspace(0, len(relief.points) - 1, number).long()
    chosen = chosen[_in_parts(relief.points[chosen, :2])]
    return relief._replace(points=relief.points[chosen].contiguous(), slopes=relief.slopes[chosen].contiguous())


def _in_parts(places: Tensor) -> Tensor:
    """An order of places (N, 2) in which PARTS runs of the same number are compact: halves of halves, across the longer side."""
    runs = [torch.arange(len(places))]
    while len(runs) < PARTS:
        halves: list[Tensor] = []
        for run in runs:
            side = int((places[run].amax(0) - places[run].amin(0)).argmax()) if len(run) else 0
            halves += run[places[run, side].argsort(stable=True)].tensor_split(2)
        runs = halves
    return torch.cat(runs)


def slopes_of_contact(frame: Contact) -> float:
    """Root mean square of the slopes of a frame's contact, per component."""
    return float(frame.gradient[0][:, frame.contact[0, 0]].square().mean().sqrt())


def pitch_by_slopes(frame: Contact) -> float:
    """The pixel pitch under which a frame's depth has its slopes, mm; 0 where these have little to do with each other.

    It is the ratio of their root mean squares: both are noisy, and differences over coarse pixels are no slopes at edges.
    """
    depth, slope, contact = frame.depth_mm[0, 0], frame.gradient[0], frame.contact[0, 0]
    by_pixel = torch.stack((depth[1:-1, 2:] - depth[1:-1, :-2], depth[2:, 1:-1] - depth[:-2, 1:-1]))
    whole = contact[1:-1, 2:] & contact[1:-1, :-2] & contact[2:, 1:-1] & contact[:-2, 1:-1]
    steps, slope = 0.5 * by_pixel[:, whole].double(), slope[:, 1:-1, 1:-1][:, whole].double()
    size = math.sqrt(float(steps.square().sum()) * float(slope.square().sum()))
    if float((steps * slope).sum()) <= LEAST_ALIKE * size:
        return 0.0
    return float(steps.square().sum()) / size
