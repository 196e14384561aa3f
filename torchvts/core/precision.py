"""Sums whose order leaves no trace in a single-precision result, so that compiled kernels and blocks find the same."""

import torch
from torch import Tensor


def widened(values: Tensor) -> Tensor:
    """Values in float64, or complex128; as they are on Apple's GPUs, which have none. Scripts."""
    if values.device.type == "mps":
        return values
    return values.to(torch.complex128) if values.is_complex() else values.double()
