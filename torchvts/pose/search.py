"""All turns and shifts in the plane at once: the slopes of two contacts, correlated by Fourier transforms."""

import math

import torch
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from .relief import Relief

STEP_DEG = 5.0
"""Turns that are tried; half of it moves the rim of a contact of 10 mm by a fifth of a millimetre, which refinement bridges."""

FLOOR = 0.15
"""Share of its whole energy that is added to the common part's, so that a small common part does not win by chance."""


def search_plane(source: Relief, target: Relief, most: int = 32, step_deg: float = STEP_DEG) -> tuple[Tensor, Tensor]:
    """Turns and shifts under which the slopes of two reliefs agree best.

    The slopes as one complex number a pixel: their product, summed over a shift, is large where they point the same way; it
    is divided by the energy that both have in the common part (masked correlation). A plane added or a deeper press changes it
    little, for it changes few slopes.

    Args:
        source, target: of the same pitch. most: number of hypotheses. step_deg: between turns.
    Returns:
        Poses (K, 4, 4) float64 without height, best first, and their scores (K,), at most 1.
    Source:
        Padfield, Masked object registration in the Fourier domain, IEEE Trans. Image Processing 21(5), 2012, on complex slopes.
    """
    turns = torch.arange(0.0, 360.0, step_deg)
    angle = torch.deg2rad(turns)
    moving, fixed = _square(source, around=True), _square(target)
    side = moving.shape[1]
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
    # output pixel (x, y down) of a picture turned by angle (y up) comes from the input turned back
    theta = torch.stack((torch.stack((cos, -sin, zero), -1), torch.stack((sin, cos, zero), -1)), 1)
    grid = affine_grid(theta, [len(turns), 1, side, side], align_corners=False)
    turned = grid_sample(moving[None].expand(len(turns), -1, -1, -1), grid, align_corners=False)
    p = cos[:, None, None] * turned[:, 0] - sin[:, None, None] * turned[:, 1]
    q = sin[:, None, None] * turned[:, 0] + cos[:, None, None] * turned[:, 1]
    size = [_smooth_size(side + fixed.shape[1])] * 2
    slopes_s, slopes_t = torch.fft.fft2(torch.complex(p, q), s=size), torch.fft.fft2(torch.complex(fixed[0], fixed[1]), s=size)
    energy_s = torch.fft.rfft2(p * p + q * q, s=size)
    energy_t = torch.fft.rfft2(fixed[0] ** 2 + fixed[1] ** 2, s=size)
    mask_s, mask_t = torch.fft.rfft2(turned[:, 2], s=size), torch.fft.rfft2(fixed[2], s=size)
    product = torch.fft.ifft2(slopes_s.conj() * slopes_t).real
    common_s = torch.fft.irfft2(energy_s.conj() * mask_t, s=size)
    common_t = torch.fft.irfft2(mask_s.conj() * energy_t, s=size)
    least_s = FLOOR * float((moving[:2] ** 2).sum()) + 1e-12
    least_t = FLOOR * float((fixed[:2] ** 2).sum()) + 1e-12
    score = product / torch.sqrt((common_s.clamp_min(0.0) + least_s) * (common_t.clamp_min(0.0) + least_t))
    return _peaks(score, angle, source, target, side, fixed.shape[1], most)


def _peaks(
    score: Tensor, angle: Tensor, source: Relief, target: Relief, side: int, side_t: int, most: int
) -> tuple[Tensor, Tensor]:
    """The best shift of each turn where that beats its neighbours, and the second best that is a millimetre away."""
    reach = max(1, round(1.0 / target.pitch))
    candidates: list[tuple[float, int, int, int]] = []
    blocked = score.clone()
    for _ in range(2):
        best, index = blocked.flatten(1).max(1)
        neighbours = torch.stack((best.roll(1), best.roll(-1))).amax(0)
        row, column = index // score.shape[2], index % score.shape[2]
        for k in torch.nonzero(best >= neighbours)[:, 0].tolist():
            candidates.append((float(best[k]), k, int(row[k]), int(column[k])))
        for k in range(len(angle)):
            rows = (torch.arange(-reach, reach + 1) + row[k]) % score.shape[1]
            columns = (torch.arange(-reach, reach + 1) + column[k]) % score.shape[2]
            blocked[k, rows[:, None], columns[None]] = -1.0
    candidates = sorted(candidates, reverse=True)[:most]
    center_s, center_t = _center(source), _center(target)
    poses = torch.eye(4, dtype=torch.float64).repeat(len(candidates), 1, 1)
    for n, (_, k, row_k, column_k) in enumerate(candidates):
        down = row_k if row_k < side_t else row_k - score.shape[1]
        right = column_k if column_k < side_t else column_k - score.shape[2]
        offset = 0.5 * (side - side_t)
        c, s = math.cos(float(angle[k])), math.sin(float(angle[k]))
        x = center_t[0] + (right + offset) * target.pitch
        y = center_t[1] - (down + offset) * target.pitch
        poses[n, 0, 0], poses[n, 0, 1], poses[n, 1, 0], poses[n, 1, 1] = c, -s, s, c
        poses[n, 0, 3] = x - (c * center_s[0] - s * center_s[1])
        poses[n, 1, 3] = y - (s * center_s[0] + c * center_s[1])
    return poses, torch.tensor([entry[0] for entry in candidates])


def _square(relief: Relief, around: bool = False) -> Tensor:
    """Masked slopes and mask in a square about the contact's center, (3, side, side); ``around``: one in which it can turn."""
    top, bottom, left, right = _bounds(relief)
    high, wide = bottom - top + 1, right - left + 1
    side = math.ceil(math.hypot(high, wide)) if around else max(high, wide)
    side += 2 + side % 2
    mask = relief.inside[top : bottom + 1, left : right + 1].float()
    slopes = relief.field[1:3, top : bottom + 1, left : right + 1] * mask
    result = torch.zeros(3, side, side)
    row, column = side // 2 - (top + bottom) // 2 - 1 + top, side // 2 - (left + right) // 2 - 1 + left
    result[:, row : row + high, column : column + wide] = torch.cat((slopes, mask[None]))
    return result


def _bounds(relief: Relief) -> tuple[int, int, int, int]:
    rows, columns = torch.nonzero(relief.inside.any(1))[:, 0], torch.nonzero(relief.inside.any(0))[:, 0]
    return int(rows[0]), int(rows[-1]), int(columns[0]), int(columns[-1])


def _center(relief: Relief) -> tuple[float, float]:
    """Middle of the contact's bounding box, put between pixels as the middle of an even square is."""
    top, bottom, left, right = _bounds(relief)
    return relief.x0 + ((left + right) // 2 + 0.5) * relief.pitch, relief.y0 - ((top + bottom) // 2 + 0.5) * relief.pitch


def _smooth_size(n: int) -> int:
    while True:
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
        n += 1
