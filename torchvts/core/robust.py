"""Tukey's biweight, which several fits share."""

from torch import Tensor

TUKEY = 4.685
"""Width of Tukey's biweight in standard deviations: 95 % efficiency under Gaussian noise."""


def tukey_weight(ratio: Tensor) -> Tensor:
    """Tukey's biweight of residual / width, (1 - ratio^2)^2 inside of 1 and 0 outside; the width is usually TUKEY deviations.

    Source:
        Beaton and Tukey, Technometrics 16, 1974.
    Example:
        >>> import torch
        >>> tukey_weight(torch.tensor([0.0, 0.5, 2.0]))
        tensor([1.0000, 0.5625, 0.0000])
    """
    return (1.0 - ratio**2).clamp_min(0.0) ** 2
