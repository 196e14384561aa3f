"""The result of a registration: a pose, its quality, and the motions that the data do not determine."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from .rigid import rigid_motion


@dataclass(frozen=True, eq=False)
class Registration:
    """Pose of a source in the target's frame: ``p_target = T_target_source p_source``, mm, x right, y up, z to the camera.

    Attributes:
        T_target_source: (4, 4) float64, a rigid motion.
        rmse_mm: root mean square difference over the part where both agree, mm: of heights, of clouds along the normal.
        fitness: share of the common contact that agrees, 0 to 1.
        converged: whether the pose can be trusted, except for what ``ambiguous`` and ``alternatives`` list.
        message: the reason, in one sentence.
        covariance: (6, 6) of a small motion ``p -> p + w x p + t`` after the pose, order (w_x, w_y, w_z, t_x, t_y, t_z), rad
            and mm; a direction that is not observable has a variance of 100 mm^2 or more at the contact.
        ambiguous: names of the motions under which the surface slides on itself; empty if there is none.
        alternatives: (4, 4) poses that fit equally well because the object is symmetric, and differ by more than motions of
            ``ambiguous``; the best pose is not among them.
        overlap: share of the smaller contact that could be compared, 0 to 1; 1 for clouds.
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
