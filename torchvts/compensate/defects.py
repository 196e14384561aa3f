"""Defective pixels, filled from valid pixels around them."""

import torch
from torch import Tensor, nn

from ..core.checks import check_tensor


class FillDefects(nn.Module):
    """Replace defective pixels of images (B, 3, H, W) by the mean of their nearest valid neighbours.

    Args:
        defects: (H, W) bool; None for none.
    Raises:
        ValueError: not (H, W) bool, or a whole row and column through a defect is defective.
    """

    defect: Tensor
    neighbours: Tensor

    def __init__(self, defects: Tensor | None = None) -> None:
        super().__init__()
        index, neighbours = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, dtype=torch.int64)
        if defects is not None:
            check_tensor("defects", defects)
            if defects.dim() != 2 or defects.dtype != torch.bool:
                raise ValueError(f"defects: expected (H, W) bool, got {tuple(defects.shape)} {defects.dtype}: threshold it")
            if bool(defects.any()):
                index, neighbours = nearest_valid(defects)
        self.register_buffer("defect", index)
        self.register_buffer("neighbours", neighbours)

    def forward(self, light: Tensor) -> Tensor:
        if self.defect.shape[0] == 0:
            return light
        pixels = light.flatten(2)
        repaired = pixels[:, :, self.neighbours].mean(dim=3)  # (B, 3, N)
        return pixels.index_copy(2, self.defect, repaired).reshape(light.shape)


def nearest_valid(defects: Tensor) -> tuple[Tensor, Tensor]:
    """For every defect of an (H, W) bool mask its flat index (N,) and those of the valid pixels to take its value from (N, 4).

    Left, right, above and below, the next valid pixel each; where the border comes first, the pixel found the other way.

    Raises:
        ValueError: a whole row and column through a defect is defective.
    """
    height, width = defects.shape
    rows, columns = torch.nonzero(defects, as_tuple=True)
    found, missing = [], []
    for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        y, x = rows.clone(), columns.clone()
        for _ in range(max(height, width)):
            y_next, x_next = (y + dy).clamp(0, height - 1), (x + dx).clamp(0, width - 1)
            move = defects[y, x]
            if not bool((move & ((y_next != y) | (x_next != x))).any()):
                break
            y, x = torch.where(move, y_next, y), torch.where(move, x_next, x)
        found.append(y * width + x)
        missing.append(defects[y, x])
    index, lost = torch.stack(found, 1), torch.stack(missing, 1)
    if bool(lost.all(1).any()):
        raise ValueError("defects: expected valid pixels in the row or column of each defect, got none: the background is unusable")
    other_way, other_lost = index[:, [1, 0, 3, 2]], lost[:, [1, 0, 3, 2]]
    any_way = index.gather(1, (~lost).to(torch.int64).argmax(1, keepdim=True))
    return rows * width + columns, torch.where(lost, torch.where(other_lost, any_way, other_way), index)
