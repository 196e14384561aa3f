"""Pose from two point clouds, by Open3D: features of points, sample consensus, iterated closest points."""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..core.checks import check_float_tensor
from ..core.geometry import check_rigid
from .ambiguity import UNKNOWN_VARIANCE, free_directions, name_directions
from .grids import LEAST_CELLS
from .read_cloud import open3d
from .result import Registration
from .rigid import Array

SEARCH_POINTS = 1000
"""Points to which clouds are thinned for sample consensus."""

LEAST_SHARE = 0.8
"""Least share of points that have a neighbour in the other cloud with which a pose is trusted."""

MOST_RMSE = 0.3
"""Largest distance along the normal, in units of the cloud's thickness, with which a pose is trusted: flat clouds have near
neighbours in any pose. Contacts fitted in the right pose have 0.02 to 0.15, knurls that are thinned up to 0.36, which are refused;
wrong poses 0.48 to 1.8."""

ALIKE_POINTS = 100
"""Distances along the normal are alike over wide areas: however many points there are, they say as much as so many."""

LEAST_INFORMATION = 1e-3
"""Mean squared share of a motion of 1 mm along the normals, below which the motion is called unknown."""


def register_points(
    source: Tensor,
    target: Tensor,
    *,
    source_normals: Tensor | None = None,
    target_normals: Tensor | None = None,
    initial: Tensor | None = None,
) -> Registration:
    """Pose of one point cloud relative to another.

    By Open3D: FPFH features, sample consensus, iterated closest points (point to plane). Other poses of a symmetric object are
    not listed; :func:`register_depth`, which also knows where nothing touched, lists them, and errs less.

    Args:
        source: (N, 3), mm, right-handed, x right, y up, z to the camera (:func:`torchvts.depth_to_points`).
        target: (M, 3), likewise.
        source_normals: unit normals of the source, of the same shape; None estimates them from the points. Photometric normals
            are better than any estimate.
        target_normals: unit normals of the target, likewise.
        initial: T_target_source (4, 4) to try first.
    Returns:
        The registration; ``converged`` is False if nothing fits.
    Raises:
        ValueError: not (N, 3), not finite, fewer than 12 distinct points, or points on one line.
        TypeError: no tensors.
        ImportError: Open3D is not installed.
    Source:
        The way of Ji, Liu, Ma 2022; Rusu, Blodow, Beetz 2009 for FPFH; Chen, Medioni 1992 for point to plane.
    Example:
        >>> from torchvts.pose import contact_cloud
        >>> from torchvts.scenes import objects
        >>> frame = objects.press(objects.stamp("T"), objects.pose(0.0), 96, 128, 0.125)
        >>> points, normals = contact_cloud(frame, 0.125, most=None)
        >>> shift = torch.tensor([1.0, 0.5, 0.0], dtype=torch.float64)
        >>> reg = register_points(points, points + shift, source_normals=normals, target_normals=normals)
        >>> reg.converged, bool((reg.T_target_source[:3, 3] - shift).abs().max() < 0.01)
        (True, True)
    """
    checked = _checked("source", source, source_normals), _checked("target", target, target_normals)
    start = None if initial is None else check_rigid("initial", initial)
    o3d = open3d()
    moving, fixed = (_cloud(o3d, *cloud) for cloud in checked)
    if start is not None and (found := _refined(o3d, moving, fixed, start.numpy())).converged:
        return found
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):  # few features that agree are no fault
        return _refined(o3d, moving, fixed, _by_features(o3d, moving, fixed))


def checked_points(name: str, values: Tensor, number: int | None = None) -> Tensor:
    """Points or normals (N, 3) in float64 on the CPU, as many as are asked for, or raise."""
    check_float_tensor(name, values)
    if values.dim() != 2 or values.shape[1] != 3 or number not in (None, len(values)):
        raise ValueError(f"{name}: expected ({'N' if number is None else number}, 3), got {tuple(values.shape)}")
    if len(values) == 0:
        raise ValueError(f"{name}: expected points, got none: no contact?")
    values = values.detach().resolve_neg().cpu().double()
    if not bool(torch.isfinite(values).all()):
        number = int((~torch.isfinite(values)).any(1).sum())
        raise ValueError(f"{name}: expected finite values, got {number} lines with NaN or infinity")
    return values


def _checked(name: str, points: Tensor, normals: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Points without duplicates, and unit normals, or raise."""
    points = checked_points(name, points)
    if normals is not None:
        normals = torch.nn.functional.normalize(checked_points(f"{name}_normals", normals, len(points)), dim=1)
        if not bool((normals.norm(dim=1) > 0.5).all()):
            raise ValueError(f"{name}_normals: expected unit normals, got some of no length")
    first = np.sort(np.unique(points.numpy(), axis=0, return_index=True)[1])
    if len(first) < LEAST_CELLS:
        raise ValueError(f"{name}: expected at least {LEAST_CELLS} distinct points, got {len(first)} of {len(points)}")
    points, normals = points[first], None if normals is None else normals[first]
    spread = torch.linalg.svdvals(points - points.mean(0))
    if float(spread[1]) < 1e-6 * float(spread[0]):
        raise ValueError(f"{name}: expected a surface, got points on one line")
    return points, normals


def _by_features(o3d: Any, source: Any, target: Any) -> Any:
    """A pose (4, 4) from FPFH features and sample consensus on thinned clouds, then ICP on these."""
    few = [cloud.farthest_point_down_sample(min(SEARCH_POINTS, len(cloud.points))) for cloud in (source, target)]
    spacing, registration = max(map(_spacing, few)), o3d.pipelines.registration
    near = o3d.geometry.KDTreeSearchParamHybrid(radius=6.0 * spacing, max_nn=100)
    features = [registration.compute_fpfh_feature(cloud, near) for cloud in few]
    o3d.utility.random.seed(0)
    rough = registration.registration_ransac_based_on_feature_matching(
        *few, *features, True, 1.5 * spacing, checkers=[registration.CorrespondenceCheckerBasedOnEdgeLength(0.9)],
        criteria=registration.RANSACConvergenceCriteria(100_000, 0.999),
    )  # fmt: skip
    return _icp(o3d, few[0], few[1], rough.transformation, 3.0 * spacing)


def _cloud(o3d: Any, points: Tensor, normals: Tensor | None) -> Any:
    """As Open3D's cloud, with normals."""
    made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.numpy()))
    if normals is None:
        made.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(12))
    else:
        made.normals = o3d.utility.Vector3dVector(normals.numpy())
    return made


def _spacing(cloud: Any) -> float:
    """Median distance of a point from the nearest other one, mm."""
    return max(float(np.median(cloud.compute_nearest_neighbor_distance())), 1e-9)


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
    back = o3d.pipelines.registration.evaluate_registration(target, source, reach, np.linalg.inv(pose))
    fitness = max(forth.fitness, back.fitness)  # one cloud may be a part of the other
    pairs = np.asarray(forth.correspondence_set).reshape(-1, 2)
    paired = np.asarray(source.points)[pairs[:, 0]] @ pose[:3, :3].T + pose[:3, 3]
    goal, normal = np.asarray(target.points)[pairs[:, 1]], np.asarray(target.normals)[pairs[:, 1]]
    rmse_mm = math.sqrt(float(np.square(((paired - goal) * normal).sum(1)).mean())) if len(pairs) else math.inf
    share = f"{100 * fitness:.0f} % of the points have a neighbour in the other cloud"
    thickness = math.sqrt(max(float(np.linalg.eigvalsh(np.cov(np.asarray(target.points).T))[0]), 0.0))
    if fitness < LEAST_SHARE or rmse_mm > max(MOST_RMSE * thickness, 0.05 * reach) or len(pairs) < LEAST_CELLS:
        unknown = torch.diag(torch.tensor([1.0] * 3 + [UNKNOWN_VARIANCE] * 3, dtype=torch.float64))
        share = f"{share}, which differ by {rmse_mm:.3f} mm along the normal; register_depth is more certain"
        return Registration(torch.tensor(pose), rmse_mm, fitness, False, f"nothing fits: {share}", unknown)
    names, covariance = _determined(paired, normal, rmse_mm)
    message = share + (f"; the surface slides on itself: {', '.join(names)} unknown" if names else "")
    return Registration(torch.tensor(pose), rmse_mm, fitness, True, message, covariance, names)


def _determined(points: Array, normal: Array, rmse_mm: float) -> tuple[list[str], Tensor]:
    """Names of the motions that the paired points (N, 3) do not determine, and the covariance (6, 6) about the origin."""
    middle = points - points.mean(0)
    units = np.array([1.0 / math.sqrt(float(np.square(middle).sum(1).mean()))] * 3 + [1.0] * 3)
    jacobian = np.hstack((np.cross(middle, normal), normal)) * units
    free = free_directions(jacobian.T @ jacobian / len(jacobian), np.zeros((6, 6)), LEAST_INFORMATION)
    about_origin = np.hstack((np.cross(points, normal), normal))
    known = about_origin.T @ about_origin * (min(1.0, ALIKE_POINTS / len(points)) / max(rmse_mm, 1e-6) ** 2)
    return name_directions(free), torch.from_numpy(np.linalg.inv(known + np.diag([1.0] * 3 + [0.01] * 3)))
