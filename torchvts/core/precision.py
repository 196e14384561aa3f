"""Sums whose order leaves no trace in a single-precision result, so that compiled kernels and blocks find the same."""

from torch import Tensor


def widened(values: Tensor) -> Tensor:
    """Values in float64; as they are on Apple's GPUs, which have none. Scripts.

    Example:
        >>> import torch
        >>> widened(torch.ones(2)).dtype
        torch.float64
    """
    return values if values.device.type == "mps" else values.double()
