"""A skin that hangs free around a contact: an elastic membrane on an elastic foundation, pressed by an object."""

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_integer, check_positive
from ..core.geometry import gradient_of_depth, normal_from_gradient
from .surfaces import Scene

CONTACT_RTOL = 1e-3
"""The skin touches where it is nearer to the object than this part of the largest depth."""


def hanging_skin(object_mm: Tensor, reach_mm: float, mm_per_pixel: float, sweeps: int = 60) -> Scene:
    r"""The skin over an object: it follows the object where it touches, and hangs free elsewhere.

    The depth z solves the obstacle problem z - reach^2 laplace z = p with p >= 0, z >= object, p (z - object) = 0: a membrane
    that a foundation of springs holds. Projected successive over-relaxation, red and black pixels in turn, from coarse grids to
    fine ones. At the image border the skin has no slope across it.

    Args:
        object_mm: (B, 1, H, W), depth that the object would reach, mm; where it does not reach the undeformed skin, at most 0.
        reach_mm: length over which the free skin comes back to zero, mm.
        mm_per_pixel: pixel pitch, mm.
        sweeps: over all pixels, on each grid.
    Returns:
        The scene: the gradient is that of the depth by central differences, and the contact is the coincidence set.
    Raises:
        ValueError, TypeError: names the argument.
    Source:
        Cryer, SIAM J. Control 9(3), 1971 (projected over-relaxation).
    Example:
        >>> ball = torch.full((1, 1, 33, 33), -1.0)
        >>> ball[..., 16, 16] = 0.5
        >>> scene = hanging_skin(ball, 0.5, 0.1)
        >>> round(float(scene.depth_mm.max()), 3), int(scene.contact.sum())
        (0.5, 1)
    """
    check_batch("object_mm", object_mm, 1)
    reach_mm, mm_per_pixel = check_positive("reach_mm", reach_mm), check_positive("mm_per_pixel", mm_per_pixel)
    check_integer("sweeps", sweeps, 1, 10_000)
    obstacle = object_mm.detach().clamp_min(0.0)
    depth = _solve(obstacle, (reach_mm / mm_per_pixel) ** 2, sweeps)
    gradient = gradient_of_depth(depth, mm_per_pixel)
    contact = (object_mm > 0) & (depth - obstacle <= CONTACT_RTOL * depth.amax(dim=(1, 2, 3), keepdim=True))
    return Scene(depth, gradient, normal_from_gradient(gradient), contact, mm_per_pixel)


def _solve(obstacle: Tensor, stiffness: float, sweeps: int) -> Tensor:
    """Depth of unit pitch; starts from the solution on every second pixel."""
    height, width = obstacle.shape[2:]
    depth = obstacle
    if stiffness > 1.0 and min(height, width) >= 8:
        coarse = _solve(nn.functional.max_pool2d(obstacle, 2, ceil_mode=True), stiffness / 4.0, sweeps)
        depth = torch.maximum(nn.functional.interpolate(coarse, size=(height, width), mode="bilinear"), obstacle)
    jacobi = 4.0 * stiffness / (1.0 + 4.0 * stiffness)  # spectral radius of plain Jacobi sweeps
    relaxation = 2.0 / (1.0 + (1.0 - jacobi**2) ** 0.5)  # Young's optimum
    rows, columns = torch.arange(height)[:, None], torch.arange(width)[None]
    red = ((rows + columns) % 2 == 0).to(depth.device)
    padded = nn.functional.pad(depth, [1, 1, 1, 1], mode="replicate")
    for _ in range(sweeps):
        for pixels in (red, ~red):
            inner = padded[..., 1:-1, 1:-1]
            neighbours = padded[..., 1:-1, 2:] + padded[..., 1:-1, :-2] + padded[..., 2:, 1:-1] + padded[..., :-2, 1:-1]
            free = stiffness * neighbours / (1.0 + 4.0 * stiffness)
            updated = torch.maximum(inner + relaxation * (free - inner), obstacle)
            padded = nn.functional.pad(torch.where(pixels, updated, inner), [1, 1, 1, 1], mode="replicate")
    return padded[..., 1:-1, 1:-1].contiguous()
