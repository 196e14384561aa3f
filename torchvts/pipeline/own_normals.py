"""What is likely wrong with the axes of normals that an own module gives: named once, where its values are checked."""

import torch
from torch import Tensor

from ..core.geometry import gradient_from_normal
from ..integration import divergence, poisson_dct

LEAST_SLOPE = 0.02
"""RMS of the slopes of a frame that says something of their axes."""

CONTRADICTED = 0.3
"""Share of the slopes' energy that no surface has, from which their axes are asked about."""

TURNED = {
    "y seems to count upwards, or x to the left: negate that component": (-1.0, False),
    "x and y seem swapped: give them in the order x, y, z": (1.0, True),
    "x and y seem swapped, and one of them turned over": (-1.0, True),
}
"""What may be wrong: the factor of y that undoes it, and whether x and y are to be exchanged."""


def doubt_of_axes(name: str, normal: Tensor) -> str | None:
    """What is likely wrong with normals (B, 3, H, W) of the module ``name``: "" for nothing, None where too little is inclined.

    Example:
        >>> up = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, 8, 8)
        >>> doubt_of_axes("Net", up)
        'normals: Net gives normals that face away from the camera in 100% of the image: n_z is above 0 here: negate or set it'
    """
    if (away := float((normal[:, 2] <= 0).double().mean())) > 0.5:
        seen = f"normals: {name} gives normals that face away from the camera in {away:.0%} of the image"
        return f"{seen}: n_z is above 0 here: negate or set it"
    gradient = gradient_from_normal(normal).double()
    if min(gradient.shape[2:]) < 2 or float(gradient.square().mean().sqrt()) < LEAST_SLOPE:
        return None
    as_given, shares = _contradicted(gradient), {}
    for cause, (of_y, swapped) in TURNED.items():
        turned = gradient.flip(1) if swapped else gradient
        shares[cause] = _contradicted(torch.cat((turned[:, :1], of_y * turned[:, 1:]), 1))
    likely = min(shares, key=lambda cause: shares[cause])
    if as_given < CONTRADICTED or shares[likely] > 0.5 * as_given:
        return ""
    return f"normals: {as_given:.0%} of the slopes of {name} are those of no surface, {shares[likely]:.0%} otherwise: {likely}"


def _contradicted(gradient: Tensor) -> float:
    """Share of the energy of slopes that no depth has, 0 to 1."""
    p, q = gradient[:, 0], gradient[:, 1]
    along_x, along_y = 0.5 * (p[..., 1:] + p[..., :-1]), 0.5 * (q[..., 1:, :] + q[..., :-1, :])
    energy = float(along_x.square().sum() + along_y.square().sum())
    kept = -float((poisson_dct(gradient) * divergence(gradient)).sum())
    return 1.0 - kept / energy if energy > 0 else 0.0
