"""Dark pixels: a dark channel may be an attached shadow, a cast shadow or dirt; what leaves the most integrable surface decides.

A frame enters this room only where a light that shines on the flat skin is dark inside the deformed area, and only for units that
are calibrated by lights.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..contact import ContactMask
from ..core.checks import may_read_values
from ..core.frame import Frame, Solution, as_factor, in_window, with_deformed
from ..core.geometry import slope_of_depth
from ..integration import Integrator
from .refine import Repeat


class Accepted(NamedTuple):
    """where (B, 1, h, w) bool, the pixels that took other slopes; gradient (B, 2, h, w) with them."""

    where: Tensor
    gradient: Tensor


class Shadows(nn.Module):
    """A refinement policy that also settles what dark channels mean.

    Before the policy goes again: dark pixels are classified, first as undeformed skin in a cast shadow, then as pixels whose dark
    channels are to be left out (dirt, or a shadow cast on a slope); and pixels with a blocked light restart from the slopes of
    their lit neighbours. After it: the normal mirrored at the plane of the two lit lights is tested. Each step is accepted
    where, and only in frames in which, integrability improves: slopes that make a surface agree with the slopes of the depth
    integrated from them.

    Args:
        policy: how often frames are solved again.
        deformed: the block of the pipeline that finds the deformed skin; None: no pixel is taken for undeformed skin.
        residual_integrator: a solver that cuts no edges; one that does would make a surface of any slopes.
        mm_per_pixel: pixel pitch, mm.
        rounds: how often pixels are classified again beside those that were accepted.
    Source:
        Onn and Bruckstein, Integrability disambiguates surface recovery in two-image photometric stereo, IJCV 5(1), 1990; the
        rest is this project's.
    """

    def __init__(
        self, policy: Repeat, deformed: ContactMask | None, residual_integrator: Integrator, mm_per_pixel: float, rounds: int = 3
    ) -> None:
        super().__init__()
        self.policy = policy
        self.deformed = deformed
        self.residual_integrator = residual_integrator
        self.mm_per_pixel = mm_per_pixel
        self.rounds = rounds

    def forward(self, frame: Frame, solution: Solution) -> tuple[Frame, Solution]:
        active = self.policy.unsettled(frame, solution)
        blocked: Tensor = self.policy.solve.normals.shadowed.blocked(frame.image, frame.window, frame.noise_std)
        blocked = blocked & frame.mask
        has_shadow = active & blocked.flatten(1).any(dim=1)
        if may_read_values() and not bool(has_shadow.any()):
            return frame, self.policy.repeat(frame, solution, active)
        frame, blocked, solution = self.classify_dark(frame, blocked, solution, has_shadow)
        solution = self.restart_from_lit_neighbours(frame, blocked, solution, has_shadow)
        solution = self.policy.repeat(frame, solution, active)
        return frame, self.test_mirrored(frame, solution, has_shadow)

    def classify_dark(
        self, frame: Frame, blocked: Tensor, solution: Solution, has_shadow: Tensor
    ) -> tuple[Frame, Tensor, Solution]:
        """Dark pixels as undeformed skin, or as pixels whose dark channels are left out, where that improves integrability.

        Returns:
            The frame with its image and deformed area changed accordingly; where dark still means a slope that faces away; the
            solution.
        """
        (top, left), normals = frame.window, self.policy.solve.normals
        shadowed = torch.zeros_like(blocked)
        if self.deformed is not None:
            found: Tensor = self.deformed.shadowed(frame.compensated, frame.noise_std)
            shadowed = found[:, :, top : top + blocked.shape[2], left : left + blocked.shape[3]] & blocked
        flat = self.accept(frame, solution.gradient, torch.zeros_like(solution.gradient), shadowed, has_shadow)
        blocked = blocked & ~flat.where
        without: Tensor = normals.shadowed.without_dark(frame.image, frame.window, frame.noise_std)
        expected = torch.where(blocked, 0.0, flat.gradient)
        other = self.policy.solve.gradient(normals.solve(without, None, frame.window, expected, frame.noise_std))
        rim = (
            nn.functional.max_pool2d(as_factor(~frame.mask, frame.image), 3, 1, 1) > 0.0
        )  # walls of a pixel make no surface either
        cut = self.accept(frame, flat.gradient, other, blocked & ~rim, has_shadow)
        frame = with_deformed(frame, torch.where(cut.where, without, frame.image), frame.mask & ~flat.where)
        return frame, blocked & ~cut.where, self.policy.solve.integrated(frame, cut.gradient)

    def restart_from_lit_neighbours(self, frame: Frame, blocked: Tensor, solution: Solution, has_shadow: Tensor) -> Solution:
        """Where a light is blocked, two slopes may fit: one near the plain inverse's, one near those of the lit pixels around."""
        (top, left), (height, width) = frame.window, frame.size
        lit = frame.mask & ~blocked
        # some 30 x 40 cells, and of a thin or small image no more than 3,000: the work grows with their square
        cell = max(1, (min(height, width) + 15) // 30, math.ceil(math.sqrt(height * width / 3000.0)))
        expected = extrapolated_slope(solution.gradient, lit, cell, top, left)
        normal = self.policy.solve.normals.solve(frame.image, None, frame.window, expected, frame.noise_std)
        other = self.policy.solve.integrated(frame, self.policy.solve.gradient(normal) * as_factor(frame.mask, frame.image))
        gained = self.residual(frame, other) - self.residual(frame, solution)
        return self.better(has_shadow, gained, other, solution)

    def test_mirrored(self, frame: Frame, solution: Solution, has_shadow: Tensor) -> Solution:
        """The same for the result and its mirror image beyond the plane of the two lit lights."""
        solve, normals = self.policy.solve, self.policy.solve.normals
        before = self.residual(frame, solution)
        view = normals.view(frame.image, frame.window)
        depth = in_window(frame, solution.depth_mm)
        slope: Tensor = normals.shadowed.mirrored(solution.gradient, frame.image, depth, view, frame.noise_std)
        slope = slope * as_factor(frame.mask, frame.image)
        other = self.policy.repeat(frame, solve.integrated(frame, slope), has_shadow)
        gained = self.residual(frame, other) - before
        slope = torch.where(nn.functional.avg_pool2d(gained, 17, 1, 8) < 0.0, other.gradient, solution.gradient)
        other = self.policy.repeat(frame, solve.integrated(frame, slope), has_shadow)
        return self.better(has_shadow, self.residual(frame, other) - before, other, solution)

    def accept(self, frame: Frame, gradient: Tensor, other: Tensor, where: Tensor, has_shadow: Tensor) -> Accepted:
        """Other slopes where the residual around a pixel shrinks, if that lowers the residual of the frame.

        Args:
            frame: the frame.
            gradient: (B, 2, h, w), slopes so far.
            other: (B, 2, h, w), the other slopes.
            where: (B, 1, h, w) bool, the pixels in question.
            has_shadow: (B,) bool, the frames in question.
        """
        taken = torch.zeros_like(where)
        if may_read_values() and not bool(where.any()):
            return Accepted(taken, gradient)
        slopes, others = gradient.detach(), other.detach()
        residual = self.residual_of(frame, slopes)
        for _ in range(self.rounds):
            gained = self.residual_of(frame, torch.where(where, others, slopes)) - residual
            here = where & (nn.functional.avg_pool2d(gained, 17, 1, 8) < 0.0)
            if may_read_values() and not bool(here.any()):
                break
            mixed = torch.where(here, others, slopes)
            after = self.residual_of(frame, mixed)
            better = (has_shadow & ((after - residual).sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
            slopes, residual = torch.where(better, mixed, slopes), torch.where(better, after, residual)
            taken, where = taken | (here & better), where & ~here & better
        return Accepted(taken, torch.where(taken, other, gradient))

    def better(self, has_shadow: Tensor, gained: Tensor, other: Solution, solution: Solution) -> Solution:
        """The other solution in frames whose residual it lowers."""
        chosen = (has_shadow & (gained.sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
        gradient = torch.where(chosen, other.gradient, solution.gradient)
        return Solution(gradient, torch.where(chosen, other.depth_mm, solution.depth_mm))

    def residual_of(self, frame: Frame, gradient: Tensor) -> Tensor:
        """Integrability residual of slopes, by the residual integrator."""
        return self.residual(frame, Solution(gradient, self.residual_integrator(gradient, frame.window, frame.size)))

    def residual(self, frame: Frame, solution: Solution) -> Tensor:
        """Squared difference of the gradient and the slopes of its depth, noise smoothed away, (B, 1, h, w)."""
        slope = slope_of_depth(in_window(frame, solution.depth_mm), self.mm_per_pixel)
        difference = (slope - solution.gradient) * as_factor(frame.mask, solution.gradient)
        return nn.functional.avg_pool2d(difference, 9, 1, 4).square().sum(dim=1, keepdim=True)


def extrapolated_slope(slope: Tensor, known: Tensor, cell: int, top: int = 0, left: int = 0) -> Tensor:
    """Slopes of all pixels extrapolated from those that are known: planes through them, weighted by nearness.

    Moving least squares over cells of pixels, with weights that fall with the fourth power of the distance: free of any scale,
    so that a plane spans a gap of any width by what is as wide around it. Memory grows with the number of cells,
    time with its square.

    Args:
        slope: (B, 2, H, W).
        known: (B, 1, H, W) bool.
        cell: side of a cell, pixels.
        top: row of the first pixel in the image, so that parts of an image have the same cells.
        left: its column.
    Returns:
        (B, 2, H, W); zero in frames without a known pixel.
    Source:
        Lancaster and Salkauskas, Surfaces generated by moving least squares methods, Math. Comp. 37, 1981.
    Example:
        >>> x = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
        >>> plane = torch.cat((x, 1 - x), dim=1)
        >>> found = extrapolated_slope(plane, x < 0.5, 2)
        >>> bool((found - plane).abs().max() < 0.02)
        True
    """
    count, height, width = slope.shape[0], slope.shape[2], slope.shape[3]
    before, above = left % cell, top % cell
    rows, columns = (above + height + cell - 1) // cell, (before + width + cell - 1) // cell
    y = (torch.arange(height, dtype=slope.dtype, device=slope.device) + (above + 0.5)) / cell
    x = (torch.arange(width, dtype=slope.dtype, device=slope.device) + (before + 0.5)) / cell
    counted = known.to(slope.dtype)
    here = torch.stack((x.expand(height, width), y[:, None].expand(height, width)))[None]
    beyond = [before, columns * cell - before - width, above, rows * cell - above - height]
    sums = nn.functional.avg_pool2d(nn.functional.pad(torch.cat((counted, counted * here, counted * slope), dim=1), beyond), cell)
    sums = sums.flatten(2).transpose(1, 2)  # (B, cells, 5)
    mass = sums[:, :, 0:1]
    mean = sums[:, :, 1:] / mass.clamp_min(1e-12)
    y = torch.arange(rows, dtype=slope.dtype, device=slope.device).repeat_interleave(columns) + 0.5
    x = torch.arange(columns, dtype=slope.dtype, device=slope.device).repeat(rows) + 0.5
    moments = torch.cat((mean, (mean[:, :, 0:2, None] * mean[:, :, None, :]).flatten(2)), dim=2)  # (B, cells, 12)
    means: list[Tensor] = []
    for to in torch.split(torch.stack((x, y), dim=1), 256):  # a part of the cells at a time, for memory
        distance = (to[:, 0:1] - mean[:, None, :, 0]).square() + (to[:, 1:2] - mean[:, None, :, 1]).square()
        weight = mass.transpose(1, 2) / (distance + 0.03).square()  # (B, cell, cell it is known in)
        means.append(weight / weight.sum(2, keepdim=True).clamp_min(1e-12) @ moments)
    found = torch.cat(means, dim=1)
    center, spread = found[:, :, 0:4], found[:, :, 4:12].reshape(count, -1, 2, 4)
    spread = spread - center[:, :, 0:2, None] * center[:, :, None, :]
    # of a cell's size at least: cells on one line constrain nothing across it
    xx, xy, yy = spread[:, :, 0, 0:1] + 0.03, spread[:, :, 0, 1:2], spread[:, :, 1, 1:2] + 0.03
    along_x, along_y = spread[:, :, 0, 2:4], spread[:, :, 1, 2:4]
    determinant = xx * yy - xy * xy
    turn_x, turn_y = (yy * along_x - xy * along_y) / determinant, (xx * along_y - xy * along_x) / determinant
    planes = torch.cat((center[:, :, 2:4] - turn_x * center[:, :, 0:1] - turn_y * center[:, :, 1:2], turn_x, turn_y), dim=2)
    grid = planes.transpose(1, 2).reshape(count, 6, rows, columns)
    grid = grid.repeat_interleave(cell, dim=2).repeat_interleave(cell, dim=3)
    grid = grid[:, :, above : above + height, before : before + width]
    return grid[:, 0:2] + grid[:, 2:4] * here[:, 0:1] + grid[:, 4:6] * here[:, 1:2]
