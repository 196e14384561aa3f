"""Heights of a keyframe, weighted by what smooth errors of slopes, integrated from undeformed skin, do to them.

A smooth error of slopes tilts a wide face as a whole, and slopes of the face cannot show it. Its heights can: skin around the
contact is undeformed, so a face that is tilted is too high at one flank and too low at the other, and narrow flanks hardly allow
that. The covariance of heights says how hardly.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..compiled import library, tracking
from .grids import Grid, Image, Mask
from .inverse import HEIGHT_NOISE_MM, SHALLOW_MM, SLOPE_NOISE, Points, Sums, residual_limits, residuals
from .rigid import Array

ALIKE_MM, ALIKE_SLOPE = 3.0, 0.4
"""Errors of slopes at places, or slopes, so far from each other have a correlation of exp(-1/2). Presses of balls on real sensors
show 2.5 mm and 0.4 (docs/tracking.md), but contacts of 3 mm hide what is alike all over them; drawn ones with wide contacts
have 3 mm."""

ERROR, FINE_SHARE, FINE_CELLS = 0.037, 0.3, 0.2
"""Of the errors of both components of slopes: their size, 3 degrees; the share of its square in waves of less than 0.5 mm, and the
share of these that the mean of a cell keeps."""

WHITE_MM = 0.02
"""What heights err by beside: cell by cell, which makes up for what the model of the errors has wrong, and alike over a contact,
which its frames cannot show. The relief of a real GelSight Mini errs by so much."""

MOST_MM = 2.0 * HEIGHT_NOISE_MM
"""Heights of a pixel that differ by more than this do not count."""

MODES = 64
"""Modes of the error of heights that are kept: they leave out 1 to 6 % of the variance."""

Index = npt.NDArray[np.int64]


class HeightErrors(NamedTuple):
    """Cells of a keyframe's contact, their heights, and how these err.

    Attributes:
        cell: (N,), the cell of each of the keyframe's pixels.
        number: (M,), pixels of each cell.
        lines: (M, K + 6), what the height of a cell changes by each mode of the error, whose sizes have a variance of 1, and by
            each scaled twist; in units of :data:`WHITE_MM`.
        products: (K + 6, K + 6), of these over all cells.
    """

    cell: npt.NDArray[np.int64]
    number: Array
    lines: Array
    products: Array


def height_errors(gradient: Tensor, skin: Tensor, mm_per_pixel: float, times: int, points: Points) -> HeightErrors:
    """Cells of a keyframe and the modes of their errors.

    Args:
        gradient: (1, 2, H, W), of the keyframe, mm per mm.
        skin: (1, 1, H, W) bool, deformed skin: around it heights are zero.
        mm_per_pixel: pitch, mm.
        times: pixels a side of a cell.
        points: of the keyframe.
    """
    height, width = skin.shape[-2:]
    share = avg_pool2d(skin.double(), times)
    slope = (avg_pool2d(gradient.double() * skin, times) / share.clamp_min(0.2))[0].numpy()
    x, y = points.columns[:2].double().numpy()
    column = ((x / mm_per_pixel + 0.5 * width) / times).astype(int).clip(0, slope.shape[2] - 1)
    row = ((0.5 * height - y / mm_per_pixel) / times).astype(int).clip(0, slope.shape[1] - 1)
    deformed = share[0, 0].numpy() > 0.5
    deformed[row, column] = True
    cells, cell = np.unique(row * slope.shape[2] + column, return_inverse=True)
    number = np.bincount(cell).astype(np.float64)
    by = np.stack([np.bincount(cell, one) for one in points.columns[17:].double().numpy()], 1) / number[:, None]
    chosen = (np.cumsum(deformed) - 1)[cells]
    covariance = 2.0 * _covariance(slope, deformed, times * mm_per_pixel, chosen)  # the keyframe's and the frame's
    lines = np.ascontiguousarray(np.hstack((_modes(covariance, MODES), by)) / WHITE_MM)
    return HeightErrors(cell, number, lines, lines.T @ lines)


def _covariance(slope: Array, deformed: Mask, pitch: float, chosen: Index) -> Array:
    """Covariance (m, m) of the heights of chosen cells, mm^2: the least squares of wrong slopes, zero on undeformed skin.

    Args:
        slope: (2, h, w), means over cells.
        deformed: (h, w), n cells.
        pitch: of cells, mm.
        chosen: (m,), which of the n.
    """
    number = int(deformed.sum())
    normal, middle = 1e-6 * np.eye(number), np.zeros((number, number))
    height, width = deformed.shape
    for down, right in ((0, 1), (1, 0)):
        row, column = np.nonzero(deformed[: height - down, : width - right] | deformed[down:, right:])
        one, other = (row, column), (row + down, column + right)
        edge = np.full((2, height, width), len(row))  # of each cell to the next one, and from the one before
        edge[0][one] = edge[1][other] = np.arange(len(row))
        ahead, behind = edge[:, deformed]
        weights = [deformed[cells].astype(np.float64) for cells in (one, other)]
        at = (weights[0] * slope[:, one[0], one[1]] + weights[1] * slope[:, other[0], other[1]]) / (weights[0] + weights[1])
        place = pitch * np.stack((column + 0.5 * right, row + 0.5 * down))
        point = np.concatenate((place / ALIKE_MM, at / ALIKE_SLOPE))
        square = 0.5 * (point * point).sum(0)
        smooth = np.exp((point.T @ point - square[:, None] - square).astype(np.float32))
        middle += (1.0 - FINE_SHARE) * _differences(smooth, ahead, behind)
        plain = _differences(np.eye(len(row), dtype=np.float32), ahead, behind)
        normal += plain
        middle += FINE_SHARE * FINE_CELLS * plain
    heights = np.linalg.inv(normal)[chosen]
    scaled: Array = heights @ middle @ heights.T * (ERROR * pitch) ** 2
    return scaled


def _differences(values: Image, ahead: Index, behind: Index) -> Image:
    """D^T values D (n, n): D (e, n) takes the cell before each edge, which has it ``ahead``, from the one after it."""
    padded = np.pad(values, (0, 1))  # the edge beyond the last one is that of no cell
    lines = padded[behind] - padded[ahead]
    difference: Image = lines[:, behind] - lines[:, ahead]
    return difference


def _modes(covariance: Array, most: int) -> Array:
    """Modes (m, k), k at most ``most``, whose products are nearly a covariance (m, m): Cholesky's, the largest pivot first.

    Source:
        Harbrecht, Peters, Schneider, Applied Numerical Mathematics 62(4), 2012.
    """
    left = covariance.diagonal().copy()
    modes = np.zeros((min(most, len(left)), len(left)))
    for k, mode in enumerate(modes):
        pivot = int(left.argmax())
        if left[pivot] <= 0.0:
            break
        mode[:] = (covariance[pivot] - modes[:k, pivot] @ modes[:k]) / math.sqrt(left[pivot])
        left -= mode * mode
        left[pivot] = 0.0
    return modes.T


def height_sums(errors: HeightErrors, grid: Grid, points: Points, pose: Array) -> tuple[Array, Array]:
    """J^T C^-1 J (6, 6) and J^T C^-1 r (6,) of the heights of cells that both contacts hold: generalised least squares.

    C is that of the modes and of white noise; so the sizes of the modes are fitted beside the twist.

    Args:
        errors: of the keyframe.
        grid: the new frame.
        points: the keyframe's, those that ``errors`` was made of.
        pose: (4, 4), of the keyframe in the grid's frame.
    Source:
        Aitken, Proceedings of the Royal Society of Edinburgh 55, 1935.
    """
    limits = residual_limits(grid, pose, SLOPE_NOISE)
    if library() is not None:
        left = tracking.height_sums(grid.channels, points.columns, limits, errors, MOST_MM, WHITE_MM)
        return left[:6, :6], left[:6, 6]
    found = residuals(grid.channels, points.columns, limits)
    residual = found.values[2]
    seen = found.inside & (found.height > SHALLOW_MM) & (np.abs(residual) < MOST_MM)
    cell = errors.cell[seen]
    count = np.bincount(cell, minlength=len(errors.number))
    used = count >= 0.5 * errors.number
    mean = np.bincount(cell, residual[seen], len(errors.number))[used] / (count[used] * WHITE_MM)
    lines = np.column_stack((errors.lines[used], mean))
    products = lines.T @ lines
    modes = len(products) - 7
    across = products[:modes, modes:]
    left = products[modes:, modes:] - across.T @ np.linalg.solve(products[:modes, :modes] + np.eye(modes), across)
    return left[:6, :6], left[:6, 6]


def covariance_with_heights(slopes: Sums, both: Sums, by_slopes: Array) -> Array:
    """Covariance of the scaled twist that slopes and heights ask for, from that of the slopes alone.

    Heights err as the modes have it, by as much less or more as the slopes of the two frames differ less or more.
    """
    spread = np.linalg.inv(both.matrix + 1e-9 * float(np.trace(both.matrix)) * np.eye(6))
    share = spread @ slopes.matrix
    size = 0.5 * (slopes.slope_noise / ERROR) ** 2
    scaled: Array = share @ by_slopes @ share.T + size * spread @ (both.matrix - slopes.matrix) @ spread
    return scaled
