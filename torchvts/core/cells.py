"""Sums and means over square cells of pixels, by shifted slices: of many pixels half the time of a pooling operator on a CPU."""

import torch
from torch import Tensor, nn


def cell_sums(image: Tensor, cell: int) -> Tensor:
    """Sums over cells of a (B, C, H, W) image, in its own dtype; where the size is no multiple, the last cells overlap others."""
    return image if cell == 1 else _line_sums(_line_sums(image, cell).transpose(2, 3), cell).transpose(2, 3).contiguous()


def cell_means(image: Tensor, cell: int) -> Tensor:
    """Means over cells of a (B, C, H, W) image; beyond the border it counts as zero."""
    if cell == 1:
        return image
    below, after = -image.shape[2] % cell, -image.shape[3] % cell
    if below > 0 or after > 0:
        image = nn.functional.pad(image, [0, after, 0, below])
    if cell == 2 and image.dtype == torch.float32:  # of few pixels; ONNX Runtime has it for float32 alone
        return nn.functional.avg_pool2d(image, cell)
    return cell_sums(image, cell) / float(cell * cell)


def _line_sums(image: Tensor, cell: int) -> Tensor:
    """Sums of each ``cell`` rows."""
    whole = image.shape[2] // cell * cell
    sums = image[:, :, 0:whole:cell]
    for k in range(1, cell):
        sums = sums + image[:, :, k:whole:cell]
    if whole == image.shape[2]:
        return sums
    last = image[:, :, -cell : image.shape[2] - cell + 1]
    for k in range(1, cell):
        first = image.shape[2] - cell + k
        last = last + image[:, :, first : first + 1]
    return torch.cat((sums, last), dim=2)


def whole_cell_means(image: Tensor, cell: int) -> Tensor:
    """Means over those cells of a (B, C, H, W) image that lie in it as a whole; pixels beyond the last one do not count."""
    rows, columns = image.shape[2] // cell * cell, image.shape[3] // cell * cell
    return cell_means(image[:, :, :rows, :columns], cell)


def cells_to_pixels(values: Tensor, cell: int, height: int, width: int) -> Tensor:
    """Values (B, C, h, w) of whole cells at the pixels of an image, interpolated; beyond the last cell as there."""
    if cell > 1:
        values = nn.functional.interpolate(values, scale_factor=float(cell), mode="bilinear", align_corners=False)
    below, after = height - values.shape[2], width - values.shape[3]
    return nn.functional.pad(values, [0, after, 0, below], mode="replicate") if below > 0 or after > 0 else values
