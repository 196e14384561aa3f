r"""Sine and cosine transforms as small matrix products, split by parity.

Both bases have rows that are even or odd about the middle of the line. A line's even part meets only the even rows and its
odd part only the odd ones, so folding the line first halves the multiplications. The coefficients stay in two blocks: a
solver that only scales them never needs them interleaved. Rows are orthonormal, so the inverse is the transpose.
"""

import math

import torch
from torch import Tensor


def sine_bases(length: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Even and odd half of the DST-I basis, and the second difference's eigenvalues that go with them.

    Returns:
        even (ceil(n/2), ceil(n/2)), odd (floor(n/2), floor(n/2)), their eigenvalues, all negative; float64.
    Source:
        Simchony, Chellappa, Shao, TPAMI 12(5), 1990: 2 cos(pi k / (n + 1)) - 2 for k = 1 ... n.
    """
    k = torch.arange(1, length + 1, dtype=torch.float64)
    j = torch.arange(1, (length + 1) // 2 + 1, dtype=torch.float64)
    basis = math.sqrt(2.0 / (length + 1)) * torch.sin(math.pi / (length + 1) * k[:, None] * j[None, :])
    return _split(basis, -4.0 * torch.sin(math.pi / (2 * (length + 1)) * k).square(), length)


def cosine_bases(length: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The same for the DCT-II basis; the eigenvalue of the constant is zero.

    Source:
        Strang, The discrete cosine transform, SIAM Review 41(1), 1999: 2 cos(pi k / n) - 2 for k = 0 ... n - 1.
    """
    k = torch.arange(length, dtype=torch.float64)
    j = torch.arange((length + 1) // 2, dtype=torch.float64)
    basis = math.sqrt(2.0 / length) * torch.cos(math.pi / length * k[:, None] * (j[None, :] + 0.5))
    basis[0] *= math.sqrt(0.5)
    return _split(basis, -4.0 * torch.sin(math.pi / (2 * length) * k).square(), length)


def _split(basis: Tensor, eigenvalues: Tensor, length: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    # row 0 is even, row 1 odd, row 2 even ...; an odd row vanishes in the middle of a line of odd length
    return basis[0::2].contiguous(), basis[1::2, : length // 2].contiguous(), eigenvalues[0::2], eigenvalues[1::2]


def fold(lines: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Even part (ceil(n/2)) and odd part (floor(n/2)) of lines along ``dim``; the middle one counts once."""
    n = lines.shape[dim]
    half = n // 2
    first = lines.narrow(dim, 0, half)
    last = lines.narrow(dim, n - half, half).flip(dim)
    even = first + last
    if n % 2 == 1:
        even = torch.cat((even, lines.narrow(dim, half, 1)), dim=dim)
    return even, first - last


def unfold(even: Tensor, odd: Tensor, dim: int) -> Tensor:
    """Lines from the values that their even and odd coefficients give on the first half."""
    half = odd.shape[dim]
    paired = even.narrow(dim, 0, half)
    middle = even.narrow(dim, half, even.shape[dim] - half)  # empty where the length is even
    return torch.cat((paired + odd, middle, (paired - odd).flip(dim)), dim=dim)
