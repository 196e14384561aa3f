"""Direct alignment of two reliefs: residuals and their derivatives, Gauss-Newton refinement, and the score of a pose."""

from typing import NamedTuple

import torch
from torch import Tensor

from .relief import Relief
from .result import invert, motion

SLOPE_NOISE = 0.06
"""Disagreement of slopes that counts as noise, mm per mm: calibrated sensors err by 2 to 3 degrees, exact ones by less."""

DEPTH_NOISE_MM = 0.03
"""The same for depth when poses are scored: errors of integration and the transition zone around a contact."""

DEPTH_DRIFT_MM = 0.5
"""The same when poses are refined: errors of integrated depth are alike over the whole contact and would tilt it. From 0.02 to
0.5 mm, with a slope noise of 0.03: rotation error of a stamp 0.23 to 0.05 degrees, of a gear 0.13 to 0.01."""

CUT = 4.0
"""A pixel whose residual exceeds this multiple of the noise is an outlier."""

LEAST_FITNESS, LEAST_OVERLAP, MOST_COST = 0.85, 0.3, 0.25
"""Thresholds that a pose must reach to be trusted."""

SMALL_FITNESS, SMALL_OVERLAP = 0.955, 0.2
"""The same where the overlap is below LEAST_OVERLAP. None of 144 pairs of different objects converges with them."""


class Fit(NamedTuple):
    """Scores of K poses.

    Attributes:
        poses: (K, 4, 4).
        cost: (K,), mean truncated residual, 0 to 1.
        fitness: (K,), share of the compared pixels that agree.
        overlap: (K,), share of the smaller contact that was compared.
    """

    poses: Tensor
    cost: Tensor
    fitness: Tensor
    overlap: Tensor


class Linear(NamedTuple):
    """Residuals of N source pixels under K poses, and their derivatives by a twist after each pose.

    Attributes:
        slope: (K, N, 2), slope residuals.
        height: (K, N), height residuals, mm.
        counts: (K, N) bool, the pixels that lie in both contacts.
        slope_by_twist: (K, N, 2, 6).
        height_by_twist: (K, N, 6).
    """

    slope: Tensor
    height: Tensor
    counts: Tensor
    slope_by_twist: Tensor
    height_by_twist: Tensor


def linearise(source: Relief, target: Relief, poses: Tensor, center: Tensor) -> Linear:
    """Residuals target - moved source, and their derivatives by a twist about ``center`` after each pose."""
    moved, slope = _moved(source, poses)
    p, q = slope.unbind(-1)
    field, inside, _, _ = target.sample(moved[..., :2])
    z, p_t, q_t, z_xx, z_xy, z_yy = field
    x, y, h = (moved - center.float()).unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    # derivatives of the point's x, y, z by (w_x, w_y, w_z, t_x, t_y, t_z)
    dx = torch.stack((zero, h, -y, one, zero, zero), -1)
    dy = torch.stack((-h, zero, x, zero, one, zero), -1)
    dz = torch.stack((y, -x, zero, zero, zero, one), -1)
    height_by = p_t[..., None] * dx + q_t[..., None] * dy - dz
    dp = torch.stack((p * q, -(1 + p * p), -q, zero, zero, zero), -1)
    dq = torch.stack((1 + q * q, -p * q, p, zero, zero, zero), -1)
    slope_by = torch.stack(
        (z_xx[..., None] * dx + z_xy[..., None] * dy - dp, z_xy[..., None] * dx + z_yy[..., None] * dy - dq), dim=-2
    )
    counts = inside & (moved[..., 2] > 0.02)
    return Linear(torch.stack((p_t - p, q_t - q), -1), z - moved[..., 2], counts, slope_by, height_by)


def _moved(source: Relief, poses: Tensor) -> tuple[Tensor, Tensor]:
    """The source's pixels (K, N, 3) and slopes (K, N, 2) under each pose."""
    rotation, shift = poses[:, :3, :3].float(), poses[:, :3, 3].float()
    points = source.points @ rotation.transpose(1, 2) + shift[:, None]
    normal = torch.cat((-source.slopes, torch.ones_like(source.slopes[:, :1])), 1) @ rotation.transpose(1, 2)
    return points, -normal[..., :2] / normal[..., 2:].clamp_min(0.05)


def refine(source: Relief, target: Relief, poses: Tensor, steps: int, wide: float = 1.0) -> Tensor:
    """Gauss-Newton with Cauchy's weights on slopes and heights of the common contact, all hypotheses at once.

    Args:
        source: the relief that is moved.
        target: the relief that stays, on a grid of the same level.
        poses: (K, 4, 4) float64.
        steps: largest number of steps.
        wide: factor on the slope noise at the first step; it halves every step down to one half.
    Returns:
        Poses (K, 4, 4).
    """
    center = poses[:, :3, :3] @ source.points.double().mean(0) + poses[:, :3, 3]
    units = twist_units(source)
    for _ in range(steps):
        normal_matrix, right = _normal_equations(linearise(source, target, poses, center[:, None]), SLOPE_NOISE * wide)
        scaled = normal_matrix * units[:, None] * units
        diagonal = scaled.diagonal(dim1=1, dim2=2)
        damped = scaled + torch.diag_embed(1e-3 * diagonal + 1e-6 * diagonal.amax(1, keepdim=True) + 1e-9)
        twist = -torch.linalg.solve(damped, (right * units)[..., None])[..., 0]
        size = twist.norm(dim=1, keepdim=True)
        twist = twist * (0.6 / size.clamp_min(0.6))
        poses = motion(twist * units, center) @ poses
        if wide <= 0.5 and float(size.max()) < 5e-5:
            break
        wide = max(0.5, 0.5 * wide)
    return poses


def twist_units(relief: Relief) -> Tensor:
    """(6,), rad and mm: rotations that move the contact's root mean square radius by 1 mm, and shifts of 1 mm."""
    spread = (relief.points[:, :2] - relief.points[:, :2].mean(0)).square().sum(1).mean().sqrt()
    return torch.tensor([1.0 / max(float(spread), relief.pitch)] * 3 + [1.0] * 3, dtype=torch.float64)


def _normal_equations(lin: Linear, slope_noise: float) -> tuple[Tensor, Tensor]:
    r_s, r_h = lin.slope / slope_noise, lin.height / DEPTH_DRIFT_MM
    weight = lin.counts / (1.0 + (r_s.square().sum(-1) + r_h.square()) / 4.0)
    root = weight.sqrt()
    j = torch.cat((lin.slope_by_twist / slope_noise, lin.height_by_twist[..., None, :] / DEPTH_DRIFT_MM), -2)  # (K, N, 3, 6)
    j = (j * root[..., None, None]).flatten(1, 2)
    r = (torch.cat((r_s, r_h[..., None]), -1) * root[..., None]).flatten(1, 2)
    across = j.transpose(1, 2)
    return (across @ j).double(), (across @ r[..., None])[..., 0].double()


def score_poses(source: Relief, target: Relief, poses: Tensor) -> Fit:
    """Score each pose in both directions; a pixel that should touch and does not counts as an outlier."""
    forth, back = _score_one_way(source, target, poses), _score_one_way(target, source, invert(poses))
    bad, good, counted = (a + b for a, b in zip(forth, back, strict=True))
    cost = (bad / counted.clamp_min(1.0)).double()
    overlap = torch.maximum(forth[2] / max(len(source.points), 1), back[2] / max(len(target.points), 1)).double()
    return Fit(poses, cost, (good / counted.clamp_min(1.0)).double(), overlap)


def _score_one_way(source: Relief, target: Relief, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sums (K,) over the source's pixels: truncated residuals, pixels that agree, pixels that are compared."""
    moved, slope = _moved(source, poses)
    field, inside, near, in_image = target.sample(moved[..., :2])
    expected = in_image & (moved[..., 2] > 0.06)
    error = ((field[1] - slope[..., 0]) ** 2 + (field[2] - slope[..., 1]) ** 2) / SLOPE_NOISE**2
    error = error + ((field[0] - moved[..., 2]) / DEPTH_NOISE_MM) ** 2
    error = torch.where(inside, (error / CUT**2).clamp_max(1.0), (~near).to(error.dtype))
    counted = expected & (inside | ~near)
    bad = (error * counted).sum(1)
    good = ((error < 1.0) & counted).sum(1).to(error.dtype)
    return bad, good, counted.sum(1).to(error.dtype)


def is_trusted(fit: Fit, k: int) -> bool:
    """Whether pose ``k`` agrees well enough, on a large enough part of the contact."""
    return agrees_enough(float(fit.fitness[k]), float(fit.overlap[k]), float(fit.cost[k]))


def agrees_enough(fitness: float, overlap: float, cost: float) -> bool:
    """The thresholds of :func:`is_trusted`: a small common part must agree nearly everywhere."""
    return (
        fitness >= (LEAST_FITNESS if overlap >= LEAST_OVERLAP else SMALL_FITNESS) and overlap >= SMALL_OVERLAP and cost <= MOST_COST
    )


def rank(fit: Fit) -> Tensor:
    """Cost (K,) with a surcharge for little overlap, which agrees by chance."""
    return fit.cost + 0.5 * (0.5 - fit.overlap).clamp_min(0.0)


def distinct(fit: Fit, source: Relief, least_mm: float) -> list[int]:
    """Indices of the poses, best first, without those that move the contact to within ``least_mm`` of a better one."""
    probe = source.points[:: max(1, len(source.points) // 64)].double()
    places = probe @ fit.poses[:, :3, :3].transpose(1, 2) + fit.poses[:, :3, 3][:, None]
    kept: list[int] = []
    for k in torch.argsort(rank(fit)).tolist():
        if all(float((places[k] - places[other]).square().sum(1).mean().sqrt()) > least_mm for other in kept):
            kept.append(k)
    return kept


def equally_good(fit: Fit, order: list[int]) -> list[int]:
    """Those of ``order`` whose cost equals that of the first within model errors."""
    first = order[0]
    most = 1.5 * float(fit.cost[first]) + 0.01
    return [k for k in order if k == first or (float(fit.cost[k]) < most and fit.overlap[k] > 0.7 * fit.overlap[first])]
