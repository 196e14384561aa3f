r"""Depth as a pinhole camera sees it: the logarithm of distance has an exact gradient, so any integrator serves.

A pinhole at height h above the image centre, whose pixels see (u, v) of the undeformed skin, sees the surface z(X, Y) at
X = u (h - z) / h, Y = v (h - z) / h. With p = dz/dX, q = dz/dY, differentiating z(X(u, v), Y(u, v)) gives

    dz/du (h + p u + q v) = p (h - z),   so   w = -h ln((h - z) / h)   has   dw/du = h p / (h + p u + q v),

dw/dv likewise with q. w is depth to first order, zero where z is, and z = h (1 - exp(-w / h)).
"""

import torch
from torch import Tensor, nn

from ..core.checks import check_pitch, check_positive, check_record
from ..core.geometry import pixel_grid_mm
from .base import Integrator
from .poisson import PoissonBackground, check_gradient

LEAST_COSINE = 0.05
"""Of h + p u + q v, relative to h: a surface steeper than that turns away from the camera."""


def integrate_perspective(gradient: Tensor, mm_per_pixel: float, camera_height_mm: float) -> Tensor:
    """Integrate the gradient of a surface seen by a pinhole camera.

    Args:
        gradient: (B, 2, H, W), (dz/dx, dz/dy) of the surface at the point that each pixel sees, mm per mm.
        mm_per_pixel: pixel pitch in mm, on the undeformed skin.
        camera_height_mm: of the camera above the undeformed skin, over the image centre.
    Returns:
        Depth in mm of the point that each pixel sees, (B, 1, H, W), with its zero as by :func:`poisson_background`.
    Raises:
        ValueError: wrong shape, or H or W below 2; pitch or height not above 0. TypeError: not floating point.
    Source:
        Tankus, Sochen, Yeshurun, Shape-from-shading under perspective projection, IJCV 63(1), 2005: the logarithm of depth;
        Queau, Durou, Aujol, Normal integration: a survey, JMIV 60, 2018.
    Example:
        >>> integrate_perspective(torch.zeros(1, 2, 8, 8), 0.1, 30.0).shape
        torch.Size([1, 1, 8, 8])
    """
    depth: Tensor = PerspectiveIntegration(mm_per_pixel, camera_height_mm)(gradient)
    return depth


class PerspectiveIntegration(Integrator):
    """Module for :func:`integrate_perspective`; takes PoissonDCT's place in a pipeline.

    Its normals should know of the camera as well: ``NormalFromIntensity.from_calibration(calibration, camera_height_mm)``.

    Args:
        mm_per_pixel: pixel pitch in mm, on the undeformed skin.
        camera_height_mm: of the camera above the undeformed skin.
        integrate: any integrator; None for PoissonBackground.
    """

    poisson = PoissonBackground

    def __init__(self, mm_per_pixel: float, camera_height_mm: float, integrate: nn.Module | None = None) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.camera_height_mm = check_positive("camera_height_mm", camera_height_mm)
        self.least_facing_mm = LEAST_COSINE * self.camera_height_mm
        self.integrate: nn.Module = self.poisson(mm_per_pixel) if integrate is None else integrate
        check_record("integrate", self.integrate, nn.Module)
        check_pitch("integrate", self.integrate, mm_per_pixel)

    def forward(self, gradient: Tensor) -> Tensor:
        check_gradient(gradient, 2)
        u, v = pixel_grid_mm(gradient.shape[2], gradient.shape[3], self.mm_per_pixel, gradient.dtype, gradient.device)
        h = self.camera_height_mm
        facing = (h + gradient[:, 0:1] * u + gradient[:, 1:2] * v).clamp_min(self.least_facing_mm)
        w: Tensor = self.integrate(gradient * (h / facing))
        return -h * torch.expm1(-w / h)

    def extra_repr(self) -> str:
        return f"mm_per_pixel={self.mm_per_pixel}, camera_height_mm={self.camera_height_mm}"
