"""Conversions between depth, gradient, normal and points, in the axes of docs/conventions.md."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from .checks import check_batch, check_float_tensor, check_positive, check_same_size, check_shape, check_tensor

MAX_SLOPE = 10.0
"""Largest |dz/dx|, |dz/dy| that ``gradient_from_normal`` returns, mm per mm: 84.3 degrees from flat."""

CLIFF_SLOPE = 2.0
"""Difference of neighbouring slopes from which depth counts as a cliff, mm per mm."""


def pixel_grid_mm(
    height: int, width: int, mm_per_pixel: float, dtype: torch.dtype = torch.float32, device: torch.device | None = None
) -> tuple[Tensor, Tensor]:
    """Millimetre positions of the pixel centres: x (1, W) to the right, y (H, 1) down, zero at the image centre."""
    x = (torch.arange(width, dtype=dtype, device=device) - (width - 1) / 2.0) * mm_per_pixel
    y = (torch.arange(height, dtype=dtype, device=device) - (height - 1) / 2.0) * mm_per_pixel
    return x[None, :], y[:, None]


def lengths(vectors: Tensor, dim: int, keepdim: bool = False) -> Tensor:
    """Lengths of vectors along a dimension, as ``vectors.norm(dim=dim)``.

    On a CPU that takes thirty times as long (PyTorch 2.13) where the dimension is not the last, as in images.
    """
    squared = vectors.square().sum(dim, keepdim)
    some = squared > 0  # else the derivative at zero would be NaN
    return torch.where(some, torch.where(some, squared, 1.0).sqrt(), squared)


def angles_deg(one: Tensor, other: Tensor) -> Tensor:
    """Angles in degrees (B, H, W) between vectors (B, 3, H, W)."""
    return torch.rad2deg(torch.atan2(lengths(torch.linalg.cross(one, other, dim=1), 1), (one * other).sum(1)))


def normal_from_gradient(gradient: Tensor) -> Tensor:
    """Unit normals (B, 3, H, W) that face the camera, of gradients (B, 2, H, W), mm per mm: (-dz/dx, -dz/dy, 1) / norm.

    Example:
        >>> normal_from_gradient(torch.zeros(1, 2, 1, 1)).flatten() + 0.0
        tensor([0., 0., 1.])
    """
    check_batch("gradient", gradient, 2)
    p, q = gradient[:, 0:1], gradient[:, 1:2]
    n_z = torch.rsqrt(p * p + q * q + 1.0)
    return torch.cat((-p * n_z, -q * n_z, n_z), dim=1)


def gradient_from_normal(normal: Tensor, max_slope: float = MAX_SLOPE) -> Tensor:
    """Depth gradient of a normal map: p = -n_x / n_z, q = -n_y / n_z.

    Where a normal grazes (n_z below ``hypot(n_x, n_y) / max_slope``) or faces away, n_z is held at that bound, so the
    steepness never exceeds ``max_slope`` and its own gradient stays finite.

    Args:
        normal: (B, 3, H, W), of any length.
        max_slope: largest steepness hypot(p, q), mm per mm.
    Returns:
        (B, 2, H, W), (dz/dx, dz/dy), mm per mm.
    Source:
        eq. 5 of the paper.
    Example:
        >>> gradient_from_normal(torch.tensor([1.0, 0.0, 1e-6]).reshape(1, 3, 1, 1))[0, 0]
        tensor([[-10.]])
    """
    check_batch("normal", normal, 3)
    if not torch.jit.is_scripting():
        max_slope = check_positive("max_slope", max_slope)
    n_xy = normal[:, 0:2]
    tilt = torch.sqrt((n_xy * n_xy).sum(1, keepdim=True) + 1e-24)  # the constant keeps the root's own slope finite at 0
    return -n_xy / torch.maximum(normal[:, 2:3], tilt / max_slope)


def gradient_of_depth(depth_mm: Tensor, mm_per_pixel: float) -> Tensor:
    """Central differences of depth, (B, 1, H, W) in mm, to (B, 2, H, W), mm per mm; one-sided at the border."""
    z = depth_mm * (0.5 / mm_per_pixel)
    near, far = min(1, z.shape[3] - 1), max(0, z.shape[3] - 2)  # the lines next to the first and the last
    z_x = torch.cat((2.0 * z[..., :1] - z[..., near : near + 1], z, 2.0 * z[..., -1:] - z[..., far : far + 1]), dim=3)
    near, far = min(1, z.shape[2] - 1), max(0, z.shape[2] - 2)
    z_y = torch.cat((2.0 * z[:, :, :1] - z[:, :, near : near + 1], z, 2.0 * z[:, :, -1:] - z[:, :, far : far + 1]), dim=2)
    return torch.cat((z_x[..., 2:] - z_x[..., :-2], z_y[:, :, 2:] - z_y[:, :, :-2]), dim=1)


def slope_of_depth(depth_mm: Tensor, mm_per_pixel: float) -> Tensor:
    """Central differences of depth that do not reach across a cliff.

    Where the differences to the two neighbours differ by more than :data:`CLIFF_SLOPE`, the smaller one counts. At the image's
    border the outer difference is zero. (B, 1, H, W), mm, to (B, 2, H, W), mm per mm.
    """
    padded = nn.functional.pad(depth_mm, [1, 1, 1, 1], mode="replicate") / mm_per_pixel
    along_x, along_y = padded[..., 1:-1, 1:] - padded[..., 1:-1, :-1], padded[..., 1:, 1:-1] - padded[..., :-1, 1:-1]
    p = slope_beside_cliff(along_x[..., :-1], along_x[..., 1:])
    q = slope_beside_cliff(along_y[..., :-1, :], along_y[..., 1:, :])
    return torch.cat((p, q), dim=1)


def slope_beside_cliff(one: Tensor, other: Tensor, most: float = CLIFF_SLOPE) -> Tensor:
    """The mean of two slopes, or the smaller one where they differ by more than ``most``: a cliff must lie on one side."""
    smaller = torch.where(one.abs() < other.abs(), one, other)
    return torch.where((one - other).abs() < most, 0.5 * (one + other), smaller)


class GradientFromNormal(nn.Module):
    """Module for :func:`gradient_from_normal`."""

    def __init__(self, max_slope: float = MAX_SLOPE) -> None:
        super().__init__()
        self.max_slope = check_positive("max_slope", max_slope)

    if TYPE_CHECKING:

        def __call__(self, normal: Tensor) -> Tensor: ...

    def forward(self, normal: Tensor) -> Tensor:
        return gradient_from_normal(normal, self.max_slope)


def laplacian(depth: Tensor) -> Tensor:
    """Five-point Laplacian of depth (B, 1, H, W), of unit pitch, with a free border. Scripts."""
    padded = nn.functional.pad(depth, [1, 1, 1, 1], mode="replicate")
    beside = padded[..., 1:-1, 2:] + padded[..., 1:-1, :-2] + padded[..., 2:, 1:-1] + padded[..., :-2, 1:-1]
    return beside - 4.0 * depth


def depth_to_points(depth_mm: Tensor, mm_per_pixel: float, contact: Tensor | None = None) -> Tensor:
    """Points of one depth map in the right-handed frame: x right, **y up**, z towards the camera.

    Args:
        depth_mm: one frame, (H, W), (1, H, W) or (1, 1, H, W), mm.
        mm_per_pixel: pixel pitch, mm.
        contact: bool of the same size; only its pixels are kept. None keeps all.
    Returns:
        (N, 3) in mm, row by row.
    Raises:
        ValueError: more than one frame, or contact of another size.
    Example:
        >>> depth_to_points(torch.zeros(3, 3), 0.5)[0]
        tensor([-0.5000,  0.5000,  0.0000])
    """
    z = _one_frame("depth_mm", depth_mm)
    check_float_tensor("depth_mm", z)
    mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    x, y = pixel_grid_mm(z.shape[0], z.shape[1], mm_per_pixel, z.dtype, z.device)
    points = torch.stack((x.expand_as(z), -y.expand_as(z), z), dim=-1)  # (H, W, 3)
    if contact is None:
        return points.reshape(-1, 3)
    keep = _one_frame("contact", contact)
    check_same_size("contact", keep, "depth_mm", z.shape[0], z.shape[1])
    return points[keep.bool()]


def check_rigid(name: str, T: Tensor) -> Tensor:
    """Return ``T`` as (4, 4) float64, or raise if it is no rigid motion."""
    check_float_tensor(name, T)
    check_shape(name, T, (4, 4))
    T = T.detach().cpu().double()
    turn, last = T[:3, :3], torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    wrong = ""
    if not bool(torch.isfinite(T).all()):
        wrong = "values that are not finite"
    elif float((T[3] - last).abs().max()) > 1e-6:
        wrong = f"the last row {T[3].tolist()}, not 0, 0, 0, 1: transposed?"
    elif (off := float((turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs().max())) > 1e-3:
        wrong = f"columns that are not of length 1 at right angles, by {off:.2g}: a scale, or another unit?"
    elif float(torch.linalg.det(turn)) < 0.0:
        wrong = "a mirror image, determinant -1: an axis that points the other way?"
    if wrong:
        raise ValueError(f"{name}: expected a rigid motion (4, 4), a rotation and a shift in mm, got {wrong}")
    return T


def _one_frame(name: str, tensor: Tensor) -> Tensor:
    check_tensor(name, tensor)
    if tensor.dim() < 2 or tensor.numel() != tensor.shape[-1] * tensor.shape[-2]:
        raise ValueError(f"{name}: expected one frame, (H, W) or (1, 1, H, W), got {tuple(tensor.shape)}: loop over the batch")
    return tensor.reshape(tensor.shape[-2], tensor.shape[-1])
