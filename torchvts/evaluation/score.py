"""Score of one frame against the ball of known size that was pressed."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import Press
from ..core.checks import check_same_size
from ..core.geometry import normal_from_gradient, pixel_grid_mm
from .metrics import fit_sphere, normal_angle_deg

RIM_PX = 3.0
"""Width of the ring inside the contact radius that is not scored: there the skin leaves the ball, and labels are a pixel off."""

SLOPE_EDGES = (0.2, 0.4, 0.6)
"""Edges of the bins of true slope in ``by_slope_deg``, mm per mm."""

PLACES = 3
"""Number of rows and of columns of image parts in ``by_place_deg``."""


class BallTruth(NamedTuple):
    """The ball under a press, float64.

    Attributes:
        depth_mm: (1, 1, H, W), height of the ball above its equator, mm.
        gradient: (1, 2, H, W), its slope, mm per mm.
        region: (1, 1, H, W) bool, the pixels to score.
    """

    depth_mm: Tensor
    gradient: Tensor
    region: Tensor


@dataclass(frozen=True)
class PressScore:
    """Errors of one method on one press, inside the contact radius less :data:`RIM_PX`.

    Attributes:
        press: name of the press.
        method: name of the method.
        normal_deg: mean angle between normals, degrees.
        relief_um: RMS difference of depth and ball, each less its own mean, micrometres.
        tilt_um: the part of ``relief_um`` that is a plane: the effect of a wrong label of the centre, and of errors that a
            response field makes alike all over a contact.
        radius_percent: error of the radius of a sphere fitted to the depth, percent; None where the depth is a plane.
        center_px: error of the centre of that sphere, pixels; None where the depth is a plane.
        apex_um: error of the depth of the middle above the rim of the region, micrometres; None if the image cuts off either.
        by_slope_deg: mean angle where the slope of the ball is below 0.2, 0.4, 0.6, and above; None without pixels.
        by_slope_pixels: number of pixels in each bin of slope.
        by_place_deg: mean angle in 3 x 3 parts of the image, row by row; None without pixels.
        by_place_pixels: number of pixels in each part.
    """

    press: str
    method: str
    normal_deg: float
    relief_um: float
    tilt_um: float
    radius_percent: float | None
    center_px: float | None
    apex_um: float | None
    by_slope_deg: tuple[float | None, ...]
    by_slope_pixels: tuple[int, ...]
    by_place_deg: tuple[float | None, ...]
    by_place_pixels: tuple[int, ...]


def ball_truth(press: Press, height: int, width: int, mm_per_pixel: float) -> BallTruth:
    """The sphere that the skin follows inside the contact.

    Args:
        press: press with centre and contact radius.
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch, mm.
    Returns:
        Depth, slope and the region to score.
    Raises:
        ValueError: the press has no centre or no contact radius.
    Example:
        >>> press = Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0)
        >>> truth = ball_truth(press, 31, 31, 0.1)
        >>> round(float(truth.depth_mm[0, 0, 15, 15]), 3), int(truth.region.sum())
        (3.0, 305)
    """
    (center_x, center_y), contact_radius_px = label(press)
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    dx = x - (center_x - (width - 1) / 2) * mm_per_pixel
    dy = y - (center_y - (height - 1) / 2) * mm_per_pixel
    radius_mm = 0.5 * press.ball_diameter_mm
    r_squared = dx**2 + dy**2
    depth = torch.sqrt((radius_mm**2 - r_squared).clamp_min((0.2 * radius_mm) ** 2))
    gradient = -torch.stack((dx.expand_as(depth), dy.expand_as(depth))) / depth
    reach_mm = min((contact_radius_px - RIM_PX) * mm_per_pixel, 0.95 * radius_mm)
    region = (r_squared < reach_mm**2) if reach_mm > 0 else torch.zeros_like(depth, dtype=torch.bool)
    return BallTruth(depth[None, None], gradient[None], region[None, None])


def label(press: Press) -> tuple[tuple[float, float], float]:
    """Centre (x, y) and contact radius of a press, pixels.

    Raises:
        ValueError: one of them is missing.
    """
    if press.center_px is None or press.contact_radius_px is None:
        raise ValueError(f"press: expected one with center_px and contact_radius_px, '{press.name}' has none: it cannot be scored")
    return press.center_px, press.contact_radius_px


def score_press(press: Press, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float, method: str = "") -> PressScore:
    """Compare one frame with the ball that was pressed.

    Args:
        press: press with centre and contact radius.
        depth_mm: (1, 1, H, W), measured depth, mm.
        normal: (1, 3, H, W), measured unit normals.
        mm_per_pixel: pixel pitch, mm.
        method: name that is kept with the score.
    Returns:
        The errors.
    Raises:
        ValueError: wrong shapes, a missing centre or contact radius, or a region too small for a sphere.
    Example:
        >>> press = Press(torch.zeros(3, 31, 31), 6.0, "middle", (15.0, 15.0), 13.0)
        >>> truth = ball_truth(press, 31, 31, 0.1)
        >>> score = score_press(press, truth.depth_mm, normal_from_gradient(truth.gradient), 0.1)
        >>> round(score.normal_deg, 6), round(score.relief_um, 6), round(abs(score.radius_percent), 6)
        (0.0, 0.0, 0.0)
    """
    truth = _checked_truth(press, depth_mm, normal, mm_per_pixel)
    region = truth.region[0, 0]
    depth = depth_mm.detach().cpu().double()
    angle = normal_angle_deg(normal.detach().cpu().double(), normal_from_gradient(truth.gradient))[0][region]  # (N,)
    error = (depth - truth.depth_mm)[0, 0][region]
    rows, columns = torch.nonzero(region, as_tuple=True)
    steepness = truth.gradient[0].norm(dim=0)[region]
    slope_bin = torch.bucketize(steepness, torch.tensor(SLOPE_EDGES, dtype=torch.float64), right=True)
    height, width = region.shape
    place_bin = (rows * PLACES // height) * PLACES + columns * PLACES // width
    by_slope, slope_pixels = _by_bin(angle, slope_bin, len(SLOPE_EDGES) + 1)
    by_place, place_pixels = _by_bin(angle, place_bin, PLACES * PLACES)
    radius_percent, center_px = _sphere_error(press, depth, truth, mm_per_pixel)
    return PressScore(
        press=press.name,
        method=method,
        normal_deg=float(angle.mean()),
        relief_um=1000.0 * float(error.std(correction=0)),
        tilt_um=1000.0 * _tilt(error, torch.stack((columns, rows))),
        radius_percent=radius_percent,
        center_px=center_px,
        apex_um=_apex_um(press, error, columns, rows),
        by_slope_deg=by_slope,
        by_slope_pixels=slope_pixels,
        by_place_deg=by_place,
        by_place_pixels=place_pixels,
    )


def _checked_truth(press: Press, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float) -> BallTruth:
    """The ball, after a check that one frame was given and that its region is large enough."""
    if depth_mm.dim() != 4 or tuple(depth_mm.shape[:2]) != (1, 1):
        raise ValueError(f"depth_mm: expected one frame, (1, 1, H, W), got {tuple(depth_mm.shape)}: loop over the batch")
    height, width = depth_mm.shape[2], depth_mm.shape[3]
    if tuple(normal.shape[:2]) != (1, 3):
        raise ValueError(f"normal: expected one frame, (1, 3, H, W), got {tuple(normal.shape)}: loop over the batch")
    check_same_size("normal", normal, "depth_mm", height, width)
    truth = ball_truth(press, height, width, mm_per_pixel)
    if int(truth.region.sum()) < 10:
        raise ValueError(
            f"press: '{press.name}' has {int(truth.region.sum())} pixels {RIM_PX:g} px inside its contact radius of "
            f"{press.contact_radius_px:g} px, 10 are needed: pressed too faintly, or outside of the image"
        )
    return truth


def _tilt(error: Tensor, place: Tensor) -> float:
    """RMS of the plane that fits error (N,) at places (2, N) best, less its mean."""
    across = (place - place.double().mean(1, keepdim=True)).t()
    plane = across @ torch.linalg.lstsq(across, (error - error.mean())[:, None]).solution
    return float(plane.std(correction=0))


def _apex_um(press: Press, error: Tensor, columns: Tensor, rows: Tensor) -> float | None:
    """Mean error of the middle less that of the rim; None if the image cuts off either."""
    (center_x, center_y), contact_radius_px = label(press)
    away = torch.hypot(columns - center_x, rows - center_y)
    middle, rim = away < 2.0, away > contact_radius_px - RIM_PX - 1.5
    return 1000.0 * float(error[middle].mean() - error[rim].mean()) if bool(middle.any() and rim.any()) else None


def _sphere_error(press: Press, depth_mm: Tensor, truth: BallTruth, mm_per_pixel: float) -> tuple[float | None, float | None]:
    """Radius error in percent and centre error in pixels of the sphere through the depth; None for a plane."""
    height, width = depth_mm.shape[2:]
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    columns = torch.stack((x.expand(height, width), y.expand(height, width), torch.ones(height, width, dtype=torch.float64)), -1)
    region = truth.region[0, 0]
    z = depth_mm[0, 0][region]
    plane = torch.linalg.lstsq(columns[region], z[:, None]).solution[:, 0]
    if float((columns[region] @ plane - z).abs().max()) < 1e-6:
        return None, None
    sphere = fit_sphere(depth_mm, mm_per_pixel, truth.region)
    if not math.isfinite(sphere.radius_mm):
        return None, None
    (center_x, center_y), _ = label(press)
    # the point frame has y up
    at_x = sphere.center_mm[0] / mm_per_pixel + (width - 1) / 2
    at_y = -sphere.center_mm[1] / mm_per_pixel + (height - 1) / 2
    away_px = math.hypot(at_x - center_x, at_y - center_y)
    return 100.0 * abs(sphere.radius_mm / (0.5 * press.ball_diameter_mm) - 1.0), away_px


def _by_bin(values: Tensor, index: Tensor, bins: int) -> tuple[tuple[float | None, ...], tuple[int, ...]]:
    """Mean of the values in each bin, None where there is none, and their number."""
    counts = torch.bincount(index, minlength=bins)
    sums = torch.bincount(index, weights=values, minlength=bins)
    return tuple(float(s / n) if n else None for s, n in zip(sums, counts)), tuple(counts.tolist())
