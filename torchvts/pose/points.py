"""Pose from two point clouds: as reliefs where they are such, else by their own axes and features; then nearest points."""

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, unfold

from ..core.checks import check_tensor
from .ambiguity import free_directions, name_directions
from .clouds import open3d, thin, voxel_first
from .direct import UNKNOWN_VARIANCE, align, rigid
from .relief import LEAST_DEPTH_MM, Levels, relief, slope_noise, without_rim
from .result import Registration, invert, motion, turn_deg

LEAST_POINTS = 10
"""A cloud of fewer points has no pose."""

LEAST_OVERLAP = 0.5
"""Of clouds as reliefs: thinned, narrow walls are lost, and a stamp the wrong way round agrees on a quarter of itself."""

SEARCH_POINTS = 1000
"""To so many the clouds are thinned while hypotheses are compared."""

FINE_POINTS = 20000
"""To so many for the last steps."""

LEAST_INFORMATION = 1e-3
"""Mean squared share of a motion of 1 mm that goes along the normals, below which it is called unknown."""


def register_points(
    source: Tensor,
    target: Tensor,
    *,
    source_normals: Tensor | None = None,
    target_normals: Tensor | None = None,
    initial: Tensor | None = None,
) -> Registration:
    """Pose of one point cloud relative to another.

    Clouds that are reliefs over x and y, as contacts are, are compared as such: every turn and shift in the plane, then slopes
    and heights. Clouds of any other shape, or turned out of the plane, start from their principal axes and, where Open3D is
    installed, from FPFH features and sample consensus. Iterated nearest points end it: point to plane, and point to point where
    the clouds are copies of each other.

    Args:
        source, target: (N, 3) and (M, 3), mm, right-handed, x right, y up, z to the camera (:func:`torchvts.depth_to_points`).
        source_normals, target_normals: their unit normals, of the same shape; estimated from the points if absent. Photometric
            normals are better than any estimate.
        initial: T_target_source (4, 4) to try first.
    Returns:
        The registration; ``converged`` is False if nothing fits.
    Raises:
        ValueError: not (N, 3), not finite, fewer than 10 distinct points, or points on one line. TypeError: no tensors.
    Source:
        Chen, Medioni 1992 for point to plane; Rusu, Blodow, Beetz 2009 for FPFH; the search over the plane is this project's.
    Example:
        >>> points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 5
        >>> shift = torch.tensor([1.0, 0.5, 0.2], dtype=torch.float64)
        >>> reg = register_points(points, points + shift)
        >>> reg.converged, bool((reg.T_target_source[:3, 3] - shift).abs().max() < 1e-4)
        (True, True)
    """
    source, source_normals = _checked("source", source, source_normals)
    target, target_normals = _checked("target", target, target_normals)
    start = None if initial is None else rigid("initial", initial)
    found = _as_reliefs(source, target, source_normals, target_normals, start)
    if found is None and start is None:
        found = _levelled(source, target, source_normals, target_normals)
    if found is not None and found.converged and found.ambiguous:
        return found  # nearest points would only drift along what is unknown
    clouds = _Pair(source, target, target_normals)
    if found is not None and found.converged:
        # the reliefs know of what does not touch, and of symmetry; nearest points only make copies exact
        for pose in (found.T_target_source, *found.alternatives):
            exact = clouds.as_copies(clouds.approach(pose))
            if exact is not None:
                return replace(found, T_target_source=exact, rmse_mm=clouds.finish(exact).rmse_mm, alternatives=[])
        return found
    if found is not None:
        exact = clouds.as_copies(clouds.approach(found.T_target_source))
        return found if exact is None else clouds.finish(exact)
    poses = [torch.eye(4, dtype=torch.float64), *_axes(source, target)]
    ranked = clouds.ranked(poses if start is None else [start, *poses])
    for widen in (None, _turned, _by_features):
        if widen is not None:
            ranked = clouds.ranked([ranked[0][1], *widen(ranked[0][1], clouds)])
        for _, pose in ranked[:8]:
            exact = clouds.as_copies(pose)
            if exact is not None:
                return clouds.finish(exact)
    result = clouds.finish(ranked[0][1])
    extent = torch.linalg.svdvals(target - target.mean(0))
    if float(extent[2]) < 0.25 * float(extent[1]):
        # flat clouds have near neighbours in any pose
        message = "nothing fits for sure: flat clouds that are no copies and do not agree as reliefs; register_depth sees more"
        return replace(result, converged=False, message=message, ambiguous=[])
    others = [pose for share, pose in ranked[1:] if share > ranked[0][0] - 0.01]
    apart = [pose for pose in others if float(turn_deg(pose @ invert(result.T_target_source))) > 3.0]
    return replace(result, alternatives=apart) if result.converged and not result.ambiguous else result


class _Pair:
    """Two clouds, thinned twice, with the target's normals."""

    def __init__(self, source: Tensor, target: Tensor, target_normals: Tensor | None) -> None:
        self.source, self.target = source, target
        self.few_s, self.few_t = thin(source, SEARCH_POINTS), thin(target, 2 * SEARCH_POINTS)
        self.spacing = max(_spacing(source[self.few_s]), _spacing(target[self.few_t]))
        self.full_s, self.full_t = thin(source, FINE_POINTS), thin(target, 5 * FINE_POINTS)
        points_t = target[self.full_t]
        self.tree, self.tree_s = _Tree(points_t), _Tree(source[self.full_s])
        self.normals = _normals(points_t, self.tree) if target_normals is None else target_normals[self.full_t]
        few = target[self.few_t]
        self.few_normals = _normals(few, _Tree(few)) if target_normals is None else target_normals[self.few_t]

    def ranked(self, poses: list[Tensor]) -> list[tuple[float, Tensor]]:
        """The hypotheses after some steps, best first, with the share of points near the other cloud."""
        return sorted(((self._share(pose), pose) for pose in map(self.approach, poses)), key=lambda entry: -entry[0])

    def approach(self, pose: Tensor) -> Tensor:
        """Point to plane on the thinned clouds."""
        reach = 8.0 * self.spacing
        for _ in range(15):
            reach = max(1.5 * self.spacing, 0.75 * reach)
            moved_on = self._step(pose, self.source[self.few_s], self.target[self.few_t], self.few_normals, reach)
            settled = reach <= 1.5 * self.spacing and float((moved_on - pose).abs().max()) < 1e-4
            pose = moved_on
            if settled:
                break
        return pose

    def _share(self, pose: Tensor) -> float:
        moved = _move(pose, self.source[self.few_s])
        distance = torch.cdist(moved, self.target[self.few_t])
        near = 1.0 - (distance.min(1).values / self.spacing).clamp_max(1.0).square()
        back = 1.0 - (distance.min(0).values / self.spacing).clamp_max(1.0).square()
        return 0.5 * float(near.mean() + back.mean())

    @staticmethod
    def _step(pose: Tensor, source: Tensor, target: Tensor, normals: Tensor, reach: float, tree: "_Tree | None" = None) -> Tensor:
        moved = _move(pose, source)
        if tree is None:
            distance, index = torch.cdist(moved, target).min(1)
        else:
            distance, index = tree.nearest(moved)
        near = distance < reach
        if int(near.sum()) < 6:
            return pose
        p, q, n = moved[near], target[index[near]], normals[index[near]]
        center = p.mean(0)
        residual = ((q - p) * n).sum(1)
        scale = 2.0 * float(residual.abs().median()) + 1e-9
        weight = 1.0 / (1.0 + (residual / scale) ** 2)
        jacobian = torch.cat((torch.linalg.cross(p - center, n, dim=1), n), 1)
        matrix = jacobian.T @ (jacobian * weight[:, None])
        matrix = matrix + 1e-6 * float(matrix.diagonal().max()) * torch.eye(6, dtype=matrix.dtype)
        return motion(torch.linalg.solve(matrix, jacobian.T @ (weight * residual)), center) @ pose

    def finish(self, pose: Tensor) -> Registration:
        source, target = self.source[self.full_s], self.target[self.full_t]
        spacing = _spacing(target)
        for k in range(12):
            pose = self._step(pose, source, target, self.normals, max(1.5 * spacing, 3.0 * self.spacing * 0.7**k), self.tree)
        exact = self.as_copies(pose)
        pose = pose if exact is None else exact
        moved = _move(pose, source)
        distance, index = self.tree.nearest(moved)
        back, _ = self.tree_s.nearest(_move(invert(pose), target))
        reach = 1.5 * max(spacing, _spacing(source))
        near = distance < reach
        fitness = min(1.0, max(float(near.double().mean()), float((back < reach).double().mean())))
        normal = self.normals[index[near]]
        off = ((moved[near] - target[index[near]]) * normal).sum(1)
        rmse_mm = float(off.square().mean().sqrt()) if bool(near.any()) else math.inf
        size = float((target - target.mean(0)).square().sum(1).mean().sqrt())
        converged = fitness >= 0.8 and rmse_mm < 0.3 * reach and int(near.sum()) >= LEAST_POINTS
        covariance = torch.diag(torch.tensor([1.0] * 3 + [UNKNOWN_VARIANCE] * 3, dtype=torch.float64))
        if not converged:
            message = f"nothing fits: {100 * fitness:.0f} % of the points have a neighbour in the other cloud"
            return Registration(pose, rmse_mm, fitness, False, message, covariance)
        center = moved[near].mean(0)
        units = torch.tensor([1.0 / size] * 3 + [1.0] * 3, dtype=torch.float64)
        jacobian = torch.cat((torch.linalg.cross(moved[near] - center, normal, dim=1), normal), 1) * units
        information = jacobian.T @ jacobian / len(jacobian)
        free, shifts = free_directions(information, torch.zeros(6, 6, dtype=torch.float64), LEAST_INFORMATION)
        names = name_directions(free, shifts)
        about_origin = torch.cat((torch.linalg.cross(moved[near], normal, dim=1), normal), 1)
        known = about_origin.T @ about_origin / max(rmse_mm, 1e-6) ** 2
        covariance = torch.linalg.inv(known + torch.diag(torch.tensor([1.0] * 3 + [0.01] * 3, dtype=torch.float64)))
        message = f"{100 * fitness:.0f} % of the points have a neighbour in the other cloud"
        message += f"; the surface slides on itself: {', '.join(names)} unknown" if names else ""
        return Registration(pose, rmse_mm, fitness, True, message, covariance, names)

    def as_copies(self, pose: Tensor) -> Tensor | None:
        """Point to point over nearest points; None unless the points then fall on each other."""
        few, target = self.source[self.few_s], self.target[self.full_t]
        spacing = _spacing(target)
        for reach in (4.0, 2.0, 1.0, 0.7, 0.7, 0.7):
            distance, index = self.tree.nearest(_move(pose, few))
            near = distance < max(reach * spacing, float(distance.median()))
            pose = _rigid_between(few[near], target[index[near]])
        for points in (few, self.source[self.full_s]):
            distance, index = self.tree.nearest(_move(pose, points))
            exact = distance < 0.02 * spacing
            if float(exact.double().mean()) < 0.3:
                return None
            pose = _rigid_between(points[exact], target[index[exact]])
        return pose


class _Tree:
    """Nearest points of a cloud, by OpenCV's k-d tree."""

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


def _checked(name: str, points: Tensor, normals: Tensor | None) -> tuple[Tensor, Tensor | None]:
    if not isinstance(points, Tensor):
        raise TypeError(f"{name}: expected a tensor (N, 3), got {type(points).__name__}")
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
    return points, normals


def _as_reliefs(
    source: Tensor, target: Tensor, source_normals: Tensor | None, target_normals: Tensor | None, start: Tensor | None
) -> Registration | None:
    """Registration of the clouds as height maps over x and y; None if they are not such."""
    pitch = max(_spacing_plane(source), _spacing_plane(target))
    lowest = [float(cloud[:, 2].min()) for cloud in (source, target)]
    skin = all(-0.02 < low < 0.15 for low in lowest)  # a contact's own frame: the skin at rest is at 0
    lift = torch.zeros(3, dtype=torch.float64)
    lift[2] = 0.0 if skin else 2.0 - min(lowest)  # elsewhere nothing is known of what does not touch: all counts as deep
    grids: list[Levels] = []
    for points, normals in ((source, source_normals), (target, target_normals)):
        grid = _grid(points + lift, normals, pitch, skin)
        if grid is None:
            return None
        grids.append(grid)
    up = torch.eye(4, dtype=torch.float64)
    up[:3, 3] = lift
    try:
        found = align(grids[0], grids[1], None if start is None else up @ start @ invert(up))
    except ValueError:
        return None
    if found.converged and found.overlap < LEAST_OVERLAP:
        message = f"nothing fits for sure: only {found.overlap:.0%} of the smaller cloud is comparable; register_depth sees more"
        found = replace(found, converged=False, message=message, ambiguous=[], alternatives=[])
    return _seen_from(found, invert(up), up)


def _seen_from(found: Registration, to_target: Tensor, from_source: Tensor) -> Registration:
    """A registration of clouds that were moved, for the clouds as they were: the moves into the true target, from the source."""
    turn = torch.zeros(6, 6, dtype=torch.float64)
    turn[:3, :3], turn[3:, 3:] = to_target[:3, :3], to_target[:3, :3]
    arm = to_target[:3, 3]  # twists about the moved origin become twists about the true one
    turn[3:, :3] = torch.linalg.cross(arm[:, None].expand(3, 3), to_target[:3, :3], dim=0)
    return replace(
        found,
        T_target_source=to_target @ found.T_target_source @ from_source,
        alternatives=[to_target @ T @ from_source for T in found.alternatives],
        covariance=turn @ found.covariance @ turn.T,
    )


def _levelled(source: Tensor, target: Tensor, source_normals: Tensor | None, target_normals: Tensor | None) -> Registration | None:
    """The same after both are laid flat, the target either side up; None if neither way fits."""
    results = []
    to_s = _flat_frame(source)
    laid_s = _move(to_s, source), None if source_normals is None else source_normals @ to_s[:3, :3].T
    for side in (1.0, -1.0):
        to_t = torch.diag(torch.tensor([1.0, side, side, 1.0], dtype=torch.float64)) @ _flat_frame(target)
        laid_t = _move(to_t, target), None if target_normals is None else target_normals @ to_t[:3, :3].T
        found = _as_reliefs(laid_s[0], laid_t[0], laid_s[1], laid_t[1], None)
        if found is None or not found.converged:
            continue
        words = [name.replace(" along ", " along the laid ").replace(" about ", " about the laid ") for name in found.ambiguous]
        results.append(replace(_seen_from(found, invert(to_t), to_s), ambiguous=words))
    return min(results, key=lambda r: r.rmse_mm / max(r.fitness, 0.1)) if results else None


def _flat_frame(points: Tensor) -> Tensor:
    """Rigid motion that lays a cloud flat: its middle at zero, its flattest axis along z."""
    center = points.mean(0)
    axes = torch.linalg.svd(points - center, full_matrices=False).Vh
    axes[2] = torch.linalg.cross(axes[0], axes[1])
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, :3], frame[:3, 3] = axes, -axes @ center
    return frame


def _grid(points: Tensor, normals: Tensor | None, pitch: float, skin: bool) -> Levels | None:
    """The cloud on three grids; None if it is no relief over x and y, or too small."""
    flattest = _flat_frame(points)[2, :3]
    if abs(float(flattest[2])) < 0.9:
        return None  # steep as a whole
    low, high = points[:, :2].amin(0), points[:, :2].amax(0)
    off = (points[:, :2] - low) / pitch
    lattice = float((off - off.round()).abs().max()) < 0.05 and _is_full(off.round().long())
    pitch = pitch if lattice else 0.5 * pitch
    columns, rows = (((high - low) / pitch).round().long() + 1).tolist()
    if columns * rows > 4_000_000 or columns < 6 or rows < 6:
        return None
    border = 2
    size = rows + 2 * border, columns + 2 * border
    corner = (float(low[0]) - border * pitch, float(high[1]) + border * pitch)
    laid = points - torch.tensor([corner[0], corner[1], 0.0], dtype=torch.float64)
    drawn = _by_cells(laid, normals, size, pitch) if lattice else _by_neighbours(laid, normals, size, pitch)
    if drawn is None:
        return None  # several heights over one place
    z, slopes, inside, noise = drawn
    first = max(1, math.ceil(max(z.shape) / 330))
    every = [max(1, min(times, round(0.3 / (pitch * first)))) * first for times in (1, 2, 4)]
    deep = inside & (z > LEAST_DEPTH_MM) if skin else inside
    perhaps = deep if skin else torch.ones_like(inside)
    deep = deep & without_rim(inside[None])[0]  # at the edge slopes look one way only
    made = [relief(z, slopes, deep, perhaps, pitch, times, corner) for times in every]
    if min(len(one.points) for one in made) < 12:
        return None
    return Levels(made[0], made[1], made[2], noise / (every[2] if lattice else 1))


def _is_full(cells: Tensor) -> bool:
    """Whether cells (N, 2) of a grid leave hardly any hole among them, as pixels of a contact do, unlike a thinned cloud."""
    columns, rows = (cells.amax(0) + 1).tolist()
    known = torch.zeros(1, 1, rows, columns)
    known[0, 0, cells[:, 1], cells[:, 0]] = 1.0
    holes = (known == 0) & (avg_pool2d(known, 3, 1, 1) > 4.5 / 9.0)
    return float(holes.sum()) < 0.03 * len(cells)


def _by_cells(
    points: Tensor, normals: Tensor | None, size: tuple[int, int], pitch: float
) -> tuple[Tensor, Tensor, Tensor, float] | None:
    """Heights (H, W), slopes (2, H, W), where they are known (H, W), and their noise, of points on a grid."""
    rows, columns = size
    column, row = (points[:, 0] / pitch).round().long(), (-points[:, 1] / pitch).round().long()
    cell = row * columns + column
    count = torch.zeros(rows * columns, dtype=torch.float64).index_add_(0, cell, torch.ones(len(points), dtype=torch.float64))

    def mean(values: Tensor) -> Tensor:
        total = torch.zeros(rows * columns, dtype=torch.float64).index_add_(0, cell, values)
        return (total / count.clamp_min(1.0)).reshape(rows, columns)

    z = mean(points[:, 2])
    if float((points[:, 2] - z.flatten()[cell]).abs().max()) > 3.0 * pitch:
        return None
    known = (count > 0).reshape(rows, columns)
    if normals is None:
        slopes = _slopes(z.float(), known, pitch)
    else:
        upright = normals[:, 2].clamp_min(0.1)
        slopes = torch.stack((mean(-normals[:, 0] / upright), mean(-normals[:, 1] / upright))).float()
    return z.float(), slopes, known, slope_noise(slopes, known)


def _by_neighbours(
    points: Tensor, normals: Tensor | None, size: tuple[int, int], pitch: float
) -> tuple[Tensor, Tensor, Tensor, float] | None:
    """The same of scattered points: planes through the nearest ones, or, with normals, the mean of the planes that these give."""
    rows, columns = size
    flat = torch.cat((points[:, :2], torch.zeros(len(points), 1, dtype=points.dtype)), 1)
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    cells = torch.stack((column * pitch, -row * pitch, torch.zeros_like(row)), -1).reshape(-1, 3).double()
    distance, index = _Tree(flat).nearest(cells, min(9 if normals is None else 5, len(points)))
    spacing = 2.0 * pitch
    inside = distance[:, 0] < 0.8 * spacing
    index, distance = index[inside], distance[inside]
    wide = 0.8 * spacing if normals is None else 0.5 * spacing
    weight = torch.exp(-0.5 * (distance / wide) ** 2)
    weight = weight / weight.sum(1, keepdim=True)
    away = points[index, :2] - cells[inside][:, None, :2]  # (C, k, 2)
    heights = points[index, 2]
    if float(torch.quantile((heights - (weight * heights).sum(1, keepdim=True)).abs().amax(1)[:100_000], 0.9)) > 8.0 * spacing:
        return None
    noise = 0.005
    if normals is None:
        place = torch.cat((torch.ones_like(away[..., :1]), away), -1)
        weighted = (place * weight[..., None]).transpose(1, 2)
        ridge = 1e-4 * torch.diag(torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64)) * spacing**2
        plane = torch.linalg.solve(weighted @ place + ridge, weighted @ heights[..., None])[..., 0]
        height, slope = plane[:, 0], plane[:, 1:]
    else:
        tilt = -normals[:, :2] / normals[:, 2:].clamp_min(0.1)
        slope = (weight[..., None] * tilt[index]).sum(1)
        height = (weight * (heights - (tilt[index] * away).sum(-1))).sum(1)
        noise = min(0.012, float((tilt[index[:, 0]] - slope).abs().median()) / 0.6745)
    z, slopes = torch.zeros(rows * columns), torch.zeros(2, rows * columns)
    z[inside], slopes[:, inside] = height.float(), slope.T.float()
    return z.reshape(rows, columns), slopes.reshape(2, rows, columns), inside.reshape(rows, columns), noise


def _slopes(z: Tensor, inside: Tensor, pitch: float) -> Tensor:
    """Slopes (2, H, W), y up, of planes through 3 x 3 heights inside."""
    side = (-1.0, 0.0, 1.0)
    place = torch.tensor([[1.0, x, -y] for y in side for x in side])
    weight = unfold(inside.float()[None, None], 3, padding=1)[0].T
    heights = unfold(z[None, None], 3, padding=1)[0].T[..., None]
    weighted = place.T * weight[:, None]
    ridge = torch.diag(torch.tensor([1e-9, 1e-3, 1e-3]))
    middle = z.reshape(-1, 1, 1)
    plane = torch.linalg.solve(weighted @ place + ridge, weighted @ (heights - middle))
    slopes: Tensor = (plane[:, 1:, 0].T / pitch).reshape(2, *z.shape) * inside
    return slopes


def _axes(source: Tensor, target: Tensor) -> list[Tensor]:
    """Poses that lay the principal axes on each other: four, for each axis may point either way."""
    back, to = invert(_flat_frame(target)), _flat_frame(source)
    flips = [torch.diag(torch.tensor([a, b, a * b, 1.0], dtype=torch.float64)) for a in (1.0, -1.0) for b in (1.0, -1.0)]
    return [back @ flip @ to for flip in flips]


def _turned(pose: Tensor, pair: _Pair) -> list[Tensor]:
    """The pose turned about the target's flattest axis, all around."""
    center, axis = pair.target.mean(0), _flat_frame(pair.target)[2, :3]
    angles = torch.deg2rad(torch.arange(10.0, 360.0, 10.0, dtype=torch.float64))
    twists = torch.cat((angles[:, None] * axis, torch.zeros(len(angles), 3, dtype=torch.float64)), 1)
    return list(motion(twists, center.expand(len(angles), 3)) @ pose)


def _by_features(pose: Tensor, pair: _Pair) -> list[Tensor]:
    """A pose from FPFH features and sample consensus; none where Open3D is not installed."""
    del pose
    try:
        o3d = open3d()
    except ImportError:
        return []
    clouds, features = [], []
    for points in (pair.source[pair.few_s], pair.target[pair.few_t]):
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.numpy()))
        cloud.normals = o3d.utility.Vector3dVector(_normals(points, _Tree(points)).numpy())
        search = o3d.geometry.KDTreeSearchParamHybrid(radius=6.0 * pair.spacing, max_nn=100)
        features.append(o3d.pipelines.registration.compute_fpfh_feature(cloud, search))
        clouds.append(cloud)
    o3d.utility.random.seed(0)
    found = o3d.pipelines.registration.registration_ransac_based_on_feature_matching(
        clouds[0], clouds[1], features[0], features[1], True, 1.5 * pair.spacing,
        criteria=o3d.pipelines.registration.RANSACConvergenceCriteria(20000, 0.999),
    )  # fmt: skip
    return [torch.from_numpy(found.transformation.copy())]


def _normals(points: Tensor, tree: _Tree, neighbours: int = 12) -> Tensor:
    """Normals of planes through nearest points, towards the camera."""
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


def _move(pose: Tensor, points: Tensor) -> Tensor:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _spacing(points: Tensor) -> float:
    """Median distance to the nearest other point."""
    some = points[:: max(1, len(points) // 500)]
    distance, _ = _Tree(points).nearest(some, 2)
    return max(float(distance[:, 1].median()), 1e-9)


def _spacing_plane(points: Tensor) -> float:
    """The same over x and y only, where points of one place count once; for scattered points the side of their mean cell."""
    flat = torch.cat((points[:, :2], torch.zeros(len(points), 1, dtype=points.dtype)), 1)
    nearest = _spacing(flat)
    covered = len(voxel_first(flat, 4.0 * nearest)) * 16.0 * nearest**2
    return max(nearest, math.sqrt(covered / len(points)) if nearest < 0.7 * math.sqrt(covered / len(points)) else nearest)
