"""Pose from two point clouds of any shape, by Open3D: features of points, sample consensus, iterated closest points."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .ambiguity import UNKNOWN_VARIANCE, free_directions, name_directions
from .clouds import thin
from .read_cloud import open3d
from .result import Registration

LEAST_POINTS = 10
"""Least number of points of a cloud that has a pose."""

SEARCH_POINTS = 1000
"""Points to which clouds are thinned for sample consensus."""

LEAST_SHARE = 0.8
"""Least share of points that have a neighbour in the other cloud with which a pose is trusted."""

MOST_RMSE = 0.3
"""Largest distance along the normal, in units of the cloud's thickness, with which a pose is trusted: flat clouds have near
neighbours in any pose. Contacts fitted in the right pose have 0.02 to 0.15, knurls that are thinned up to 0.36, which are refused;
wrong poses 0.48 to 1.8."""

LEAST_INFORMATION = 1e-3
"""Mean squared share of a motion of 1 mm along the normals, below which the motion is called unknown."""


class Cloud(NamedTuple):
    """Points (N, 3) float64, mm, and their unit normals (N, 3), if known."""

    points: Tensor
    normals: Tensor | None


def register_features(source: Cloud, target: Cloud, start: Tensor | None) -> Registration:
    """Register two clouds by FPFH, sample consensus and point-to-plane ICP; from ``start`` by ICP alone, if that fits.

    Raises:
        ImportError: Open3D is not installed.
    Source:
        The way of Ji, Liu, Ma 2022; Rusu, Blodow, Beetz 2009 for FPFH; Chen, Medioni 1992 for point to plane.
    """
    o3d = open3d()
    a, b = (_cloud(o3d, cloud) for cloud in (source, target))
    if start is not None:
        found = _refined(o3d, a, b, start.numpy())
        if found.converged:
            return found
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):  # few features that agree are no fault
        return _refined(o3d, a, b, _by_features(o3d, a, b))


def _by_features(o3d: Any, source: Any, target: Any) -> Any:
    """A pose (4, 4) from FPFH features and sample consensus on thinned clouds, then ICP on these."""
    few = [cloud.select_by_index(thin(_points(cloud), SEARCH_POINTS).tolist()) for cloud in (source, target)]
    spacing, registration = max(map(_spacing, few)), o3d.pipelines.registration
    near = o3d.geometry.KDTreeSearchParamHybrid(radius=6.0 * spacing, max_nn=100)
    features = [registration.compute_fpfh_feature(cloud, near) for cloud in few]
    o3d.utility.random.seed(0)
    rough = registration.registration_ransac_based_on_feature_matching(
        *few, *features, True, 1.5 * spacing, checkers=[registration.CorrespondenceCheckerBasedOnEdgeLength(0.9)],
        criteria=registration.RANSACConvergenceCriteria(100_000, 0.999),
    )  # fmt: skip
    return _icp(o3d, few[0], few[1], rough.transformation, 3.0 * spacing)


def _cloud(o3d: Any, cloud: Cloud) -> Any:
    """As Open3D's cloud, with normals."""
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points.numpy()))
    if cloud.normals is None:
        made.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    else:
        made.normals = o3d.utility.Vector3dVector(cloud.normals.numpy())
    return made


def _points(cloud: Any) -> Tensor:
    return torch.tensor(np.asarray(cloud.points))


def _spacing(cloud: Any) -> float:
    """Median distance of a point from the nearest other one, mm."""
    return max(float(torch.tensor(np.asarray(cloud.compute_nearest_neighbor_distance())).median()), 1e-9)


def _icp(o3d: Any, source: Any, target: Any, pose: Any, reach: float) -> Any:
    registration = o3d.pipelines.registration
    steps = registration.ICPConvergenceCriteria(1e-9, 1e-9, 60)
    by_planes = registration.TransformationEstimationPointToPlane()
    return registration.registration_icp(source, target, reach, pose, by_planes, steps).transformation


def _refined(o3d: Any, source: Any, target: Any, pose: Any) -> Registration:
    """Refine a pose (4, 4) by ICP on all points, and describe the result."""
    reach = 1.5 * max(_spacing(source), _spacing(target))
    for times in (3.0, 1.0):
        pose = _icp(o3d, source, target, pose, times * reach)
    forth = o3d.pipelines.registration.evaluate_registration(source, target, reach, pose)
    moved_back = torch.linalg.inv(torch.tensor(pose)).numpy()
    back = o3d.pipelines.registration.evaluate_registration(target, source, reach, moved_back)
    fitness = max(forth.fitness, back.fitness)  # one cloud may be a part of the other
    T = torch.tensor(pose)
    pairs = torch.tensor(np.asarray(forth.correspondence_set), dtype=torch.long).reshape(-1, 2)
    paired = (_points(source)[pairs[:, 0]] @ T[:3, :3].T) + T[:3, 3]
    goal, normal = _points(target)[pairs[:, 1]], torch.tensor(np.asarray(target.normals))[pairs[:, 1]]
    rmse_mm = float(((paired - goal) * normal).sum(1).square().mean().sqrt()) if len(pairs) else math.inf
    share = f"{100 * fitness:.0f} % of the points have a neighbour in the other cloud"
    thickness = float(torch.linalg.eigvalsh(_points(target).T.cov())[0].clamp_min(0.0).sqrt())
    if fitness < LEAST_SHARE or rmse_mm > max(MOST_RMSE * thickness, 0.05 * reach) or len(pairs) < LEAST_POINTS:
        unknown = torch.diag(torch.tensor([1.0] * 3 + [UNKNOWN_VARIANCE] * 3, dtype=torch.float64))
        share = f"{share}, which differ by {rmse_mm:.3f} mm along the normal; register_depth is more certain"
        return Registration(T, rmse_mm, fitness, False, f"nothing fits: {share}", unknown)
    names, covariance = _determined(paired, normal, rmse_mm)
    message = share + (f"; the surface slides on itself: {', '.join(names)} unknown" if names else "")
    return Registration(T, rmse_mm, fitness, True, message, covariance, names)


def _determined(points: Tensor, normal: Tensor, rmse_mm: float) -> tuple[list[str], Tensor]:
    """Names of the motions that the paired points (N, 3) do not determine, and the covariance (6, 6) about the origin."""
    middle = points - points.mean(0)
    units = torch.tensor([1.0 / float(middle.square().sum(1).mean().sqrt())] * 3 + [1.0] * 3, dtype=torch.float64)
    jacobian = torch.cat((torch.linalg.cross(middle, normal, dim=1), normal), 1) * units
    information = jacobian.T @ jacobian / len(jacobian)
    free, shifts = free_directions(information, torch.zeros(6, 6, dtype=torch.float64), LEAST_INFORMATION)
    about_origin = torch.cat((torch.linalg.cross(points, normal, dim=1), normal), 1)
    known = about_origin.T @ about_origin / max(rmse_mm, 1e-6) ** 2
    prior = torch.diag(torch.tensor([1.0] * 3 + [0.01] * 3, dtype=torch.float64))
    return name_directions(free, shifts), torch.linalg.inv(known + prior)
