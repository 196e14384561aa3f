r"""Poisson integration: the depth whose finite differences are nearest to a gradient map, by fast transforms.

The gradient of an edge between two pixels is the mean of theirs (trapezoid rule). Least squares over all edges gives the
five-point Laplacian on the left and the difference of edge gradients on the right, at borders too, so both solvers are
exact inverses of one discrete operator.
"""

import torch
from torch import Tensor, nn

from ..core.checks import check_batch
from .transforms import (
    cosine_bases,
    cosine_twiddles,
    deinterleave,
    fft_is_fast,
    fold,
    interleave,
    mirror_rows,
    sine_bases,
    unfold,
)


def divergence(gradient: Tensor) -> Tensor:
    """Difference of edge gradients at every pixel; edges beyond the border count as zero.

    Inside, this is the central difference of p along x plus that of q along y.

    Args:
        gradient: (B, 2, H, W), H and W at least 2.
    Returns:
        (B, 1, H, W), in the gradient's unit per pixel.
    """
    check_batch("gradient", gradient, 2)
    p, q = gradient[:, 0:1], gradient[:, 1:2]
    edge_x = nn.functional.pad(p[..., 1:] + p[..., :-1], [1, 1])
    edge_y = nn.functional.pad(q[..., 1:, :] + q[..., :-1, :], [0, 0, 1, 1])
    return 0.5 * (edge_x[..., 1:] - edge_x[..., :-1] + edge_y[..., 1:, :] - edge_y[..., :-1, :])


def poisson_dst(gradient: Tensor, mm_per_pixel: float = 1.0) -> Tensor:
    r"""Integrate a gradient map into depth that is zero on the border.

    Five-point Laplacian diagonalised by a sine transform (DST-I of the interior); second order where the depth is smooth.
    Differentiable: the operator is linear and symmetric.

    Args:
        gradient: (B, 2, H, W), (dz/dx, dz/dy), mm per mm.
        mm_per_pixel: pixel pitch in mm.
    Returns:
        Depth in mm, (B, 1, H, W).
    Raises:
        ValueError: wrong shape, or H or W below 3. TypeError: not floating point.
    Source:
        eq. 4 of the paper; Simchony, Chellappa, Shao, TPAMI 12(5), 1990.
    Example:
        >>> poisson_dst(torch.zeros(1, 2, 8, 8), 0.05).shape
        torch.Size([1, 1, 8, 8])
    """
    _check(gradient, 3)
    return _integrate_dst(gradient, mm_per_pixel, _plan_dst(gradient))


def poisson_dct(gradient: Tensor, mm_per_pixel: float = 1.0) -> Tensor:
    r"""Integrate a gradient map into depth with a free border and zero mean.

    Five-point Laplacian with Neumann border diagonalised by a cosine transform (DCT-II); it holds a tilt, and contact that
    reaches the image border. Differentiable.

    Args:
        gradient: (B, 2, H, W), (dz/dx, dz/dy), mm per mm.
        mm_per_pixel: pixel pitch in mm.
    Returns:
        Depth in mm, (B, 1, H, W), mean zero per item.
    Raises:
        ValueError: wrong shape, or H or W below 2. TypeError: not floating point.
    Source:
        Frankot and Chellappa, TPAMI 10(4), 1988, on the cosine basis; Strang, SIAM Review 41(1), 1999.
    Example:
        >>> z = poisson_dct(torch.full((1, 2, 8, 8), 0.1), 1.0)
        >>> bool((z[0, 0, 1:, 1:] - z[0, 0, :-1, :-1] - 0.2).abs().max() < 1e-6)
        True
    """
    _check(gradient, 2)
    return _integrate_dct(gradient, mm_per_pixel, _plan_dct(gradient))


def poisson_rest(gradient: Tensor, mm_per_pixel: float = 1.0) -> Tensor:
    r"""Integrate a gradient map into depth with a free border that is zero on average where the gradient is zero.

    :func:`poisson_dct`, levelled by the skin at rest: pixels whose gradient is exactly zero, as outside a contact mask. It
    equals :func:`poisson_dst` for contact inside the image and stays right for contact that the image border cuts. Without
    any pixel at rest, the lowest depth is zero.

    Args:
        gradient: (B, 2, H, W), (dz/dx, dz/dy), mm per mm.
        mm_per_pixel: pixel pitch in mm.
    Returns:
        Depth in mm, (B, 1, H, W).
    Raises:
        ValueError: wrong shape, or H or W below 2. TypeError: not floating point.
    Example:
        >>> poisson_rest(torch.zeros(1, 2, 8, 8)).abs().max()
        tensor(0.)
    """
    return _level(poisson_dct(gradient, mm_per_pixel), gradient)


class PoissonDST(nn.Module):
    """Module face of :func:`poisson_dst`; keeps the plan of the last size, so that a stream of frames makes it once."""

    def __init__(self, mm_per_pixel: float = 1.0) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel
        self._plan: list[Tensor] = _plan_dst(torch.zeros(1, 2, 3, 3))

    def forward(self, gradient: Tensor) -> Tensor:
        _check(gradient, 3)
        plan = self._plan
        if not _plan_fits(plan, gradient, 2):
            plan = _plan_dst(gradient)
            self._plan = plan
        return _integrate_dst(gradient, self.mm_per_pixel, plan)


class PoissonDCT(nn.Module):
    """Module face of :func:`poisson_dct`; keeps the plan of the last size, so that a stream of frames makes it once."""

    def __init__(self, mm_per_pixel: float = 1.0) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel
        self._plan: list[Tensor] = _plan_dct(torch.zeros(1, 2, 2, 2))

    def forward(self, gradient: Tensor) -> Tensor:
        _check(gradient, 2)
        plan = self._plan
        if not _plan_fits(plan, gradient, 0):
            plan = _plan_dct(gradient)
            self._plan = plan
        return _integrate_dct(gradient, self.mm_per_pixel, plan)


class PoissonRest(nn.Module):
    """Module face of :func:`poisson_rest`; keeps the plan as :class:`PoissonDCT` does."""

    def __init__(self, mm_per_pixel: float = 1.0) -> None:
        super().__init__()
        self.dct = PoissonDCT(mm_per_pixel)

    def forward(self, gradient: Tensor) -> Tensor:
        return _level(self.dct(gradient), gradient)


def _level(depth: Tensor, gradient: Tensor) -> Tensor:
    rest = ((gradient[:, 0:1] == 0) & (gradient[:, 1:2] == 0)).to(depth.dtype)
    count = rest.sum(dim=(2, 3), keepdim=True)
    mean = (depth * rest).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
    return depth - torch.where(count > 0, mean, depth.amin(dim=(2, 3), keepdim=True))


def _check(gradient: Tensor, least: int) -> None:
    check_batch("gradient", gradient, 2)
    if gradient.shape[2] < least or gradient.shape[3] < least:
        raise ValueError(
            f"gradient: expected H and W of at least {least}, got {gradient.shape[2]} x {gradient.shape[3]}: "
            "nothing lies between the borders"
        )


def _integrate_dst(gradient: Tensor, mm_per_pixel: float, plan: list[Tensor]) -> Tensor:
    z = _solve(divergence(gradient)[..., 1:-1, 1:-1], plan)
    return mm_per_pixel * nn.functional.pad(z, [1, 1, 1, 1])


def _integrate_dct(gradient: Tensor, mm_per_pixel: float, plan: list[Tensor]) -> Tensor:
    right = divergence(gradient)
    return mm_per_pixel * (_solve_by_fft(right, plan) if len(plan) == 5 else _solve(right, plan))


def _plan_dst(gradient: Tensor) -> list[Tensor]:
    even_y, odd_y, value_even_y, value_odd_y = sine_bases(gradient.shape[2] - 2)
    even_x, odd_x, value_even_x, value_odd_x = sine_bases(gradient.shape[3] - 2)
    return _plan([even_y, odd_y], [value_even_y, value_odd_y], [even_x, odd_x], [value_even_x, value_odd_x], gradient)


def _plan_dct(gradient: Tensor) -> list[Tensor]:
    """Tables for the FFT where both lengths suit it, else matrices; 480 x 640: 2.3 against 3.1 ms on two cores."""
    if fft_is_fast(gradient.shape[2]) and fft_is_fast(gradient.shape[3]) and gradient.shape[3] % 2 == 0:
        return _plan_fft(gradient)
    even_y, odd_y, value_even_y, value_odd_y = cosine_bases(gradient.shape[2])
    even_x, odd_x, value_even_x, value_odd_x = cosine_bases(gradient.shape[3])
    return _plan([even_y, odd_y], [value_even_y, value_odd_y], [even_x, odd_x], [value_even_x, value_odd_x], gradient)


def _plan_fft(gradient: Tensor) -> list[Tensor]:
    """Five tensors: the four tables of :func:`cosine_twiddles`, and the inverse eigenvalues (H, W // 2 + 1, 2)."""
    forward, flipped, back, back_flipped, value, value_flipped = cosine_twiddles(gradient.shape[2], gradient.shape[3])
    values = torch.stack((value, value_flipped), dim=-1)
    inverse = torch.where(values == 0.0, torch.zeros_like(values), 1.0 / values).to(gradient.dtype)
    kind = torch.complex128 if gradient.dtype == torch.float64 else torch.complex64
    tables = [forward.to(kind), flipped.to(kind), back.to(kind), back_flipped.to(kind), inverse]
    return [table.to(gradient.device) for table in tables]


def _plan(
    basis_y: list[Tensor], value_y: list[Tensor], basis_x: list[Tensor], value_x: list[Tensor], gradient: Tensor
) -> list[Tensor]:
    """Twelve tensors: for each of the four parities the basis along y, the basis along x, the inverse eigenvalues."""
    plan: list[Tensor] = []
    for i in range(2):
        for j in range(2):
            value = value_y[i][:, None] + value_x[j][None, :]
            # only the constant of the cosine family has the value zero: its coefficient, the mean, is set to zero
            inverse = torch.where(value == 0.0, torch.zeros_like(value), 1.0 / value)
            for tensor in (basis_y[i], basis_x[j], inverse):
                plan.append(tensor.to(gradient.dtype).to(gradient.device))
    return plan


def _plan_fits(plan: list[Tensor], gradient: Tensor, border: int) -> bool:
    if len(plan) == 5:
        inverse = plan[4]
        return (
            inverse.dtype == gradient.dtype
            and inverse.device == gradient.device
            and inverse.shape[0] == gradient.shape[2]
            and inverse.shape[1] * 2 - 2 == gradient.shape[3]  # only even widths have such a plan
        )
    return (
        plan[0].dtype == gradient.dtype
        and plan[0].device == gradient.device
        and plan[0].shape[0] + plan[6].shape[0] == gradient.shape[2] - border
        and plan[1].shape[0] + plan[4].shape[0] == gradient.shape[3] - border
    )


def _solve(right: Tensor, plan: list[Tensor]) -> Tensor:
    """Depth of unit pitch whose Laplacian is ``right``: transform, divide, transform back, each parity by itself."""
    up, down = fold(right, -2)
    up_even, up_odd = fold(up, -1)
    down_even, down_odd = fold(down, -1)
    blocks = [up_even, up_odd, down_even, down_odd]
    for i in range(4):
        basis_y, basis_x, inverse = plan[3 * i], plan[3 * i + 1], plan[3 * i + 2]
        blocks[i] = basis_y.t() @ ((basis_y @ blocks[i] @ basis_x.t()) * inverse) @ basis_x
    return unfold(unfold(blocks[0], blocks[1], -1), unfold(blocks[2], blocks[3], -1), -2)


def _solve_by_fft(right: Tensor, plan: list[Tensor]) -> Tensor:
    """The same as :func:`_solve` for the cosine family, by one real FFT there and one back."""
    forward, flipped, back, back_flipped, inverse = plan[0], plan[1], plan[2], plan[3], plan[4]
    spectrum = torch.fft.rfft2(interleave(interleave(right, -1), -2))
    spectrum = forward * spectrum + flipped * mirror_rows(spectrum)
    spectrum = torch.view_as_complex(torch.view_as_real(spectrum) * inverse)
    spectrum = back * spectrum + back_flipped * mirror_rows(spectrum)
    lines = torch.fft.irfft2(spectrum, s=(right.shape[-2], right.shape[-1]))
    return deinterleave(deinterleave(lines, -2), -1)
