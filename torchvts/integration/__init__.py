"""Floor 2: from gradient to depth."""

from .cliffs import CliffIntegration, CliffSolution, integrate_cliffs
from .poisson import PoissonDCT, PoissonDST, PoissonRest, divergence, poisson_dct, poisson_dst, poisson_rest

__all__ = [
    "CliffIntegration",
    "CliffSolution",
    "PoissonDCT",
    "PoissonDST",
    "PoissonRest",
    "divergence",
    "integrate_cliffs",
    "poisson_dct",
    "poisson_dst",
    "poisson_rest",
]
