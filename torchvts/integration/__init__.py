"""Floor 2: from gradient to depth."""

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
    "PerspectiveIntegration",
    "PoissonBackground",
    "PoissonDCT",
    "PoissonDST",
    "discontinuity_share",
    "divergence",
    "integrate_discontinuities",
    "integrate_perspective",
    "label_contacts",
    "poisson_background",
    "poisson_dct",
    "poisson_dst",
]
