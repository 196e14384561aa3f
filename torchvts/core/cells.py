"""Means over square cells of pixels, by shifted slices: of many pixels half the time of a pooling operator on a CPU."""

import torch
from torch import Tensor, nn


def whole_cell_means(image: Tensor, cell: int) -> Tensor:
    """Means over cells of a (B, C, H, W) image that lie in it as a whole; pixels beyond the last one do not count. Scripts."""
    if cell == 1:
        return image
    rows, columns = image.shape[2] // cell * cell, image.shape[3] // cell * cell
    image = image[:, :, :rows, :columns]
    if cell == 2 and image.dtype == torch.float32:  # of few pixels; ONNX Runtime has it for float32 alone
        return nn.functional.avg_pool2d(image, cell)
    sums = _line_sums(_line_sums(image, cell).transpose(2, 3), cell).transpose(2, 3).contiguous()
    return sums / float(cell * cell)


def _line_sums(image: Tensor, cell: int) -> Tensor:
    """Sums of each ``cell`` rows."""
    sums = image[:, :, 0::cell]
    for k in range(1, cell):
        sums = sums + image[:, :, k::cell]
    return sums


def cells_to_pixels(values: Tensor, cell: int, height: int, width: int) -> Tensor:
    """Values (B, C, h, w) of whole cells at the pixels of an image, interpolated; beyond the last cell as there."""
    if cell > 1:
        values = nn.functional.interpolate(values, scale_factor=float(cell), mode="bilinear", align_corners=False)
    below, after = height - values.shape[2], width - values.shape[3]
    return nn.functional.pad(values, [0, after, 0, below], mode="replicate") if below > 0 or after > 0 else values
