"""Inverse compositional alignment: a pose is moved so that a new frame, seen from the reference, agrees with the reference.

The pulled-back slopes of the new frame minus those of the reference have, near the right pose, the derivatives of the reference
with respect to its own motion. So they are computed once per reference. Slopes count more than heights, as in :mod:`.alignment`.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..compiled import library, tracking
from .alignment import CUT, DEPTH_DRIFT_MM, SLOPE_NOISE, linearise
from .relief import Relief
from .rigid import Array, inverted, rigid_motion, rotation_vector

DEEP_MM, SHALLOW_MM = 0.06, 0.02
"""Reference pixels that should be deeper than this under a pose count in its score; in its refinement from the second on."""

LEAST_NOISE, LARGEST_STEP_MM = 0.02, 0.6
"""Slope noise down to which the weights narrow, and the largest step, mm at the contact."""

HEIGHT_NOISE_MM = 0.1
"""Disagreement of heights that counts as noise in a score: what integrated slopes that err by 3 degrees add up to."""

SCORE = (1.0 / (CUT * SLOPE_NOISE) ** 2, 1.0 / (CUT * HEIGHT_NOISE_MM) ** 2)


class Field(NamedTuple):
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


class Pixels(NamedTuple):
    """Pixels of a reference and their derivatives by a scaled twist about ``center``.

    Attributes:
        columns: (23, N), one column a pixel: x, y, z, p, q, and what p, q and z change by each of the six twists.
        center: (3,), mm.
        units: (6,), rad and mm: the twist that is one of each, so that all six are lengths at the contact.
    """

    columns: Tensor
    center: Array
    units: Array

    @property
    def number(self) -> int:
        """Of pixels."""
        return self.columns.shape[1]


class Sums(NamedTuple):
    """Sums over the reference's pixels under one pose.

    Attributes:
        matrix: (6, 6), weighted J^T J in units of the noise.
        right: (6,), weighted J^T r.
        used: pixels in both contacts.
        slope_noise: weighted root mean square of slope residuals, per component.
        depth_noise: the same of height residuals, mm.
        cost: mean truncated residual of the pixels that are compared, 0 to 1.
        fitness: share of them that agrees.
        compared: number of them.
        noise: slope noise of the weights.
    """

    matrix: Array
    right: Array
    used: int
    slope_noise: float
    depth_noise: float
    cost: float
    fitness: float
    compared: float
    noise: float


def reference_pixels(part: Relief, relief: Relief, center: Tensor, units: Tensor) -> Pixels:
    """Pixels of a part of a relief, with the derivatives that the relief's field has there."""
    lin = linearise(part, relief, torch.eye(4, dtype=torch.float64)[None], center[None, None])
    by = torch.cat((lin.slope_by_twist[0], lin.height_by_twist[0][:, None]), 1) * units.float()  # (N, 3, 6)
    columns = torch.cat((part.points, part.slopes, by.flatten(1)), 1).float().T.contiguous()
    return Pixels(columns, center.numpy(), units.numpy())


def refine(
    field: Field, pixels: Pixels, pose: Array, steps: int, wide: float, held: Array | None = None, small_mm: float = 1e-4
) -> tuple[Array, Sums]:
    """Gauss-Newton from a pose (4, 4) of the reference in the field's frame.

    Args:
        field: the new frame.
        pixels: of the reference.
        pose: to start from.
        steps: largest number of steps.
        wide: slope noise of the first step; it halves down to half as much again as the residuals.
        held: (6, k) orthonormal scaled twists that keep their value.
        small_mm: a step so small, at the contact, is the last one.
    Returns:
        The pose, and the sums under the pose before the last step.
    """
    if held is None:
        held = np.zeros((6, 0))
    noise = wide
    for _ in range(steps):
        sums = sum_residuals(field, pixels, pose, noise)
        step = solve_step(sums, held)
        pose = pose @ moved_by(pixels, step)
        noise = max(LEAST_NOISE, 1.5 * sums.slope_noise, 0.5 * noise)
        if float(np.abs(step).max()) < small_mm:
            break
    return pose, sums


ROTATION_FIRST = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
"""Relative damping of scaled twists: what is not determined is chosen so that rotations keep their value before shifts do."""


def solve_step(sums: Sums, held: Array | None = None) -> Array:
    """The scaled twist (6,) that the sums ask for.

    What they do not determine is chosen by :data:`ROTATION_FIRST`: a ball that moves sideways is followed by a shift, no roll.
    """
    matrix, right = sums.matrix, sums.right
    if held is not None and held.shape[1] > 0:
        known = np.eye(6) - held @ held.T
        matrix, right = known @ matrix @ known, known @ right
    damping = 1e-6 * max(float(np.trace(matrix)), 1e-9)
    step: Array = -np.linalg.solve(matrix + damping * np.diag(ROTATION_FIRST), right)
    step *= min(1.0, LARGEST_STEP_MM / max(float(np.linalg.norm(step)), 1e-12))
    return step


def moved_by(pixels: Pixels, step: Array) -> Array:
    """The rigid motion (4, 4) of a scaled twist."""
    return rigid_motion(step * pixels.units, pixels.center)


def step_between(pixels: Pixels, pose: Array, other: Array) -> Array:
    """The scaled twist (6,) after which, by :func:`moved_by`, a pose (4, 4) is another one."""
    moved = inverted(pose) @ other
    turn = moved[:3, :3]
    twist = np.concatenate((rotation_vector(turn), moved[:3, 3] - pixels.center + turn @ pixels.center))
    step: Array = twist / pixels.units
    return step


def sum_residuals(field: Field, pixels: Pixels, pose: Array, slope_noise: float, score_only: bool = False) -> Sums:
    """Sums of one Gauss-Newton step with Cauchy's weights, and the score of the pose (4, 4), from the reference to the field."""
    by = tracking.alignment_sums if library() is not None else alignment_sums
    return sums_of(by(field.channels, pixels.columns, residual_limits(field, pose, slope_noise), score_only), slope_noise)


def sum_parts(field: Field, pixels: Pixels, pose: Array, slope_noise: float, parts: int) -> tuple[Sums, Array, Array]:
    """:func:`sum_residuals`, and the matrices (parts, 6, 6) and right sides (parts, 6) of as many runs of pixels."""
    limits = residual_limits(field, pose, slope_noise)
    if library() is not None:
        found = tracking.part_sums(field.channels, pixels.columns, parts, limits)
    else:
        ends = [pixels.number * k // parts for k in range(parts + 1)]
        runs = [pixels.columns[:, first:end] for first, end in pairwise(ends)]
        found = np.stack([alignment_sums(field.channels, run, limits) for run in runs])
    products = found[:, :49].reshape(parts, 7, 7)
    return sums_of(found.sum(0), slope_noise), products[:, :6, :6], products[:, :6, 6]


def residual_limits(field: Field, pose: Array, slope_noise: float) -> Array:
    """What the residuals depend on beside the pixels, (25,)."""
    limits = np.empty(25)
    limits[:16] = pose.ravel()
    limits[16:] = (
        field.x0, field.y0, field.pitch, slope_noise**-2, DEPTH_DRIFT_MM**-2, *SCORE, DEEP_MM, SHALLOW_MM,
    )  # fmt: skip
    return limits


def sums_of(total: Array, slope_noise: float) -> Sums:
    """What :func:`alignment_sums` returns, (56,), with names."""
    matrix = total[:49].reshape(7, 7)
    count, weight, off, high, bad, good, compared = total[49:].tolist()
    most = max(compared, 1.0)
    slope, depth = math.sqrt(0.5 * off / max(weight, 1e-9)), math.sqrt(high / max(weight, 1e-9))
    return Sums(matrix[:6, :6], matrix[:6, 6], int(count), slope, depth, bad / most, good / most, compared, slope_noise)


def alignment_sums(channels: Tensor, columns: Tensor, limits: Array, score_only: bool = False) -> Array:
    """Sums (56,) float64: 7 x 7 products of the Jacobian and the residual, zero with ``score_only``, then seven of the score."""
    place, n = torch.from_numpy(limits[:16].reshape(4, 4)).float(), limits[16:].tolist()
    rotation, shift, rows = place[:3, :3], place[:3, 3], columns.T
    height, width = channels.shape[:2]
    moved = rows[:, :3] @ rotation.T + shift
    column, row = (moved[:, 0] - n[0]) / n[2], (n[1] - moved[:, 1]) / n[2]
    seen = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
    rows, moved, column, row = rows[seen], moved[seen], column[seen], row[seen]
    z, p, q, mask = _between(channels, row, column).unbind(1)
    inside, near = mask > 0.999, mask > 0.001
    back = torch.stack((-p, -q, torch.ones_like(p)), 1) @ rotation
    slope = -back[:, :2] / back[:, 2:].clamp_min(0.05) - rows[:, 3:5]
    residual = torch.cat((slope, (z - moved[:, 2])[:, None]), 1)  # (N, 3)
    off, high = slope.square().sum(1), residual[:, 2].square()
    counted = (moved[:, 2] > n[7]) & (inside | ~near)
    error = torch.where(inside, off * n[5] + high * n[6], 1.0).clamp_max(1.0)
    used = inside & (moved[:, 2] > n[8])
    weight = used / (1.0 + 0.25 * (off * n[3] + high * n[4]))
    products = torch.zeros(7, 7, dtype=torch.float64)
    if not score_only:
        lines = torch.cat((rows[:, 5:].reshape(-1, 3, 6), residual[..., None]), 2)
        scaled = lines * (weight[:, None, None] * lines.new_tensor([n[3], n[3], n[4]])[:, None])
        products = torch.einsum("nri,nrk->ik", scaled.double(), lines.double())
    score = [used.sum(), weight.sum(), (weight * off).sum(), (weight * high).sum()]
    score += [error[counted].sum(), (error[counted] < 1.0).sum(), counted.sum()]
    total: Array = torch.cat((products.reshape(-1), torch.stack([s.double() for s in score]))).numpy()
    return total


def _between(channels: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """The channels (N, 4) between pixels, bilinearly."""
    height, width = channels.shape[:2]
    top, left = row.long().clamp_max(height - 2), column.long().clamp_max(width - 2)
    down, along = (row - top)[:, None], (column - left)[:, None]
    upper = (1 - along) * channels[top, left] + along * channels[top, left + 1]
    lower = (1 - along) * channels[top + 1, left] + along * channels[top + 1, left + 1]
    return (1 - down) * upper + down * lower
