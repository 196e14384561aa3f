"""Coarse search: correlates the slopes of two contacts over all in-plane rotations and shifts at once, by Fourier transforms."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample, max_pool1d

from .grids import Grid

STEP_DEG = 5.0
"""Step of the rotations; half of it moves the rim of a contact of 10 mm by a fifth of a millimetre, which refinement corrects."""

ENERGY_FLOOR = 0.15
"""Share of a contact's whole energy that is added to the common part's, so that a small common part does not win by chance."""

SAME_MM = 0.4
"""Shifts, or poses, that move a contact to so nearly the same place are one: teeth of a key are 1.2 mm apart."""


class _Square(NamedTuple):
    """A contact in the middle of a square: masked slopes and mask (3, side, side), and the middle's (x, y) in mm."""

    channels: Tensor
    center_mm: tuple[float, float]


def search_plane(source: Grid, target: Grid, most: int = 48, angle: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Find the in-plane rotations and shifts under which the slopes of two grids agree best.

    The two slopes of a pixel form one complex number. The sum of products over a shift is large where the slopes point the same
    way; it is divided by the energy of both in the common part (masked correlation). An added plane or a deeper press changes
    the score little, because both change few slopes.

    Args:
        source: the grid that is moved.
        target: the grid that stays, of the same pitch.
        most: number of hypotheses.
        angle: the rotations to try, rad, each by itself; if None, all around in steps of :data:`STEP_DEG`.
    Returns:
        Poses (K, 4, 4) float64 without a shift in z, best first, and their scores (K,), at most 1.
    Source:
        Padfield, Masked object registration in the Fourier domain, IEEE Trans. Image Processing 21(5), 2012, on complex slopes.
    """
    around = angle is None
    angle = torch.deg2rad(torch.arange(0.0, 360.0, STEP_DEG, dtype=torch.float32)) if angle is None else angle
    moving, fixed = _square(source, rotatable=True), _square(target)
    score = _masked_correlation(moving.channels, fixed.channels, angle)
    reach = max(1, min(round(SAME_MM / target.pitch), min(score.shape[1:]) // 2))
    best, turn, shift = _peaks(score, reach, around, most)
    side, size = fixed.channels.shape[1], score.shape[1]
    down, right = torch.where(shift < side, shift, shift - size).double() + 0.5 * (moving.channels.shape[1] - side)
    c, s = angle[turn].double().cos(), angle[turn].double().sin()
    poses = torch.eye(4, dtype=torch.float64).repeat(len(best), 1, 1)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = c, -s, s, c
    (x, y), (to_x, to_y) = moving.center_mm, fixed.center_mm
    poses[:, 0, 3] = to_x + right * target.pitch - (c * x - s * y)
    poses[:, 1, 3] = to_y - down * target.pitch - (s * x + c * y)
    return poses, best


def _masked_correlation(moving: Tensor, fixed: Tensor, angle: Tensor) -> Tensor:
    """Scores (angles, rows, columns) of every shift of ``moving``, rotated by every angle, on ``fixed``; both (3, side, side)."""
    import cv2

    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    # an output pixel (x, y down) of an image rotated by angle (y up) comes from the input rotated back
    theta = torch.stack((torch.stack((cos, -sin, zero), -1), torch.stack((sin, cos, zero), -1)), 1)
    grid = affine_grid(theta, [len(angle), 1, *moving.shape[1:]], align_corners=False)
    turned = grid_sample(moving[None].expand(len(angle), -1, -1, -1), grid, align_corners=False)
    p = cos[:, None, None] * turned[:, 0] - sin[:, None, None] * turned[:, 1]
    q = sin[:, None, None] * turned[:, 0] + cos[:, None, None] * turned[:, 1]
    size = [cv2.getOptimalDFTSize(moving.shape[1] + fixed.shape[1])] * 2
    slopes_s, slopes_t = torch.fft.fft2(torch.complex(p, q), s=size), torch.fft.fft2(torch.complex(fixed[0], fixed[1]), s=size)
    energy_s = torch.fft.rfft2(p * p + q * q, s=size)
    energy_t = torch.fft.rfft2(fixed[0] ** 2 + fixed[1] ** 2, s=size)
    mask_s, mask_t = torch.fft.rfft2(turned[:, 2], s=size), torch.fft.rfft2(fixed[2], s=size)
    product = torch.fft.ifft2(slopes_s.conj() * slopes_t).real
    common_s = torch.fft.irfft2(energy_s.conj() * mask_t, s=size)
    common_t = torch.fft.irfft2(mask_s.conj() * energy_t, s=size)
    floor_s, floor_t = (ENERGY_FLOOR * float((one[:2] ** 2).sum()) + 1e-12 for one in (moving, fixed))
    score: Tensor = product / torch.sqrt((common_s.clamp_min(0.0) + floor_s) * (common_t.clamp_min(0.0) + floor_t))
    return score


def _peaks(score: Tensor, reach: int, around: bool, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """The best shifts that no shift within ``reach`` beats, nor a neighbouring rotation if they go ``around``, best first.

    Returns:
        Scores (K,), the rotation of each (K,), and its rows and columns (2, K), modulo the size of the transform.
    """
    highest = _largest_around(_largest_around(score, 1, reach), 2, reach)
    if around:
        highest = _largest_around(highest, 0, 1)
    rows, columns = score.shape[1:]
    best, index = torch.where(score >= highest, score, 0.0).flatten().topk(min(most, score.numel()))
    index = index[best > 0.0]
    return best[best > 0.0], index // (rows * columns), torch.stack((index // columns % rows, index % columns))


def _largest_around(values: Tensor, dim: int, reach: int) -> Tensor:
    """The largest value within ``reach`` along a dimension that goes around."""
    lines = values.movedim(dim, -1)
    around = torch.cat((lines[..., -reach:], lines, lines[..., :reach]), -1)
    return max_pool1d(around.flatten(0, -2), 2 * reach + 1, 1).reshape(lines.shape).movedim(-1, dim)


def _square(grid: Grid, rotatable: bool = False) -> _Square:
    """Put the contact's bounding box into the middle of a square; ``rotatable``: large enough to turn the box in it."""
    row, column = grid.pixels()
    top, bottom, left, right = int(row.min()), int(row.max()), int(column.min()), int(column.max())
    high, wide = bottom - top + 1, right - left + 1
    side = math.ceil(math.hypot(high, wide)) if rotatable else max(high, wide)
    side += 2 + side % 2
    channels = torch.zeros(3, side, side, dtype=torch.float32)
    down, along = side // 2 - (top + bottom) // 2 - 1, side // 2 - (left + right) // 2 - 1
    at = torch.from_numpy(row), torch.from_numpy(column)
    channels[:2, at[0] + down, at[1] + along] = grid.channels[at[0], at[1], 1:3].T
    channels[2, at[0] + down, at[1] + along] = 1.0
    # between pixels, as the middle of a square of even side
    x, y = ((left + right) // 2 + 0.5) * grid.pitch, ((top + bottom) // 2 + 0.5) * grid.pitch
    return _Square(channels, (grid.x0 + x, grid.y0 - y))
