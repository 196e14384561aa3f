"""One pass: from a compensated image to normals, slopes and depth (eq. 9 or 10, 5 and 4 of the paper)."""

import warnings
from typing import Final

import torch
from torch import Tensor, nn

from ..core.checks import reads_freely
from ..core.frame import Frame, Solution
from ..normals import NormalModel
from ..normals.base import check_normals
from .own_normals import doubt_of_axes


class Solve(nn.Module):
    """Normals, gradient and depth of a :class:`~torchvts.core.frame.Frame`.

    What a model gives that is not declared as calibrated is checked, for eager tensors on a CPU; a warning says once where the
    axes of its normals are likely wrong.

    Args:
        normals: compensated image to normals.
        gradient: normals to gradient.
        integrate: gradient to depth.
        zero: depth and weight to depth that counts from the undeformed skin.
    """

    calibrated: Final[bool]

    def __init__(self, normals: NormalModel, gradient: nn.Module, integrate: nn.Module, zero: nn.Module) -> None:
        super().__init__()
        self.normals = normals
        self.calibrated = normals.calibrated
        self._axes_known = False  # asked of the first frame that shows a contact
        self.gradient = gradient
        self.integrate = integrate
        self.zero = zero

    def forward(self, frame: Frame, depth_mm: Tensor) -> Solution:
        """Solve a frame again with the depth so far, (B, 1, H, W): eq. 10."""
        return self.integrated(frame, self.slopes(frame.image, depth_mm) * frame.weight)

    @torch.jit.export
    def slopes(self, image: Tensor, depth_mm: Tensor | None) -> Tensor:
        """Slopes of all pixels of compensated images (B, 3, H, W), (B, 2, H, W); without depth eq. 9, with it eq. 10."""
        normal = self.normals(image, depth_mm)
        if not torch.jit.is_scripting():
            self._check(normal, image)
        gradient: Tensor = self.gradient(normal.to(image.dtype))  # under autocast a network gives fewer bits
        return gradient

    def _check(self, normal: Tensor, image: Tensor) -> None:
        if self.calibrated or not reads_freely(image):
            return
        name = check_normals(self.normals, normal, image)
        if self._axes_known or normal.requires_grad or normal.numel() == 0:  # in training they may be anything
            return
        doubt = doubt_of_axes(name, normal.detach().to(image.dtype))
        self._axes_known = doubt is not None
        if doubt:
            warnings.warn(doubt, UserWarning, stacklevel=2)

    @torch.jit.export
    def integrated(self, frame: Frame, gradient: Tensor) -> Solution:
        """The solution of a gradient (B, 2, H, W) that is zero where the weight is."""
        integrated: Tensor = self.integrate(gradient)
        depth: Tensor = self.zero(integrated, frame.weight)
        if depth.shape != integrated.shape:
            raise ValueError(f"zero: expected depth {list(integrated.shape)} like that of integrate, got {list(depth.shape)}")
        return Solution(gradient, depth)
