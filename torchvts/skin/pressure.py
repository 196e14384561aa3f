"""Where the object touches the skin, from depth: the part of it that bears a pressure."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights
from ..core.cells import cells_to_pixels, whole_cell_means
from ..core.checks import check_batch, check_decay, check_mask, check_positive, check_record
from ..core.geometry import laplacian
from ..model.calibration import Calibration, check_calibration
from .settings import ContactSettings

CELL_MM = 0.06
"""Side of the cells in which pressure is found, about."""

BLUR_MM = 0.1
"""Blur of depth before its curvature is taken; 0.16 is as good on balls and 0.01 of IoU worse on shapes."""

CONTACT_DECAY_MM = 0.45
"""Longest L of contact, in frames and from presses; that of zero.py is chosen by depth."""

SHARE = 0.3
"""Share of the frame's pressure where no press of a ball shows it: a unit's own is 0.15 to 0.6."""

LARGE = 0.9
"""The frame's pressure is this quantile of the deep skin's: rims of flat faces bear more than the faces."""

DEEP_SHARE = 0.15
"""Depth of the deep skin, as a share of the deepest."""

LEAST_DEEP = 0.005
"""Skin shallower than this share of the deepest says nothing of a pressure."""

RIM_MM = 0.4
"""Skin just inside a rim lies within this, either way."""

FALL = 0.6
"""Pressure at a rim, as a share of that just inside: it falls to zero there, and blur makes a slope of that step."""

PULL = 0.02
"""Skin pulls where its pressure is below minus this share of the largest depth: L of contact is longer than the skin's own."""

PULLING = 0.5
"""Share of the hollow skin's curvature that may pull."""

KINK = 2.0
"""A kink at the rim of an object without skin has L^2 of this number times that of the blur: depth is blurred as much again."""

PULL_STEPS = 64
"""L^2 of a frame is found in so many steps."""

LEAST_CONTACT_DEPTH = 0.02
"""Contact is deeper than this share of the largest depth."""

CONTACT_SAMPLES = 120
"""Samples of the frame's pressure along the shorter side."""


class ContactFromDepth(nn.Module):
    """Contact of depth frames: where the pressure p = z - L^2 laplace z exceeds a share of the frame's, and of that just inside.

    Skin in contact follows the object; around it the skin hangs free and bears no pressure. Real skin is no thin membrane, so that
    deep free skin seems to bear some: the share belongs to the gel, and calibration finds it from presses of balls.

    L is :data:`CONTACT_DECAY_MM`, or as short as hollow skin shows, for free skin is hollow and does not pull. Presses of balls
    show it best, and calibration takes their median. Without presses each frame shows its own, and the shares fall with L^2. Where
    L is 0, as in renders without skin around the object, all depth is contact.

    Args:
        mm_per_pixel: pixel pitch, mm.
        share: of the frame's pressure; None for the usual one.
        decay_mm: L, mm; None to find it in each frame.
    Source:
        membrane on an elastic foundation: Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, 1959; the rest is this
        project's.
    Example:
        >>> from torchvts.scenes import sphere_press
        >>> ball = sphere_press(10.0, 1.0, height=120, width=160, mm_per_pixel=0.1)
        >>> found = ContactFromDepth(0.1, share=0.2)(ball.depth_mm, ball.contact)
        >>> bool(((found ^ ball.contact).sum() / ball.contact.sum()) < 0.1)
        True
    """

    def __init__(self, mm_per_pixel: float, share: float | None = None, decay_mm: float | None = None) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.share = SHARE if share is None else check_positive("share", share, 1.0)
        self.cell = max(1, round(CELL_MM / mm_per_pixel))
        self.large, self.deep, self.rim_mm, self.fall = LARGE, DEEP_SHARE, RIM_MM, FALL
        self.by_frame = decay_mm is None
        self.decay_mm = CONTACT_DECAY_MM if decay_mm is None else check_decay("decay_mm", decay_mm)
        self.blur_mm, self.least_deep = BLUR_MM, LEAST_DEEP
        self.pull, self.pulling, self.kink, self.steps, self.least_depth = PULL, PULLING, KINK, PULL_STEPS, LEAST_CONTACT_DEPTH

    @classmethod
    def from_calibration(cls, calibration: Calibration, settings: ContactSettings | None = None) -> "ContactFromDepth":
        """The block of a calibrated unit, with its own share and L where settings do not say otherwise."""
        check_calibration("calibration", calibration)
        settings = ContactSettings() if settings is None else settings
        check_record("settings", settings, ContactSettings, "ContactSettings() makes one")
        share = calibration.contact_share if settings.share is None else settings.share
        decay_mm = calibration.contact_decay_mm if settings.decay_mm is None else settings.decay_mm
        return cls(calibration.sensor.mm_per_pixel, share, decay_mm)

    if TYPE_CHECKING:

        def __call__(self, depth_mm: Tensor, deformed: Tensor) -> Tensor: ...

    def forward(self, depth_mm: Tensor, deformed: Tensor) -> Tensor:
        """Depth (B, 1, H, W), and where the skin has moved, bool (B, 1, H, W), to contact, bool (B, 1, H, W), part of it.

        Raises:
            ValueError: shapes that differ.
        """
        check_batch("depth_mm", depth_mm, 1)
        check_mask("deformed", deformed)
        if deformed.shape != depth_mm.shape:
            raise ValueError(f"deformed: expected {list(depth_mm.shape)} like depth_mm, got {list(deformed.shape)}")
        height, width = depth_mm.shape[2], depth_mm.shape[3]
        cell = min(self.cell, height, width)
        above = self.above(self.blurred(depth_mm.detach(), cell), cell * self.mm_per_pixel)
        return deformed & (cells_to_pixels(above, cell, height, width) > 0.0)

    def decays_mm(self, depth_mm: Tensor) -> Tensor:
        """L of each frame of depth (B, 1, H, W), (B,), mm."""
        check_batch("depth_mm", depth_mm, 1)
        cell = min(self.cell, depth_mm.shape[2], depth_mm.shape[3])
        depth = self.blurred(depth_mm.detach(), cell)
        curvature = laplacian(depth) / (cell * self.mm_per_pixel) ** 2
        return self.decay_of(depth, curvature, depth.amax(dim=(2, 3), keepdim=True)).sqrt().flatten()

    def blurred(self, depth: Tensor, cell: int) -> Tensor:
        """Depth of cells, blurred, whose curvature is taken, (B, 1, h, w)."""
        return blur(whole_cell_means(depth, cell), gaussian_weights(self.blur_mm / (cell * self.mm_per_pixel)))

    def above(self, depth: Tensor, pitch_mm: float) -> Tensor:
        """Pressure less what contact needs, (B, 1, h, w): a share of the frame's, and of that just inside of the rim."""
        deepest = depth.amax(dim=(2, 3), keepdim=True)
        curvature = laplacian(depth) / pitch_mm**2
        decay = self.decay_of(depth, curvature, deepest)
        soft = decay / max(self.decay_mm**2, 1e-9)
        pressure = depth - decay * curvature
        large = frame_quantile(pressure, (depth > self.deep * deepest).to(depth.dtype), self.large)
        least = torch.maximum(soft * self.share * large, self.least_depth * deepest)
        touching = (pressure > least).to(pressure.dtype)
        reach = rim_reach(self.rim_mm, pitch_mm)
        inside = box_mean(touching * pressure, reach) / box_mean(touching, reach).clamp_min(1e-9)
        return pressure - torch.maximum(least, soft * self.fall * inside)

    def decay_of(self, depth: Tensor, curvature: Tensor, deepest: Tensor) -> Tensor:
        """L^2 of each frame, (B, 1, 1, 1): the unit's, or as short as hollow skin shows."""
        if not self.by_frame:
            return torch.full_like(deepest, self.decay_mm**2)
        hollow = torch.where(depth > self.least_deep * deepest, curvature.clamp_min(0.0), 0.0)
        not_pulling = (depth + self.pull * deepest) / curvature - self.kink * self.blur_mm**2  # L^2 from which it pulls
        step = self.decay_mm**2 / self.steps
        return frame_quantile((not_pulling / step).clamp(0.0, float(self.steps)), hollow, self.pulling).floor() * step


def rim_reach(rim_mm: float, pitch_mm: float) -> int:
    """Cells within which skin just inside a rim lies."""
    return max(1, int(rim_mm / pitch_mm + 0.5))


def frame_quantile(values: Tensor, weights: Tensor, share: float, samples: int = CONTACT_SAMPLES) -> Tensor:
    """A quantile of the weighed values of each frame (B, 1, h, w), (B, 1, 1, 1); 0 where nothing weighs."""
    step = max(1, min(values.shape[2], values.shape[3]) // samples)
    weights = weights[:, :, step // 2 :: step, step // 2 :: step].flatten(1)
    values = values[:, :, step // 2 :: step, step // 2 :: step].flatten(1)
    ordered, order = torch.where(weights > 0.0, values, torch.inf).sort(dim=1)
    total = weights.sum(dim=1, keepdim=True)
    below = (weights.gather(1, order).cumsum(dim=1) < share * total).sum(dim=1, keepdim=True)
    found = ordered.gather(1, below.clamp_max(ordered.shape[1] - 1))
    return torch.where(total > 0.0, found, 0.0)[:, :, None, None]


def box_mean(image: Tensor, reach: int) -> Tensor:
    """Mean over ``reach`` pixels either way; zero beyond the border."""
    side = 2 * reach + 1
    return nn.functional.avg_pool2d(nn.functional.avg_pool2d(image, (side, 1), 1, (reach, 0)), (1, side), 1, (0, reach))
