"""How an object moves between two frames by printed dots: skin that sticks to it moves with it."""

import numpy as np
from numpy.linalg import inv
from torch import Tensor

from ..core.checks import check_record
from ..skin import DotMotion
from .rigid import Array, cross, rigid_motion, rotation_vector

FEWEST = 4
"""Dots under the object in both frames at least."""

STEPS = 5
"""Times that dots which differ from the others are given less weight (Cauchy's)."""


def points_under(moved: DotMotion, contact: Tensor) -> Array:
    """Places (N, 3) of one frame's dots, mm, x right, y up, z towards the camera; NaN where none is seen in contact."""
    check_record("moved", moved, DotMotion)
    places: Array = moved.displacement_mm[0].detach().double().cpu().numpy() + np.pad(moved.rest_mm.cpu().numpy(), ((0, 0), (0, 1)))
    return np.where(moved.touched(contact)[0, :, None].cpu().numpy(), places * (1.0, -1.0, 1.0), np.nan)


def carried(before: Array, after: Array) -> tuple[Array, Array] | None:
    """The rigid motion (4, 4) of dots from places (N, 3) to those in the next frame, and its covariance (6, 6), rad and mm.

    Deep dots count most, because they slip last. None where the dots are too few or lie on a line.

    Source:
        Arun, Huang, Blostein, Least-squares fitting of two 3-D point sets, IEEE TPAMI 9(5), 1987.
    """
    both = ~np.isnan(before + after).any(1)
    before, after = before[both], after[both]
    if len(before) < FEWEST or np.linalg.svd(before - before.mean(0), compute_uv=False)[1] < 1e-6:
        return None
    deep = weight = after[:, 2].clip(1e-3)
    motion, off = np.eye(4), weight
    for _ in range(STEPS):
        weight = weight / weight.sum()
        middle, to = weight @ before, weight @ after
        left, _, right = np.linalg.svd((after - to).T @ ((before - middle) * weight[:, None]))
        motion[:3, :3] = left @ np.diag((1.0, 1.0, np.linalg.det(left @ right))) @ right
        motion[:3, 3] = to - motion[:3, :3] @ middle
        off = np.linalg.norm(before @ motion[:3, :3].T + motion[:3, 3] - after, axis=1)
        weight = deep / (1.0 + (off / (2.0 * max(float(np.median(off)), 1e-4))) ** 2)
    by_twist = np.concatenate((-cross(after), np.broadcast_to(np.eye(3), (len(after), 3, 3))), 2)  # (N, 3, 6)
    information = np.einsum("n,nij,nik->jk", weight / weight.max(), by_twist, by_twist)
    return motion, max(float(np.average(off**2, weights=weight)), 1e-8) * inv(information)


def fused(pose: Array, covariance: Array, other: Array, of_other: Array) -> tuple[Array, Array]:
    """The mean of two independent poses (4, 4), and its covariance (6, 6), as small motions after them (Kalman)."""
    gain, between = covariance @ inv(covariance + of_other), other @ inv(pose)
    step = gain @ np.concatenate((rotation_vector(between[:3, :3]), between[:3, 3]))
    return rigid_motion(step, np.zeros(3)) @ pose, covariance - gain @ covariance
