"""The sums of tracking, in C: a function for each, of float32 tensors on the CPU whose rows are contiguous."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from .binding import check_memory, loaded


def alignment_sums(field: Tensor, columns: Tensor, limits: npt.NDArray[Any], score_only: bool = False) -> npt.NDArray[Any]:
    """Sums (56,) float64 of one Gauss-Newton step: see :mod:`torchvts.pose.inverse`, whose tensors these are."""
    sums = np.empty(56)
    inputs = (field.data_ptr(), *field.shape[:2], columns.data_ptr(), columns.stride(0), columns.shape[1], score_only)
    loaded().alignment_sums(*inputs, limits.ctypes.data, sums.ctypes.data)
    return sums


def height_sums(
    field: Tensor, columns: Tensor, limits: npt.NDArray[Any], cells: tuple[npt.NDArray[Any], ...], most_mm: float, white_mm: float
) -> npt.NDArray[Any]:
    """Products (7, 7) of six twists and the residual of heights: see :mod:`torchvts.pose.height_errors`.

    Args:
        field: of the frame.
        columns: of the keyframe's pixels.
        limits: as of :func:`alignment_sums`.
        cells: the cell of each pixel, int64, the number of pixels of each cell, what its height changes by, and products of that.
        most_mm: height residuals of more than this are left out.
        white_mm: unit of the residuals of cells.
    """
    cell, number, lines, products = cells
    left = np.empty((7, 7))
    inputs = (field.data_ptr(), *field.shape[:2], columns.data_ptr(), columns.stride(0), columns.shape[1], limits.ctypes.data)
    arrays = (cell.ctypes.data, number.ctypes.data, lines.ctypes.data, products.ctypes.data)
    check_memory(loaded().height_sums(*inputs, *arrays, len(number), lines.shape[1] - 6, most_mm, white_mm, left.ctypes.data))
    return left


def track_grids(
    depth: Tensor, slopes: Tensor, contact: Tensor, least_mm: float, times: tuple[int, int]
) -> tuple[Tensor, Tensor, int]:
    """Fine and coarse channels (H, W, 4) of a frame, and how many fine pixels lie on it: see :mod:`torchvts.pose.grids`.

    Args:
        depth: (1, 1, H, W), contiguous as the others.
        slopes: (1, 2, H, W), y down.
        contact: (1, 1, H, W) bool.
        least_mm: depth from which skin surely lies on the object.
        times: pixels a side of the cells of both grids.
    """
    height, width = depth.shape[-2:]
    fine, coarse = (torch.empty(height // n, width // n, 4, dtype=torch.float32) for n in times)
    inputs = (depth.data_ptr(), slopes.data_ptr(), contact.data_ptr(), height, width, least_mm, *times)
    touching = loaded().track_grids(*inputs, fine.data_ptr(), coarse.data_ptr())
    check_memory(touching < 0)
    return fine, coarse, int(touching)
