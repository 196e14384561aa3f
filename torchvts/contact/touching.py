"""Where the object touches the skin, from the depth of a frame."""

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_same_size


class ContactFromDepth(nn.Module):
    """Contact of depth frames: the part of the deformed area that the object presses."""

    def __init__(self, mm_per_pixel: float) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel

    def forward(self, depth_mm: Tensor, gradient: Tensor, deformed: Tensor) -> Tensor:
        """Contact, bool (B, 1, H, W)."""
        check_batch("depth_mm", depth_mm, 1)
        check_same_size("deformed", deformed, "depth_mm", depth_mm.shape[2], depth_mm.shape[3])
        depth = depth_mm.detach() * deformed.to(torch.uint8).to(depth_mm.dtype)
        return deformed & (depth > 0.3 * depth.amax(dim=(2, 3), keepdim=True))
