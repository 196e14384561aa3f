"""Point clouds of all pixels of a contact: drawn on the grid that they come from, then registered as depth frames are."""

import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from .direct import align
from .features import Cloud
from .relief import LEAST_DEPTH_MM, Levels, relief, slope_noise, slopes_of_planes, without_rim
from .result import Registration

MOST_CELLS = 4_000_000
"""Largest number of cells of a grid."""

DEEPEST_MM = 1.0
"""Depth of the shallowest point of a contact, at most: of faces with steep walls none are left out but the walls."""

COARSEST_MM = 0.3
"""Pitch of the coarsest grid, at most."""


def register_height_maps(source: Cloud, target: Cloud, start: Tensor | None) -> Registration | None:
    """Register two clouds as height maps on the grid of their pixels; None if they are not such."""
    grids = [_grids(cloud) for cloud in (source, target)]
    if grids[0] is None or grids[1] is None or abs(math.log(grids[0].fine.pitch / grids[1].fine.pitch)) > 0.01:
        return None
    try:
        return align(grids[0], grids[1], start)
    except ValueError:
        return None


def _grids(cloud: Cloud) -> Levels | None:
    """The cloud on three grids; None if it is no height map on a grid over x and y with the undeformed skin at 0, or too small."""
    points = cloud.points
    if not -0.02 < float(points[:, 2].min()) < DEEPEST_MM:
        return None
    gaps = torch.unique(points[:, 0]).diff()
    pitch = float(gaps[gaps > 0.01 * gaps.max()].median()) if len(gaps) else 0.0
    low, high = points[:, :2].amin(0), points[:, :2].amax(0)
    if pitch <= 0.0 or bool(((high - low) / pitch < 4.5).any()) or float(((high - low) / pitch + 5.0).prod()) > MOST_CELLS:
        return None
    corner = (float(low[0]) - 2 * pitch, float(high[1]) + 2 * pitch)  # two cells of border
    place = torch.stack((corner[1] - points[:, 1], points[:, 0] - corner[0]), 1) / pitch  # row, column
    cell = place.round().long()
    rows, columns = (cell.amax(0) + 3).tolist()
    known = torch.zeros(rows, columns, dtype=torch.bool)
    known[cell[:, 0], cell[:, 1]] = True
    holes = ~known & (avg_pool2d(known[None].double(), 3, 1, 1)[0] > 4.5 / 9.0)
    if float((place - cell).abs().max()) > 0.05 or int(known.sum()) < len(points) or float(holes.sum()) > 0.03 * len(points):
        return None  # scattered, several heights over one place, or thinned
    z, slopes = torch.zeros(rows, columns), torch.zeros(2, rows, columns)
    z[cell[:, 0], cell[:, 1]] = points[:, 2].float()
    if cloud.normals is None:
        slopes = slopes_of_planes(z[None], known, pitch)[0] * known
    else:
        slopes[:, cell[:, 0], cell[:, 1]] = (-cloud.normals[:, :2] / cloud.normals[:, 2:].clamp_min(0.1)).T.float()
    first = max(1, math.ceil(max(z.shape) / 330))
    every = [max(1, min(times, round(COARSEST_MM / (pitch * first)))) * first for times in (1, 2, 4)]
    perhaps = known & (z > LEAST_DEPTH_MM)
    deep = perhaps & without_rim(known[None])[0]  # at the edge slopes come from one side only
    made = [relief(z, slopes, deep, perhaps, pitch, times, corner) for times in every]
    if min(len(one.points) for one in made) < 12:
        return None
    return Levels(made[0], made[1], made[2], slope_noise(slopes, known) / every[2])
