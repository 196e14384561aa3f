"""A frame registered to a keyframe from poses that are nearly right, with what speaks for and against the result."""

import math
from typing import NamedTuple

import numpy as np
import torch

from .alignment import SLOPE_NOISE, agrees_enough
from .ambiguity import ALIKE_PIXELS, LEAST_INFORMATION, UNKNOWN_VARIANCE, free_directions, name_directions
from .inverse import Array, Field, Pixels, Sums, refine, sum_residuals
from .keyframe import Grids, Keyframe

COARSE_STEPS, SOME_STEPS = 6, 6
"""Largest number of steps on the coarse grid, and with some pixels of the fine one."""

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
    """Register a frame to a keyframe from the best of several poses: on the coarse grid, on some pixels, on many of them."""
    costs = [sum_residuals(frame.coarse, keyframe.coarse, start, SLOPE_NOISE).cost for start in starts]
    start = starts[int(np.argmin(costs))]
    pose, coarse = refine(frame.coarse, keyframe.coarse, start, COARSE_STEPS, 2.0 * SLOPE_NOISE, keyframe.held, 0.02)
    free, names = _unknown(keyframe, coarse, pose)
    pose, some = refine(frame.fine, keyframe.some, pose, SOME_STEPS, SLOPE_NOISE, free, 2e-3)
    pose, fine = refine(frame.fine, keyframe.many, pose, 1, 1.5 * max(some.slope_noise, 0.01), free)
    forth = sum_residuals(frame.coarse, keyframe.coarse, pose, SLOPE_NOISE)
    back_pixels = _pixels(frame.coarse)
    back = sum_residuals(keyframe.grids.coarse, back_pixels, np.linalg.inv(pose), SLOPE_NOISE)
    compared = max(forth.compared + back.compared, 1.0)
    cost = (forth.cost * forth.compared + back.cost * back.compared) / compared
    fitness = (forth.fitness * forth.compared + back.fitness * back.compared) / compared
    overlap = max(forth.compared / len(keyframe.coarse.rows), back.compared / max(len(back_pixels.rows), 1))
    return Followed(pose, fine, fitness, overlap, cost, free, names, _covariance(keyframe.many, fine, pose, free))


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


def _unknown(keyframe: Keyframe, coarse: Sums, pose: Array) -> tuple[Array, list[str]]:
    """Motions that the common contact does not determine, or not well enough: scaled twists (6, k), and their names.

    Three reasons: the surface slides on itself; the whole keyframe does, or may roll; or the common contact is so small or so
    faint that its noise hides the motion.
    """
    information = torch.from_numpy(coarse.matrix * ((coarse.noise / SLOPE_NOISE) ** 2 / max(coarse.used, 1)))
    free, _ = free_directions(information, keyframe.bias, LEAST_INFORMATION)
    wanted = np.concatenate((keyframe.coarse.units[:3] ** -1 * math.radians(MOST_STD_DEG), np.full(3, MOST_STD_MM)))
    alike = max(1.0, ALIKE_PIXELS / keyframe.times[1] ** 2)
    matrix = coarse.matrix * wanted[:, None] * wanted / (alike * (max(coarse.slope_noise, 1e-3) / coarse.noise) ** 2)
    precision, directions = np.linalg.eigh(matrix)  # 1 where the standard deviation is as wanted
    vague = directions[:, precision < 1.0] * wanted[:, None]
    vague /= np.maximum(np.linalg.norm(vague, axis=0), 1e-12)
    u, size, _ = np.linalg.svd(np.hstack((free.numpy(), keyframe.held, vague)), full_matrices=False)
    held: Array = u[:, size > 0.5]
    if held.shape[1] == 0:
        return held, []
    turned = torch.from_numpy(np.vstack((pose[:3, :3] @ held[:3], pose[:3, :3] @ held[3:])))
    return held, name_directions(turned, _pure_shifts(turned))


def _pure_shifts(free: torch.Tensor) -> torch.Tensor:
    """The combinations (3, m) of motions (6, k) that hardly turn."""
    _, size, vh = torch.linalg.svd(free[:3])
    size = torch.cat((size, size.new_zeros(len(vh) - len(size))))
    shifts: torch.Tensor = torch.nn.functional.normalize((free @ vh[size < 0.3].T)[3:], dim=0)
    return shifts


def _covariance(pixels: Pixels, fine: Sums, pose: Array, free: Array) -> Array:
    """Covariance of a small motion after the pose.

    Residuals are alike over some pixels, and an error of the height is alike over all of them.
    """
    known = np.eye(6) - free @ free.T
    scaled = np.linalg.pinv(known @ fine.matrix @ known, rcond=1e-9, hermitian=True)
    scaled *= ALIKE_PIXELS * (fine.slope_noise / fine.noise) ** 2
    scaled[5, 5] += fine.depth_noise**2
    scaled += free @ free.T * UNKNOWN_VARIANCE
    to_origin = np.diag(pixels.units)
    to_origin[3:, :3] = cross(pixels.center) @ to_origin[:3, :3]
    after = adjoint(pose) @ to_origin
    covariance: Array = after @ scaled @ after.T
    return covariance
