"""Refinement: a frame is solved again with the depth found (eq. 10 of the paper)."""

from torch import nn

from ..core.frame import Frame, Solution
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
