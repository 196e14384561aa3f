"""Dark pixels: a dark channel may be an attached shadow, a cast shadow or dirt; what leaves the most integrable surface decides.

A frame is treated here only where a light that shines on the flat skin is dark inside the deformed area, and only for units that
are calibrated by lights.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..core.checks import check_positive, check_record, may_read_values
from ..core.frame import Frame, Solution
from ..core.geometry import slope_of_depth
from ..integration import Integrator, PoissonBackground
from ..normals import NormalFromIntensity
from .refine import Refine


class Accepted(NamedTuple):
    """where (B, 1, H, W) bool, the pixels that took other slopes; gradient (B, 2, H, W) with them."""

    where: Tensor
    gradient: Tensor


class Shadows(nn.Module):
    """A refinement that also settles what dark channels mean: put it in place of the pipeline's own, ``pipe.refine``.

    Where LEDs are so low that an object casts shadows; frames without a blocked light pass as by :class:`Refine`. Before a frame is
    solved again: dark pixels are classified, first as undeformed skin in a cast shadow, then as pixels whose dark
    channels are to be left out (dirt, or a shadow cast on a slope); and pixels with a blocked light restart from the slopes of
    their lit neighbours. After it: the normal mirrored at the plane of the two lit lights is tested. Each step is accepted
    where, and only in frames in which, integrability improves: slopes that make a surface agree with the slopes of the depth
    integrated from them.

    Args:
        refine: of a pipeline of mode precise, by lights.
        mm_per_pixel: pixel pitch, mm.
    Raises:
        TypeError: no :class:`Refine`. ValueError: one whose normals are not made of lights.
    Source:
        Onn and Bruckstein, Integrability disambiguates surface recovery in two-image photometric stereo, IJCV 5(1), 1990.
    Example:
        >>> from torchvts import Calibration, DepthPipeline, PointLights, Sensor
        >>> lights = PointLights([[20, 0, 8], [-10, 17, 8], [-10, -17, 8]], [200, 200, 200])
        >>> cal = Calibration.from_lights(lights, Sensor("low LEDs", 48, 64, 0.2))
        >>> pipe = DepthPipeline.from_calibration(cal, "precise")
        >>> pipe.refine = Shadows(pipe.refine, pipe.mm_per_pixel)
        >>> pipe(cal.model_image[None]).depth_mm.shape
        torch.Size([1, 1, 48, 64])
    """

    def __init__(self, refine: nn.Module, mm_per_pixel: float) -> None:
        super().__init__()
        check_record("refine", refine, Refine, 'pipe.refine of DepthPipeline.from_calibration(calibration, "precise") is one')
        assert isinstance(refine, Refine)
        if not isinstance(refine.solve.normals, NormalFromIntensity):
            raise ValueError(
                f"refine: expected normals by lights, NormalFromIntensity, got {type(refine.solve.normals).__name__}: "
                "only known lights say which channel a shadow blocks"
            )
        self.refine = refine
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        # it cuts no edges, which would make a surface of any slopes
        self.residual_integrator: Integrator = PoissonBackground(self.mm_per_pixel)

    def forward(self, frame: Frame, solution: Solution) -> tuple[Frame, Solution]:
        blocked: Tensor = self.refine.solve.normals.shadowed.blocked(frame.image)
        blocked = blocked & (frame.weight > 0.5)
        has_shadow = blocked.flatten(1).any(dim=1)
        if not may_read_values() or bool(has_shadow.any()):
            frame, blocked, solution = self.classify_dark(frame, blocked, solution, has_shadow)
            solution = self.restart_from_lit_neighbours(frame, blocked, solution, has_shadow)
            frame, solution = self.refine(frame, solution)
            solution = self.test_mirrored(frame, solution, has_shadow)
        else:
            frame, solution = self.refine(frame, solution)
        return frame, solution

    def classify_dark(
        self, frame: Frame, blocked: Tensor, solution: Solution, has_shadow: Tensor
    ) -> tuple[Frame, Tensor, Solution]:
        """Dark pixels as undeformed skin, or as pixels whose dark channels are left out, where that improves integrability.

        Returns:
            The frame with its image and deformed area changed accordingly; where dark still means a slope that faces away; the
            solution.
        """
        normals = self.refine.solve.normals
        shadowed: Tensor = normals.shadowed.undeformed_in_shadow(frame.image) & blocked
        flat = self.accept(frame, solution.gradient, torch.zeros_like(solution.gradient), shadowed, has_shadow)
        blocked = blocked & ~flat.where
        without: Tensor = normals.shadowed.without_dark(frame.image)
        expected = torch.where(blocked, 0.0, flat.gradient)
        other = self.refine.solve.gradient(normals.solve(without, None, expected))
        # walls of a pixel make no surface either
        rim = -nn.functional.max_pool2d(-frame.weight.detach(), 3, 1, 1) < 0.5
        cut = self.accept(frame, flat.gradient, other, blocked & ~rim, has_shadow)
        frame = Frame(torch.where(cut.where, without, frame.image), frame.weight.masked_fill(flat.where, 0.0))
        return frame, blocked & ~cut.where, self.refine.solve.integrated(frame, cut.gradient)

    def restart_from_lit_neighbours(self, frame: Frame, blocked: Tensor, solution: Solution, has_shadow: Tensor) -> Solution:
        """Where a light is blocked, two slopes may fit: one near the plain inverse's, one near those of the lit pixels around."""
        height, width = frame.image.shape[2], frame.image.shape[3]
        changed: Tensor = self.refine.solve.normals.shadowed.changed(frame.image)
        lit = (frame.weight > 0.5) & changed & ~blocked  # flat skin beside a wall does not go on in it
        # some 30 x 40 cells, and of a thin or small image no more than 3,000: the work grows with their square
        cell = max(1, (min(height, width) + 15) // 30, math.ceil(math.sqrt(height * width / 3000.0)))
        expected = extrapolated_slope(solution.gradient, lit, cell)
        normal = self.refine.solve.normals.solve(frame.image, None, expected)
        other = self.refine.solve.integrated(frame, self.refine.solve.gradient(normal) * frame.weight)
        gained = self.residual(frame, other.gradient) - self.residual(frame, solution.gradient)
        return self.better(has_shadow, gained, other, solution)

    def test_mirrored(self, frame: Frame, solution: Solution, has_shadow: Tensor) -> Solution:
        """The same for the result and its mirror image beyond the plane of the two lit lights."""
        solve, normals = self.refine.solve, self.refine.solve.normals
        before = self.residual(frame, solution.gradient)
        slope: Tensor = normals.shadowed.mirrored(solution.gradient, frame.image, solution.depth_mm, normals.view())
        _, other = self.refine(frame, solve.integrated(frame, slope * frame.weight))
        gained = self.residual(frame, other.gradient) - before
        slope = torch.where(nn.functional.avg_pool2d(gained, 17, 1, 8) < 0.0, other.gradient, solution.gradient)
        _, other = self.refine(frame, solve.integrated(frame, slope))
        return self.better(has_shadow, self.residual(frame, other.gradient) - before, other, solution)

    def accept(self, frame: Frame, gradient: Tensor, other: Tensor, where: Tensor, has_shadow: Tensor) -> Accepted:
        """Other slopes where the residual around a pixel shrinks, if that lowers the residual of the frame.

        Args:
            frame: the frame.
            gradient: (B, 2, H, W), slopes so far.
            other: (B, 2, H, W), the other slopes.
            where: (B, 1, H, W) bool, the pixels in question.
            has_shadow: (B,) bool, the frames in question.
        """
        if may_read_values() and not bool(where.any()):
            return Accepted(where, gradient)
        slopes, others = gradient.detach(), other.detach()
        residual = self.residual(frame, slopes)
        gained = self.residual(frame, torch.where(where, others, slopes)) - residual
        taken = where & (nn.functional.avg_pool2d(gained, 17, 1, 8) < 0.0)
        after = self.residual(frame, torch.where(taken, others, slopes))
        taken = taken & (has_shadow & ((after - residual).sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
        return Accepted(taken, torch.where(taken, other, gradient))

    def better(self, has_shadow: Tensor, gained: Tensor, other: Solution, solution: Solution) -> Solution:
        """The other solution in frames whose residual it lowers."""
        chosen = (has_shadow & (gained.sum(dim=(1, 2, 3)) < 0.0))[:, None, None, None]
        gradient = torch.where(chosen, other.gradient, solution.gradient)
        return Solution(gradient, torch.where(chosen, other.depth_mm, solution.depth_mm))

    def residual(self, frame: Frame, gradient: Tensor) -> Tensor:
        """Squared difference of a gradient and the slopes of its depth, noise smoothed away, (B, 1, H, W)."""
        slope = slope_of_depth(self.residual_integrator(gradient), self.mm_per_pixel)
        difference = (slope - gradient) * frame.weight.detach()
        return nn.functional.avg_pool2d(difference, 9, 1, 4).square().sum(dim=1, keepdim=True)


def extrapolated_slope(slope: Tensor, known: Tensor, cell: int) -> Tensor:
    """Slopes of all pixels extrapolated from those that are known: planes through them, weighted by nearness.

    Moving least squares over cells of pixels, with weights that fall with the fourth power of the distance: free of any scale,
    so that a plane spans a gap of any width by what is as wide around it. Memory grows with the number of cells,
    time with its square.

    Args:
        slope: (B, 2, H, W).
        known: (B, 1, H, W) bool.
        cell: side of a cell, pixels.
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
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    y = (torch.arange(height, dtype=slope.dtype, device=slope.device) + 0.5) / cell
    x = (torch.arange(width, dtype=slope.dtype, device=slope.device) + 0.5) / cell
    counted = known.to(slope.dtype)
    here = torch.stack((x.expand(height, width), y[:, None].expand(height, width)))[None]
    beyond = [0, columns * cell - width, 0, rows * cell - height]
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
    grid = grid[:, :, :height, :width]
    return grid[:, 0:2] + grid[:, 2:4] * here[:, 0:1] + grid[:, 4:6] * here[:, 1:2]
