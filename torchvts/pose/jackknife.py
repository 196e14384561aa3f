"""Uncertainty of a tracked pose: how far it moves when a part of the contact is left out."""

import numpy as np

from .inverse import Array

ALIKE_PARTS = 2.0
"""Neighbouring parts err alike where errors of slopes are smooth, so that so many of them count as one."""


def jackknife(matrices: Array, rights: Array, known: Array) -> Array:
    """Covariance (6, 6) of the step that a Gauss-Newton system asks for, by leaving out one part of its pixels after the other.

    What remains of the residuals of a calibrated sensor is no noise: it is alike over a large part of the contact, and pixels
    that are counted as independent promise a pose ten to a hundred times too exact. Leaving out a whole part at a time counts
    what is alike in it once.

    Args:
        matrices: (K, 6, 6), J^T J of each part.
        rights: (K, 6), J^T r of each part.
        known: (6, n), orthonormal scaled twists; the others get no step.
    Source:
        the delete-a-group jackknife: Efron, Tibshirani, An Introduction to the Bootstrap, 1993, section 11.5; blocks of what is
        correlated: Kuensch, Annals of Statistics 17(3), 1989.
    Example:
        >>> parts = np.random.default_rng(0).standard_normal((8, 100, 6))
        >>> matrices, rights = np.swapaxes(parts, 1, 2) @ parts, parts.sum(1)
        >>> jackknife(matrices, rights, np.eye(6)).shape
        (6, 6)
    """
    if known.shape[1] == 0:
        return np.zeros((6, 6))
    inside = known.T @ matrices @ known
    whole, right = inside.sum(0), (rights @ known).sum(0)
    damping = 1e-6 * max(float(np.trace(whole)), 1e-9) * np.eye(len(whole))
    without = np.linalg.solve(whole + damping - inside, (right - rights @ known)[..., None])[..., 0]
    off = (without - np.linalg.solve(whole + damping, right)) @ known.T
    covariance: Array = ALIKE_PARTS * (len(off) - 1) / len(off) * off.T @ off
    return covariance
