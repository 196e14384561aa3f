"""Metrics of frames against an exact truth: depth, normals, contact mask; and the sphere that fits measured depth."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchvts.core.checks import check_integer, check_tensor
from torchvts.core.geometry import angles_deg, depth_to_points


class DepthError(NamedTuple):
    """Depth error of one or more frames.

    Attributes:
        max_mm: largest absolute error, mm.
        rms_mm: RMS error, mm.
        max_px: largest absolute error, pixels of pitch.
        rms_px: RMS error, pixels of pitch.
    """

    max_mm: float
    rms_mm: float
    max_px: float
    rms_px: float


def depth_error(depth_mm: Tensor, truth_mm: Tensor, mm_per_pixel: float, region: Tensor | None = None) -> DepthError:
    """Largest and RMS depth error.

    Args:
        depth_mm: measured depth, mm.
        truth_mm: true depth, the same shape, mm.
        mm_per_pixel: pixel pitch, mm.
        region: bool, the same shape, the pixels to compare; None for all.
    Example:
        >>> import torch
        >>> depth_error(torch.full((1, 1, 4, 4), 0.5), torch.zeros(1, 1, 4, 4), 0.25).max_px
        2.0
    """
    error = (depth_mm - truth_mm).double() if region is None else (depth_mm[region.bool()] - truth_mm[region.bool()]).double()
    largest, rms = float(error.abs().max()), float(error.square().mean().sqrt())
    return DepthError(largest, rms, largest / mm_per_pixel, rms / mm_per_pixel)


def normal_angle_deg(normal: Tensor, truth: Tensor, region: Tensor | None = None) -> Tensor:
    """Angles between two maps of unit normals (B, 3, H, W), degrees, (B, H, W), or (N,) inside a region (B, 1, H, W)."""
    angle = angles_deg(normal, truth)
    return angle if region is None else angle[region[:, 0].bool()]


def mask_iou(mask: Tensor, truth: Tensor) -> float:
    """Intersection over union of two masks; 1 if both are empty."""
    union = int((mask.bool() | truth.bool()).sum())
    return int((mask.bool() & truth.bool()).sum()) / union if union else 1.0


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
