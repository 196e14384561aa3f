"""From gradient to depth."""

from .base import Integrator
from .discontinuities import AdaptiveIntegration
from .perspective import PerspectiveIntegration, integrate_perspective
from .poisson import PoissonBackground, PoissonDCT, PoissonDST, divergence, poisson_background, poisson_dct, poisson_dst

__all__ = [
    "AdaptiveIntegration",
    "Integrator",
    "PerspectiveIntegration",
    "PoissonBackground",
    "PoissonDCT",
    "PoissonDST",
    "divergence",
    "integrate_perspective",
    "poisson_background",
    "poisson_dct",
    "poisson_dst",
]
