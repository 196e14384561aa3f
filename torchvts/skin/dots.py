"""Where printed dots of a background are in a frame: a dot's surroundings are its template, and the frame is regressed on it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights

LEAST_LEFT = 0.35
"""A dot with less than this share of its darkness is not seen."""

LEAST_EXPLAINED = 0.4
"""Least share of what a patch holds beside a plane of light that its dot explains."""

RIDGE = 1e-6
"""Of the regression, relative: a dot that is a line says nothing of motion along it."""

SPLINE_VARIANCE = 1.0 / 3.0
"""Of the cubic B-spline through which images are sampled, px^2: it blurs by 0.58 px, and moves no ramp, as bicubic kernels do."""


class Settled(NamedTuple):
    """Dots of frames: place (B, N, 2) px, its covariance (B, N, 2, 2) px^2, and whether they are there, (B, N) bool."""

    place: Tensor
    covariance: Tensor
    there: Tensor


class DotTemplates(nn.Module):
    """Templates of all dots of a background at one resolution.

    Light around a dot's place is regressed on the dot's template, its two derivatives, four strains and a plane of light. The share
    of the derivatives is the displacement that is left, the share of the template how much of the dot is left, the residual the
    noise. The matrix depends on the background alone, so that a step is one sampling and one product.

    Args:
        grey: (1, 1, H, W), log light of the background.
        dots_px: (N, 2).
        half_px: half a patch.
        cell: side of the cells of pixels that are the level's pixels.
        blur_px: blur of the level.
    Source:
        Baker and Matthews, Lucas-Kanade 20 years on: a unifying framework, IJCV 56(3), 2004 (inverse compositional).
    """

    patch: Tensor
    weight: Tensor
    columns: Tensor
    matrix: Tensor
    unit_covariance: Tensor
    unit_residual: Tensor

    def __init__(self, grey: Tensor, dots_px: Tensor, half_px: float, cell: int, blur_px: float) -> None:
        super().__init__()
        self.cell, self.reach = cell, math.ceil(half_px / cell)
        self.weights = gaussian_weights(blur_px / cell)
        self.least_left, self.least_explained = LEAST_LEFT, LEAST_EXPLAINED
        one = torch.arange(-self.reach, self.reach + 1, dtype=grey.dtype)
        patch = torch.stack(torch.meshgrid(one, one, indexing="xy"), -1).reshape(-1, 2)
        window = torch.exp(-0.5 * (patch.norm(dim=1) * cell / (0.75 * half_px)) ** 4)
        self.register_buffer("patch", cell * patch)
        at_rest = torch.eye(2, dtype=grey.dtype).expand(1, len(dots_px), 2, 2)
        values, along_x, along_y = self.sample_warped(self.prepare(grey), dots_px[None].to(grey.dtype), at_rest)
        template, dx, dy = values[0, ..., None], along_x[0, ..., None], along_y[0, ..., None]  # (N, P, 1)
        x, y = (patch[:, k : k + 1].expand_as(dx) * cell for k in (0, 1))
        mean = (template * window[:, None]).sum(1, keepdim=True) / window.sum()
        noise = torch.exp(mean - template)  # of a logarithm: larger where it is dark
        weight = window[:, None] / noise.square()  # (N, P, 1)
        light = torch.cat((template - mean, torch.ones_like(x), x, y), 2)
        columns = torch.cat((dx, dy, light, dx * x, dx * y, dy * x, dy * y), 2).double()
        weighed = columns * weight
        normal = weighed.mT @ columns
        ridge = RIDGE * torch.diag(normal.diagonal(dim1=1, dim2=2).mean(0).clamp_min(1e-12))
        matrix = torch.linalg.solve(normal + ridge, weighed.mT)  # (N, 10, P)
        # unit noise, alike in neighbours by blur, in the shares, and what of it is left in the residual
        apart = torch.cdist(patch, patch).double()
        alike = torch.exp(-apart.square() / (4.0 * ((blur_px / cell) ** 2 + SPLINE_VARIANCE)))
        shares = ((matrix * noise.mT) @ alike) * noise.mT  # (N, 10, P)
        covariance = shares @ matrix.mT
        residual = window.sum() - 2.0 * (shares * weighed.mT).sum((1, 2)) + (normal * covariance).sum((1, 2))
        buffers = {"weight": weight[..., 0], "columns": columns, "matrix": matrix, "unit_residual": residual}
        for name, value in (buffers | {"unit_covariance": covariance[:, :2, :2]}).items():
            self.register_buffer(name, value.to(grey.dtype))

    def prepare(self, grey: Tensor) -> Tensor:
        """The level (B, 1, h, w) of log light (B, 1, H, W)."""
        return blur(nn.functional.avg_pool2d(grey, self.cell) if self.cell > 1 else grey, self.weights)

    def follow(self, level: Tensor, place: Tensor, steps: int, most_px: float) -> tuple[Tensor, Tensor]:
        """Places (B, N, 2) px after steps of at most so many px, and whether the dots are there, (B, N) bool."""
        values = self.sample(level, place)
        fit = self.fit(values)
        for _ in range(steps):
            there = fit[..., 2:3] > 0.5 * self.least_left  # others stay
            change = -fit[..., :2] / torch.where(there, fit[..., 2:3], 1.0)
            length = change.square().sum(-1, keepdim=True).sqrt().clamp_min(most_px)
            place = place + torch.where(there, change * (most_px / length), 0.0)
            values = self.sample(level, place)
            fit = self.fit(values)
        return place, (fit[..., 2] > self.least_left) & (self.residual(values, fit)[1] > self.least_explained)

    def settle(self, level: Tensor, place: Tensor, warp: Tensor, most_px: float) -> Settled:
        """A step by the frame's own derivatives, of patches that are warped; its gradient is that of the place where steps end.

        Where the shares of the derivatives are zero, their change by the frame is their change by the place, times minus one, times
        the motion (implicit function theorem).
        """
        values, along_x, along_y = self.sample_warped(level, place, warp)
        fit = self.fit(values)
        by_place = torch.stack((self.fit(along_x.detach())[..., :2], self.fit(along_y.detach())[..., :2]), -1)  # (B, N, 2, 2)
        determinant = by_place[..., 0, 0] * by_place[..., 1, 1] - by_place[..., 0, 1] * by_place[..., 1, 0]
        squares, explained = self.residual(values.detach(), fit.detach())
        there = (fit[..., 2] > self.least_left) & (explained > self.least_explained) & (determinant > 0.1 * self.least_left**2)
        adjugate = torch.stack((by_place[..., 1, 1], -by_place[..., 0, 1], -by_place[..., 1, 0], by_place[..., 0, 0]), -1)
        inverse = adjugate.reshape(by_place.shape) / torch.where(there, determinant, 1.0)[..., None, None]
        change = torch.where(there[..., None], -(inverse @ fit[..., :2, None])[..., 0], 0.0).clamp(-most_px, most_px)
        variance = (squares / self.unit_residual)[..., None, None]
        return Settled(place + change, variance * (inverse @ self.unit_covariance @ inverse.mT), there)

    def residual(self, values: Tensor, fit: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted squares (B, N) of what patches (B, N, P) hold beside the fit, and the share (B, N) that the dot explains."""
        without_dot = values - (self.columns[..., 3:6] @ fit[..., 3:6, None])[..., 0]
        missed = (values - (self.columns @ fit[..., None])[..., 0]).square()
        squares = (self.weight * missed).sum(-1)
        return squares, 1.0 - squares / (self.weight * without_dot.square()).sum(-1).clamp_min(1e-12)

    def fit(self, values: Tensor) -> Tensor:
        """Shares of the columns (B, N, 10) in patches (B, N, P)."""
        return (self.matrix @ values[..., None])[..., 0]

    def sample(self, level: Tensor, place: Tensor) -> Tensor:
        """Patches (B, N, P) of a level around places (B, N, 2) px, through a cubic B-spline: all lie alike between pixels."""
        whole, t = self._split(place)
        window = torch.arange(-self.reach - 1, self.reach + 3, device=level.device)
        block = self._pixels(level, whole[..., 0:1] + window, whole[..., 1:2] + window)  # (B, N, S + 3, S + 3)
        return _along(_along(block, _spline(t[..., 1]), 2), _spline(t[..., 0]), 3).flatten(2)

    def sample_warped(self, level: Tensor, place: Tensor, warp: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Patches (B, N, P) that are warped by (B, N, 2, 2), and their slopes along x and y, by px."""
        whole, t = self._split(place[:, :, None] + (warp @ self.patch.t()).mT)
        window = torch.arange(-1, 3, device=level.device)
        block = self._pixels(level, whole[..., 0:1] + window, whole[..., 1:2] + window)  # (B, N, P, 4, 4)
        across, down = _spline(t[..., 0])[..., None, :], _spline(t[..., 1])
        rows = (block * across).sum(-1)
        along_x = ((block * _spline_slope(t[..., 0])[..., None, :]).sum(-1) * down).sum(-1)
        along_y = (rows * _spline_slope(t[..., 1])).sum(-1)
        return (rows * down).sum(-1), along_x / float(self.cell), along_y / float(self.cell)

    def _split(self, place: Tensor) -> tuple[Tensor, Tensor]:
        """Whole pixels of the level, and what is left, of places in px."""
        at = ((place + 0.5) / float(self.cell) - 0.5).clamp(-1e4, 1e5)
        whole = at.detach().floor()
        return whole.long(), at - whole

    def _pixels(self, level: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
        """Pixels (B, ..., R, C) of a level at rows (B, ..., R) and columns (B, ..., C)."""
        height, width = level.shape[2], level.shape[3]
        index = rows.clamp(0, height - 1)[..., None] * width + columns.clamp(0, width - 1)[..., None, :]
        return level.flatten(1).gather(1, index.flatten(1)).reshape(index.shape)


def _along(block: Tensor, weights: Tensor, dim: int) -> Tensor:
    """Weighted sums (B, N, ., .) of four neighbours along a dimension, weights (B, N, 4)."""
    size = block.shape[dim] - 3
    total = block.narrow(dim, 0, size) * weights[..., 0, None, None]
    for k in range(1, 4):
        total = total + block.narrow(dim, k, size) * weights[..., k, None, None]
    return total


def _spline(t: Tensor) -> Tensor:
    """Weights of the four neighbours by a cubic B-spline, (..., 4)."""
    s = 1.0 - t
    return torch.stack((s**3, 3.0 * t**3 - 6.0 * t**2 + 4.0, 3.0 * s**3 - 6.0 * s**2 + 4.0, t**3), -1) / 6.0


def _spline_slope(t: Tensor) -> Tensor:
    """Their slopes by the place."""
    s = 1.0 - t
    return torch.stack((-(s**2), 3.0 * t**2 - 4.0 * t, 4.0 * s - 3.0 * s**2, t**2), -1) / 2.0
