"""Uncertainty of a pose: how far it moves when a part of the contact is left out, and what parts have in common."""

import math

import numpy as np

from .height_errors import ALIKE_MM
from .inverse import LEAST_SLOPE_NOISE, Sums
from .rigid import Array

PARTS = 8
"""Parts of a contact, a power of two: a pose is as uncertain as it depends on which of them is left out."""

UNSEEN = math.sqrt(2.0 / (5 * (PARTS - 1)))
"""Standard deviation, as a share, of the variance that so many parts show in the five motions that slopes show."""


def in_parts(places: Array) -> Array:
    """An order of places (N, 2) in which PARTS runs of the same number are compact: halves of halves, across the longer side."""
    runs = [np.arange(len(places))]
    while len(runs) < PARTS:
        halves: list[Array] = []
        for run in runs:
            side = int(np.ptp(places[run], axis=0).argmax()) if len(run) else 0
            halves += np.array_split(run[places[run, side].argsort(kind="stable")], 2)
        runs = halves
    return np.concatenate(runs)


def shared_error(places: Array, parts: int) -> float:
    """How many times larger the variance of a pose is than leaving out one part after the other shows.

    Parts that err alike cannot disagree about it. For K parts whose errors have a mean correlation c, the variance of their mean is
    (1 + (K - 1) c) / (1 - c) times that which their scatter shows. The correlation is that of smooth errors, :data:`ALIKE_MM`.

    Args:
        places: (N, 2), pixels of the contact, mm, in so many runs of nearly the same number.
        parts: number of runs.
    Example:
        >>> grid = np.stack(np.meshgrid(np.arange(64.0), np.arange(8.0), indexing="ij"), -1).reshape(-1, 2)
        >>> round(shared_error(1.0 * grid, 8), 1), round(shared_error(0.1 * grid, 8), 1)
        (1.4, 20.6)
    """
    step = max(1, len(places) // (parts * 40))
    runs = [run[::step] for run in np.array_split(places, parts)]
    points, first = np.concatenate(runs), np.cumsum([0, *map(len, runs[:-1])])
    square = 0.5 * (points * points).sum(1) / ALIKE_MM**2
    alike = np.exp((points / ALIKE_MM**2) @ points.T - square[:, None] - square)
    number = np.array([len(run) for run in runs])
    alike = np.add.reduceat(np.add.reduceat(alike, first, 0), first, 1) / np.outer(number, number)
    own, all_ = float(np.trace(alike)) / parts, float(alike.sum())
    others = (all_ - parts * own) / (parts * (parts - 1))
    return (own + (parts - 1) * others) / max(own - others, 1e-3)


def jackknife(matrices: Array, rights: Array, known: Array) -> Array:
    """Covariance (6, 6) of the step that a Gauss-Newton system asks for, by leaving out one part of its pixels after the other.

    What remains of the residuals of a calibrated sensor is no noise: it is alike over a large part of the contact, and pixels
    that are counted as independent promise a pose ten to a hundred times too exact. Leaving out a whole part at a time counts
    what is alike in it once; what is alike in all parts is for :func:`shared_error`.

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
    covariance: Array = (len(off) - 1) / len(off) * off.T @ off
    return covariance


def covariance_of_slopes(fine: Sums, matrices: Array, rights: Array, shared: float, free: Array) -> Array:
    """Covariance of the scaled twist that slopes ask for: the noise of pixels, and what is alike in many of them.

    What parts of the contact disagree by beyond the noise of pixels is alike over wide areas, and parts have much of it in common.
    Where they disagree by no more than that noise, a smooth error may still be as large as it can be without being seen.

    Args:
        fine: sums over all pixels.
        matrices: J^T J of each part.
        rights: J^T r of each part.
        shared: :func:`shared_error` of the contact.
        free: (6, k), orthonormal scaled twists that are not determined.
    """
    known = np.linalg.qr(free, mode="complete")[0][:, free.shape[1] :] if free.shape[1] else np.eye(6)
    by_parts, beside = jackknife(matrices, rights, known), known @ known.T
    matrix = beside @ fine.matrix @ beside
    matrix[5, :] = matrix[:, 5] = 0.0  # heights have a weight of their own
    information, directions = np.linalg.eigh(matrix)
    shown = information > 1e-9 * information[-1]
    noise = (directions[:, shown] / information[shown]) @ directions[:, shown].T
    noise *= (max(fine.slope_noise, LEAST_SLOPE_NOISE) / fine.noise) ** 2
    alike = 1.0 - float(np.trace(noise)) / max(float(np.trace(by_parts[:5, :5])), 1e-30)
    scaled: Array = noise + shared * (max(0.0, alike) * by_parts + UNSEEN * noise)
    return scaled
