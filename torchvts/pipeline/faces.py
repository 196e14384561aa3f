"""Faces of the object that the image border cuts: found by the depth of a frame, and solved with the rest of it."""

import torch
from torch import nn

from ..core.checks import may_read
from ..core.frame import Crop, Frame, Solution
from ..integration.background import with_cut_faces
from .solve import Solve


class CutFaces(nn.Module):
    """Frames in which the image border cuts a flat face of the object are solved again, the face in their deformed area.

    Without it the integrator takes the face for undeformed skin: depth is zero between the two, and the slope of the face is lost.
    Elsewhere than on a CPU, and in exported programs, every frame is solved again: to ask would wait for the device.

    Args:
        solve: one pass.
        crop: to the window of the deformed area.
    """

    def __init__(self, solve: Solve, crop: Crop) -> None:
        super().__init__()
        self.solve = solve
        self.crop = crop

    def forward(self, frame: Frame, solution: Solution) -> tuple[Frame, Solution]:
        deformed = with_cut_faces(solution.depth_mm.detach(), frame.deformed)
        if may_read(deformed) and torch.equal(deformed, frame.deformed):
            return frame, solution
        frame = self.crop(frame.compensated, deformed)
        return frame, self.solve(frame)
