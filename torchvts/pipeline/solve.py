"""One pass: from a compensated window to normals, gradient and depth (eq. 9 or 10, 5 and 4 of the paper)."""

from typing import Final

from torch import Tensor, nn

from ..accelerated import Masked
from ..core.frame import Frame, Solution, in_window
from ..integration import Integrator
from ..normals import NormalModel


class Solve(nn.Module):
    """Normals, gradient and depth of a :class:`~torchvts.core.frame.Frame`.

    Args:
        normals: compensated image to normals.
        gradient: normals to gradient.
        integrate: gradient to depth.
    """

    takes_noise: Final[bool]

    def __init__(self, normals: NormalModel, gradient: nn.Module, integrate: Integrator) -> None:
        super().__init__()
        self.normals = normals
        self.takes_noise = normals.takes_noise
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
        return self.integrated(frame, self.masked(self.gradient(normal), frame.mask))

    def integrated(self, frame: Frame, gradient: Tensor) -> Solution:
        """The solution with a gradient (B, 2, h, w) that is known."""
        return Solution(gradient, self.integrate(gradient, frame.window, frame.size))
