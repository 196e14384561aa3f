"""A graph of keyframes: their poses from the registrations between them, whose contradictions are spread over a closed loop."""

from typing import NamedTuple

import numpy as np
import torch

from .keyframe import Keyframe
from .result import motion
from .rigid import Array, adjoint, inverted, orthonormal, rotation_vector

STEPS = 5
"""Gauss-Newton steps; contradictions are small motions, so two or three are enough."""


class Edge(NamedTuple):
    """A registration of keyframe ``source`` in keyframe ``target``: T_target_source (4, 4), and its covariance (6, 6)."""

    source: int
    target: int
    pose: Array
    covariance: Array


class KeyframeGraph:
    """Keyframes, the first of which is the reference, and the registrations between them.

    Attributes:
        keyframes: the keyframes.
        poses: T_keyframe_reference (4, 4) of each.
        covariances: (6, 6) of a small motion after each of these poses, rad and mm.
        edges: the registrations.

    Source:
        Lu and Milios, Globally consistent range scan alignment, Autonomous Robots 4, 1997; Gauss-Newton on SE(3) as in Grisetti,
        Kuemmerle, Stachniss, Burgard, A tutorial on graph-based SLAM, IEEE ITS Magazine 2(4), 2010.
    """

    def __init__(self, reference: Keyframe) -> None:
        self.keyframes = [reference]
        self.poses = [np.eye(4)]
        self.covariances = [np.zeros((6, 6))]
        self.edges: list[Edge] = []

    def add(self, keyframe: Keyframe, source: int, pose: Array, covariance: Array) -> int:
        """Add a keyframe with its registration T_new_source; returns its index."""
        self.keyframes.append(keyframe)
        self.poses.append(orthonormal(pose @ self.poses[source]))
        self.covariances.append(covariance + moved_covariance(pose, self.covariances[source]))
        self.edges.append(Edge(source, len(self.poses) - 1, pose, covariance))
        return len(self.poses) - 1

    def close(self, edge: Edge) -> Array:
        """Add a registration between known keyframes and find all poses anew; returns its contradiction before, a twist (6,)."""
        contradiction = self._residual(edge)
        self.edges.append(edge)
        size = 6 * (len(self.poses) - 1)
        for _ in range(STEPS):
            matrix, right = np.zeros((size + 6, size + 6)), np.zeros(size + 6)
            for one in self.edges:
                jacobian = np.zeros((6, size + 6))
                jacobian[:, 6 * one.target : 6 * one.target + 6] = np.eye(6)
                relative = self.poses[one.target] @ inverted(self.poses[one.source])
                jacobian[:, 6 * one.source : 6 * one.source + 6] -= adjoint(relative)
                information = np.linalg.inv(one.covariance + 1e-12 * np.eye(6))
                matrix += jacobian.T @ information @ jacobian
                right += jacobian.T @ information @ self._residual(one)
            spread = np.linalg.inv(matrix[6:, 6:] + 1e-9 * np.eye(size))  # the reference stays
            step = -spread @ right[6:]
            for k in range(1, len(self.poses)):
                twist = torch.from_numpy(step[6 * k - 6 : 6 * k])
                self.poses[k] = orthonormal(motion(twist).numpy() @ self.poses[k])
        for k in range(1, len(self.poses)):
            self.covariances[k] = np.array(spread[6 * k - 6 : 6 * k, 6 * k - 6 : 6 * k], dtype=np.float64)
        return contradiction

    def _residual(self, edge: Edge) -> Array:
        """The twist (6,) after the registration that leads to the poses of its keyframes."""
        off = self.poses[edge.target] @ inverted(self.poses[edge.source]) @ inverted(edge.pose)
        return np.concatenate((rotation_vector(off[:3, :3]), off[:3, 3]))


def moved_covariance(pose: Array, covariance: Array) -> Array:
    """Covariance of a small motion before a pose (4, 4), as one after it."""
    by = adjoint(pose)
    return by @ covariance @ by.T
