"""Floor 2: from gradient to depth."""

from .poisson import PoissonDCT, PoissonDST, PoissonRest, divergence, poisson_dct, poisson_dst, poisson_rest

__all__ = ["PoissonDCT", "PoissonDST", "PoissonRest", "divergence", "poisson_dct", "poisson_dst", "poisson_rest"]
