"""Noise of a camera image, estimated from the image itself."""

import math

import torch
from torch import Tensor

from .precision import widened


def noise_std(image: Tensor, samples: int = 8000) -> Tensor:
    """Noise of each channel, from second differences along rows: what is smooth, contact too, hardly enters.

    The absolute second differences over an even choice of at most ``samples`` pixels: their median, scaled to the standard
    deviation of Gaussian noise, and from there their mean square up to three standard deviations, because a median of 8-bit
    values moves in steps as large as the noise itself. Scripts.

    Args:
        image: (B, C, H, W), W at least 3.
        samples: the standard error is 1.2 / sqrt(samples) of the noise.
    Returns:
        (B, C).
    Source:
        Immerkaer, Fast noise variance estimation, CVIU 64(2), 1996, with the median in place of the mean.
    Example:
        >>> import torch
        >>> bool((noise_std(0.01 * torch.randn(1, 1, 99, 99)) - 0.01).abs() < 0.001)
        True
    """
    second = second_differences(image, samples)
    return noise_from(second, second.median(dim=-1, keepdim=True).values / 0.6745)


def sample_stride(height: int, width: int, samples: int) -> int:
    """Distance of at most that many samples, spread evenly over an image; of a thin one at least one line is sampled."""
    return max(1, min(math.ceil(math.sqrt(height * width / float(samples))), height, width))


def second_differences(image: Tensor, samples: int) -> Tensor:
    """Absolute second differences along rows at no more than ``samples`` evenly chosen pixels, (B, C, N)."""
    stride = sample_stride(image.shape[2], image.shape[3], samples)
    return second_differences_of_rows(image[:, :, stride // 2 :: stride], stride)


def second_differences_of_rows(rows: Tensor, stride: int) -> Tensor:
    """The same of all rows (B, C, h, W) that are given, at every ``stride``-th pixel."""
    left, middle, right = rows[..., :-2:stride], rows[..., 1:-1:stride], rows[..., 2::stride]
    return (middle - 0.5 * (left + right)).abs().flatten(2)


def noise_from(second: Tensor, std: Tensor) -> Tensor:
    """Noise (B, C) from second differences (B, C, N) and a first estimate of their standard deviation (B, C, 1)."""
    return clipped_std(second, 1.5 * std)[:, :, 0] / math.sqrt(1.5)


def dark_below(flat: Tensor, three_noises: Tensor) -> Tensor:
    """Intensity below which a channel is dark: three times the noise, and where light is weak half of that on the flat skin.

    So a dark channel is always nearer to an unlit one than to the flat skin. Minus infinity, never, where the flat skin itself is
    no brighter than three times the noise.

    Args:
        flat: (..., H, W), what the lights give on the flat skin.
        three_noises: three standard deviations of the noise, broadcast against it.
    Example:
        >>> import torch
        >>> dark_below(torch.tensor([0.02, 0.04, 0.5]), torch.tensor(0.03))
        tensor([  -inf, 0.0200, 0.0300])
    """
    return torch.where(flat > three_noises, torch.minimum(three_noises, 0.5 * flat), -torch.inf)


def clipped_std(values: Tensor, std: Tensor) -> Tensor:
    """Standard deviation (B, C, 1) of the absolute values (B, C, N) within three standard deviations, from a first estimate."""
    squared = widened(values * values)
    for _ in range(2):
        near = (values <= 3.0 * std).to(squared.dtype)
        mean = (squared * near).sum(dim=2, keepdim=True) / near.sum(dim=2, keepdim=True).clamp_min(1.0)
        std = torch.sqrt(mean / 0.97334).to(values.dtype)  # mean of x^2 of a standard Gaussian x within three standard deviations
    return std
