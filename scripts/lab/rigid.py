"""Rigid motions as tensors, for benches and tests."""

import torch
from torch import Tensor

from torchvts.pose.rigid import rigid_motion


def invert(T: Tensor) -> Tensor:
    """Inverse of rigid motions (..., 4, 4)."""
    inverse: Tensor = torch.linalg.inv(T)
    return inverse


def motion(twist: Tensor, center: Tensor | None = None) -> Tensor:
    """Rigid motions (..., 4, 4) of twists (..., 6): rotation by w about ``center`` (default: the origin), then shift by t."""
    about = torch.zeros(3, dtype=torch.float64) if center is None else center
    return torch.from_numpy(rigid_motion(twist.double().numpy(), about.double().numpy())).to(twist.dtype)


def turn_deg(T: Tensor) -> Tensor:
    """Rotation angle of rigid motions (..., 4, 4), degrees; accurate for small angles too."""
    r = T[..., :3, :3]
    skew = torch.stack((r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]), -1)
    return torch.rad2deg(torch.atan2(skew.norm(dim=-1), r.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0))
