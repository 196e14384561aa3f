"""The result of a registration: a pose, its quality, and the motions that the data do not determine."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


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
        inverse: Tensor = torch.linalg.inv(self.T_target_source)
        return inverse
