"""Where printed dots of a background are in a frame: a dot's surroundings are its template, and the frame is regressed on it."""

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

DIFFERENCE_PX = 0.05
"""Half the step of difference quotients by a place: 0.03 % off."""

STRIDE = 1.5
"""Between the samples of a patch, in standard deviations of the blur."""

SETTLED_PX = 0.005
"""Steps that move no dot further end a search."""


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
        half_px: radius of a patch.
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
    by_bend: Tensor

    def __init__(self, grey: Tensor, dots_px: Tensor, half_px: float, cell: int, blur_px: float) -> None:
        super().__init__()
        self.cell, self.weights = cell, gaussian_weights(blur_px / cell)
        self.least_left, self.least_explained, self.difference_px, self.settled_px = (
            LEAST_LEFT,
            LEAST_EXPLAINED,
            DIFFERENCE_PX,
            SETTLED_PX,
        )
        variance = blur_px**2 + SPLINE_VARIANCE * cell**2
        step = max(float(cell), STRIDE * variance**0.5)
        one = torch.arange(-int(half_px / step), int(half_px / step) + 1, dtype=torch.float64) * step
        patch = torch.stack(torch.meshgrid(one, one, indexing="xy"), -1).reshape(-1, 2)
        patch = patch[patch.norm(dim=1) <= half_px]
        window = torch.exp(-0.5 * (patch.norm(dim=1) / (0.75 * half_px)) ** 4)
        self.register_buffer("patch", patch.to(grey.dtype))
        level, places = self.prepare(grey).double(), dots_px[None, :, None].double() + patch
        template = self.sample(level, places)[0, ..., None]  # (N, P, 1)
        slope = self.slopes(level, places)[0]  # (N, P, 2)
        mean = (template * window[:, None]).sum(1, keepdim=True) / window.sum()
        noise = torch.exp(mean - template)  # of a logarithm: larger where it is dark
        weight = window[:, None] / noise.square()  # (N, P, 1)
        terms = torch.cat((torch.ones_like(patch[:, :1]), patch, quadratic(patch)), 1).expand(len(dots_px), -1, -1)
        along = self.difference_px * torch.eye(2, dtype=torch.float64)
        curved = [(self.slopes(level, places + one) - self.slopes(level, places - one))[0] / (2.0 * self.difference_px) for one in along]
        columns = torch.cat((slope, template - mean, terms, slope * patch[:, :1], slope * patch[:, 1:], *curved), 2)
        columns = torch.cat((columns[..., :-2], columns[..., -1:]), 2)
        weighed = columns * weight
        normal = weighed.mT @ columns
        ridge = RIDGE * torch.diag(normal.diagonal(dim1=1, dim2=2).mean(0).clamp_min(1e-12))
        matrix = torch.linalg.solve(normal + ridge, weighed.mT)  # (N, 10, P)
        # unit noise, alike in neighbours by blur, in the shares, and what of it is left in the residual
        alike = torch.exp(-torch.cdist(patch, patch).square() / (4.0 * variance))
        shares = ((matrix * noise.mT) @ alike) * noise.mT  # (N, 10, P)
        covariance = shares @ matrix.mT
        residual = window.sum() - 2.0 * (shares * weighed.mT).sum((1, 2)) + (normal * covariance).sum((1, 2))
        by_bend = torch.einsum("nkp,npj,pq->nkjq", matrix[:, :2], slope, quadratic(patch))
        buffers = {"weight": weight[..., 0], "columns": columns, "matrix": matrix, "unit_residual": residual, "by_bend": by_bend}
        for name, value in (buffers | {"unit_covariance": covariance[:, :2, :2]}).items():
            self.register_buffer(name, value.to(grey.dtype))

    def prepare(self, grey: Tensor) -> Tensor:
        """The level (B, 1, h, w) of log light (B, 1, H, W)."""
        return blur(nn.functional.avg_pool2d(grey, self.cell) if self.cell > 1 else grey, self.weights)

    def follow(self, level: Tensor, place: Tensor, steps: int, most_px: float) -> tuple[Tensor, Tensor]:
        """Places (B, N, 2) px after steps of at most so many px, and whether the dots are there, (B, N) bool."""
        there = torch.ones_like(place[..., 0]) > 0.0
        for _ in range(steps + 1):
            values = self.sample(level, place[:, :, None] + self.patch)
            fit = self.fit(values)
            there = (fit[..., 2] > self.least_left) & (self.residual(values, fit)[1] > self.least_explained)
            near = fit[..., 2:3] > 0.5 * self.least_left  # others stay
            change = -fit[..., :2] / torch.where(near, fit[..., 2:3], 1.0)
            length = change.square().sum(-1, keepdim=True).sqrt().clamp_min(most_px)
            change = torch.where(near, change * (most_px / length), 0.0)
            place = place + change
            if bool((change.abs() < self.settled_px).all()):
                break
        return place, there

    def settle(self, level: Tensor, place: Tensor, around: Tensor, most_px: float) -> Settled:
        """A step by the frame's own derivatives, of patches (B, N, P, 2) px; its gradient is that of the place where steps end.

        Where the shares of the derivatives are zero, their change by the frame is their change by the place, times minus one, times
        the motion (implicit function theorem).
        """
        places = place[:, :, None] + around
        values = self.sample(level, places)
        fit = self.fit(values)
        by_place = (self.matrix[:, :2] @ self.slopes(level.detach(), places))
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
        without_dot = values - (self.columns[..., 3:9] @ fit[..., 3:9, None])[..., 0]
        missed = (values - (self.columns @ fit[..., None])[..., 0]).square()
        squares = (self.weight * missed).sum(-1)
        return squares, 1.0 - squares / (self.weight * without_dot.square()).sum(-1).clamp_min(1e-12)

    def fit(self, values: Tensor) -> Tensor:
        """Shares of the columns (B, N, 10) in patches (B, N, P)."""
        return (self.matrix @ values[..., None])[..., 0]

    def slopes(self, level: Tensor, places: Tensor) -> Tensor:
        """Slopes (B, N, P, 2) of a level at places (B, N, P, 2), by px."""
        step, none = self.difference_px, torch.zeros_like(places[..., :1])
        along = [torch.cat((none + step, none), -1), torch.cat((none, none + step), -1)]
        slopes = [(self.sample(level, places + one) - self.sample(level, places - one)) / (2.0 * step) for one in along]
        return torch.stack(slopes, -1)

    def sample(self, level: Tensor, places: Tensor) -> Tensor:
        """A level (B, 1, h, w) at places (B, N, P, 2) px, through a cubic B-spline: four bilinear samples with its weights.

        Source:
            Sigg and Hadwiger, Fast third-order texture filtering, GPU Gems 2, 2005, chapter 20.
        """
        at = (places + 0.5) / float(self.cell) - 0.5
        whole = at.detach().floor()
        t = at - whole
        s, t3, t2 = 1.0 - t, t**3, t * t
        first, last = s**3, t3
        far = (3.0 * (s**3 - 2.0 * s * s) + 4.0 + last) / 6.0  # weight of the two pixels beyond
        near = 1.0 - far
        lower = whole - first / (6.0 * near)
        upper = whole + 1.0 + last / (6.0 * far)
        size = torch.tensor([level.shape[3] - 1.0, level.shape[2] - 1.0], dtype=at.dtype, device=at.device)
        lower, upper = 2.0 * lower / size - 1.0, 2.0 * upper / size - 1.0
        x, y = [lower[..., 0], upper[..., 0]], [lower[..., 1], upper[..., 1]]
        corners = torch.stack((torch.stack((x[0], x[1], x[0], x[1]), -1), torch.stack((y[0], y[0], y[1], y[1]), -1)), -1)
        light = nn.functional.grid_sample(
            level.expand(places.shape[0], -1, -1, -1), corners.flatten(2, 3), "bilinear", "border", align_corners=True
        ).reshape(corners.shape[:-1])
        left, up = near[..., 0], near[..., 1]
        right, down = far[..., 0], far[..., 1]
        return (light * torch.stack((left * up, right * up, left * down, right * down), -1)).sum(-1)


def quadratic(places: Tensor) -> Tensor:
    """Halves of squares and the product of places (..., 2): (..., 3), the terms of a bend."""
    x, y = places[..., 0], places[..., 1]
    return torch.stack((0.5 * x * x, x * y, 0.5 * y * y), -1)
