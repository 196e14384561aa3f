"""Pose from two point clouds: as height maps where they are such, else from principal axes and features; then ICP."""

from dataclasses import replace

import torch
from torch import Tensor

from ..core.checks import check_float_tensor, check_tensor
from .clouds import open3d
from .direct import check_rigid
from .height_maps import Cloud, principal_frame, register_flattened, register_height_maps
from .icp import LEAST_POINTS, Correspondence, Tree, estimate_normals
from .result import Registration, invert, motion, turn_deg


def register_points(
    source: Tensor,
    target: Tensor,
    *,
    source_normals: Tensor | None = None,
    target_normals: Tensor | None = None,
    initial: Tensor | None = None,
) -> Registration:
    """Pose of one point cloud relative to another.

    Clouds that are height maps over x and y, as contacts are, are compared as such: every rotation and shift in the plane, then
    slopes and heights. Clouds of any other shape, or rotated out of the plane, start from their principal axes and, where Open3D
    is installed, from FPFH features and sample consensus. Iterated closest points (ICP) end it: point to plane, and point to
    point where the clouds are copies of each other.

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
        ValueError: not (N, 3), not finite, fewer than 10 distinct points, or points on one line.
        TypeError: no tensors.
    Source:
        Chen, Medioni 1992 for point to plane; Rusu, Blodow, Beetz 2009 for FPFH; the search over the plane is this project's.
    Example:
        >>> points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 5
        >>> shift = torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64)
        >>> reg = register_points(points, points + shift)
        >>> reg.converged, bool((reg.T_target_source[:3, 3] - shift).abs().max() < 1e-4)
        (True, True)
    """
    a = _check_cloud("source", source, source_normals)
    b = _check_cloud("target", target, target_normals)
    start = None if initial is None else check_rigid("initial", initial)
    found = register_height_maps(a, b, start)
    if found is None and start is None:
        found = register_flattened(a, b)
    if found is not None and found.converged and found.ambiguous:
        return found  # ICP would only drift along the unknown motions
    clouds = Correspondence(a.points, b.points, b.normals)
    if found is not None:
        return _polish(found, clouds)
    return _register_any_shape(a, b, clouds, start)


def _polish(found: Registration, clouds: Correspondence) -> Registration:
    """Make the pose exact where the clouds are copies; height maps know more about missing contact and symmetry than ICP does."""
    poses = [found.T_target_source, *(found.alternatives if found.converged else [])]
    for pose in poses:
        exact = clouds.as_copies(clouds.approach(pose))
        if exact is not None:
            result = clouds.finish(exact)
            if not found.converged:
                return result
            return replace(found, T_target_source=exact, rmse_mm=result.rmse_mm, alternatives=[])
    return found


def _register_any_shape(a: Cloud, b: Cloud, clouds: Correspondence, start: Tensor | None) -> Registration:
    """ICP from ever more starting poses, until the clouds turn out to be copies; else the best pose."""
    poses = [torch.eye(4, dtype=torch.float64), *_poses_of_axes(a.points, b.points)]
    ranked = clouds.ranked(poses if start is None else [start, *poses])
    for widen in (None, _turned, _from_features):
        if widen is not None:
            ranked = clouds.ranked([ranked[0][1], *widen(ranked[0][1], clouds)])
        for _, pose in ranked[:8]:
            exact = clouds.as_copies(pose)
            if exact is not None:
                return clouds.finish(exact)
    result = clouds.finish(ranked[0][1])
    extent = torch.linalg.svdvals(b.points - b.points.mean(0))
    if float(extent[2]) < 0.25 * float(extent[1]):
        # flat clouds have near neighbours in any pose
        message = "no certain fit: flat clouds that are no copies and do not agree as height maps; register_depth is more certain"
        return replace(result, converged=False, message=message, ambiguous=[])
    if not result.converged or result.ambiguous:
        return result
    others = [pose for share, pose in ranked[1:] if share > ranked[0][0] - 0.01]
    back = invert(result.T_target_source)
    return replace(result, alternatives=[pose for pose in others if float(turn_deg(pose @ back)) > 3.0])


def _check_cloud(name: str, points: Tensor, normals: Tensor | None) -> Cloud:
    """A cloud in float64 without duplicate points, or raise."""
    check_float_tensor(name, points)
    if points.dim() != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected (N, 3), got {tuple(points.shape)}")
    if len(points) == 0:
        raise ValueError(f"{name}: expected points, got none: no contact?")
    points = points.detach().cpu().double()
    if not bool(torch.isfinite(points).all()):
        raise ValueError(f"{name}: expected finite points, got {int((~torch.isfinite(points)).any(1).sum())} with NaN or infinity")
    if normals is not None:
        check_tensor(f"{name}_normals", normals)
        if tuple(normals.shape) != tuple(points.shape):
            raise ValueError(f"{name}_normals: expected {tuple(points.shape)} like the points, got {tuple(normals.shape)}")
        normals = torch.nn.functional.normalize(normals.detach().cpu().double(), dim=1)
        if not bool((normals.norm(dim=1) > 0.5).all()):  # NaN too
            raise ValueError(f"{name}_normals: expected finite normals, got NaN, infinite or zero ones")
    distinct, inverse = torch.unique(points, dim=0, return_inverse=True)
    if len(distinct) < LEAST_POINTS:
        raise ValueError(f"{name}: expected at least {LEAST_POINTS} distinct points, got {len(distinct)} of {len(points)}")
    if len(distinct) < len(points):
        first = torch.full((len(distinct),), len(points)).scatter_reduce(0, inverse, torch.arange(len(points)), "amin")
        first = first.sort().values
        points, normals = points[first], None if normals is None else normals[first]
    spread = torch.linalg.svdvals(points - points.mean(0))
    if float(spread[1]) < 1e-6 * float(spread[0]):
        raise ValueError(f"{name}: expected a surface, got points on one line")
    return Cloud(points, normals)


def _poses_of_axes(source: Tensor, target: Tensor) -> list[Tensor]:
    """Poses that align the principal axes: four, because each axis may point either way."""
    back, to = invert(principal_frame(target)), principal_frame(source)
    flips = [torch.diag(torch.tensor([a, b, a * b, 1.0], dtype=torch.float64)) for a in (1.0, -1.0) for b in (1.0, -1.0)]
    return [back @ flip @ to for flip in flips]


def _turned(pose: Tensor, clouds: Correspondence) -> list[Tensor]:
    """The pose rotated about the target's flattest axis in steps of 10 degrees."""
    center, axis = clouds.target.mean(0), principal_frame(clouds.target)[2, :3]
    angles = torch.deg2rad(torch.arange(10.0, 360.0, 10.0, dtype=torch.float64))
    twists = torch.cat((angles[:, None] * axis, torch.zeros(len(angles), 3, dtype=torch.float64)), 1)
    return list(motion(twists, center.expand(len(angles), 3)) @ pose)


def _from_features(pose: Tensor, clouds: Correspondence) -> list[Tensor]:
    """A pose from FPFH features and sample consensus; none where Open3D is not installed."""
    del pose
    try:
        o3d = open3d()
    except ImportError:
        return []
    made, features = [], []
    for points in (clouds.coarse_source, clouds.coarse_target):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.numpy()))
        cloud.normals = o3d.utility.Vector3dVector(estimate_normals(points, Tree(points)).numpy())
        search = o3d.geometry.KDTreeSearchParamHybrid(radius=6.0 * clouds.spacing, max_nn=100)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, search))
        made.append(cloud)
    o3d.utility.random.seed(0)
    found = o3d.pipelines.registration.registration_ransac_based_on_feature_matching(
        made[0], made[1], features[0], features[1], True, 1.5 * clouds.spacing,
        criteria=o3d.pipelines.registration.RANSACConvergenceCriteria(20000, 0.999),
    )  # fmt: skip
    return [torch.from_numpy(found.transformation.copy())]
