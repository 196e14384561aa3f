"""Robust statistics that several fits share: Tukey's biweight, and the half-sample mode."""

import torch
from torch import Tensor

TUKEY = 4.685
"""Width of Tukey's biweight in standard deviations: 95 % efficiency under Gaussian noise."""


HALVINGS = 4
"""How often the narrowest half is taken for a mode."""


def tukey_weight(ratio: Tensor) -> Tensor:
    """Tukey's biweight, (1 - ratio^2)^2 inside of 1 and 0 outside.

    Args:
        ratio: residual / width, of any shape; the width is usually :data:`TUKEY` times the scale of the residuals.
    Returns:
        Weights in [0, 1], of the same shape.
    Source:
        Beaton and Tukey, Technometrics 16, 1974.
    Example:
        >>> import torch
        >>> tukey_weight(torch.tensor([0.0, 0.5, 2.0]))
        tensor([1.0000, 0.5625, 0.0000])
    """
    return (1.0 - ratio**2).clamp_min(0.0) ** 2


def half_sample_mode(ordered: Tensor, halvings: int = HALVINGS) -> Tensor:
    """The mode of sorted values: the middle of the narrowest half of the narrowest half, and so on.

    Args:
        ordered: (B, C, N), sorted along the last dimension.
        halvings: how often the narrowest half is taken.
    Returns:
        (B, C).
    Source:
        Bickel and Fruhwirth, Computational Statistics and Data Analysis 50(12), 2006.
    Example:
        >>> half_sample_mode(torch.tensor([[[0.0, 4.9, 5.0, 5.05, 5.1, 9.0, 20.0]]]), 2)
        tensor([[5.1000]])
    """
    for _ in range(halvings):
        half = (ordered.shape[2] + 1) // 2
        width = ordered[:, :, half - 1 :] - ordered[:, :, : ordered.shape[2] - half + 1]
        start = width.argmin(dim=2, keepdim=True)
        ordered = ordered.gather(2, start + torch.arange(half, device=ordered.device))
    return ordered[:, :, ordered.shape[2] // 2]
