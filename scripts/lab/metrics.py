"""Metrics of frames against an exact truth: depth, normals, contact mask."""

from typing import NamedTuple

from torch import Tensor

from torchvts.core.geometry import angles_deg


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
