"""Refinement: a frame is solved again with the depth found (eq. 10 of the paper), and what its slopes are then."""

from torch import Tensor, nn

from ..core.frame import Frame, Solution
from ..core.geometry import gradient_of_depth
from .solve import Solve


class Refine(nn.Module):
    """Solve a frame again with the depth found, a fixed number of times: a second pass takes most of what a third would.

    Args:
        solve: one pass.
        passes: how often a frame is solved, the first among them.
    Source:
        eq. 10 of the paper.
    """

    def __init__(self, solve: Solve, passes: int) -> None:
        super().__init__()
        self.solve = solve
        self.passes = passes

    def forward(self, frame: Frame, solution: Solution) -> tuple[Frame, Solution]:
        for _ in range(1, self.passes):
            solution = self.solve(frame, solution.depth_mm)
        return frame, solution


class SlopesOfDepth(nn.Module):
    """The gradient of the depth in place of that of single pixels: it is the slope of a surface.

    Args:
        mm_per_pixel: pixel pitch, mm.
    """

    def __init__(self, mm_per_pixel: float) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel

    def forward(self, solution: Solution) -> Tensor:
        return gradient_of_depth(solution.depth_mm, self.mm_per_pixel)


class SlopesOfPixels(nn.Module):
    """The gradient as it was found, pixel by pixel."""

    def forward(self, solution: Solution) -> Tensor:
        return solution.gradient
