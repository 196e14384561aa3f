"""Noise of a camera image, estimated from the image itself."""

import math

import torch
from torch import Tensor

from .precision import widened


def noise_std(image: Tensor) -> Tensor:
    """Noise of each channel (B, C) of (B, C, H, W), from second differences along rows: what is smooth, contact too, hardly enters.

    The absolute second differences over an even choice of at most 8,000 pixels: their median, scaled to the standard
    deviation of Gaussian noise, and from there their mean square up to three standard deviations, because a median of 8-bit
    values moves in steps as large as the noise itself. The standard error is 1.3 % of it. Scripts.

    Source:
        Immerkaer, Fast noise variance estimation, CVIU 64(2), 1996, with the median in place of the mean.
    Example:
        >>> import torch
        >>> bool((noise_std(0.01 * torch.randn(1, 1, 99, 99)) - 0.01).abs() < 0.001)
        True
    """
    height, width = image.shape[2], image.shape[3]
    stride = max(1, min(math.ceil(math.sqrt(height * width / 8000.0)), height, width))  # of a thin image at least one line
    rows = image[:, :, stride // 2 :: stride]
    left, middle, right = rows[..., :-2:stride], rows[..., 1:-1:stride], rows[..., 2::stride]
    second = (middle - 0.5 * (left + right)).abs().flatten(2)  # (B, C, N)
    std = 1.5 * (second.median(dim=-1, keepdim=True).values / 0.6745)
    squared = widened(second * second)
    for _ in range(2):
        near = (second <= 3.0 * std).to(squared.dtype)
        mean = (squared * near).sum(dim=2, keepdim=True) / near.sum(dim=2, keepdim=True).clamp_min(1.0)
        std = torch.sqrt(mean / 0.97334).to(image.dtype)  # mean of x^2 of a standard Gaussian x within three standard deviations
    return std[:, :, 0] / math.sqrt(1.5)


def dark_below(flat: Tensor, three_noises: Tensor) -> Tensor:
    """Intensity below which a channel is dark: three times the noise, and where light is weak half of that on the flat skin.

    So a dark channel is always nearer to an unlit one than to the flat skin. Minus infinity, never, where the flat skin itself is
    no brighter than three times the noise.

    Example:
        >>> import torch
        >>> dark_below(torch.tensor([0.02, 0.04, 0.5]), torch.tensor(0.03))
        tensor([  -inf, 0.0200, 0.0300])
    """
    return torch.where(flat > three_noises, torch.minimum(three_noises, 0.5 * flat), -torch.inf)
