r"""Poisson integration: the depth whose finite differences are nearest to a gradient map, by fast transforms.

The gradient of an edge between two pixels is the mean of theirs (trapezoid rule). Least squares over all edges gives the
five-point Laplacian on the left and the difference of edge gradients on the right, at borders too, so both solvers are
exact inverses of one discrete operator.
"""

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_integer, check_numbers, check_positive, has_memory
from ..core.precision import widened
from .base import Integrator
from .transforms import cosine_tables, matrices, reordering, sine_basis, solve_by_fft, solve_by_matrices


def divergence(gradient: Tensor) -> Tensor:
    """Difference of edge gradients at every pixel; edges beyond the border count as zero.

    Inside, this is the central difference of p along x plus that of q along y.

    Args:
        gradient: (B, 2, H, W), H and W at least 2.
    Returns:
        (B, 1, H, W), in the gradient's unit per pixel.
    """
    check_gradient(gradient, 2)
    p, q = gradient[:, 0:1], gradient[:, 1:2]
    first, last = p[..., :1] + p[..., 1:2], p[..., -1:] + p[..., -2:-1]
    along_x = torch.cat((first, p[..., 2:] - p[..., :-2], -last), dim=3)
    first, last = q[..., :1, :] + q[..., 1:2, :], q[..., -1:, :] + q[..., -2:-1, :]
    along_y = torch.cat((first, q[..., 2:, :] - q[..., :-2, :], -last), dim=2)
    return 0.5 * (along_x + along_y)


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
    check_gradient(gradient, 3)
    if not torch.jit.is_scripting():
        mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    return _integrate_dst(gradient, mm_per_pixel, _plan_dst(_wide(gradient), gradient.shape[2], gradient.shape[3]))


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
    check_gradient(gradient, 2)
    if not torch.jit.is_scripting():
        mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    return _integrate_dct(gradient, mm_per_pixel, plan_dct(_wide(gradient), gradient.shape[2], gradient.shape[3]), False)


def poisson_background(gradient: Tensor, mm_per_pixel: float = 1.0) -> Tensor:
    r"""Integrate a gradient map into depth with a free border that is zero on average in the background.

    :func:`poisson_dct` with its zero at the undeformed skin: pixels whose gradient is exactly zero, as outside a contact mask. It
    equals :func:`poisson_dst` for contact inside the image and stays right for contact that the image border cuts. Without
    any such pixel, the lowest depth is zero.

    Args:
        gradient: (B, 2, H, W), (dz/dx, dz/dy), mm per mm.
        mm_per_pixel: pixel pitch in mm.
    Returns:
        Depth in mm, (B, 1, H, W).
    Raises:
        ValueError: wrong shape, or H or W below 2. TypeError: not floating point.
    Example:
        >>> poisson_background(torch.zeros(1, 2, 8, 8)).abs().max()
        tensor(0.)
    """
    check_gradient(gradient, 2)
    if not torch.jit.is_scripting():
        mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    return _integrate_dct(gradient, mm_per_pixel, plan_dct(_wide(gradient), gradient.shape[2], gradient.shape[3]), True)


class PoissonDST(Integrator):
    """Module for :func:`poisson_dst`; keeps the tables of the last size, so that a stream of frames makes them once."""

    def __init__(self, mm_per_pixel: float = 1.0) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self._plan: list[Tensor] = _plan_dst(torch.zeros(1, dtype=torch.float64), 3, 3)

    def forward(self, gradient: Tensor) -> Tensor:
        check_gradient(gradient, 3)
        plan = self._plan
        if not _plan_fits(plan, _wide(gradient), gradient.shape[2], gradient.shape[3]):
            plan = _kept(_plan_dst(_wide(gradient), gradient.shape[2], gradient.shape[3]))
            if _plain(plan[2]):
                self._plan = plan
        return _integrate_dst(gradient, self.mm_per_pixel, plan)


class PoissonDCT(Integrator):
    """Module for :func:`poisson_dct`; keeps the tables of the last size, so that a stream of frames makes them once.

    Args:
        mm_per_pixel: pixel pitch, mm.
        size: height and width whose tables are there before the first call; :func:`torch.jit.trace` would record how they are made.
    """

    def __init__(self, mm_per_pixel: float = 1.0, size: tuple[int, int] = (2, 2)) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.zero_in_background = False
        check_numbers("size", size, (2,))
        height, width = (check_integer("size", number, 2) for number in size)
        self._plan: list[Tensor] = plan_dct(torch.zeros(1, dtype=torch.float64), height, width)

    def forward(self, gradient: Tensor) -> Tensor:
        check_gradient(gradient, 2)
        plan = self._plan
        if not _plan_fits(plan, _wide(gradient), gradient.shape[2], gradient.shape[3]):
            plan = _kept(plan_dct(_wide(gradient), gradient.shape[2], gradient.shape[3]))
            if _plain(plan[2]):
                self._plan = plan
        return _integrate_dct(gradient, self.mm_per_pixel, plan, self.zero_in_background)


class PoissonBackground(PoissonDCT):
    """Module for :func:`poisson_background`; keeps the tables as :class:`PoissonDCT` does."""

    def __init__(self, mm_per_pixel: float = 1.0) -> None:
        super().__init__(mm_per_pixel)
        self.zero_in_background = True


def zeroed_in_background(depth: Tensor, gradient: Tensor) -> Tensor:
    """Zero on average where the gradient is, or where that is nowhere, its lowest. The depth has zero mean."""
    inclined = ((gradient[:, 0:1] != 0) | (gradient[:, 1:2] != 0)).to(depth.dtype)
    pixels = float(depth.shape[2] * depth.shape[3])
    count = pixels - inclined.sum(dim=(2, 3), keepdim=True)
    mean = -(depth * inclined).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
    return depth - torch.where(count > 0, mean, depth.amin(dim=(2, 3), keepdim=True))


def check_gradient(gradient: Tensor, least: int) -> None:
    """Raise unless ``gradient`` is (B, 2, H, W) with H and W of at least ``least``. Scripts."""
    check_batch("gradient", gradient, 2)
    if gradient.shape[2] < least or gradient.shape[3] < least:
        raise ValueError(
            f"gradient: expected H and W of at least {least}, got {gradient.shape[2]} x {gradient.shape[3]}: "
            "nothing lies between the borders"
        )


def _integrate_dst(gradient: Tensor, mm_per_pixel: float, plan: list[Tensor]) -> Tensor:
    z = solve_by_matrices(divergence(widened(gradient))[..., 1:-1, 1:-1], plan)
    return (mm_per_pixel * nn.functional.pad(z, [1, 1, 1, 1])).to(gradient.dtype)


def _integrate_dct(gradient: Tensor, mm_per_pixel: float, plan: list[Tensor], zero_in_background: bool) -> Tensor:
    """In double precision: waves as long as the image are nearly all of the depth, and single rounds them at every step."""
    if gradient.shape[0] == 0:
        return gradient[:, 0:1]  # a transform of nothing is an error
    depth = solve_by_fft(mm_per_pixel * divergence(widened(gradient)), plan)
    if zero_in_background:
        depth = zeroed_in_background(depth, gradient)
    return depth.to(gradient.dtype)


def _wide(gradient: Tensor) -> Tensor:
    """Nothing, of the dtype in which a gradient is integrated, and on its device."""
    return widened(gradient.narrow(0, 0, 0))


def _kept(plan: list[Tensor]) -> list[Tensor]:
    """A plan that later calls, which may record gradients, can use: tensors made under inference mode refuse that."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if not torch.compiler.is_compiling() and torch.is_inference_mode_enabled():  # which torch.compile cannot ask
            with torch.inference_mode(False):
                return [table.clone() for table in plan]
    return plan


def _plain(table: Tensor) -> bool:
    """Whether a table outlives this call: it has memory of its own, which one of a transform of torch.func has not. Scripts."""
    if torch.jit.is_scripting():
        return True
    else:  # noqa: RET505, TorchScript needs the else to skip this branch
        return torch.compiler.is_compiling() or has_memory(table)


def _plan_dst(like: Tensor, height: int, width: int) -> list[Tensor]:
    """The three tables of :func:`solve_by_matrices` for the inside of an image, of the dtype and on the device of ``like``."""
    return [table.to(like.dtype).to(like.device) for table in matrices(sine_basis(height - 2), sine_basis(width - 2))]


def plan_dct(like: Tensor, height: int, width: int) -> list[Tensor]:
    """The seven tables of :func:`solve_by_fft`, of the dtype and on the device of ``like``."""
    order = [reordering(height).to(like.device), reordering(width).to(like.device)]
    kind = torch.complex128 if like.dtype == torch.float64 else torch.complex64
    there, back, of_sum, of_difference, back_y = cosine_tables(height, width)
    tables = [there.to(kind), back.to(kind), of_sum.to(like.dtype), of_difference.to(like.dtype), back_y]
    return [table.to(like.device) for table in tables] + order


def _plan_fits(plan: list[Tensor], like: Tensor, height: int, width: int) -> bool:
    table = plan[2]  # real: inverse eigenvalues
    same_kind = table.dtype == like.dtype and table.device == like.device and _plain(table) and _plain(like)
    if len(plan) == 3:
        return same_kind and plan[0].shape[0] == height - 2 and plan[1].shape[0] == width - 2
    return same_kind and plan[-2].shape[0] == height and plan[-1].shape[0] == width
