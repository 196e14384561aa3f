r"""Integration with known depth: the depth that follows both a gradient and, by a weight, a depth that is known from elsewhere.

It minimises the sum over the image of ``|grad z - g|^2 + weight (z - known)^2``, in mm; its normal equations are the Laplacian
of :func:`poisson_dct` less ``weight * mm_per_pixel^2`` on the diagonal. One weight for all pixels leaves it diagonal under the
cosine transform; a map of weights is solved by conjugate gradients with that transform as preconditioner.
"""

import warnings

import torch
from torch import Tensor

from ..core.checks import check_batch, check_same_count, check_same_size, reads_freely
from ..core.geometry import laplacian
from .transforms import inverse_or_zero, solve_by_fft

MAX_ITERATIONS = 1000
"""Bound on the conjugate-gradient steps. Known depth in half of an image of 96 x 128 takes 20 of weight 1 and 250 of weight 1e6."""


def check_known(gradient: Tensor, known_mm: Tensor, known_weight: Tensor) -> None:
    """Raise unless known depth and its weight belong to a gradient (B, 2, H, W). Scripts.

    Args:
        gradient: checked.
        known_mm: (B, 1, H, W), or (1, 1, H, W) for all frames.
        known_weight: of the same shape, or (B, 1, 1, 1) or (1, 1, 1, 1) for all pixels.
    Raises:
        ValueError: other shapes, negative weights, values that are not finite. TypeError: not floating point.
    """
    for name, value in (("known_mm", known_mm), ("known_weight", known_weight)):
        check_batch(name, value, 1)
        check_same_count(name, value, "gradient", gradient.shape[0])
        if name == "known_mm" or value.shape[2] * value.shape[3] > 1:
            check_same_size(name, value, "gradient", gradient.shape[2], gradient.shape[3])
        if not torch.jit.is_scripting():
            _check_values(name, value)


def _check_values(name: str, value: Tensor) -> None:
    if not reads_freely(value) or value.numel() == 0:
        return
    if not bool(torch.isfinite(value).all()):
        raise ValueError(f"{name}: expected finite values, got NaN or infinite ones: set unknown pixels to 0, and their weight too")
    if name == "known_weight" and bool((value < 0).any()):
        raise ValueError(f"{name}: expected values of at least 0, got {float(value.min()):g}")


def solve_screened(
    right: Tensor, pull: Tensor, known: Tensor, plan: list[Tensor], tolerance: float, max_iterations: int = MAX_ITERATIONS
) -> Tensor:
    """The depth whose Laplacian is ``right + pull (depth - known)``, (B, 1, H, W). Scripts; differentiable in all arguments.

    Args:
        right: (B, 1, H, W), divergence of the edges' slopes times the pitch.
        pull: weight times the square of the pitch, as :func:`check_known` has it.
        known: depth, (B, 1, H, W) or (1, 1, H, W).
        plan: tables for the size.
        tolerance: of a map of weights, residual relative to the first, in the preconditioner's norm.
        max_iterations: of a map of weights.
    """
    target = right - pull * known
    if pull.shape[2] * pull.shape[3] == 1:
        return solve_by_fft(target, screened(plan, pull))
    pull = pull.expand(right.shape)
    scale = (1.0 + 0.25 * pull).rsqrt()  # pixels that are as good as fixed are taken out of the Laplacian, whose diagonal is -4
    tables = screened(plan, (pull * scale.square()).mean(dim=(2, 3), keepdim=True).detach())
    residual = -target
    towards = -scale * solve_by_fft(scale * residual, tables)
    search, depth = towards, torch.zeros_like(right)
    size = (residual * towards).sum(dim=(1, 2, 3), keepdim=True)
    enough = tolerance**2 * size.detach()
    for _ in range(max_iterations):
        if bool((size <= enough).all()):
            break
        image = pull * search - laplacian(search)
        step = size / (search * image).sum(dim=(1, 2, 3), keepdim=True).clamp_min(1e-300)
        depth, residual = depth + step * search, residual - step * image
        towards = -scale * solve_by_fft(scale * residual, tables)
        before, size = size, (residual * towards).sum(dim=(1, 2, 3), keepdim=True)
        search = towards + size / before.clamp_min(1e-300) * search
    if not torch.jit.is_scripting():
        _check_settled(size > enough, max_iterations)
    return depth


def _check_settled(moves: Tensor, steps: int) -> None:
    if bool(moves.any()):
        warnings.warn(
            f"known_weight: the depth of {int(moves.sum())} of {len(moves)} frames has not settled in {steps} steps: "
            "expected smaller weights, or float64",
            stacklevel=2,
        )


def screened(plan: list[Tensor], pull: Tensor) -> list[Tensor]:
    """Tables of the Laplacian less a number per frame, (B, 1, 1, 1). Scripts."""
    off = pull.unsqueeze(-1)
    tables = list(plan)
    for k in (2, 3):
        inverse = plan[k]
        tables[k] = torch.where(inverse == 0.0, -inverse_or_zero(off), inverse / (1.0 - off * inverse))
    return tables
