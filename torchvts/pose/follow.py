"""A frame registered to a keyframe from poses that are nearly right, with what speaks for and against the result."""

import math
from typing import NamedTuple

import numpy as np
import torch

from .alignment import SLOPE_NOISE, agrees_enough
from .ambiguity import ALIKE_PIXELS, LEAST_INFORMATION, UNKNOWN_VARIANCE, free_directions, name_directions
from .inverse import Array, Field, Pixels, Sums, refine, sum_residuals
from .keyframe import Grids, Keyframe

COARSE_STEPS, SOME_STEPS = 8, 6
"""Largest number of steps on the coarse grid, and with some pixels of the fine one."""

INDEPENDENT_PARTS = 6
"""Parts of a contact over which errors of a calibrated sensor are independent: they are smooth, as its fields are."""

MOST_STD_DEG, MOST_STD_MM = 1.0, 0.15
"""Standard deviations of a motion, as a turn and as a shift, above which it is called unknown."""


class Followed(NamedTuple):
    """A frame registered to a keyframe.

    Attributes:
        pose: (4, 4), T_frame_keyframe.
        fine: sums over the fine grid.
        fitness: share of the pixels compared, in both directions, that agree.
        overlap: share of the smaller contact that was compared.
        cost: mean truncated residual, 0 to 1.
        free: (6, k), scaled twists that the common contact does not determine.
        names: of these motions, in the frame's axes.
        covariance: (6, 6) of a small motion after the pose, rad and mm.
    """

    pose: Array
    fine: Sums
    fitness: float
    overlap: float
    cost: float
    free: Array
    names: list[str]
    covariance: Array

    @property
    def agrees(self) -> bool:
        """Whether the frames agree well enough on a large enough part."""
        return agrees_enough(self.fitness, self.overlap, self.cost)


def follow(keyframe: Keyframe, frame: Grids, starts: list[Array]) -> Followed:
    """Register a frame to a keyframe from the most likely of several poses, and from the others if that leads nowhere."""
    order = sorted(starts, key=lambda start: sum_residuals(frame.coarse, keyframe.coarse, start, SLOPE_NOISE).cost)
    first = _follow_from(keyframe, frame, order[0])
    if not first.agrees:
        for start in order[1:]:
            other = _follow_from(keyframe, frame, start)
            if other.agrees:
                return other
    return first


def _follow_from(keyframe: Keyframe, frame: Grids, start: Array) -> Followed:
    """Refine one pose on the coarse grid, on some pixels, and on many of them, and score it."""
    pose, coarse = refine(frame.coarse, keyframe.coarse, start, COARSE_STEPS, 2.0 * SLOPE_NOISE, keyframe.held, 0.02)
    unknown = _sliding(keyframe, coarse)
    refined, some = refine(frame.fine, keyframe.some, pose, SOME_STEPS, SLOPE_NOISE, unknown.motions, 2e-3)
    vague = _vague(keyframe, some)
    if vague.motions.shape[1] > 0:
        unknown = _joined(unknown, vague)
        refined, some = refine(frame.fine, keyframe.some, pose, SOME_STEPS, SLOPE_NOISE, unknown.motions, 2e-3)
    free = unknown.motions
    pose, fine = refine(frame.fine, keyframe.many, refined, 1, 1.5 * max(some.slope_noise, 0.01), free)
    forth = sum_residuals(frame.coarse, keyframe.coarse, pose, SLOPE_NOISE)
    back_pixels = _pixels(frame.coarse)
    back = sum_residuals(keyframe.grids.coarse, back_pixels, np.linalg.inv(pose), SLOPE_NOISE)
    compared = max(forth.compared + back.compared, 1.0)
    cost = (forth.cost * forth.compared + back.cost * back.compared) / compared
    fitness = (forth.fitness * forth.compared + back.fitness * back.compared) / compared
    overlap = max(forth.compared / len(keyframe.coarse.rows), back.compared / max(len(back_pixels.rows), 1))
    return Followed(
        pose, fine, fitness, overlap, cost, free, _names(unknown, pose), _covariance(keyframe.many, fine, forth, pose, free)
    )


def common_share(keyframe: Keyframe, frame: Grids, sums: Sums, pixels: Pixels) -> float:
    """Share of the smaller contact that both have in common, by the sums over fine pixels of the keyframe."""
    return sums.used / len(pixels.rows) * keyframe.touching / max(min(keyframe.touching, frame.touching), 1)


def orthonormal(pose: Array) -> Array:
    """The pose (4, 4) with its rotation made exact: products of poses multiply what is missing."""
    u, _, vh = np.linalg.svd(pose[:3, :3])
    pose = pose.copy()
    pose[:3, :3] = u @ vh
    return pose


def adjoint(pose: Array) -> Array:
    """(6, 6), which turns a small motion before a pose (4, 4) into the same motion after it."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = pose[:3, :3]
    result[3:, :3] = cross(pose[:3, 3]) @ pose[:3, :3]
    return result


def cross(v: Array) -> Array:
    """The matrix (3, 3) of a cross product with v (3,)."""
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _pixels(field: Field) -> Pixels:
    """The pixels of a coarse field that lie on the object, without derivatives."""
    row, column = torch.nonzero(field.channels[..., 3] > 0.999, as_tuple=True)
    rows = torch.zeros(len(row), 32)
    rows[:, 0], rows[:, 1] = field.x0 + column * field.pitch, field.y0 - row * field.pitch
    rows[:, 2:5] = field.channels[row, column, :3]
    return Pixels(rows, np.zeros(3), np.ones(6))


class _Unknown(NamedTuple):
    """Scaled twists (6, k) that are not determined, and those among them that are pure shifts (3, m); orthonormal columns."""

    motions: Array
    shifts: Array


def _sliding(keyframe: Keyframe, coarse: Sums) -> _Unknown:
    """Motions under which the common contact slides on itself, by its information, and those that the keyframe may roll by."""
    information = torch.from_numpy(coarse.matrix * ((coarse.noise / SLOPE_NOISE) ** 2 / max(coarse.used, 1)))
    free, shifts = free_directions(information, keyframe.bias, LEAST_INFORMATION)
    found = _Unknown(free.numpy(), shifts.numpy())
    return _joined(found, _Unknown(keyframe.held, shifts.numpy())) if keyframe.held.shape[1] > 0 else found


def _vague(keyframe: Keyframe, some: Sums) -> _Unknown:
    """Motions whose standard deviation is too large, because the common contact is small or faint."""
    wanted = np.concatenate((math.radians(MOST_STD_DEG) / keyframe.some.units[:3], np.full(3, MOST_STD_MM)))
    alike = max(1.0, ALIKE_PIXELS * len(keyframe.some.rows) / keyframe.touching)
    matrix = some.matrix * wanted[:, None] * wanted / (alike * (max(some.slope_noise, 1e-3) / some.noise) ** 2)

    def below(part: Array, scale: Array) -> Array:
        precision, directions = np.linalg.eigh(part)  # 1 where the standard deviation is as wanted
        return np.linalg.qr(directions[:, precision < 1.0] * scale[:, None])[0]

    return _Unknown(below(matrix, wanted), below(matrix[3:, 3:], wanted[3:]))


def _joined(one: _Unknown, other: _Unknown) -> _Unknown:
    """All motions that are in one or the other."""

    def span(columns: Array) -> Array:
        u, size, _ = np.linalg.svd(columns, full_matrices=False)
        return u[:, : len(size)][:, size > 0.5]

    return _Unknown(span(np.hstack((one.motions, other.motions))), span(np.hstack((one.shifts, other.shifts))))


def _names(unknown: _Unknown, pose: Array) -> list[str]:
    """Names of the motions in the frame's axes."""
    if unknown.motions.shape[1] == 0:
        return []
    turn = pose[:3, :3]
    turned = np.vstack((turn @ unknown.motions[:3], turn @ unknown.motions[3:]))
    return name_directions(torch.from_numpy(turned), torch.from_numpy(turn @ unknown.shifts))


def _covariance(pixels: Pixels, fine: Sums, coarse: Sums, pose: Array, free: Array) -> Array:
    """Covariance of a small motion after the pose.

    Residuals are alike over some pixels, and an error of the height is alike over all of them. What is left of residuals in
    means over cells is alike over a large part of the contact, and tilts it.
    """
    known = np.eye(6) - free @ free.T
    scaled = np.linalg.pinv(known @ fine.matrix @ known, rcond=1e-9, hermitian=True)
    scaled *= ALIKE_PIXELS * (fine.slope_noise / fine.noise) ** 2
    scaled[5, 5] += fine.depth_noise**2
    scaled[[0, 1], [0, 1]] += (coarse.slope_noise / pixels.units[:2]) ** 2 / INDEPENDENT_PARTS
    scaled += free @ free.T * UNKNOWN_VARIANCE
    to_origin = np.diag(pixels.units)
    to_origin[3:, :3] = cross(pixels.center) @ to_origin[:3, :3]
    after = adjoint(pose) @ to_origin
    covariance: Array = after @ scaled @ after.T
    return covariance
