"""One pass: from a compensated window to normals, gradient and depth (eq. 9 or 10, 5 and 4 of the paper)."""

from typing import Final

import torch
from torch import Tensor, nn

from ..accelerated import Masked
from ..core.checks import reads_freely
from ..core.frame import Frame, Solution, in_window
from ..integration import Integrator
from ..normals import NormalModel, WrappedNormals
from ..normals.base import check_normals


class Solve(nn.Module):
    """Normals, gradient and depth of a :class:`~torchvts.core.frame.Frame`.

    What a module from outside of this library gives is checked, for eager tensors on a CPU.

    Args:
        normals: compensated image to normals.
        gradient: normals to gradient.
        integrate: gradient to depth.
    """

    takes_noise: Final[bool]
    _checks: Final[bool]

    def __init__(self, normals: NormalModel, gradient: nn.Module, integrate: Integrator) -> None:
        super().__init__()
        self.normals = normals
        self.takes_noise = normals.takes_noise
        given = normals.module if isinstance(normals, WrappedNormals) else normals
        self._checks = not type(given).__module__.startswith("torchvts.")
        self.gradient = gradient
        self.integrate = integrate
        self.masked = Masked()

    def forward(self, frame: Frame, depth_mm: Tensor | None = None) -> Solution:
        """Solve a frame.

        Args:
            frame: the frame.
            depth_mm: (B, 1, H, W), the depth so far, which eq. 10 takes; None for eq. 9.
        """
        depth = None if depth_mm is None else in_window(frame, depth_mm)
        if self.takes_noise:
            normal = self.normals(frame.image, depth, frame.window, frame.noise_std)
        else:
            normal = self.normals(frame.image, depth, frame.window)
        if not torch.jit.is_scripting():
            self._check(normal, frame.image)
        return self.integrated(frame, self.masked(self.gradient(normal), frame.mask))

    def _check(self, normal: Tensor, image: Tensor) -> None:
        if self._checks and reads_freely(image):
            check_normals(self.normals, normal, image)

    def integrated(self, frame: Frame, gradient: Tensor) -> Solution:
        """The solution with a gradient (B, 2, h, w) that is known."""
        return Solution(gradient, self.integrate(gradient, frame.window, frame.size))
