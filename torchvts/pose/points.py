"""Pose from two point clouds: as height maps where they are such, else by Open3D."""

import numpy as np
import torch
from torch import Tensor

from ..core.checks import check_float_tensor, check_tensor
from ..core.geometry import check_rigid
from .features import LEAST_POINTS, Cloud, register_features
from .height_maps import register_height_maps
from .result import Registration


def register_points(
    source: Tensor,
    target: Tensor,
    *,
    source_normals: Tensor | None = None,
    target_normals: Tensor | None = None,
    initial: Tensor | None = None,
) -> Registration:
    """Pose of one point cloud relative to another.

    Clouds of all pixels of a contact (``contact_cloud(frame, pitch, most=None)``) are drawn on the grid that they come from and
    registered as :func:`register_depth` does. All others, thinned, moved or of any shape, go to Open3D: FPFH features, sample
    consensus, iterated closest points; other poses of a symmetric object are then not listed.

    Args:
        source: (N, 3), mm, right-handed, x right, y up, z to the camera (:func:`torchvts.depth_to_points`).
        target: (M, 3), likewise.
        source_normals: unit normals of the source, of the same shape; None estimates them from the points. Photometric normals
            are better than any estimate.
        target_normals: unit normals of the target, likewise.
        initial: T_target_source (4, 4) to try first.
    Returns:
        The registration; ``converged`` is False if nothing fits.
    Raises:
        ValueError: not (N, 3), not finite, fewer than 10 distinct points, or points on one line.
        TypeError: no tensors.
        ImportError: Open3D is needed and not installed.
    Example:
        >>> from torchvts.pose import contact_cloud
        >>> from torchvts.scenes import objects
        >>> frame = objects.press(objects.stamp("T"), objects.pose(0.0), 96, 128, 0.125)
        >>> points, normals = contact_cloud(frame, 0.125, most=None)
        >>> shift = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
        >>> reg = register_points(points, points + shift, source_normals=normals, target_normals=normals)
        >>> reg.converged, bool((reg.T_target_source[:3, 3] - shift).abs().max() < 0.01)
        (True, True)
    """
    a = _check_cloud("source", source, source_normals)
    b = _check_cloud("target", target, target_normals)
    start = None if initial is None else check_rigid("initial", initial)
    found = register_height_maps(a, b, start)
    return register_features(a, b, start) if found is None else found


def _check_cloud(name: str, points: Tensor, normals: Tensor | None) -> Cloud:
    """A cloud in float64 without duplicate points, or raise."""
    check_float_tensor(name, points)
    if points.dim() != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected (N, 3), got {tuple(points.shape)}")
    if len(points) == 0:
        raise ValueError(f"{name}: expected points, got none: no contact?")
    points = points.detach().resolve_neg().cpu().double()
    if not bool(torch.isfinite(points).all()):
        raise ValueError(f"{name}: expected finite points, got {int((~torch.isfinite(points)).any(1).sum())} with NaN or infinity")
    if normals is not None:
        check_tensor(f"{name}_normals", normals)
        if tuple(normals.shape) != tuple(points.shape):
            raise ValueError(f"{name}_normals: expected {tuple(points.shape)} like the points, got {tuple(normals.shape)}")
        normals = torch.nn.functional.normalize(normals.detach().cpu().double(), dim=1)
        if not bool((normals.norm(dim=1) > 0.5).all()):  # NaN too
            raise ValueError(f"{name}_normals: expected finite normals, got NaN, infinite or zero ones")
    first = np.sort(np.unique(points.numpy(), axis=0, return_index=True)[1])
    if len(first) < LEAST_POINTS:
        raise ValueError(f"{name}: expected at least {LEAST_POINTS} distinct points, got {len(first)} of {len(points)}")
    points, normals = points[first], None if normals is None else normals[first]
    spread = torch.linalg.svdvals(points - points.mean(0))
    if float(spread[1]) < 1e-6 * float(spread[0]):
        raise ValueError(f"{name}: expected a surface, got points on one line")
    return Cloud(points, normals)
