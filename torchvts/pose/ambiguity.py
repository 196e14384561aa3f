"""Ambiguity: the motions under which a surface slides on itself, and their names."""

import math

import numpy as np

from .grids import Grid
from .inverse import (
    CUT,
    HEIGHT_NOISE_MM,
    LEAST_OVERLAP,
    SHALLOW_MM,
    SLOPE_NOISE,
    Points,
    center_and_units,
    points_of,
    residual_limits,
    residuals,
)
from .rigid import Array, adjoint, rigid_motion

SINE_OF_AXIS = 0.3
"""Sine of the angle to the z axis up to which a direction is called z, and of that to the skin up to which it has an angle."""

SHIFT = 0.995
"""A shift is free if so much of it lies in the free motions: of a ball of ten times the contact's radius, which rolls, it does."""

LEAST_INFORMATION = 0.12
"""Squared change of slope, in units of its noise, per squared mm of motion, below which a motion is unknown: 0.02 a mm."""

NOISE = np.array([SLOPE_NOISE, SLOPE_NOISE, HEIGHT_NOISE_MM])
"""Of p, q and z."""

DEEP = 0.6
"""Share of the largest depth above which the skin certainly lies on the object."""

ROLLS = (0.5, 0.25, 0.125, 0.0625)
"""Shares of the contact's radius by which a motion is tried: only small ones leave a thin, long rod where it touches."""

TURNED = (3.0, 5.0, 5.0, 5.0)
"""How many times the rise of the mean squared residual the mean square must be by which normals turn, for each share of the radius.
By half of the radius real balls have 4 to 5; by the small shares thin rods, capsules and balls have 10 and more,
a roof or a screw thread 3 to 5."""

UNKNOWN_VARIANCE = 100.0
"""Variance of a motion that the surface does not determine, mm^2."""


def unknown_motions(grid: Grid, points: Points, noise: float) -> Array:
    """Scaled twists (6, k), orthonormal columns, that a surface does not determine, on its coarse grid, which is least noisy.

    Two tests: whether slopes and heights of the whole contact change with a motion; and, where the contact is a single hill,
    whether its deep part rolls on itself: its normals turn by more than frames disagree, and it still fits no worse. The deep
    part lies on the object; the skin around a ball moves with the contact, not with the ball, and hides that the ball can roll. Of
    a thin rod a pixel covers so much of the bend that derivatives are wrong: only the second test finds that it can roll.

    Args:
        grid: the surface.
        points: all its pixels, whose twists they are.
        noise: of its slopes.
    """
    information, bias = _information(points), information_of_noise(noise, grid.pitch)
    free = free_directions(information, bias, LEAST_INFORMATION)
    depth = points.columns[2].numpy()
    deep = depth > DEEP * depth.max()
    if int(deep.sum()) < 6 or not _is_one_hill(grid):
        return free
    row, column = (at[deep] for at in grid.pixels())
    part = points_of(grid, row, column, *center_and_units(grid.points(row, column)))
    motions = np.linalg.eigh(_information(part))[1]
    rolls = motions[:, _rolls(grid, part, motions)]
    shifts = free_directions(information[3:, 3:], bias[3:, 3:], LEAST_INFORMATION)
    slides = np.concatenate((np.zeros_like(shifts), shifts))  # of the whole contact; a rod rolls and slides
    rolls = span(np.hstack((slides, rolls - slides @ (slides.T @ rolls))))
    return motions_of(points, rolls, part, np.eye(4)) if rolls.shape[1] > free.shape[1] else free


def motions_of(other: Points, motions: Array, points: Points, pose: Array) -> Array:
    """Orthonormal scaled twists (6, k) of some points as those of others, which lie under a pose (4, 4) of the first."""
    return np.linalg.qr(np.linalg.solve(other.to_origin(), adjoint(pose) @ points.to_origin() @ motions))[0]


def span(columns: Array) -> Array:
    """Orthonormal columns that span some columns (n, k) of length about 1; what is shorter than 0.5 beside the others is noise."""
    u, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, : len(sizes)][:, sizes > 0.5]


def information_of_noise(noise: float, pitch: float) -> Array:
    """(6, 6), the information of a pixel that the noise of slopes alone causes, through planes fitted to 3 x 3 of them."""
    bend = 1.5 / 6.0 * (noise / pitch / SLOPE_NOISE) ** 2
    return np.diag(bend * np.array([0.1, 0.1, 1.0, 1.0, 1.0, 0.1]))


def free_directions(information: Array, bias: Array, least: float) -> Array:
    """Motions about which a surface holds hardly any information, orthonormal columns (6, k).

    Args:
        information: (6, 6), mean over the contact's pixels of J^T J in units of the noise; rotations in units of the contact's
            size, shifts in mm, so that all six are lengths.
        bias: (6, 6), the part of it that noise alone causes.
        least: information below which a direction counts as unknown, 1/mm^2.
    """
    values, vectors = np.linalg.eigh(information)
    noise = ((vectors.T @ bias) * vectors.T).sum(1)
    free: Array = vectors[:, values < least + 3.0 * noise]
    return free


def name_directions(free: Array) -> list[str]:
    """Names of free motions, orthonormal columns (6, k).

    Example:
        >>> name_directions(np.eye(6)[:, 2:5])
        ['translation along x', 'translation along y', 'rotation about z']
        >>> name_directions(np.eye(6)[:, :3])
        ['rotation about x', 'rotation about y', 'rotation about z']
        >>> name_directions(np.array([[0.0, 0.0, 0.0, 0.8, 0.6, 0.0]]).T)
        ['translation along 37 degrees']
    """
    names: list[str] = []
    directions, sizes, _ = np.linalg.svd(free[3:], full_matrices=False)
    shifts = directions[:, sizes > SHIFT]
    count = shifts.shape[1]
    if count == 1:
        names.append(f"translation along {_line(shifts[:, 0])}")
    elif count > 1:
        inside = np.linalg.norm(shifts, axis=1).tolist()  # how much of x, y, z lies in the space of shifts
        names += [f"translation along {'xyz'[k]}" for k in sorted(sorted(range(3), key=lambda k: -inside[k])[:count])]
    turns = min(free.shape[1] - count, 3)
    if turns == 3:
        return names + [f"rotation about {axis}" for axis in "xyz"]
    axes = np.linalg.svd(free[:3], full_matrices=False)[0]  # the axes of the free rotations, largest first
    return names + [f"rotation about {_line(axes[:, k])}" for k in range(turns)]


def _line(direction: Array) -> str:
    """A line by its name: x, y, z, its angle in the plane of the skin, or its direction.

    Example:
        >>> _line(np.array([0.0, 1.0, 0.0])), _line(np.array([0.4, 0.0, 0.9]))
        ('y', '(0.40, 0.00, 0.90)')
    """
    x, y, z = direction.tolist()
    if math.hypot(x, y) < SINE_OF_AXIS * abs(z) / math.sqrt(1 - SINE_OF_AXIS**2):
        return "z"
    if abs(z) > SINE_OF_AXIS:
        return f"({x:.2f}, {y:.2f}, {z:.2f})"
    angle = round(math.degrees(math.atan2(y, x))) % 180
    if min(angle, 180 - angle) <= 2:
        return "x"
    return "y" if abs(angle - 90) <= 2 else f"{angle} degrees"


def _is_one_hill(grid: Grid) -> bool:
    """Whether no path from the contact's deep part climbs by more than a tenth of the depth: there is no second hill."""
    import cv2

    channels = grid.channels.numpy()
    depth = np.where(channels[..., 3] > 0.999, channels[..., 0], 0.0).astype(np.float32)
    highest = float(depth.max())
    reached, before = np.where(depth > DEEP * highest, depth, np.float32(0.0)), np.zeros_like(depth)
    while not np.array_equal(reached, before):
        before, reached = reached, np.minimum(cv2.dilate(reached, np.ones((3, 3), np.uint8)), depth)
    return float((depth - reached).max()) < 0.1 * highest


def _information(points: Points) -> Array:
    """(6, 6), mean over pixels of J^T J in units of the noise."""
    by = points.columns[5:].double().numpy().reshape(3, 6, -1) / NOISE[:, None, None]
    information: Array = np.einsum("rin,rkn->ik", by, by, optimize=True) / points.number
    return information


def _rolls(grid: Grid, deep: Points, motions: Array) -> Array:
    """Which motions (6, K) turn the deep part's normals and leave its fit unchanged, by steps of some length; bool (K,)."""
    columns = deep.columns[:5].contiguous()
    p, q = columns[3:].double().numpy()
    turn = np.stack(((p * q, -(1.0 + p * p), -q), (1.0 + q * q, -p * q, p))) / SLOPE_NOISE  # (2, 3, N), of slopes by a rotation
    rolls = np.zeros(motions.shape[1], bool)
    for k, twist in enumerate((motions * deep.units[:, None]).T):
        turned = float(np.square(np.einsum("rin,i->rn", turn, twist[:3])).sum(0).mean())
        for share, times in zip(ROLLS, TURNED, strict=True):
            step = share / deep.units[0]  # mm
            rises = []
            for sign in (step, -step):
                limits = residual_limits(grid, rigid_motion(sign * twist, deep.center), SLOPE_NOISE)
                found = residuals(grid.channels, columns, limits)
                compared = found.inside & (found.height > SHALLOW_MM)
                if compared.sum() <= LEAST_OVERLAP * deep.number:
                    break
                squared = np.square(found.values / NOISE[:, None]).sum(0)
                rises.append(float(np.minimum(squared, CUT**2)[compared].mean()))
            rolls[k] |= len(rises) == 2 and max(rises) < 2.0 < turned * step**2 > times * max(rises)
    return rolls
