r"""Sine and cosine transforms: by matrix products, and the cosine transform by one real FFT.

The rows of both bases are orthonormal, so the inverse is the transpose.
"""

import math

import torch
from torch import Tensor


def sine_basis(length: int) -> tuple[Tensor, Tensor]:
    """The DST-I basis (n, n), a wave a row, and the second difference's eigenvalues (n,), all negative; float64.

    Source:
        Simchony, Chellappa, Shao, TPAMI 12(5), 1990: 2 cos(pi k / (n + 1)) - 2 for k = 1 ... n.
    """
    k = torch.arange(1, length + 1, dtype=torch.float64)
    basis = math.sqrt(2.0 / (length + 1)) * torch.sin(math.pi / (length + 1) * k[:, None] * k[None, :])
    return basis, -4.0 * torch.sin(math.pi / (2 * (length + 1)) * k).square()


def cosine_basis(length: int) -> tuple[Tensor, Tensor]:
    """The same for the DCT-II basis; the eigenvalue of the constant is zero.

    Source:
        Strang, The discrete cosine transform, SIAM Review 41(1), 1999: 2 cos(pi k / n) - 2 for k = 0 ... n - 1.
    """
    k = torch.arange(length, dtype=torch.float64)
    basis = math.sqrt(2.0 / length) * torch.cos(math.pi / length * k[:, None] * (k[None, :] + 0.5))
    basis[0] *= math.sqrt(0.5)
    return basis, -4.0 * torch.sin(math.pi / (2 * length) * k).square()


def matrices(y: tuple[Tensor, Tensor], x: tuple[Tensor, Tensor]) -> list[Tensor]:
    """Tables of :func:`solve_by_matrices` from the bases along y and x: both bases, and the Laplacian's inverse eigenvalues."""
    return [y[0], x[0], inverse_or_zero(y[1][:, None] + x[1][None, :])]


def solve_by_matrices(right: Tensor, plan: list[Tensor]) -> Tensor:
    """Depth of unit pitch whose five-point Laplacian is ``right``, at the border as the bases are."""
    basis_y, basis_x, inverse = plan[0], plan[1], plan[2]
    return basis_y.t() @ ((basis_y @ right @ basis_x.t()) * inverse) @ basis_x


def cosine_tables(height: int, width: int) -> list[Tensor]:
    r"""Tables for solving with the cosine family by one real FFT there and one back.

    With v the lines reordered by :func:`reordering`, A its FFT and w = exp(-i pi k / 2n), the complex array
    E(k_y) = w_x (w_y A(k_y) + conj(w_y) A(-k_y)) holds every coefficient: C(k_y, k_x) = Re E / 2 and
    C(k_y, n_x - k_x) = -Im E / 2. Back, A = conj(w_y w_x) (E(k_y) - i E(n_y - k_y)) / 2, where E(n_y) counts as zero.

    The rows k_y and n_y - k_y meet only each other. With U = w_x w_y A(k_y) and V = w_x conj(w_y) A(-k_y) they are U + V and
    i (U - V), so a solver forms sum and difference, scales their parts, and goes back; only half the rows are looped over.

    Returns:
        Columns first, because the FFT along them leaves its results so: w_x w_y and w_x conj(w_y), and their conjugates halved,
        (2, W // 2 + 1, H // 2 + 1) complex128; the second difference's inverse eigenvalues for the sum and for the difference,
        (W // 2 + 1, H // 2 + 1, 2) for real and imaginary part; the places -k_y.
    Source:
        Makhoul, A fast cosine transform in one and two dimensions, IEEE Trans. ASSP 28(1), 1980.
    """
    k_y = torch.arange(height // 2 + 1, dtype=torch.float64)[None, :]
    k_x = torch.arange(width // 2 + 1, dtype=torch.float64)[:, None]
    turn_y, turn_x = -0.5 * math.pi / height * k_y, -0.5 * math.pi / width * k_x
    one = torch.ones_like(turn_y + turn_x)
    there = torch.stack((torch.polar(one, turn_x + turn_y), torch.polar(one, turn_x - turn_y)))
    back = torch.stack((torch.polar(0.5 * one, -turn_x - turn_y), torch.polar(0.5 * one, turn_y - turn_x)))
    low_y, low_x = -4.0 * torch.sin(turn_y).square(), -4.0 * torch.sin(turn_x).square()  # eigenvalues at k
    high_y, high_x = -4.0 * torch.cos(turn_y).square(), -4.0 * torch.cos(turn_x).square()  # and at n - k
    of_sum = torch.stack((low_y + low_x, low_y + high_x), dim=-1)
    of_difference = torch.stack((high_y + high_x, high_y + low_x), dim=-1)
    back_y = (-torch.arange(height // 2 + 1)) % height
    return [there, back, inverse_or_zero(of_sum), inverse_or_zero(of_difference), back_y]


def inverse_or_zero(values: Tensor) -> Tensor:
    """1 / values, and 0 where they are 0: of a solver's eigenvalues only the constant's, whose coefficient, the mean, becomes 0."""
    return torch.where(values == 0.0, torch.zeros_like(values), 1.0 / values)


def reordering(length: int) -> Tensor:
    """Where each element of a line goes before the FFT: even places first, then the odd ones backwards; (length,) int64."""
    place = torch.arange(length)
    return torch.where(place % 2 == 0, place // 2, length - 1 - place // 2)


def interleave(lines: Tensor) -> Tensor:
    """Rows reordered by :func:`reordering`."""
    return torch.cat((lines[..., ::2], lines[..., 1::2].flip(-1)), dim=-1)


def deinterleave(lines: Tensor) -> Tensor:
    """The inverse of :func:`interleave`."""
    n = lines.shape[-1]
    half = (n + 1) // 2
    even, odd = lines.narrow(-1, 0, half), lines.narrow(-1, n - half, half).flip(-1)  # of odd length: one too many, last
    return torch.view_as_real(torch.complex(even, odd)).flatten(-2).narrow(-1, 0, n)  # pairs; two thirds of the time of a stack


def solve_by_fft(right: Tensor, plan: list[Tensor]) -> Tensor:
    """Depth of unit pitch whose five-point Laplacian with a free border is ``right``, by one real FFT there and one back."""
    there, back, of_sum, of_difference, back_y, order_y = plan[0], plan[1], plan[2], plan[3], plan[4], plan[5]
    height, width = int(order_y.shape[0]), right.shape[-1]
    lines = torch.fft.rfft(interleave(right)).transpose(2, 3)  # (B, 1, W // 2 + 1, H): columns are contiguous from here on
    lines = lines.new_zeros(lines.shape).index_copy_(3, order_y, lines)
    spectrum = torch.fft.fft(lines)
    up = torch.view_as_real(spectrum.narrow(3, 0, height // 2 + 1) * there[0])
    down = torch.view_as_real(spectrum.index_select(3, back_y) * there[1])
    total, difference = (up + down) * of_sum, up - down
    up = torch.view_as_complex(torch.addcmul(total, difference, of_difference)) * back[0]
    down = torch.view_as_complex(torch.addcmul(total, difference, of_difference, value=-1.0)) * back[1]
    spectrum = torch.cat((up, down[..., 1 : (height + 1) // 2].flip(3)), dim=3)
    lines = torch.fft.irfft(torch.fft.ifft(spectrum), n=width, dim=2).transpose(2, 3)
    return deinterleave(lines.index_select(2, order_y))
