"""Pose from two depth frames: all turns and shifts first, then every pixel of the common contact, then what cannot be known."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import check_positive

from .relief import Frame, Levels, Relief, levels
from .result import Registration, invert, motion, turn_deg
from .search import search_plane

SLOPE_NOISE = 0.06
"""Least disagreement of slopes that counts as noise, mm per mm: calibrated sensors err by 2 to 3 degrees, exact ones by less."""

DEPTH_NOISE_MM = 0.02
"""The same for depth: what integration and a skirt add."""

CUT = 4.0
"""A pixel that disagrees by more than so many noises is an outlier."""


class Fit(NamedTuple):
    """Hypotheses (K, 4, 4), their cost (K,), 0 to 1, the share of agreeing pixels (K,), and of the smaller contact compared (K,)."""

    poses: Tensor
    cost: Tensor
    fitness: Tensor
    overlap: Tensor


class Linear(NamedTuple):
    """Residuals of all source pixels under K poses: slopes (K, N, 2), heights (K, N), which count (K, N), derivatives."""

    slope: Tensor
    height: Tensor
    counts: Tensor
    slope_by_twist: Tensor  # (K, N, 2, 6)
    height_by_twist: Tensor  # (K, N, 6)


def linearise(source: Relief, target: Relief, poses: Tensor, center: Tensor) -> Linear:
    """Residuals target - moved source, and their derivatives by a twist about ``center`` after each pose."""
    rotation, shift = poses[:, :3, :3].float(), poses[:, :3, 3].float()
    moved = source.points @ rotation.transpose(1, 2) + shift[:, None]  # (K, N, 3)
    normal = torch.cat((-source.slopes, torch.ones_like(source.slopes[:, :1])), 1) @ rotation.transpose(1, 2)
    upright = normal[..., 2].clamp_min(0.05)
    p, q = -normal[..., 0] / upright, -normal[..., 1] / upright
    field, inside, _, _ = target.sample(moved[..., :2])
    z, p_t, q_t, z_xx, z_xy, z_yy = field
    x, y, h = (moved - center.float()).unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    # how the point's x, y, z answer to (w_x, w_y, w_z, t_x, t_y, t_z)
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


def refine(source: Relief, target: Relief, poses: Tensor, steps: int, scale: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Newton with Cauchy's weights on slopes and heights of the common contact, all hypotheses at once.

    Args:
        source, target: of the same level. poses: (K, 4, 4) float64. steps: at most. scale: factor on the noises that are assumed.
    Returns:
        Poses (K, 4, 4), the last normal matrix (K, 6, 6) about the contact's centre in the target, and those centres (K, 3).
    """
    center = (poses[:, :3, :3] @ source.points.double().mean(0) + poses[:, :3, 3])[:, None]
    length = _length(source)
    units = torch.tensor([1.0 / length] * 3 + [1.0] * 3, dtype=torch.float64)
    normal_matrix = torch.zeros(len(poses), 6, 6, dtype=torch.float64)
    for step_number in range(steps):
        lin = linearise(source, target, poses, center)
        wide = scale * max(1.0, 3.0 * 0.5**step_number) if scale > 1.0 else 1.0
        normal_matrix, right = _normal_equations(lin, wide)
        scaled = normal_matrix * units[:, None] * units
        damped = scaled + torch.diag_embed(1e-3 * scaled.diagonal(dim1=1, dim2=2) + 1e-6 * scaled.diagonal(dim1=1, dim2=2).amax(1, True) + 1e-9)
        twist = -torch.linalg.solve(damped, (right * units)[..., None])[..., 0]
        length_of_step = twist.norm(dim=1, keepdim=True)
        twist = twist * (0.6 / length_of_step.clamp_min(0.6))
        poses = motion(twist * units, center[:, 0]) @ poses
        if float(length_of_step.max()) < 2e-5:
            break
    return poses, normal_matrix, center[:, 0]


def _normal_equations(lin: Linear, wide: float) -> tuple[Tensor, Tensor]:
    r_s, r_h = lin.slope / (SLOPE_NOISE * wide), lin.height / (DEPTH_NOISE_MM * wide)
    weight = lin.counts / (1.0 + (r_s.square().sum(-1) + r_h.square()) / 4.0)
    j_s = lin.slope_by_twist / (SLOPE_NOISE * wide)
    j_h = lin.height_by_twist / (DEPTH_NOISE_MM * wide)
    j = torch.cat((j_s, j_h[..., None, :]), -2).flatten(1, 2)  # (K, 3 N, 6)
    r = torch.cat((r_s, r_h[..., None]), -1).flatten(1, 2)
    w = weight[..., None].expand(-1, -1, 3).flatten(1, 2)
    weighted = (j * w[..., None]).transpose(1, 2)
    return (weighted @ j).double(), (weighted @ r[..., None])[..., 0].double()


def judge(source: Relief, target: Relief, poses: Tensor) -> Fit:
    """How well each pose explains both frames, both ways: what should touch and does not counts against it."""
    forth, back = _one_way(source, target, poses), _one_way(target, source, invert(poses))
    bad, good, counted, possible = (a + b for a, b in zip(forth, back, strict=True))
    cost = (bad / counted.clamp_min(1.0)).double()
    overlap = torch.maximum(forth[2] / max(len(source.points), 1), back[2] / max(len(target.points), 1)).double()
    del possible
    return Fit(poses, cost, (good / counted.clamp_min(1.0)).double(), overlap)


def _one_way(source: Relief, target: Relief, poses: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rotation, shift = poses[:, :3, :3].float(), poses[:, :3, 3].float()
    moved = source.points @ rotation.transpose(1, 2) + shift[:, None]
    normal = torch.cat((-source.slopes, torch.ones_like(source.slopes[:, :1])), 1) @ rotation.transpose(1, 2)
    slope = -normal[..., :2] / normal[..., 2:].clamp_min(0.05)
    field, inside, near, seen = target.sample(moved[..., :2])
    expected = seen & (moved[..., 2] > 0.06)
    error = ((field[1] - slope[..., 0]) ** 2 + (field[2] - slope[..., 1]) ** 2) / SLOPE_NOISE**2
    error = error + ((field[0] - moved[..., 2]) / DEPTH_NOISE_MM) ** 2
    error = torch.where(inside, (error / CUT**2).clamp_max(1.0), (~near).to(error.dtype))
    counted = expected & (inside | ~near)
    bad = (error * counted).sum(1)
    good = ((error < 1.0) & counted).sum(1).to(error.dtype)
    return bad, good, counted.sum(1).to(error.dtype), seen.sum(1).to(error.dtype)


def _length(relief: Relief) -> float:
    """Root mean square radius of a contact, mm: a turn by a radian moves it by so much."""
    return max(float((relief.points[:, :2] - relief.points[:, :2].mean(0)).square().sum(1).mean().sqrt()), relief.pitch)


def distinct(fit: Fit, source: Relief, apart_mm: float) -> list[int]:
    """Indices of the poses, best first, without those that move the contact to nearly the same place as a better one."""
    probe = source.points[:: max(1, len(source.points) // 64)].double()
    places = probe @ fit.poses[:, :3, :3].transpose(1, 2) + fit.poses[:, :3, 3][:, None]
    kept: list[int] = []
    for k in torch.argsort(fit.cost + 0.5 * (0.5 - fit.overlap).clamp_min(0.0)).tolist():
        if all(float((places[k] - places[other]).square().sum(1).mean().sqrt()) > apart_mm for other in kept):
            kept.append(k)
    return kept
