"""Refinement policies: whether and how often a frame is solved again with the depth found (eq. 10 of the paper)."""

import torch
from torch import Tensor, nn

from ..core.frame import Frame, Solution
from ..core.geometry import gradient_of_depth
from ..integration import Integrator
from ..normals import NormalModel
from .solve import Solve


class Once(nn.Module):
    """No refinement: the first pass stands."""

    def forward(self, frame: Frame, solution: Solution) -> tuple[Frame, Solution]:
        return frame, solution


class Repeat(nn.Module):
    """Solve again until the change that is still missing falls below a tolerance.

    What is missing is extrapolated from how fast the change of depth shrinks from pass to pass. Frames of a batch do not influence
    one another: each stops by itself.

    Args:
        solve: one pass.
        mm_per_pixel: pixel pitch, mm.
        tolerance_px: change of depth still missing at which a frame is done, as a multiple of the pitch.
        max_passes: bound on all passes, the first among them.
    """

    def __init__(self, solve: Solve, mm_per_pixel: float, tolerance_px: float, max_passes: int) -> None:
        super().__init__()
        self.solve = solve
        self.mm_per_pixel = mm_per_pixel
        self.tolerance_px = tolerance_px
        self.max_passes = max_passes

    def forward(self, frame: Frame, solution: Solution) -> tuple[Frame, Solution]:
        return frame, self.repeat(frame, solution, self.unsettled(frame, solution))

    @torch.jit.export
    def unsettled(self, frame: Frame, solution: Solution) -> Tensor:
        """The frames of a batch that are to be solved again, bool (B,): all of them."""
        return torch.ones(frame.image.shape[0], dtype=torch.bool, device=frame.image.device)

    @torch.jit.export
    def repeat(self, frame: Frame, solution: Solution, active: Tensor) -> Solution:
        """Solve the active frames again until each has settled."""
        if not torch.jit.is_scripting():  # noqa: SIM102
            if torch.compiler.is_exporting():
                return self._repeat_in_graph(frame, solution, active)
        gradient, depth = solution.gradient, solution.depth_mm
        last_px = depth.detach().abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
        for number in range(1, self.max_passes):
            if not bool(active.any()):
                break
            index = torch.where(active)[0]
            every = index.shape[0] == active.shape[0]
            before = _some(depth, index, every)
            found = self.solve(_some_frames(frame, index, every), before)
            if number == self.max_passes - 1:  # whatever is missing still
                return Solution(_with_some(gradient, index, found.gradient, every), _with_some(depth, index, found.depth_mm, every))
            change_px = _largest_change(found.depth_mm.detach(), before.detach()) / self.mm_per_pixel
            missing_px = still_missing_px(change_px, _some(last_px, index, every))
            gradient = _with_some(gradient, index, found.gradient, every)
            depth = _with_some(depth, index, found.depth_mm, every)
            active = _with_some(active, index, missing_px > self.tolerance_px, every)
            last_px = _with_some(last_px, index, change_px, every)
        return Solution(gradient, depth)

    def _repeat_in_graph(self, frame: Frame, solution: Solution, active: Tensor) -> Solution:
        """:meth:`repeat` for torch.export: the loop as one operator; settled frames are computed along and left as they are."""

        def unsettled(step: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, last_px: Tensor) -> Tensor:
            return active.any() & (step < self.max_passes)

        def go_again(step: Tensor, gradient: Tensor, depth: Tensor, active: Tensor, last_px: Tensor) -> tuple[Tensor, ...]:
            found = self.solve(frame, depth)
            change_px = _largest_change(found.depth_mm, depth) / self.mm_per_pixel
            left = active & (still_missing_px(change_px, last_px) > self.tolerance_px)
            where = active[:, None, None, None]
            gradient, depth = torch.where(where, found.gradient, gradient), torch.where(where, found.depth_mm, depth)
            return step + 1, gradient.contiguous(), depth.contiguous(), left, torch.where(active, change_px, last_px)

        gradient, depth = solution.gradient.contiguous(), solution.depth_mm.contiguous()
        last_px = depth.abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel
        step = torch.ones((), dtype=torch.int64, device=depth.device)
        state: tuple[Tensor, ...] = (step, gradient, depth, active, last_px)
        if self.max_passes == 2:  # one pass needs no loop, and stays differentiable
            state = go_again(*state)
        elif self.max_passes > 2:
            state = torch.while_loop(unsettled, go_again, state)  # type: ignore[no-untyped-call]
        return Solution(state[1], state[2])


class SlopesOfDepth(nn.Module):
    """The gradient of the depth in place of that of single pixels: it is the slope of a surface.

    Args:
        mm_per_pixel: pixel pitch, mm.
    """

    def __init__(self, mm_per_pixel: float) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel

    def forward(self, frame: Frame, solution: Solution) -> Solution:
        return Solution(gradient_of_depth(solution.depth_mm, self.mm_per_pixel), solution.depth_mm)


class SlopesOfPixels(nn.Module):
    """The gradient as it was found, pixel by pixel."""

    def forward(self, frame: Frame, solution: Solution) -> Solution:
        return solution


class Adaptive(Repeat):
    """Solve again only frames for which a second pass is predicted to change the depth by more than a threshold.

    The prediction is a second pass on every ``stride``-th pixel.

    Args:
        solve: one pass.
        coarse_normals: the model of normals for every ``stride``-th pixel.
        coarse_integrate: the integrator for that grid.
        mm_per_pixel: pixel pitch, mm.
        tolerance_px: change of depth still missing at which a frame is done, as a multiple of the pitch.
        max_passes: bound on all passes.
        refine_threshold_px: predicted change of depth from which a frame is solved again, as a multiple of the pitch.
        stride: pixels.
    """

    def __init__(
        self,
        solve: Solve,
        coarse_normals: NormalModel,
        coarse_integrate: Integrator,
        mm_per_pixel: float,
        tolerance_px: float,
        max_passes: int,
        refine_threshold_px: float,
        stride: int,
    ) -> None:
        super().__init__(solve, mm_per_pixel, tolerance_px, max_passes)
        self.coarse_normals = coarse_normals
        self.coarse_integrate = coarse_integrate
        self.refine_threshold_px = refine_threshold_px
        self.stride = stride

    @torch.jit.export
    def unsettled(self, frame: Frame, solution: Solution) -> Tensor:
        """The frames for which a second pass is predicted to change the depth by more than the threshold, bool (B,)."""
        height, width = frame.image.shape[2], frame.image.shape[3]
        if min(height, width) <= self.stride + self.stride // 2:  # the grid would have one pixel a line
            return torch.ones(frame.image.shape[0], dtype=torch.bool, device=frame.image.device)
        return self.predicted_change_px(frame, solution) > self.refine_threshold_px

    @torch.jit.export
    def predicted_change_px(self, frame: Frame, solution: Solution) -> Tensor:
        """Largest change of depth that a second pass would bring, per frame (B,), in pixels of pitch."""
        first, step = self.stride // 2, self.stride
        image = frame.image.detach()[:, :, first::step, first::step]
        depth = solution.depth_mm.detach()[:, :, first::step, first::step]
        inside = frame.weight.detach()[:, :, first::step, first::step]
        before = solution.gradient.detach()[:, :, first::step, first::step]
        normal = self.coarse_normals(image, depth, frame.noise_std) if self.solve.takes_noise else self.coarse_normals(image, depth)
        found: Tensor = self.coarse_integrate(self.solve.gradient(normal) * inside - before)
        return found.abs().amax(dim=(1, 2, 3)) / self.mm_per_pixel


def still_missing_px(change_px: Tensor, last_px: Tensor) -> Tensor:
    """The stopping rule: what is missing after a change that shrank by r from the one before, change * r / (1 - r)."""
    ratio = (change_px / last_px.clamp_min(1e-12)).clamp(0.0, 0.9)
    return change_px * ratio / (1.0 - ratio)


def _largest_change(one: Tensor, other: Tensor) -> Tensor:
    """Largest difference of two batches of depths, per frame, (B,)."""
    return (one - other).abs().amax(dim=(1, 2, 3))


def _some_frames(frame: Frame, index: Tensor, every: bool) -> Frame:
    if every:
        return frame
    noise = frame.noise_std
    return Frame(frame.image[index], frame.weight[index], None if noise is None else noise[index])


def _some(frames: Tensor, index: Tensor, every: bool) -> Tensor:
    """Some frames of a batch, or all as they are."""
    return frames if every else frames[index]


def _with_some(frames: Tensor, index: Tensor, some: Tensor, every: bool) -> Tensor:
    """A batch with some of its frames replaced."""
    return some if every else frames.index_copy(0, index, some)
