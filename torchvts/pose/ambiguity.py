"""Which motions a surface cannot tell, in words: those under which it slides on itself."""

import math

import torch
from torch import Tensor

FLAT = 0.3
"""Sine of the angle to an axis up to which a direction counts as that axis."""


def free_directions(information: Tensor, bias: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Motions of which a surface says next to nothing.

    Args:
        information: (6, 6), mean over the contact's pixels of J^T J in units of the noise; turns in units of the contact's size,
            shifts in mm, so that all six are lengths.
        bias: (6, 6), what noise alone puts there.
        least: information below which a direction counts as unknown, 1/mm^2.
    Returns:
        Orthonormal columns: all free motions (6, k), and those of them that are pure shifts (3, m).
    """
    return _below(information, bias, least), _below(information[3:, 3:], bias[3:, 3:], least)


def _below(information: Tensor, bias: Tensor, least: float) -> Tensor:
    values, vectors = torch.linalg.eigh(information)
    noise = ((vectors.T @ bias) * vectors.T).sum(1)
    free: Tensor = vectors[:, values < least + 3.0 * noise]
    return free


def name_directions(free: Tensor, shifts: Tensor) -> list[str]:
    """Words for what :func:`free_directions` found.

    Example:
        >>> name_directions(torch.eye(6)[:, 2:5], torch.eye(3)[:, :2])
        ['translation along x', 'translation along y', 'rotation about z']
        >>> name_directions(torch.eye(6)[:, :3], torch.zeros(3, 0))
        ['rotation about x', 'rotation about y', 'rotation about z']
        >>> slide = torch.tensor([[0.0, 0.0, 0.0, 0.8, 0.6, 0.0]]).T
        >>> name_directions(slide, slide[3:])
        ['translation along 37 degrees']
    """
    names = []
    count = min(shifts.shape[1], free.shape[1])
    if count == 1:
        names.append(f"translation along {_line(shifts[:, 0])}")
    elif count > 1:
        inside = [float(row.norm()) for row in shifts]  # how much of x, y, z lies in the space of shifts
        names += [f"translation along {'xyz'[k]}" for k in sorted(sorted(range(3), key=lambda k: -inside[k])[:count])]
    turns = min(free.shape[1] - count, 3)
    if turns == 3:
        return names + [f"rotation about {axis}" for axis in "xyz"]
    axes = torch.linalg.svd(free[:3], full_matrices=False).U  # by how much the free motions turn about them, most first
    return names + [f"rotation about {_line(axes[:, k])}" for k in range(turns)]


def _line(direction: Tensor) -> str:
    x, y, z = direction.tolist()
    if math.hypot(x, y) < FLAT * abs(z) / math.sqrt(1 - FLAT**2):
        return "z"
    angle = round(math.degrees(math.atan2(y, x))) % 180
    if min(angle, 180 - angle) <= 2:
        return "x"
    return "y" if abs(angle - 90) <= 2 else f"{angle} degrees"
