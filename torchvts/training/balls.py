"""Balls that are pressed: their true surface inside the contact."""

from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import Press
from ..core.geometry import pixel_grid_mm

RIM_PX = 3.0
"""Width of the ring inside the contact radius that is not scored: there the skin leaves the ball, and labels are a pixel off."""


class Truth(NamedTuple):
    """What a frame shows, float64.

    Attributes:
        depth_mm: (1, 1, H, W), mm, up to a constant: of a ball the height above its equator.
        gradient: (1, 2, H, W), its slope, mm per mm.
        region: (1, 1, H, W) bool, the pixels where depth and normals are scored.
        contact: (1, 1, H, W) bool, where the object touches; None if that is unknown.
        from_undeformed: whether depth is counted from the undeformed skin, and not up to a constant.
    """

    depth_mm: Tensor
    gradient: Tensor
    region: Tensor
    contact: Tensor | None = None
    from_undeformed: bool = False


def ball_truth(press: Press, height: int, width: int, mm_per_pixel: float) -> Truth:
    """The sphere that the skin follows inside the contact; the region is :data:`RIM_PX` smaller than the contact.

    Args:
        press: press with centre and contact radius.
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch, mm.
    Raises:
        ValueError: the press has no centre or no contact radius.
    Example:
        >>> press = Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0)
        >>> truth = ball_truth(press, 31, 31, 0.1)
        >>> round(float(truth.depth_mm[0, 0, 15, 15]), 3), int(truth.region.sum())
        (3.0, 305)
    """
    (center_x, center_y), contact_radius_px = label(press)
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    dx = x - (center_x - (width - 1) / 2) * mm_per_pixel
    dy = y - (center_y - (height - 1) / 2) * mm_per_pixel
    radius_mm = 0.5 * press.ball_diameter_mm
    r_squared = dx**2 + dy**2
    depth = torch.sqrt((radius_mm**2 - r_squared).clamp_min((0.2 * radius_mm) ** 2))
    gradient = -torch.stack((dx.expand_as(depth), dy.expand_as(depth))) / depth
    reach_mm = min((contact_radius_px - RIM_PX) * mm_per_pixel, 0.95 * radius_mm)
    region = (r_squared < reach_mm**2) if reach_mm > 0 else torch.zeros_like(depth, dtype=torch.bool)
    contact = r_squared < (contact_radius_px * mm_per_pixel) ** 2
    return Truth(depth[None, None], gradient[None], region[None, None], contact[None, None])


def label(press: Press) -> tuple[tuple[float, float], float]:
    """Centre (x, y) and contact radius of a press, pixels.

    Raises:
        ValueError: one of them is missing.
    """
    if press.center_px is None or press.contact_radius_px is None:
        raise ValueError(f"press: expected one with center_px and contact_radius_px, '{press.name}' has none: it cannot be scored")
    return press.center_px, press.contact_radius_px
