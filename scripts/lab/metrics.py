"""Metrics of frames against an exact truth: depth, normals, contact mask, fitted sphere."""

from typing import NamedTuple

from torch import Tensor

from torchvts.core.checks import check_batch, check_float_tensor, check_positive, check_shape, check_tensor
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
    Raises:
        ValueError: shapes differ, or the region is empty.
    Example:
        >>> import torch
        >>> depth_error(torch.full((1, 1, 4, 4), 0.5), torch.zeros(1, 1, 4, 4), 0.25).max_px
        2.0
    """
    check_float_tensor("truth_mm", truth_mm)
    check_float_tensor("depth_mm", depth_mm)
    mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    error = (_inside("depth_mm", depth_mm, truth_mm, region) - _inside("truth_mm", truth_mm, truth_mm, region)).double()
    largest, rms = float(error.abs().max()), float(error.square().mean().sqrt())
    return DepthError(largest, rms, largest / mm_per_pixel, rms / mm_per_pixel)


def normal_angle_deg(normal: Tensor, truth: Tensor, region: Tensor | None = None) -> Tensor:
    """Angles between two maps of unit normals.

    The cross product enters too, so small angles keep their digits.

    Args:
        normal: (B, 3, H, W), measured normals.
        truth: (B, 3, H, W), true normals.
        region: (B, 1, H, W) bool, the pixels to compare; None for all.
    Returns:
        Degrees, (B, H, W), or (N,) inside the region.
    """
    check_batch("truth", truth, 3)
    check_batch("normal", normal, 3)
    check_shape("normal", normal, truth.shape, "truth")
    if truth.dtype != normal.dtype:
        raise TypeError(f"truth: expected {normal.dtype} like normal, got {truth.dtype}: convert one of them")
    if region is not None:
        check_shape("region", region, (normal.shape[0], 1, *normal.shape[2:]), "one channel of normal")
    angle = angles_deg(normal, truth)
    return angle if region is None else angle[region[:, 0].bool()]


def mask_iou(mask: Tensor, truth: Tensor) -> float:
    """Intersection over union of two masks; 1 if both are empty."""
    check_tensor("truth", truth)
    check_shape("mask", mask, truth.shape, "truth")
    union = int((mask.bool() | truth.bool()).sum())
    return int((mask.bool() & truth.bool()).sum()) / union if union else 1.0


def _inside(name: str, values: Tensor, truth: Tensor, region: Tensor | None) -> Tensor:
    check_shape(name, values, truth.shape, "truth_mm")
    if region is None:
        return values
    check_shape("region", region, truth.shape, "truth_mm")
    if not bool(region.any()):
        raise ValueError("region: expected at least one pixel, got none: no contact was found")
    return values[region.bool()]
