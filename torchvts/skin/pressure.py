"""Where the object touches the skin, from depth: the part of it that bears a pressure."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights
from ..core.cells import cells_to_pixels, whole_cell_means
from ..core.checks import check_batch, check_mask, check_positive, check_record
from ..model.calibration import Calibration, check_calibration
from .settings import ContactSettings

CELL_MM = 0.06
"""Side of the cells in which pressure is found, about."""

BLUR_MM = 0.1
"""Blur of depth before its curvature is taken; 0.16 is as good on balls and 0.01 of IoU worse on shapes."""

CONTACT_DECAY_MM = 0.45
"""L of contact; that of zero.py is chosen by depth. With a unit's best share, IoU is the same within 0.01 in the mean over sets
from 0.4 to 0.7: larger is better on drawn shapes (0.90 for 0.89), smaller on balls on real sensors (0.89 for 0.86)."""

SHARE = 0.3
"""Share of the frame's pressure where no press of a ball shows it: a unit's own is 0.15 to 0.6."""

LARGE = 0.9
"""The frame's pressure is this quantile of the deep skin's: rims of flat faces bear more than the faces."""

DEEP = 0.15
"""Depth of the deep skin, as a share of the deepest."""

LEAST_DEEP = 0.005
"""That share is this at least: shallower skin says nothing of a pressure."""

RIM_MM = 0.4
"""Skin just inside a rim lies within this, either way."""

FALL = 0.6
"""Pressure at a rim, as a share of that just inside: it falls to zero there, and blur makes a slope of that step. Without
it, IoU of drawn shapes is 0.88 in place of 0.91."""

PULLED = 0.11
"""Negative pressure, as a share of the frame's, that no skin bears: a fiftieth of the skin pulls by 0.06 at most on real and drawn
sensors, and by 0.16 and more where an object is rendered without the skin that hangs around it."""

PULLING = 0.02
"""That share of the skin."""

LEAST_CONTACT_DEPTH = 0.02
"""Depth of contact without such skin, as a share of the deepest."""

SAMPLES = 80
"""Samples of the frame's pressure along the shorter side."""


class ContactFromDepth(nn.Module):
    """Contact of depth frames: where the pressure p = z - L^2 laplace z exceeds a share of the frame's, and of that just inside.

    Skin in contact follows the object; around it the skin hangs free and bears no pressure. Real skin is no thin membrane, so that
    deep free skin seems to bear some: the share belongs to the gel, and calibration finds it from presses of balls.

    Where a rim pulls, as in renders of an object without skin around it, all depth is contact.

    Args:
        mm_per_pixel: pixel pitch, mm.
        share: of the frame's pressure; None for the usual one.
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

    def __init__(self, mm_per_pixel: float, share: float | None = None) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.share = SHARE if share is None else check_positive("share", share, 1.0)
        self.cell = max(1, round(CELL_MM / mm_per_pixel))
        self.large, self.deep, self.rim_mm, self.fall = LARGE, DEEP, RIM_MM, FALL
        self.pulled, self.pulling, self.least_depth = PULLED, PULLING, LEAST_CONTACT_DEPTH

    @classmethod
    def from_calibration(cls, calibration: Calibration, settings: ContactSettings | None = None) -> "ContactFromDepth":
        """The block of a calibrated unit, with its own share where settings do not say otherwise."""
        check_calibration("calibration", calibration)
        settings = ContactSettings() if settings is None else settings
        check_record("settings", settings, ContactSettings, "ContactSettings() makes one")
        return cls(calibration.sensor.mm_per_pixel, calibration.contact_share if settings.share is None else settings.share)

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
        depth = whole_cell_means(depth_mm.detach(), cell)
        pressure = pressure_of(depth, cell * self.mm_per_pixel)
        above = self.above(depth, pressure, cell * self.mm_per_pixel)
        return deformed & (cells_to_pixels(above, cell, height, width) > 0.0)

    def above(self, depth: Tensor, pressure: Tensor, pitch_mm: float) -> Tensor:
        """Pressure less what contact needs, (B, 1, h, w): a share of the frame's, and of that just inside of the rim."""
        large, pulled = frame_pressure(depth, pressure, self.large, self.deep), -frame_pressure(depth, pressure, self.pulling, 0.0)
        touching = (pressure > self.share * large).to(pressure.dtype)
        reach = rim_reach(self.rim_mm, pitch_mm)
        inside = box_mean(touching * pressure, reach) / box_mean(touching, reach).clamp_min(1e-9)
        deepest = depth.amax(dim=(2, 3), keepdim=True)
        with_skin = pressure - torch.maximum(self.share * large, self.fall * inside)
        return torch.where(pulled > self.pulled * large, depth - self.least_depth * deepest, with_skin)


def pressure_of(depth_mm: Tensor, pitch_mm: float, blur_mm: float = BLUR_MM, decay_mm: float = CONTACT_DECAY_MM) -> Tensor:
    """Pressure p = z - L^2 laplace z of skin of depth z, (B, 1, h, w), as a depth, mm."""
    z = blur(depth_mm, gaussian_weights(blur_mm / pitch_mm))
    z = nn.functional.pad(z, [1, 1, 1, 1], mode="replicate")
    middle = z[:, :, 1:-1, 1:-1]
    around = z[:, :, 1:-1, 2:] + z[:, :, 1:-1, :-2] + z[:, :, 2:, 1:-1] + z[:, :, :-2, 1:-1]
    return middle - (decay_mm / pitch_mm) ** 2 * (around - 4.0 * middle)


def rim_reach(rim_mm: float, pitch_mm: float) -> int:
    """Cells within which skin just inside a rim lies."""
    return max(1, int(rim_mm / pitch_mm + 0.5))


def frame_pressure(
    depth_mm: Tensor, pressure: Tensor, share: float, depth: float, samples: int = SAMPLES, least: float = LEAST_DEEP
) -> Tensor:
    """A quantile of the pressure of each frame (B, 1, h, w), (B, 1, 1, 1), over skin deeper than a share of the deepest."""
    step = max(1, min(depth_mm.shape[2], depth_mm.shape[3]) // samples)
    deepest = depth_mm.amax(dim=(2, 3), keepdim=True)
    deep = depth_mm > max(depth, least) * deepest
    some = deep[:, :, step // 2 :: step, step // 2 :: step].flatten(1)
    values = pressure[:, :, step // 2 :: step, step // 2 :: step].flatten(1)
    ordered = torch.where(some, values, torch.inf).sort(dim=1).values
    count = some.sum(dim=1, keepdim=True)
    found = ordered.gather(1, (share * (count - 1).clamp_min(0)).long())
    return torch.where(count > 0, found, 0.0)[:, :, None, None]


def box_mean(image: Tensor, reach: int) -> Tensor:
    """Mean over ``reach`` pixels either way; zero beyond the border."""
    side = 2 * reach + 1
    return nn.functional.avg_pool2d(nn.functional.avg_pool2d(image, (side, 1), 1, (reach, 0)), (1, side), 1, (0, reach))
