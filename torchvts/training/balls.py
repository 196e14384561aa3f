"""Balls that are pressed: their true surface inside the contact, and the sphere that fits measured depth."""

from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import Press
from ..core.checks import check_integer, check_tensor
from ..core.geometry import depth_to_points, pixel_grid_mm

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


class SphereFit(NamedTuple):
    """Least-squares sphere in the point frame (x right, y up, z towards the camera).

    Attributes:
        center_mm: its centre (x, y, z), mm.
        radius_mm: its radius, mm.
        rms_mm: RMS distance of the points from it, mm.
    """

    center_mm: tuple[float, float, float]
    radius_mm: float
    rms_mm: float


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


def fit_sphere(depth_mm: Tensor, mm_per_pixel: float, contact: Tensor, steps: int = 20) -> SphereFit:
    """Geometric least-squares sphere through the points of the contact: algebraic start, then Gauss-Newton on the distance.

    Args:
        depth_mm: depth of one frame, mm.
        mm_per_pixel: pixel pitch, mm.
        contact: bool, the same shape, the pixels to fit.
        steps: most Gauss-Newton steps; fewer are made where the sphere does not move any more.
    Raises:
        ValueError: fewer than 4 points, or depth that is not finite or beyond 1e6 mm.
    """
    check_integer("steps", steps, 0)
    check_tensor("contact", contact)
    points = depth_to_points(depth_mm, mm_per_pixel, contact).double()
    if not bool((points.abs() <= 1e6).all()):  # also NaN
        raise ValueError(
            "depth_mm: expected finite values of at most 1e6 mm, got others in the contact: an upstream division failed"
        )
    if len(points) < 4:
        raise ValueError(f"contact: expected at least 4 pixels, got {len(points)}: no contact, no sphere")
    mean = points.mean(0)
    centred = points - mean
    columns = torch.cat((2 * centred, torch.ones(len(points), 1, dtype=torch.float64)), 1)
    solution = torch.linalg.lstsq(columns, centred.square().sum(1, keepdim=True)).solution[:, 0]
    center, radius = solution[:3], (solution[3] + solution[:3].square().sum()).clamp_min(0).sqrt()
    for _ in range(steps):
        offset = centred - center
        distance = offset.norm(dim=1, keepdim=True)
        jacobian = torch.cat((-offset / distance, -torch.ones_like(distance)), 1)
        step = torch.linalg.lstsq(jacobian, distance - radius).solution[:, 0]
        center, radius = center - step[:3], radius - step[3]
        if not float(step.abs().max()) > 1e-14 * float(radius.abs()):  # also NaN, where the points lie in a plane
            break
    rms = ((centred - center).norm(dim=1) - radius).square().mean().sqrt()
    x, y, z = (center + mean).tolist()
    return SphereFit((x, y, z), float(radius), float(rms))
