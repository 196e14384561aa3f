"""Iterated closest points (ICP): point to plane, and point to point for clouds that are copies of each other."""

import math
from typing import Any

import torch
from torch import Tensor

from .ambiguity import UNKNOWN_VARIANCE, free_directions, name_directions
from .clouds import thin
from .result import Registration, invert, motion

LEAST_POINTS = 10
"""Least number of points of a cloud that has a pose."""

SEARCH_POINTS = 1000
"""Number of points to which clouds are thinned while hypotheses are compared."""

FINE_POINTS = 20000
"""The same for the last steps."""

LEAST_INFORMATION = 1e-3
"""Mean squared share of a motion of 1 mm along the normals, below which the motion is called unknown."""


class Correspondence:
    """Two clouds, each thinned to a coarse and a fine version, with the target's normals.

    Args:
        source: (N, 3) float64, mm.
        target: (M, 3) float64, mm.
        target_normals: (M, 3), unit normals; None estimates them from the points.
    """

    def __init__(self, source: Tensor, target: Tensor, target_normals: Tensor | None) -> None:
        coarse_t, fine_t = thin(target, 2 * SEARCH_POINTS), thin(target, 5 * FINE_POINTS)
        self.target = target
        self.coarse_source, self.coarse_target = source[thin(source, SEARCH_POINTS)], target[coarse_t]
        self.fine_source, self.fine_target = source[thin(source, FINE_POINTS)], target[fine_t]
        self.spacing = max(spacing(self.coarse_source), spacing(self.coarse_target))
        self.target_tree, self.source_tree = Tree(self.fine_target), Tree(self.fine_source)
        if target_normals is None:
            self.normals = estimate_normals(self.fine_target, self.target_tree)
            self.coarse_normals = estimate_normals(self.coarse_target, Tree(self.coarse_target))
        else:
            self.normals, self.coarse_normals = target_normals[fine_t], target_normals[coarse_t]

    def ranked(self, poses: list[Tensor]) -> list[tuple[float, Tensor]]:
        """The poses after some steps, best first, with the share of points that lie near the other cloud."""
        return sorted(((self._share(pose), pose) for pose in map(self.approach, poses)), key=lambda entry: -entry[0])

    def approach(self, pose: Tensor) -> Tensor:
        """Refine a pose by point to plane on the coarse clouds."""
        reach = 8.0 * self.spacing
        for _ in range(15):
            reach = max(1.5 * self.spacing, 0.75 * reach)
            moved = transform(pose, self.coarse_source)
            distance, index = torch.cdist(moved, self.coarse_target).min(1)
            near = distance < reach
            last = pose
            pose = _point_to_plane(pose, moved[near], self.coarse_target[index[near]], self.coarse_normals[index[near]])
            if reach <= 1.5 * self.spacing and float((pose - last).abs().max()) < 1e-4:
                break
        return pose

    def _share(self, pose: Tensor) -> float:
        distance = torch.cdist(transform(pose, self.coarse_source), self.coarse_target)
        near = 1.0 - (distance.min(1).values / self.spacing).clamp_max(1.0).square()
        back = 1.0 - (distance.min(0).values / self.spacing).clamp_max(1.0).square()
        return 0.5 * float(near.mean() + back.mean())

    def finish(self, pose: Tensor) -> Registration:
        """Refine a pose on the fine clouds and describe the result."""
        target_spacing = spacing(self.fine_target)
        for k in range(12):
            reach = max(1.5 * target_spacing, 3.0 * self.spacing * 0.7**k)
            moved = transform(pose, self.fine_source)
            distance, index = self.target_tree.nearest(moved)
            near = distance < reach
            pose = _point_to_plane(pose, moved[near], self.fine_target[index[near]], self.normals[index[near]])
        exact = self.as_copies(pose)
        pose = pose if exact is None else exact
        moved = transform(pose, self.fine_source)
        distance, index = self.target_tree.nearest(moved)
        back, _ = self.source_tree.nearest(transform(invert(pose), self.fine_target))
        reach = 1.5 * max(target_spacing, spacing(self.fine_source))
        near = distance < reach
        fitness = min(1.0, max(float(near.double().mean()), float((back < reach).double().mean())))
        points, normal = moved[near], self.normals[index[near]]
        off = ((points - self.fine_target[index[near]]) * normal).sum(1)
        rmse_mm = float(off.square().mean().sqrt()) if bool(near.any()) else math.inf
        if fitness < 0.8 or rmse_mm >= 0.3 * reach or len(points) < LEAST_POINTS:
            covariance = torch.diag(torch.tensor([1.0] * 3 + [UNKNOWN_VARIANCE] * 3, dtype=torch.float64))
            message = f"nothing fits: {100 * fitness:.0f} % of the points have a neighbour in the other cloud"
            return Registration(pose, rmse_mm, fitness, False, message, covariance)
        names, covariance = self._determined(points, normal, rmse_mm)
        message = f"{100 * fitness:.0f} % of the points have a neighbour in the other cloud"
        message += f"; the surface slides on itself: {', '.join(names)} unknown" if names else ""
        return Registration(pose, rmse_mm, fitness, True, message, covariance, names)

    def _determined(self, points: Tensor, normal: Tensor, rmse_mm: float) -> tuple[list[str], Tensor]:
        """Names of the motions that the paired points do not determine, and the covariance (6, 6) about the origin."""
        target = self.fine_target
        size = float((target - target.mean(0)).square().sum(1).mean().sqrt())
        units = torch.tensor([1.0 / size] * 3 + [1.0] * 3, dtype=torch.float64)
        jacobian = torch.cat((torch.linalg.cross(points - points.mean(0), normal, dim=1), normal), 1) * units
        information = jacobian.T @ jacobian / len(jacobian)
        free, shifts = free_directions(information, torch.zeros(6, 6, dtype=torch.float64), LEAST_INFORMATION)
        about_origin = torch.cat((torch.linalg.cross(points, normal, dim=1), normal), 1)
        known = about_origin.T @ about_origin / max(rmse_mm, 1e-6) ** 2
        prior = torch.diag(torch.tensor([1.0] * 3 + [0.01] * 3, dtype=torch.float64))
        return name_directions(free, shifts), torch.linalg.inv(known + prior)

    def as_copies(self, pose: Tensor) -> Tensor | None:
        """Refine a pose by point to point; None unless the points then coincide."""
        target = self.fine_target
        target_spacing = spacing(target)
        for reach in (4.0, 2.0, 1.0, 0.7, 0.7, 0.7):
            distance, index = self.target_tree.nearest(transform(pose, self.coarse_source))
            near = distance < max(reach * target_spacing, float(distance.median()))
            pose = _rigid_between(self.coarse_source[near], target[index[near]])
        for points in (self.coarse_source, self.fine_source):
            distance, index = self.target_tree.nearest(transform(pose, points))
            exact = distance < 0.02 * target_spacing
            if float(exact.double().mean()) < 0.3:
                return None
            pose = _rigid_between(points[exact], target[index[exact]])
        return pose


def _point_to_plane(pose: Tensor, moved: Tensor, target: Tensor, normals: Tensor) -> Tensor:
    """One weighted step that moves the points (N, 3) onto the planes at ``target``; the pose as it is for fewer than 6 pairs."""
    if len(moved) < 6:
        return pose
    center = moved.mean(0)
    residual = ((target - moved) * normals).sum(1)
    scale = 2.0 * float(residual.abs().median()) + 1e-9
    weight = 1.0 / (1.0 + (residual / scale) ** 2)
    jacobian = torch.cat((torch.linalg.cross(moved - center, normals, dim=1), normals), 1)
    matrix = jacobian.T @ (jacobian * weight[:, None])
    matrix = matrix + 1e-6 * float(matrix.diagonal().max()) * torch.eye(6, dtype=matrix.dtype)
    return motion(torch.linalg.solve(matrix, jacobian.T @ (weight * residual)), center) @ pose


class Tree:
    """A k-d tree (OpenCV's FLANN) that finds nearest points of a cloud (N, 3)."""

    def __init__(self, points: Tensor) -> None:
        import cv2

        self.points = points
        self.center = points.mean(0)
        self.index: Any = cv2.flann_Index(  # type: ignore[attr-defined]
            (points - self.center).float().contiguous().numpy(), {"algorithm": 4}
        )

    def nearest(self, points: Tensor, count: int = 1) -> tuple[Tensor, Tensor]:
        """Distances and indices, (N,), or (N, count)."""
        found, _ = self.index.knnSearch((points - self.center).float().contiguous().numpy(), count, params={"checks": -1})
        index = torch.from_numpy(found.astype("int64"))
        distance = (points[:, None] - self.points[index]).norm(dim=2)
        return (distance[:, 0], index[:, 0]) if count == 1 else (distance, index)


def estimate_normals(points: Tensor, tree: Tree, neighbours: int = 12) -> Tensor:
    """Unit normals (N, 3) of planes through the nearest points, towards the camera."""
    _, index = tree.nearest(points, min(neighbours, len(points)))
    around = points[index] - points[index].mean(1, keepdim=True)
    normal = torch.linalg.eigh(around.transpose(1, 2) @ around).eigenvectors[:, :, 0]
    return torch.where(normal[:, 2:] < 0, -normal, normal)


def _rigid_between(source: Tensor, target: Tensor) -> Tensor:
    """Least-squares rigid motion of paired points (Kabsch 1976)."""
    c_s, c_t = source.mean(0), target.mean(0)
    u, _, vh = torch.linalg.svd((target - c_t).T @ (source - c_s))
    flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.linalg.det(u @ vh)))], dtype=torch.float64))
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = u @ flip @ vh
    pose[:3, 3] = c_t - pose[:3, :3] @ c_s
    return pose


def transform(pose: Tensor, points: Tensor) -> Tensor:
    """Points (N, 3) moved by a rigid motion (4, 4)."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def spacing(points: Tensor) -> float:
    """Median distance to the nearest other point, mm."""
    some = points[:: max(1, len(points) // 500)]
    distance, _ = Tree(points).nearest(some, 2)
    return max(float(distance[:, 1].median()), 1e-9)
