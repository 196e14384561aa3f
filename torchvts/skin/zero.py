"""Depth counted from the undeformed skin: a smooth offset makes free skin bear no pressure."""

import math

import torch
from torch import Tensor, nn

from ..core.cells import whole_cell_means
from ..core.checks import check_batch, check_positive
from ..core.geometry import laplacian
from ..core.precision import widened

ZERO_CELLS = 30
"""Cells along the shorter side of the image, on which the offset is fitted."""

WAVES = 8
"""Cosine terms along the shorter side of which the offset is made."""

DECAY_MM = 1.5
"""L, the length on which free skin decays."""

SMOOTH_MM = 0.35
"""Pressure, mm, that costs as much as an offset of slope 1."""

STIFF = 30.0
"""How much stiffer the deepest skin is against the offset: slopes are calibrated in contacts, and least known around them."""

FACE = 0.25
"""Depth, as a share of the frame's range, about which unchanged skin becomes a face of the object."""

PIT = 2.0
"""Weight of depth below zero in moved skin: skin is pressed in and never pulled out."""

PIT_SHARE = 0.01
"""Depth below zero that is let be, as a share of the frame's range; at twice that a pit has its full weight."""


class ZeroBackground(nn.Module):
    """Depth of integrated slopes, counted from the undeformed skin.

    A stretched skin on a soft gel bears the pressure p = z - L^2 laplace z. Free skin bears none; so an offset, a sum of a few
    cosines, is found that makes p vanish where the weight is 0, by weighted least squares. The law takes free skin on
    beyond what can be seen, as it decays. Unchanged skin that is deep lies on a face of the object and counts less.
    The offset is smooth, most of all where skin is deep, so that errors of slopes go into the free skin. Without any free skin, the
    lowest cell is at zero. Differentiable.

    Args:
        mm_per_pixel: pixel pitch, mm.
    Source:
        membrane on an elastic foundation: Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, 1959; the weight of
        deep skin is that of Geman and McClure.
    Example:
        >>> weight = torch.zeros(1, 1, 48, 64)
        >>> weight[..., 12:36, 16:48] = 1.0
        >>> tilt = torch.linspace(-0.1, 0.1, 64).expand(1, 1, 48, 64)
        >>> bool(ZeroBackground(0.1)(tilt + weight, weight)[..., :8, :].abs().max() < 0.03)
        True
    """

    def __init__(self, mm_per_pixel: float) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.cells, self.waves, self.face = ZERO_CELLS, WAVES, FACE
        self.decay_mm, self.smooth_mm, self.stiff = DECAY_MM, SMOOTH_MM, STIFF
        self.pit, self.pit_share = PIT, PIT_SHARE

    def forward(self, depth_mm: Tensor, weight: Tensor) -> Tensor:
        """Depth (B, 1, H, W) up to a smooth offset, and the weight of moved skin (B, 1, H, W), to depth (B, 1, H, W).

        Raises:
            ValueError: shapes that differ.
        """
        check_batch("depth_mm", depth_mm, 1)
        check_batch("weight", weight, 1)
        height, width = depth_mm.shape[2], depth_mm.shape[3]
        if weight.shape != depth_mm.shape:
            raise ValueError(f"weight: expected {list(depth_mm.shape)} like depth_mm, got {list(weight.shape)}")
        cell = max(1, min(height, width) // self.cells)
        z = whole_cell_means(widened(depth_mm), cell)[:, 0]
        # the largest in a cell and beside it: a Laplacian takes its neighbours, and half a rim bears pressure
        around = nn.functional.max_pool2d(widened(weight), 3 * cell, cell, cell)[:, 0, : z.shape[1], : z.shape[2]]
        offset = self.offset(z, around, cell * self.mm_per_pixel)
        rows = cosines(height, offset.shape[1], z.shape[1] * cell, z)
        columns = cosines(width, offset.shape[2], z.shape[2] * cell, z)
        return (widened(depth_mm) + (rows.t() @ offset @ columns)[:, None]).to(depth_mm.dtype)

    def offset(self, depth: Tensor, weight: Tensor, pitch_mm: float) -> Tensor:
        """The offset of cells (B, h, w) as coefficients of cosines along y and x, (B, K, M)."""
        height, width = depth.shape[1], depth.shape[2]
        k, m = number_of_waves(height, width, self.waves)
        rows, columns = cosines(height, k, height, depth), cosines(width, m, width, depth)
        along_y, along_x = slopes_of_cosines(height, k, pitch_mm, depth), slopes_of_cosines(width, m, pitch_mm, depth)
        by_pressure = pressure_of_waves(k, m, (height, width), pitch_mm, self.decay_mm, depth)
        pressure = depth - (self.decay_mm / pitch_mm) ** 2 * laplacian(depth[:, None])[:, 0]
        reach = (depth.amax(dim=(1, 2), keepdim=True) - depth.amin(dim=(1, 2), keepdim=True)).clamp_min(1e-9)
        free, flat = (weight < 0.1).flatten(1), depth.flatten(1)
        any_free = free.any(dim=1)
        # the lower quartile of free cells; or the lower eighth of all, if that is lower: free cells may be faces of an object
        start = -torch.minimum(lower_part(flat, free, 4), lower_part(flat, any_free[:, None].expand_as(free), 8))
        z = depth + start[:, :, None]
        unchanged = (1.0 - weight) / (1.0 + (z / (self.face * reach)).square()).square()
        pit = self.pit * weight * (-z / (self.pit_share * reach) - 1.0).clamp(0.0, 1.0)
        stiff = self.smooth_mm**2 * (1.0 + self.stiff * (z / reach).clamp(0.0, 1.0).square())
        system = products(unchanged, rows, columns) * by_pressure[:, None] * by_pressure
        system = system + products(pit + 1e-6, rows, columns)
        system = system + products(stiff, along_y, columns) + products(stiff, rows, along_x)
        right = (rows @ (unchanged * pressure) @ columns.t()).flatten(1) * by_pressure
        right = right + (rows @ (pit * depth) @ columns.t()).flatten(1)
        solved = -torch.linalg.solve(system, right[..., None])[..., 0]
        lowest = torch.cat((start, torch.zeros_like(solved[:, 1:])), dim=1)
        return torch.where(any_free[:, None], solved, lowest).reshape(-1, k, m)


def number_of_waves(height: int, width: int, waves: int) -> tuple[int, int]:
    """Cosine terms along y and x of cells (height, width), ``waves`` along the shorter side."""
    shorter = min(height, width)
    k = min(height, 3 * waves, (2 * waves * height + shorter) // (2 * shorter))
    m = min(width, 3 * waves, (2 * waves * width + shorter) // (2 * shorter))
    return k, m


def pressure_of_waves(k: int, m: int, size: tuple[int, int], pitch_mm: float, decay_mm: float, like: Tensor) -> Tensor:
    """What p = z - L^2 laplace z makes of each cosine, (k m,), on cells of a size (height, width)."""
    square = wave_numbers(k, size[0] * pitch_mm, like).square()[:, None] + wave_numbers(m, size[1] * pitch_mm, like).square()
    return (1.0 + decay_mm**2 * square).flatten()


def products(field: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Sums over cells of a field (B, h, w) times two terms each, (B, K M, K M); a term is a row (K, h) times a column (M, w)."""
    k, m = rows.shape[0], columns.shape[0]
    by_row = (rows[:, None] * rows).flatten(0, 1)
    by_column = (columns[:, None] * columns).flatten(0, 1)
    sums = by_row @ field @ by_column.t()  # (B, K K, M M)
    return sums.reshape(-1, k, k, m, m).transpose(2, 3).reshape(-1, k * m, k * m)


def cosines(count: int, terms: int, length: int, like: Tensor) -> Tensor:
    """The first cosines of a cosine transform over ``length`` places, at ``count`` places, (terms, count)."""
    place = (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) / float(length)
    return torch.cos(wave_numbers(terms, 1.0, like)[:, None] * place)


def slopes_of_cosines(count: int, terms: int, pitch_mm: float, like: Tensor) -> Tensor:
    """Their slopes per mm, but for the sign."""
    place = (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) / float(count)
    return wave_numbers(terms, count * pitch_mm, like)[:, None] * torch.sin(wave_numbers(terms, 1.0, like)[:, None] * place)


def wave_numbers(terms: int, length: float, like: Tensor) -> Tensor:
    """Their wave numbers, radians per unit of length."""
    return math.pi / length * torch.arange(terms, dtype=like.dtype, device=like.device)


def lower_part(values: Tensor, some: Tensor, part: int) -> Tensor:
    """Value below which one part in so many of some values (B, N) lies, (B, 1); the least of all where there are none."""
    count = some.sum(dim=1, keepdim=True)
    ordered = torch.where(some | (count == 0), values, torch.inf).sort(dim=1).values
    return ordered.gather(1, count // part)
