"""Floor 2: from gradient to depth."""

from .cliffs import AdaptiveIntegration, CliffIntegration, CliffSolution, cliff_share, integrate_cliffs, label_contacts
from .perspective import PerspectiveIntegration, integrate_perspective
from .poisson import PoissonDCT, PoissonDST, PoissonRest, divergence, poisson_dct, poisson_dst, poisson_rest

__all__ = [
    "AdaptiveIntegration",
    "CliffIntegration",
    "CliffSolution",
    "PerspectiveIntegration",
    "PoissonDCT",
    "PoissonDST",
    "PoissonRest",
    "cliff_share",
    "divergence",
    "integrate_cliffs",
    "integrate_perspective",
    "label_contacts",
    "poisson_dct",
    "poisson_dst",
    "poisson_rest",
]
