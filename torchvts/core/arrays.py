"""Means of a frame over cells, and medians of few values, in NumPy: a stream waits for them, and PyTorch takes twice the time."""

from typing import Any

import numpy as np
from torch import Tensor

Array = np.ndarray[Any, Any]
"""float32, float64 or bool."""


def array_of(image: Tensor) -> Array:
    """An image as float32 on the CPU, of the same shape."""
    array: Array = image.detach().resolve_neg().float().cpu().numpy()
    return array


def cell_means(image: Array, cell: int) -> Array:
    """Means (3, h, w) over whole cells of ``cell`` pixels a side of (3, H, W)."""
    height, width = image.shape[1] // cell, image.shape[2] // cell
    rows = image[:, : height * cell].reshape(3, height, cell, -1).sum(2)
    means: Array = rows[..., : width * cell].reshape(3, height, width, cell).sum(3) / np.float32(cell**2)
    return means


def lower_median(values: Array) -> Array:
    """Of the last dimension, which is not empty; the lower one of two, as torch has it."""
    middle = (values.shape[-1] - 1) // 2
    median: Array = np.partition(values, middle)[..., middle]
    return median
