"""Where the object touches the skin, from the depth of a frame: the part of the deformed area that bears a pressure.

Skin in contact follows the object; around the contact it hangs free, down to where it is undeformed. A stretched skin on a soft
gel obeys p = z - L^2 laplace z, p being the pressure on it, as a depth, and L the length on which free skin decays.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.cells import cell_means
from ..core.checks import check_batch, check_mask, check_positive, check_same_size
from ..core.morphology import dilate_cross

CELL_MM = 0.13
"""Side of the cells in which pressure is found, at most; finer, the noise of slopes hides it."""

RIM_MM = 3.5
"""Length of rim along which its depth is averaged, either way."""

DECAY_MM = (0.1, 3.0)
"""Bounds of the length on which free skin decays."""

INNER = 3
"""Cells, either way, over which the pressure just inside a rim is averaged: more than the blur of skin and camera reaches."""

TAIL = (0.03, 0.4)
"""Depths of free skin from which that length is found, as shares of a frame's largest depth."""

LEAST_FREE = (0.23, 0.12)
"""Share of the deformed skin that is free where skin hangs around a contact; or least product of that share and the share of the
shallow skin that is free. With such skin, on real and drawn sensors: 0.21 to 0.7, and 0.12 to 0.7; without, on objects whose
grooves and feet of walls bend alike: at most 0.23, and 0.12. Below both, all deformed skin lies on the object."""

EXPLAINED = 0.85
"""Share of the slopes nearby that a surface must explain, in squares. Of slopes that are noise, depth explains half in the mean,
and 0.84 at most in undeformed frames of a video; of presses of 0.1 mm on drawn sensors 0.9 and more."""

FALL = 0.5
"""Pressure at a rim, as a share of that just inside: pressure falls to zero there, and blur makes a slope of that step."""

FREE = 0.5
"""Pressure, as a share of depth, below which skin between parts of a contact is free: free skin bears none, that on a flat face as
much as its depth."""

NOISE_DEPTH = 0.4
"""Or depth nearby exceeds so much of what unexplained slopes would add up to from there to the end of what is nearby."""


class ContactFromDepth(nn.Module):
    """Contact of depth frames: the part of the deformed area that bears a pressure.

    The decay length L of a frame is the regression of its convex skin. A cell is pressed if its pressure exceeds a share of what
    lifts free skin of the slope nearby, slope * L: at the rim of any contact pressure falls from at least that to zero. Where it
    falls from more, as under a ball, half of the pressure just inside decides: a step that is blurred has its half where it was.
    Single cells follow the most of the 3 x 3 around them. The rim of the pressed cells then gets one depth along 3.5 mm of it,
    since depth has less noise than its curvature. Skin that hangs between the strokes of a letter, or over a groove, is deeper
    than that rim, but free: there, 3 x 3 cells or more that lie together bear less than half of the pressure of a flat face.
    Slopes that are noise have as much curl as divergence. Where depth explains too little of the slopes nearby, and is less than
    the unexplained part would add up to, nothing is pressed.

    Args:
        mm_per_pixel: pixel pitch, mm.
        share: of slope * L, from which a cell is pressed. One half is the middle of a sharp step; blur carries pressure outward,
            hence more.
    Source:
        membrane on an elastic foundation: Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, 1959; level from the
        rim: Yanowitz and Bruckstein, CVGIP 46(1), 1989; the rest is this project's.
    Example:
        >>> from torchvts.scenes import sphere_press
        >>> ball = sphere_press(10.0, 1.0, height=120, width=160, mm_per_pixel=0.1)
        >>> found = ContactFromDepth(0.1)(ball.depth_mm, ball.gradient, ball.contact)
        >>> bool((found & ~ball.contact).any())
        False
    """

    def __init__(self, mm_per_pixel: float, share: float = 0.8) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.share = check_positive("share", share)
        # a power of two, as the corners of windows are multiples of eight
        self.cell = 1
        while self.cell < 8 and 2 * self.cell * mm_per_pixel <= CELL_MM:
            self.cell *= 2
        self.reach = min(60, max(1, round(RIM_MM / (self.cell * mm_per_pixel))))
        self.decay, self.tail, self.least_free = DECAY_MM, TAIL, LEAST_FREE
        self.most_unexplained, self.free_share = 1.0 - EXPLAINED, 1.0 - FREE
        self.fall, self.inner = FALL, INNER
        self.noise_depth_mm = NOISE_DEPTH * (self.reach // 2) * self.cell * self.mm_per_pixel

    if TYPE_CHECKING:

        def __call__(self, depth_mm: Tensor, gradient: Tensor, deformed: Tensor) -> Tensor: ...

    def forward(self, depth_mm: Tensor, gradient: Tensor, deformed: Tensor) -> Tensor:
        """Contact of frames, or of windows of them.

        Args:
            depth_mm: (B, 1, H, W).
            gradient: (B, 2, H, W), mm per mm, as measured: that of depth itself does not show what is noise.
            deformed: (B, 1, H, W) bool, where the skin has moved; all of it lies within the window.
        Returns:
            (B, 1, H, W) bool, part of ``deformed``.
        Raises:
            ValueError: shapes that differ.
        """
        check_batch("depth_mm", depth_mm, 1)
        check_batch("gradient", gradient, 2)
        height, width = depth_mm.shape[2], depth_mm.shape[3]
        check_same_size("gradient", gradient, "depth_mm", height, width)
        check_mask("deformed", deformed)
        count = depth_mm.shape[0]
        if deformed.dim() != 4 or deformed.shape[1] != 1 or deformed.shape[0] != count or gradient.shape[0] != count:
            raise ValueError(
                f"gradient, deformed: expected {count} frames like depth_mm, got {list(gradient.shape)} and {list(deformed.shape)}"
            )
        check_same_size("deformed", deformed, "depth_mm", height, width)
        return self.find(depth_mm.detach(), gradient.detach(), deformed)

    def find(self, depth: Tensor, gradient: Tensor, deformed: Tensor) -> Tensor:
        """The same of checked inputs; compiled kernels replace this method."""
        height, width, cell = depth.shape[2], depth.shape[3], self.cell
        inside = deformed.to(torch.uint8).to(depth.dtype)
        level = self.rim_depth(cell_means(torch.cat((inside, depth * inside, gradient * inside), dim=1), cell))
        if cell > 1:
            level = level.repeat_interleave(cell, dim=2).repeat_interleave(cell, dim=3)[:, :, :height, :width]
        return deformed & (depth > level)

    def rim_depth(self, fields: Tensor) -> Tensor:
        """Depth of the rim of the contact nearby, (B, 1, h, w), infinite where there is none or where skin hangs free within it,
        and minus infinity near deep skin where none of the frame's hangs free and slopes are those of a surface.

        Args:
            fields: (B, 4, h, w): the deformed share of a cell, its depth and its two slopes times that share.
        """
        mass, some = fields[:, 0:1], fields[:, 0:1] > 0.0
        means = fields[:, 1:4] / mass.clamp_min(1e-6)
        depth, slope = means[:, 0:1], means[:, 1:3]
        bend = self.divergence(slope, some)
        smooth = _box(torch.cat((mass, fields[:, 1:2], bend * mass), dim=1), 1)
        smooth = smooth / smooth[:, 0:1].clamp_min(1e-6)
        smooth_depth, curvature = smooth[:, 1:2], smooth[:, 2:3]
        most = smooth_depth.amax(dim=(2, 3), keepdim=True)
        convex = curvature > smooth_depth / self.decay[1] ** 2  # a plane is not free
        deep = some & (smooth_depth > self.tail[0] * most)
        shallow = deep & (smooth_depth < self.tail[1] * most)
        free = shallow & convex
        number, of_deep, of_shallow = (mask.sum(dim=(2, 3), keepdim=True).to(depth.dtype) for mask in (free, deep, shallow))
        hangs = (number > self.least_free[0] * of_deep) | (number * number > self.least_free[1] * (of_deep * of_shallow))
        decay = self.squared_decay(smooth_depth.masked_fill(~free, 0.0), curvature)
        pressure = (depth - decay * bend).masked_fill(~some, 0.0)
        steep = slope.square().sum(dim=1, keepdim=True)
        nearby = torch.cat((steep, steep * torch.sqrt(steep), self.unexplained(depth, slope, some), depth.square()), dim=1)
        nearby = _box(nearby, self.reach // 2)
        by_slopes, by_depth = self.most_unexplained * nearby[:, 0:1], nearby[:, 3:4] / max(1e-9, self.noise_depth_mm**2)
        surface = nearby[:, 2:3] < torch.maximum(by_slopes, by_depth)
        least = self.share * torch.sqrt(decay) * nearby[:, 1:2] / nearby[:, 0:1].clamp_min(1e-9)
        most = (smooth_depth - decay * curvature).masked_fill(~some, 0.0).amax(dim=(2, 3), keepdim=True)
        pressed = self.pressed(pressure, torch.maximum(least, 0.1 * most), surface)
        around = _box(torch.cat((pressed, some), dim=1).to(depth.dtype), 1)
        share = around[:, 0:1] / around[:, 1:2].clamp_min(1e-6)  # of deformed cells: none lie beyond the image
        rim = ((share > 0.2) & (share < 0.8) & some).to(depth.dtype)
        found = _box(torch.cat((rim, rim * depth), dim=1), self.reach)
        level = found[:, 1:2] / found[:, 0:1].clamp_min(1e-9)
        infinite = torch.full_like(level, float("inf"))
        near_deep = _box(deep.to(depth.dtype), self.inner) > 1e-3
        far, all_or_none = infinite.masked_fill(pressed, 0.0), infinite.masked_fill(surface & near_deep, -float("inf"))
        level = torch.where(found[:, 0:1] > 1e-9, level, far)
        free = (decay * bend > self.free_share * depth) & (depth > level)
        whole = _box(free.to(depth.dtype), 1) > 0.95
        level = torch.where(_box(whole.to(depth.dtype), 1) > 0.05, infinite, level)
        return torch.where(hangs, level, all_or_none)

    def pressed(self, pressure: Tensor, least: Tensor, surface: Tensor) -> Tensor:
        """Cells (B, 1, h, w), bool, whose pressure exceeds the least one, and a share of that of such cells nearby."""
        found = surface & (pressure > least)
        counted = found.to(pressure.dtype)
        inner = _box(torch.cat((counted, counted * pressure), dim=1), self.inner)
        inside = inner[:, 1:2] / inner[:, 0:1].clamp_min(1e-6)
        found = found & (pressure > self.fall * inside)
        return _box(found.to(pressure.dtype), 1) > 0.5

    def divergence(self, slope: Tensor, some: Tensor) -> Tensor:
        """Of slopes (B, 2, h, w), per mm; beyond cells without deformed skin, and beyond the border, slopes go on as they are."""
        cell_mm = self.cell * self.mm_per_pixel
        along_x, along_y = slope[:, 0:1], slope[:, 1:2]
        right = torch.where(some[..., 1:], along_x[..., 1:], along_x[..., :-1])
        left = torch.where(some[..., :-1], along_x[..., :-1], along_x[..., 1:])
        below = torch.where(some[..., 1:, :], along_y[..., 1:, :], along_y[..., :-1, :])
        above = torch.where(some[..., :-1, :], along_y[..., :-1, :], along_y[..., 1:, :])
        right, left = torch.cat((right, along_x[..., -1:]), 3), torch.cat((along_x[..., :1], left), 3)
        below, above = torch.cat((below, along_y[..., -1:, :]), 2), torch.cat((along_y[..., :1, :], above), 2)
        return (right - left + below - above) / (2.0 * cell_mm)

    def unexplained(self, depth: Tensor, slope: Tensor, some: Tensor) -> Tensor:
        """Squares of slopes (B, 2, h, w) less those of depth (B, 1, h, w), between neighbouring cells of deformed skin."""
        cell_mm = self.cell * self.mm_per_pixel
        along_x, along_y, both = slope[:, 0:1], slope[:, 1:2], some[..., 1:] & some[..., :-1]
        right = 0.5 * (along_x[..., 1:] + along_x[..., :-1]) - (depth[..., 1:] - depth[..., :-1]) / cell_mm
        right = right.masked_fill(~both, 0.0).square()
        both = some[..., 1:, :] & some[..., :-1, :]
        below = 0.5 * (along_y[..., 1:, :] + along_y[..., :-1, :]) - (depth[..., 1:, :] - depth[..., :-1, :]) / cell_mm
        below = below.masked_fill(~both, 0.0).square()
        return nn.functional.pad(right, [0, 1]) + nn.functional.pad(below, [0, 0, 0, 1])

    def squared_decay(self, free: Tensor, curvature: Tensor) -> Tensor:
        """L^2 of each frame, (B, 1, 1, 1): that of laplace z = z / L^2 in free skin, whose depth is given and zero elsewhere."""
        squared = free.square().sum(dim=(2, 3), keepdim=True) / (free * curvature).sum(dim=(2, 3), keepdim=True).clamp_min(1e-9)
        return squared.clamp(self.decay[0] ** 2, self.decay[1] ** 2)


def above_tail(depth_mm: Tensor, deformed: Tensor, tail: Tensor, most: float = TAIL[1]) -> tuple[Tensor, Tensor]:
    """Depth from the edge beyond which moved skin goes on below the threshold, and the deformed area without that tail.

    Out there skin sinks with all of the gel, and rises more slowly than a membrane; what is deeper than the edge shows pressure.
    Skin deeper than free skin is, such as a flat face, stays.

    Args:
        depth_mm: (B, 1, H, W).
        deformed: (B, 1, H, W) bool.
        tail: (B, 1, H, W) bool, part of it: of :class:`ContactMask`.
        most: depth of free skin, as a share of a frame's largest.
    """
    tail = tail & (depth_mm < most * depth_mm.amax(dim=(2, 3), keepdim=True))
    core = deformed & ~tail
    border = (dilate_cross(tail) & core).to(torch.uint8).to(depth_mm.dtype)
    level = (depth_mm * border).sum(dim=(2, 3), keepdim=True) / border.sum(dim=(2, 3), keepdim=True).clamp_min(1.0)
    return torch.where(level > 0.0, (depth_mm - level).clamp_min(0.0), depth_mm), core


def _box(image: Tensor, reach: int) -> Tensor:
    """Mean over ``reach`` cells either way, by running sums; zero beyond the border."""
    side, height, width = 2 * reach + 1, image.shape[2], image.shape[3]
    sums = nn.functional.pad(image, [reach + 1, reach, reach + 1, reach]).cumsum(2)
    sums = (sums[:, :, side : side + height] - sums[:, :, :height]).cumsum(3)
    return (sums[..., side : side + width] - sums[..., :width]) / float(side * side)
