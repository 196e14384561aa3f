"""Point clouds as height maps over x and y: drawn on grids, then registered as depth frames are."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, unfold

from .clouds import voxel_first
from .direct import align
from .icp import Tree, spacing, transform
from .relief import LEAST_DEPTH_MM, Levels, relief, slope_noise, without_rim
from .result import Registration, invert

LEAST_OVERLAP = 0.5
"""Least overlap that converges: thinning loses narrow walls, and a stamp the wrong way round agrees on a quarter of itself."""

MOST_CELLS = 4_000_000
"""Largest number of cells of a grid."""


class Cloud(NamedTuple):
    """Points (N, 3) float64, mm, and their unit normals (N, 3), if known."""

    points: Tensor
    normals: Tensor | None


class _HeightMap(NamedTuple):
    """Heights (H, W), mm, slopes (2, H, W), y up, where both are known (H, W) bool, and the noise of the slopes."""

    height: Tensor
    slope: Tensor
    known: Tensor
    noise: float


def register_height_maps(source: Cloud, target: Cloud, start: Tensor | None) -> Registration | None:
    """Register two clouds as height maps over x and y; None if they are not such."""
    pitch = max(_spacing_in_plane(source.points), _spacing_in_plane(target.points))
    lowest = [float(cloud.points[:, 2].min()) for cloud in (source, target)]
    skin = all(-0.02 < low < 0.15 for low in lowest)  # in a contact's own frame the undeformed skin is at 0
    lift = torch.zeros(3, dtype=torch.float64)
    lift[2] = 0.0 if skin else 2.0 - min(lowest)  # in other frames all points count as deep
    grids: list[Levels] = []
    for cloud in (source, target):
        grid = _grids(Cloud(cloud.points + lift, cloud.normals), pitch, skin)
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
        message = f"no certain fit: only {found.overlap:.0%} of the smaller cloud is comparable; register_depth is more certain"
        found = replace(found, converged=False, message=message, ambiguous=[], alternatives=[])
    return _change_frames(found, invert(up), up)


def register_flattened(source: Cloud, target: Cloud) -> Registration | None:
    """Register two clouds as height maps in their principal axes, the target either side up; None if neither way fits."""
    results = []
    to_s = principal_frame(source.points)
    flat_s = _in_frame(to_s, source)
    for side in (1.0, -1.0):
        to_t = torch.diag(torch.tensor([1.0, side, side, 1.0], dtype=torch.float64)) @ principal_frame(target.points)
        found = register_height_maps(flat_s, _in_frame(to_t, target), None)
        if found is None or not found.converged:
            continue
        names = [
            name.replace(" along ", " along the principal ").replace(" about ", " about the principal ") for name in found.ambiguous
        ]
        results.append(replace(_change_frames(found, invert(to_t), to_s), ambiguous=names))
    return min(results, key=lambda r: r.rmse_mm / max(r.fitness, 0.1)) if results else None


def principal_frame(points: Tensor) -> Tensor:
    """Rigid motion (4, 4) that puts the cloud's middle at zero and its flattest axis along z."""
    center = points.mean(0)
    axes = torch.linalg.svd(points - center, full_matrices=False).Vh
    axes[2] = torch.linalg.cross(axes[0], axes[1])
    frame = torch.eye(4, dtype=torch.float64)
    frame[:3, :3], frame[:3, 3] = axes, -axes @ center
    return frame


def _in_frame(frame: Tensor, cloud: Cloud) -> Cloud:
    return Cloud(transform(frame, cloud.points), None if cloud.normals is None else cloud.normals @ frame[:3, :3].T)


def _change_frames(found: Registration, to_target: Tensor, from_source: Tensor) -> Registration:
    """Express a registration of moved clouds for the original ones: motions (4, 4) into the original target, from the source."""
    turn = torch.zeros(6, 6, dtype=torch.float64)
    turn[:3, :3], turn[3:, 3:] = to_target[:3, :3], to_target[:3, :3]
    arm = to_target[:3, 3]  # twists about the moved origin become twists about the original one
    turn[3:, :3] = torch.linalg.cross(arm[:, None].expand(3, 3), to_target[:3, :3], dim=0)
    return replace(
        found,
        T_target_source=to_target @ found.T_target_source @ from_source,
        alternatives=[to_target @ T @ from_source for T in found.alternatives],
        covariance=turn @ found.covariance @ turn.T,
    )


def _grids(cloud: Cloud, pitch: float, skin: bool) -> Levels | None:
    """The cloud on three grids; None if it is no height map over x and y, or too small. ``skin``: low points are no contact."""
    points = cloud.points
    if abs(float(principal_frame(points)[2, 2])) < 0.9:
        return None  # steep as a whole
    low, high = points[:, :2].amin(0), points[:, :2].amax(0)
    off = (points[:, :2] - low) / pitch
    lattice = float((off - off.round()).abs().max()) < 0.05 and _is_full(off.round().long())
    pitch = pitch if lattice else 0.5 * pitch
    columns, rows = (((high - low) / pitch).round().long() + 1).tolist()
    if columns * rows > MOST_CELLS or columns < 6 or rows < 6:
        return None
    border = 2
    size = rows + 2 * border, columns + 2 * border
    corner = (float(low[0]) - border * pitch, float(high[1]) + border * pitch)
    shifted = Cloud(points - torch.tensor([corner[0], corner[1], 0.0], dtype=torch.float64), cloud.normals)
    drawn = _draw_lattice(shifted, size, pitch) if lattice else _draw_scattered(shifted, size, pitch)
    if drawn is None:
        return None  # several heights over one place
    z, inside = drawn.height, drawn.known
    first = max(1, math.ceil(max(z.shape) / 330))
    every = [max(1, min(times, round(0.3 / (pitch * first)))) * first for times in (1, 2, 4)]
    deep = inside & (z > LEAST_DEPTH_MM) if skin else inside
    perhaps = deep if skin else torch.ones_like(inside)
    deep = deep & without_rim(inside[None])[0]  # at the edge slopes come from one side only
    made = [relief(z, drawn.slope, deep, perhaps, pitch, times, corner) for times in every]
    if min(len(one.points) for one in made) < 12:
        return None
    return Levels(made[0], made[1], made[2], drawn.noise / (every[2] if lattice else 1))


def _is_full(cells: Tensor) -> bool:
    """Whether cells (N, 2) of a grid leave hardly any holes, as the pixels of a contact do, unlike a thinned cloud."""
    columns, rows = (cells.amax(0) + 1).tolist()
    known = torch.zeros(1, 1, rows, columns)
    known[0, 0, cells[:, 1], cells[:, 0]] = 1.0
    holes = (known == 0) & (avg_pool2d(known, 3, 1, 1) > 4.5 / 9.0)
    return float(holes.sum()) < 0.03 * len(cells)


def _draw_lattice(cloud: Cloud, size: tuple[int, int], pitch: float) -> _HeightMap | None:
    """Height map of points on a regular grid; None if several heights lie over one place."""
    points, normals = cloud
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
    return _HeightMap(z.float(), slopes, known, slope_noise(slopes, known))


def _draw_scattered(cloud: Cloud, size: tuple[int, int], pitch: float) -> _HeightMap | None:
    """Height map of scattered points, from planes through the nearest ones, or from the mean of the planes of their normals."""
    points, normals = cloud
    rows, columns = size
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    cells = torch.stack((column * pitch, -row * pitch, torch.zeros_like(row)), -1).reshape(-1, 3).double()
    distance, index = Tree(_flat(points)).nearest(cells, min(9 if normals is None else 5, len(points)))
    pitch_of_points = 2.0 * pitch
    inside = distance[:, 0] < 0.8 * pitch_of_points
    index, distance = index[inside], distance[inside]
    wide = 0.8 * pitch_of_points if normals is None else 0.5 * pitch_of_points
    weight = torch.exp(-0.5 * (distance / wide) ** 2)
    weight = weight / weight.sum(1, keepdim=True)
    offset = points[index, :2] - cells[inside][:, None, :2]  # (C, k, 2)
    heights = points[index, 2]
    spread = (heights - (weight * heights).sum(1, keepdim=True)).abs().amax(1)[:100_000]
    if float(torch.quantile(spread, 0.9)) > 8.0 * pitch_of_points:
        return None
    noise = 0.005
    if normals is None:
        place = torch.cat((torch.ones_like(offset[..., :1]), offset), -1)
        weighted = (place * weight[..., None]).transpose(1, 2)
        ridge = 1e-4 * torch.diag(torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64)) * pitch_of_points**2
        plane = torch.linalg.solve(weighted @ place + ridge, weighted @ heights[..., None])[..., 0]
        height, slope = plane[:, 0], plane[:, 1:]
    else:
        tilt = -normals[:, :2] / normals[:, 2:].clamp_min(0.1)
        slope = (weight[..., None] * tilt[index]).sum(1)
        height = (weight * (heights - (tilt[index] * offset).sum(-1))).sum(1)
        noise = min(0.012, float((tilt[index[:, 0]] - slope).abs().median()) / 0.6745)
    z, slopes = torch.zeros(rows * columns, dtype=torch.float32), torch.zeros(2, rows * columns, dtype=torch.float32)
    z[inside], slopes[:, inside] = height.float(), slope.T.float()
    return _HeightMap(z.reshape(rows, columns), slopes.reshape(2, rows, columns), inside.reshape(rows, columns), noise)


def _slopes(z: Tensor, inside: Tensor, pitch: float) -> Tensor:
    """Slopes (2, H, W), y up, of planes through 3 x 3 heights inside."""
    side = (-1.0, 0.0, 1.0)
    place = z.new_tensor([[1.0, x, -y] for y in side for x in side])
    weight = unfold(inside.to(z.dtype)[None, None], 3, padding=1)[0].T
    heights = unfold(z[None, None], 3, padding=1)[0].T[..., None]
    weighted = place.T * weight[:, None]
    ridge = torch.diag(z.new_tensor([1e-9, 1e-3, 1e-3]))
    middle = z.reshape(-1, 1, 1)
    plane = torch.linalg.solve(weighted @ place + ridge, weighted @ (heights - middle))
    slopes: Tensor = (plane[:, 1:, 0].T / pitch).reshape(2, *z.shape) * inside
    return slopes


def _flat(points: Tensor) -> Tensor:
    return torch.cat((points[:, :2], torch.zeros(len(points), 1, dtype=points.dtype)), 1)


def _spacing_in_plane(points: Tensor) -> float:
    """Spacing over x and y only, where points of one place count once; for scattered points the side of their mean cell."""
    flat = _flat(points)
    nearest = spacing(flat)
    covered = len(voxel_first(flat, 4.0 * nearest)) * 16.0 * nearest**2
    return max(nearest, math.sqrt(covered / len(points)) if nearest < 0.7 * math.sqrt(covered / len(points)) else nearest)
