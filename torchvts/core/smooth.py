"""A smooth change of the light over the image, found in the undeformed part of a frame and divided out."""

import torch
from torch import Tensor

from .precision import widened

SAMPLES = 24
"""Samples along the shorter side from which the change is found; smaller images are taken to have none."""

STEPS = 12
"""Steps of its fit."""

FIRST_SCALE, LAST_SCALE = 0.06, 0.01
"""Scale of the fit's residuals, relative, at first and from the middle of the steps on: from what a press makes in undeformed skin
at most down to the noise of real frames. Samples off by twice that, in each channel, do not count."""

MOST = 0.15
"""Largest change that is believed."""


def smooth_change(ratio: Tensor, samples: int = SAMPLES, steps: int = STEPS, most: float = MOST) -> Tensor:
    """Coefficients (B, 3, 6) of the smooth change of light in images / background (B, 3, H, W).

    LEDs that fade, ambient light that moves and a press that scatters light change the light smoothly all over the image; the
    skin of a contact changes it much more, or not at all. So a polynomial of degree 2 is fitted to the samples that stay near it,
    from 0 on, by Tukey's loss with a scale that shrinks. Where few samples are left, or they lie at one side only, the steps
    end before it has moved far: a contact that fills the image is not explained away.

    Source:
        Tukey's loss by majorisation: Huber, Robust Statistics, 1981; a scale that shrinks: Blake and Zisserman, Visual
        Reconstruction, 1987.
    """
    count, height, width = ratio.shape[0], ratio.shape[2], ratio.shape[3]
    found = torch.zeros(count, 3, 6, dtype=ratio.dtype, device=ratio.device)
    if min(height, width) < samples:
        return found
    stride = smooth_stride(height, width)
    change = widened(grid_samples(ratio, stride).flatten(2) - 1.0)  # (B, 3, N)
    place = smooth_basis(height, width, stride).to(change).flatten(1)  # (6, N)
    found = found.to(change.dtype)
    place = place.expand(count, -1, -1)
    across = place.transpose(1, 2) / float(place.shape[2])
    for step in range(steps):
        left = torch.baddbmm(change, found, place, alpha=-1.0)
        off = (left * left).sum(dim=1, keepdim=True)
        weight = torch.rsub(off * per_square(step), 1.0).clamp_min(0.0)
        # terms are orthonormal and weights at most 1, so the sum of losses falls with every step
        found = torch.baddbmm(found, left * (weight * weight), across)
    largest = (found.abs() * peaks().to(found)).sum(dim=2, keepdim=True)
    return (found * (most / largest.clamp_min(most))).to(ratio.dtype)


def without_smooth_change(ratio: Tensor) -> Tensor:
    """Images / background (B, 3, H, W) over their smooth change of light."""
    return over_smooth(ratio, smooth_change(ratio))


def over_smooth(ratio: Tensor, coefficients: Tensor) -> Tensor:
    """Images (B, 3, H, W) over 1 + the surface of coefficients (B, 3, 6), to second order: at 5 % off by 0.01 %."""
    x, y = legendre(ratio.shape[3], 1).to(ratio), legendre(ratio.shape[2], 1).to(ratio)[:, :, None]
    terms = coefficients[..., None, None]  # in the order of smooth_basis
    constant = terms[:, :, 0] + terms[:, :, 2] * y[1] + terms[:, :, 5] * y[2]  # (B, 3, H, 1)
    once = terms[:, :, 1] + terms[:, :, 4] * y[1]
    # product by product and sum by sum, as compiled kernels do: a fused operator rounds otherwise
    surface = constant + once * x[1] + terms[:, :, 3] * x[2]
    return ratio * (1.0 - surface + surface * surface)


def grid_samples(image: Tensor, stride: int) -> Tensor:
    """Every ``stride``-th pixel of images (B, C, H, W), each the mean of 3 x 3 pixels where these do not overlap."""
    if stride < 3:
        return image[:, :, stride // 2 :: stride, stride // 2 :: stride]
    first = stride // 2 - 1
    rows, columns = image.shape[2] // stride * stride, image.shape[3] // stride * stride
    total = image[:, :, first:rows:stride, first:columns:stride].clone()
    for k in range(1, 9):
        total += image[:, :, first + k // 3 : rows : stride, first + k % 3 : columns : stride]
    return total / 9.0


def smooth_stride(height: int, width: int, samples: int = SAMPLES) -> int:
    """Distance of the samples."""
    return max(1, min(height, width) // samples)


def per_square(step: int, steps: int = STEPS, first: float = FIRST_SCALE, last: float = LAST_SCALE) -> float:
    """What a squared residual is multiplied by in a step: 1 is where a sample no longer counts."""
    scale = first * float((last / first) ** min(1.0, 2.0 * step / steps))
    return 1.0 / (12.0 * scale * scale)


def smooth_basis(height: int, width: int, stride: int) -> Tensor:
    """The terms of the surface at every ``stride``-th pixel, (6, h, w), float64: products of Legendre polynomials."""
    y, x = legendre(height, stride)[:, :, None], legendre(width, stride)[:, None]  # (3, h, 1), (3, 1, w)
    return torch.stack((y[0] * x[0], y[0] * x[1], y[1] * x[0], y[0] * x[2], y[1] * x[1], y[2] * x[0]))


def peaks() -> Tensor:
    """Largest values of these, (6,), float64."""
    return torch.tensor([1.0, 3.0**0.5, 3.0**0.5, 5.0**0.5, 3.0, 5.0**0.5], dtype=torch.float64)


def legendre(length: int, stride: int) -> Tensor:
    """Legendre polynomials of degree 0 to 2 over a line of pixels, of mean square 1, at the samples, (3, n), float64."""
    last = length if stride < 3 else length // stride * stride
    place = (2.0 * torch.arange(stride // 2, last, stride, dtype=torch.float64) + 1.0) / float(length) - 1.0
    return torch.stack((torch.ones_like(place), 3.0**0.5 * place, 5.0**0.5 * (1.5 * place.square() - 0.5)))
