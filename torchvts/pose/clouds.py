"""Point clouds of contacts, thinned evenly, and their PCD and PLY files."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..core.checks import check_integer, check_path, check_positive
from ..core.files import check_size
from ..core.geometry import depth_to_points
from ..core.morphology import dilate
from . import read_cloud
from .grids import DepthFrame, least_depth_mm, slope_noise, surface_of
from .output_frame import SENSOR_AXES
from .points import checked_points
from .surface_files import write_pcd, write_ply

CLOUD_SUFFIXES = (".pcd", ".ply")

SPREAD = (0.7548776662466927, 0.5698402909980532)
"""Multiples of the row and the column of a pixel, modulo 1, by which a part of the pixels is spread evenly over the image (Roberts,
The unreasonable effectiveness of quasirandom sequences, 2018)."""


def contact_cloud(frame: DepthFrame, mm_per_pixel: float, most: int | None = 1000) -> tuple[Tensor, Tensor]:
    """The contact of one depth frame as points and normals, in the right-handed frame (x right, y up, z to the camera).

    The cloud holds the pixels that are deeper than the noise of depth and than the transition zone around a contact, without a rim
    of one pixel. The normals are those of the measured slopes (means of 3 x 3 pixels where the cloud is thinned), not estimates
    from the points.

    Args:
        frame: a :class:`torchvts.DepthOutput`.
        mm_per_pixel: pitch, mm.
        most: largest number of points, evenly spread; None keeps all.
    Returns:
        Points (N, 3), mm, and unit normals (N, 3), float64.
    Raises:
        ValueError: not one frame, values not finite, or no contact deeper than the noise.
    """
    mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    surface = surface_of(frame, "frame", with_skin=True)
    depth, gradient, contact = surface.depth_mm[0, 0], surface.gradient[0], surface.contact[0, 0]
    whole = contact & (depth > least_depth_mm(slope_noise(surface), mm_per_pixel))
    inside = ~dilate(~whole[None, None])[0, 0]  # without its rim
    if not bool(inside.any()):
        raise ValueError("frame: expected a contact deeper than its own noise, got none: pressed too faintly")
    points = depth_to_points(depth, mm_per_pixel, inside).double()
    if most is not None:  # fewer points: each stands for its neighbours
        share = avg_pool2d(contact.float()[None], 3, 1, 1)
        gradient = avg_pool2d(gradient * contact, 3, 1, 1) / share.clamp_min(1e-6)
    normals = torch.stack((-gradient[0], gradient[1], torch.ones_like(depth)), dim=-1)[inside].double()
    normals = torch.nn.functional.normalize(normals, dim=1)
    if most is not None and len(points) > check_integer("most", most, 1):
        row, column = (at.double() for at in torch.nonzero(inside, as_tuple=True))
        place = (SPREAD[0] * row + SPREAD[1] * column) % 1.0 * normals[:, 2]  # by the area of the skin: more on steep flanks
        index = place.argsort(stable=True)[:most].sort().values
        points, normals = points[index], normals[index]
    return points, normals


def write_point_cloud(path: str | Path, points: Tensor, normals: Tensor | None = None, text: str = SENSOR_AXES) -> None:
    """Write a point cloud as .pcd or .ply, whole or not at all.

    Args:
        path: the file.
        points: (N, 3), in general mm, right-handed (see :func:`torchvts.depth_to_points`).
        normals: (N, 3), or None.
        text: comment of the file, one line: unit and axes of the points, and what is in doubt.
    Raises:
        ValueError: wrong shape, no points, values not finite, or another suffix.
    """
    path = check_path("path", path)
    if path.suffix.lower() not in CLOUD_SUFFIXES:
        raise ValueError(f"{path}: expected a name ending in {' or '.join(CLOUD_SUFFIXES)}, got {path.suffix!r}")
    places = checked_points("points", points).numpy()
    directions = None if normals is None else checked_points("normals", normals, len(places)).numpy()
    write = write_ply if path.suffix.lower() == ".ply" else write_pcd
    write(path, places, directions, text)


def read_point_cloud(path: str | Path) -> tuple[Tensor, Tensor | None]:
    """Read a .pcd or .ply file: points (N, 3) float64, and normals (N, 3) if it has them.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a cloud, cut short, or an empty one.
        ImportError: Open3D, which reads it, is not installed.
    """
    path = check_path("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such point cloud")
    if path.suffix.lower() not in CLOUD_SUFFIXES:
        raise ValueError(f"{path}: expected a name ending in {' or '.join(CLOUD_SUFFIXES)}, got {path.suffix!r}")
    check_size(path, "a point cloud")
    data = path.read_bytes()
    head = re.split(rb"\n(?:DATA|end_header)", data, maxsplit=1)[0]
    announced = re.search(rb"^(?:POINTS|element\s+vertex)\s+(\d{1,18})\s*$", head, re.MULTILINE)
    number = int(announced[1]) if announced else 0
    if not 0 < number <= 256 * len(data):  # a byte of a compressed file stands for 256 at most
        raise ValueError(f"{path}: no points could be read: no point cloud, or its header says {number} points")
    _, is_text, text = data.partition(b"\nDATA ascii")
    if path.suffix.lower() == ".pcd" and is_text:  # Open3D fills what is missing with anything
        words = {len(line.split()) for line in text.strip().splitlines()}
        if len(words) > 1 or len(text.strip().splitlines()) != number:
            raise ValueError(f"{path}: no points could be read: its header says {number} points, another number follows")
    points, normals = _read_apart(path)
    if points is None or len(points) != number:
        raise ValueError(
            f"{path}: no points could be read: its header says {number}, {0 if points is None else len(points)} were read"
        )
    if not bool(torch.isfinite(points).all()):
        raise ValueError(
            f"{path}: no points could be read: expected finite coordinates, got NaN or infinite ones: leave such points out"
        )
    return points, normals


def _read_apart(path: Path) -> tuple[Tensor | None, Tensor | None]:
    """Points and normals, if there are any, by a process that may die of a damaged file."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(read_cloud.__file__).read_text()  # as a file it would find its neighbours before other packages
        command = [sys.executable, "-W", "ignore", "-c", program, str(path.resolve()), folder]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, cwd=folder)
        said = (f"{done.stdout}\n{done.stderr}".strip().splitlines() or ["it said nothing"])[-1][:300]
        if said.startswith("ImportError: "):
            raise ImportError(said.removeprefix("ImportError: "))
        if done.returncode != 0 or "WARNING" in done.stdout + done.stderr:
            raise ValueError(f"{path}: no points could be read: damaged or cut short; Open3D ended with {done.returncode}: {said}")
        arrays = [Path(folder) / f"{name}.npy" for name in ("points", "normals")]
        points, normals = (torch.from_numpy(np.load(one)) if one.exists() else None for one in arrays)
    return points, normals
