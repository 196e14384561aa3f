"""Rotations and rigid motions in NumPy; a twist (6,) is a rotation vector and a shift, rad and mm."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


def rigid_motion(twist: Array, center: Array) -> Array:
    """Rigid motions (..., 4, 4) of twists (..., 6), by Rodrigues' formula: rotation about ``center`` (..., 3), then shift."""
    angle = np.linalg.norm(twist[..., :3], axis=-1)[..., None, None]
    large = np.maximum(angle, 1e-9)
    turn = cross(twist[..., :3])
    turn = np.eye(3) + np.sin(large) / large * turn + 0.5 * (np.sin(0.5 * large) / (0.5 * large)) ** 2 * (turn @ turn)
    result = np.zeros((*twist.shape[:-1], 4, 4))
    result[..., :3, :3], result[..., 3, 3] = turn, 1.0
    result[..., :3, 3] = twist[..., 3:] + center - (turn @ center[..., None])[..., 0]
    return result


def rotation_vector(turn: Array) -> Array:
    """Axis times angle (3,) of a rotation (3, 3) of at most half a turn."""
    skew = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine, cosine = float(np.linalg.norm(skew)), 0.5 * (float(np.trace(turn)) - 1.0)
    if cosine < -0.9:  # the sine is small: the axis is that of (1 - cosine) a a^T
        square = 0.5 * (turn + turn.T) - cosine * np.eye(3)
        axis = square[:, int(square.diagonal().argmax())]
        sign = -1.0 if float(axis @ skew) < 0.0 else 1.0
        half: Array = axis * (sign * math.atan2(sine, cosine) / float(np.linalg.norm(axis)))
        return half
    return skew * (math.atan2(sine, cosine) / sine if sine > 1e-12 else 1.0)


def orthonormal(pose: Array) -> Array:
    """The pose (4, 4) with the rotation that is nearest to its own: products of poses multiply what is missing."""
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose = pose.copy()
    pose[:3, :3] = left @ right
    return pose


def adjoint(pose: Array) -> Array:
    """(6, 6), which turns a small motion before a pose (4, 4) into the same motion after it."""
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = pose[:3, :3]
    result[3:, :3] = cross(pose[:3, 3]) @ pose[:3, :3]
    return result


def cross(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with v (..., 3)."""
    result = np.zeros((*v.shape, 3))
    result[..., 2, 1], result[..., 0, 2], result[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return result - result.swapaxes(-1, -2)


def distance_mm(spread: Array, one: Array, other: Array) -> float:
    """Root mean square distance of points under two poses (4, 4), mm, by the mean of the products (4, 4) of (x, y, z, 1)."""
    off = one[:3] - other[:3]
    return math.sqrt(max(float(np.vdot(off @ spread, off)), 0.0))


def moved_covariance(pose: Array, covariance: Array) -> Array:
    """Covariance (6, 6) of a small motion before a pose (4, 4), as one after it."""
    by = adjoint(pose)
    return by @ covariance @ by.T
