"""What a registration tells: a pose, how good it is, and what it cannot know."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Registration:
    """Where a source lies in the target's frame: ``p_target = T_target_source p_source``, mm, x right, y up, z to the camera.

    Attributes:
        T_target_source: (4, 4) float64, a rigid motion.
        rmse_mm: root mean square distance along the surface's normal, over the part where both agree.
        fitness: share of what both should show (the common contact) that agrees, 0 to 1.
        converged: whether the pose is to be trusted, up to what ``ambiguous`` and ``alternatives`` say.
        message: why, in a sentence.
        covariance: (6, 6) of a small motion ``p -> p + w x p + t`` after the pose, order (w_x, w_y, w_z, t_x, t_y, t_z), rad
            and mm; a direction that is not observable has a variance of 100 mm^2 or more at the contact.
        ambiguous: directions in which the surface slides on itself, in words; empty if there is none.
        alternatives: (4, 4) poses that fit as well, the object being symmetric; the best one is not among them.
        overlap: share of the smaller contact that could be compared, 0 to 1; 1 for clouds that are no reliefs.
    """

    T_target_source: Tensor
    rmse_mm: float
    fitness: float
    converged: bool
    message: str
    covariance: Tensor
    ambiguous: list[str] = field(default_factory=list)
    alternatives: list[Tensor] = field(default_factory=list)
    overlap: float = 1.0

    def inverse(self) -> Tensor:
        """T_source_target (4, 4)."""
        return invert(self.T_target_source)


def invert(T: Tensor) -> Tensor:
    """Inverse of rigid motions (..., 4, 4)."""
    turned = T[..., :3, :3].transpose(-1, -2)
    result = torch.zeros_like(T)
    result[..., :3, :3] = turned
    result[..., :3, 3] = -(turned @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def motion(twist: Tensor, center: Tensor | None = None) -> Tensor:
    """Rigid motions (..., 4, 4) of twists (..., 6): turned by w about an axis through ``center`` (the origin), then moved by t."""
    w, t = twist[..., :3], twist[..., 3:]
    zero = torch.zeros_like(w[..., 0])
    cross = torch.stack((zero, -w[..., 2], w[..., 1], w[..., 2], zero, -w[..., 0], -w[..., 1], w[..., 0], zero), -1)
    turned = torch.linalg.matrix_exp(cross.reshape(*w.shape[:-1], 3, 3))
    result = torch.zeros(*w.shape[:-1], 4, 4, dtype=twist.dtype, device=twist.device)
    result[..., :3, :3] = turned
    result[..., :3, 3] = t if center is None else t + center - (turned @ center[..., None])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def turn_deg(T: Tensor) -> Tensor:
    """Angle of the rotation of rigid motions (..., 4, 4), degrees; small angles keep their digits."""
    r = T[..., :3, :3]
    skew = torch.stack((r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]), -1)
    return torch.rad2deg(torch.atan2(skew.norm(dim=-1), r.diagonal(dim1=-2, dim2=-1).sum(-1) - 1.0))
