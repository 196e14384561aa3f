"""From gradient to depth."""

from .base import Integrator, WrappedIntegrator, as_integrator
from .discontinuities import (
    AdaptiveIntegration,
    DiscontinuityIntegration,
    DiscontinuitySolution,
    discontinuity_share,
    integrate_discontinuities,
    label_contacts,
)
from .perspective import PerspectiveIntegration, integrate_perspective
from .poisson import PoissonBackground, PoissonDCT, PoissonDST, divergence, poisson_background, poisson_dct, poisson_dst

__all__ = [
    "AdaptiveIntegration",
    "DiscontinuityIntegration",
    "DiscontinuitySolution",
    "Integrator",
    "PerspectiveIntegration",
    "PoissonBackground",
    "PoissonDCT",
    "PoissonDST",
    "WrappedIntegrator",
    "as_integrator",
    "discontinuity_share",
    "divergence",
    "integrate_discontinuities",
    "integrate_perspective",
    "label_contacts",
    "poisson_background",
    "poisson_dct",
    "poisson_dst",
]
