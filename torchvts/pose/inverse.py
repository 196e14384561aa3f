"""Inverse compositional alignment: a pose is moved so that a new frame, seen from the reference, agrees with the reference.

The pulled-back slopes of the new frame minus those of the reference have, near the right pose, the derivatives of the reference
with respect to its own motion. So they are computed once per reference. Slopes count more than heights.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.linalg import inv
from torch import Tensor

from ..compiled import library, tracking
from .grids import Grid, Image, Mask
from .rigid import Array, cross, rigid_motion, rotation_vector

SLOPE_NOISE = 0.06
"""Disagreement of slopes that counts as noise, mm per mm: calibrated sensors err by 2 to 3 degrees, exact ones by less."""

DEPTH_DRIFT_MM = 0.5
"""The same of heights when poses are refined: errors of integrated depth are alike over the whole contact and would tilt it."""

HEIGHT_NOISE_MM = 0.1
"""The same of heights in a score: what integrated slopes that err by 3 degrees add up to."""

CUT = 4.0
"""A pixel whose residual exceeds this multiple of the noise is an outlier."""

SHALLOW_MM = 0.02
"""Reference pixels that should be deeper than this under a pose count."""

LEAST_SLOPE_NOISE = 1e-3
"""Slopes of pixels err by so much at least."""

LARGEST_STEP_MM = 0.6
"""Of a refinement, at the contact: a small part of one asks for large ones by noise alone."""

LEAST_OVERLAP, MOST_COST = 0.3, 0.25
"""Limits within which a score is trusted."""

COARSE_WINDOW, FINE_WINDOW = np.ones(3), np.array([1.0, 4.0, 6.0, 4.0, 1.0])
"""Weights of neighbours along each side in second derivatives, whose noise looks like information on the pose."""


class Points(NamedTuple):
    """Pixels of a reference and their derivatives by a scaled twist about ``center``.

    Attributes:
        columns: (23, N), one column a pixel: x, y, z, p, q, and what p, q and z change by each of the six twists; (5, N) where no
            derivatives are needed.
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

    def to_origin(self) -> Array:
        """(6, 6), which turns a scaled twist into one about the origin, rad and mm."""
        matrix = np.diag(self.units)
        matrix[3:, :3] = cross(self.center) @ matrix[:3, :3]
        return matrix


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


class Score(NamedTuple):
    """Of a pose, from the pixels of both frames: one that should touch and does not counts as an outlier.

    Attributes:
        fitness: share of the pixels compared that agree.
        overlap: share of the smaller contact that was compared.
        cost: mean truncated residual, 0 to 1.
    """

    fitness: float
    overlap: float
    cost: float

    @property
    def is_enough(self) -> bool:
        """Whether the pose can be trusted."""
        return self.overlap >= LEAST_OVERLAP and self.cost <= MOST_COST

    @property
    def share(self) -> str:
        """What was compared, in words."""
        common = f"{100 * self.fitness:.0f} % of the common contact agrees"
        return f"{common}, which is {100 * self.overlap:.0f} % of the smaller one"


def center_and_units(points: Image) -> tuple[Array, Array]:
    """Centre (3,) of points (5, N), and units (6,): rotations that move their mean radius by 1 mm, and shifts of 1 mm."""
    center = points[:3].mean(1, dtype=np.float64)
    radius = math.sqrt(float(np.square(points[:2] - center[:2, None]).sum(0).mean()))
    return center, np.array([1.0 / max(radius, 1e-6)] * 3 + [1.0] * 3)


def points_of(grid: Grid, row: Array, column: Array, center: Array, units: Array, window: Array = COARSE_WINDOW) -> Points:
    """Pixels of a grid and their derivatives by a motion of the grid's own surface."""
    points = grid.points(row, column)
    x, y, h = points[:3] - center[:, None]
    p, q = points[3:].astype(np.float64)
    p_x, z_xy, q_y = _bends(grid, row, column, window)
    zero, one = np.zeros_like(x), np.ones_like(x)
    # derivatives of x, y and z of a point, and of its p and q, by (w_x, w_y, w_z, t_x, t_y, t_z)
    dx = np.stack((zero, h, -y, one, zero, zero))
    dy = np.stack((-h, zero, x, zero, one, zero))
    dz = np.stack((y, -x, zero, zero, zero, one))
    dp = np.stack((p * q, -(1.0 + p * p), -q, zero, zero, zero))
    dq = np.stack((1.0 + q * q, -p * q, p, zero, zero, zero))
    by = np.stack((p_x * dx + z_xy * dy - dp, z_xy * dx + q_y * dy - dq, p * dx + q * dy - dz)) * units[:, None]  # (3, 6, N)
    columns = np.concatenate((points, by.reshape(18, -1).astype(np.float32)))
    return Points(torch.from_numpy(np.ascontiguousarray(columns)), center, units)


def _bends(grid: Grid, row: Array, column: Array, window: Array) -> tuple[Array, Array, Array]:
    """Second derivatives z_xx, z_xy and z_yy (N,) of pixels, 1/mm, by planes of least squares through the slopes around them.

    Only pixels on the object count: the skin bends beyond the rim.
    """
    reach = len(window) // 2
    channels = np.pad(grid.channels.numpy(), ((reach, reach), (reach, reach), (0, 0)))
    matrix, right = np.zeros((len(row), 3, 3)), np.zeros((len(row), 3, 2))
    middle = channels[row + reach, column + reach, 1:3]
    for (i, j), share in np.ndenumerate(np.outer(window, window)):
        near, place = channels[row + i, column + j], np.array([1.0, j - reach, reach - i])
        weight = (share * (near[:, 3] > 0.999))[:, None, None]
        matrix += weight * np.outer(place, place)
        right += weight * place[:, None] * (near[:, 1:3] - middle)[:, None]
    planes = np.linalg.solve(matrix + np.diag([1e-9, 1e-3, 1e-3]), right) / grid.pitch
    return planes[:, 1, 0], 0.5 * (planes[:, 2, 0] + planes[:, 1, 1]), planes[:, 2, 1]


def bare_points(grid: Grid) -> Points:
    """All pixels on the object, without derivatives: for scores."""
    return Points(torch.from_numpy(grid.points(*grid.pixels())), np.zeros(3), np.ones(6))


def refine(
    grid: Grid, points: Points, pose: Array, steps: int, wide: float, held: Array | None = None, small_mm: float = 1e-4
) -> tuple[Array, Sums]:
    """Gauss-Newton from a pose (4, 4) of the reference in the grid's frame.

    Args:
        grid: the new frame.
        points: of the reference.
        pose: to start from.
        steps: largest number of steps.
        wide: slope noise of the first step; it halves down to half as much again as the residuals.
        held: (6, k) orthonormal scaled twists that keep their value.
        small_mm: a step so small, at the contact, is the last one.
    Returns:
        The pose, and the sums under the pose before the last step.
    """
    noise = wide
    for _ in range(steps):
        sums = sum_residuals(grid, points, pose, noise)
        step = solve_step(sums, held)
        pose = pose @ moved_by(points, step)
        noise = max(LEAST_SLOPE_NOISE, 1.5 * sums.slope_noise, 0.5 * noise)
        if float(np.abs(step).max()) < small_mm:
            break
    return pose, sums


ROTATION_FIRST = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])
"""Relative damping of scaled twists: what is not determined is chosen so that rotations keep their value before shifts do."""


def solve_step(sums: Sums, held: Array | None = None) -> Array:
    """The scaled twist (6,) that the sums ask for.

    What they do not determine is chosen by :data:`ROTATION_FIRST`: a ball that moves sideways is followed by a shift, no roll.
    """
    known = np.eye(6) if held is None else beside(held)
    matrix, right = known.T @ sums.matrix @ known, known.T @ sums.right
    damping = 1e-6 * max(float(np.trace(matrix)), 1e-9)
    step: Array = -np.linalg.solve(matrix + damping * np.diag(ROTATION_FIRST), right)
    step *= min(1.0, LARGEST_STEP_MM / max(float(np.linalg.norm(step)), 1e-12))
    return step


def beside(held: Array) -> Array:
    """(6, 6), which takes from a scaled twist what it has of orthonormal ones (6, k), so that it turns least.

    Steps that are made otherwise than they are asked for never end: slopes ask for a shift along z, which they do not see.
    """
    weighted = held.T * ROTATION_FIRST
    matrix: Array = np.eye(6) - held @ np.linalg.solve(weighted @ held, weighted)
    return matrix


def moved_by(points: Points, step: Array) -> Array:
    """The rigid motion (4, 4) of a scaled twist."""
    return rigid_motion(step * points.units, points.center)


def step_between(points: Points, pose: Array, other: Array) -> Array:
    """The scaled twist (6,) after which, by :func:`moved_by`, a pose (4, 4) is another one."""
    moved = inv(pose) @ other
    turn = moved[:3, :3]
    twist = np.concatenate((rotation_vector(turn), moved[:3, 3] - points.center + turn @ points.center))
    step: Array = twist / points.units
    return step


def score_pose(grid: Grid, points: Points, own_grid: Grid, own_points: Points, pose: Array) -> Score:
    """Score of a pose of ``points`` in ``grid``, and back, of the new frame's own points in the reference's ``own_grid``."""
    forth = sum_residuals(grid, points, pose, SLOPE_NOISE, score_only=True)
    back = sum_residuals(own_grid, own_points, inv(pose), SLOPE_NOISE, score_only=True)
    compared = max(forth.compared + back.compared, 1.0)
    fitness = (forth.fitness * forth.compared + back.fitness * back.compared) / compared
    overlap = max(forth.compared / max(points.number, 1), back.compared / max(own_points.number, 1))
    return Score(fitness, overlap, (forth.cost * forth.compared + back.cost * back.compared) / compared)


def sum_residuals(grid: Grid, points: Points, pose: Array, slope_noise: float, score_only: bool = False) -> Sums:
    """Sums of one Gauss-Newton step with Cauchy's weights, and the score of the pose (4, 4), from the reference to the grid."""
    found = _alignment_sums(grid.channels, points.columns, residual_limits(grid, pose, slope_noise), score_only)
    return sums_of(found, slope_noise)


def sum_parts(grid: Grid, points: Points, pose: Array, slope_noise: float, parts: int) -> tuple[Sums, Array, Array]:
    """:func:`sum_residuals`, and the matrices (parts, 6, 6) and right sides (parts, 6) of as many runs of pixels."""
    limits, ends = residual_limits(grid, pose, slope_noise), [points.number * k // parts for k in range(parts + 1)]
    found = np.stack([_alignment_sums(grid.channels, points.columns[:, a:b], limits) for a, b in pairwise(ends)])
    products = found[:, :49].reshape(parts, 7, 7)
    return sums_of(found.sum(0), slope_noise), products[:, :6, :6], products[:, :6, 6]


def _alignment_sums(channels: Tensor, columns: Tensor, limits: Array, score_only: bool = False) -> Array:
    """:func:`alignment_sums`, in C where there is a library."""
    by = tracking.alignment_sums if library() is not None else alignment_sums
    return by(channels, columns, limits, score_only)


def residual_limits(grid: Grid, pose: Array, slope_noise: float) -> Array:
    """What the residuals depend on beside the pixels, (24,)."""
    limits = np.empty(24)
    limits[:16] = pose.ravel()
    limits[16:] = (
        grid.x0, grid.y0, grid.pitch, slope_noise**-2, DEPTH_DRIFT_MM**-2,
        (CUT * SLOPE_NOISE) ** -2, (CUT * HEIGHT_NOISE_MM) ** -2, SHALLOW_MM,
    )  # fmt: skip
    return limits


def sums_of(total: Array, slope_noise: float) -> Sums:
    """What :func:`alignment_sums` returns, (56,), with names."""
    matrix = total[:49].reshape(7, 7)
    count, weight, off, high, bad, good, compared = total[49:].tolist()
    most = max(compared, 1.0)
    slope, depth = math.sqrt(0.5 * off / max(weight, 1e-9)), math.sqrt(high / max(weight, 1e-9))
    return Sums(matrix[:6, :6], matrix[:6, 6], int(count), slope, depth, bad / most, good / most, compared, slope_noise)


class Residuals(NamedTuple):
    """Of the pixels of a reference under one pose.

    Attributes:
        values: (3, N), the new frame's p, q and z minus the reference's.
        height: (N,), z of the pixel under the pose.
        inside: (N,) bool, where the new frame surely lies on the object.
        seen: (N,) bool, where the new frame has its pixel and says whether it does.
    """

    values: Image
    height: Image
    inside: Mask
    seen: Mask


def residuals(channels: Tensor, columns: Tensor, limits: Array) -> Residuals:
    """Residuals of pixels (5 or 23, N) under the pose in ``limits``, in the plain way."""
    place, (x0, y0, pitch) = limits[:16].reshape(4, 4).astype(np.float32), limits[16:19].tolist()
    turn, rows = place[:3, :3], columns[:5].numpy()
    x, y, height = turn @ rows[:3] + place[:3, 3:]
    column, row = (x - x0) / pitch, (y0 - y) / pitch
    flat, (high, wide) = channels.numpy().reshape(-1, 4), channels.shape[:2]
    within = (column >= 0) & (column <= wide - 1) & (row >= 0) & (row <= high - 1)
    left, top = column.astype(np.int64).clip(0, wide - 2), row.astype(np.int64).clip(0, high - 2)
    along, down, first = (column - left)[:, None], (row - top)[:, None], top * wide + left
    upper = flat[first] + along * (flat[first + 1] - flat[first])
    lower = flat[first + wide] + along * (flat[first + wide + 1] - flat[first + wide])
    z, p, q, mask = (upper + down * (lower - upper)).T
    back = turn.T @ np.stack((-p, -q, np.ones_like(p)))
    values = np.stack((*(-back[:2] / np.maximum(back[2], 0.05) - rows[3:5]), z - height))
    inside = within & (mask > 0.999)
    return Residuals(values, height, inside, inside | (within & (mask <= 0.001)))


def alignment_sums(channels: Tensor, columns: Tensor, limits: Array, score_only: bool = False) -> Array:
    """Sums (56,) float64: 7 x 7 products of the Jacobian and the residual, zero with ``score_only``, then seven of the score."""
    found = residuals(channels, columns, limits)
    per_slope, per_height, score_slope, score_height, shallow = limits[19:].astype(np.float32)
    off, high = np.square(found.values[:2]).sum(0), np.square(found.values[2])
    counted = found.seen & (found.height > shallow)
    error = np.where(found.inside, np.minimum(off * score_slope + high * score_height, 1.0), 1.0)[counted]
    used = found.inside & (found.height > shallow)
    weight = used / (1.0 + 0.25 * (off * per_slope + high * per_height))
    products = np.zeros((7, 7))
    if not score_only:
        lines = np.concatenate((columns[5:].numpy().reshape(3, 6, -1), found.values[:, None]), 1).astype(np.float64)  # (3, 7, N)
        scale = np.array([per_slope, per_slope, per_height])[:, None] * weight
        products = np.einsum("rin,rn,rkn->ik", lines, scale, lines, optimize=True)
    score = [used.sum(), weight.sum(), (weight * off).sum(), (weight * high).sum(), error.sum(), (error < 1.0).sum(), counted.sum()]
    return np.concatenate((products.ravel(), np.array(score, np.float64)))
