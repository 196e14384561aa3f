"""Where printed dots of a background are in a frame: a dot's surroundings are its template, and the frame is regressed on it."""

import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights

LEAST_LEFT = 0.25
"""A dot is seen by so much of its darkness at least, beyond what its patch holds else."""

RIDGE = 1e-6
"""Of the regression, relative: a dot that is a line says nothing of motion along it."""

SPLINE_VARIANCE = 1.0 / 3.0
"""Of the cubic B-spline through which images are sampled, px^2: it blurs by 0.58 px, and moves no ramp, as bicubic kernels do."""

DIFFERENCE_PX = 0.02
"""Step of difference quotients by a place."""

STRIDE = 1.5
"""Between the samples of a patch, in standard deviations of the blur."""

STEPS, SETTLED_PX = 6, 0.005
"""Steps of a search at most; it ends with one that moves no dot further."""


class DotTemplates(nn.Module):
    """Templates of all dots of a background at one resolution.

    Light around a dot's place is regressed on the dot's template, its two derivatives, a parabola of light, four strains, and the
    second derivatives (another blur). The share of the derivatives is the displacement that is left, the share of the template how
    much of the dot is left, the residual the noise. The matrix depends on the background alone, so that a step is one sampling and
    one product.

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
    corners: Tensor
    weight: Tensor
    columns: Tensor
    matrix: Tensor
    unit_covariance: Tensor
    unit_residual: Tensor
    darkness: Tensor
    by_bend: Tensor

    def __init__(self, grey: Tensor, dots_px: Tensor, half_px: float, cell: int, blur_px: float) -> None:
        super().__init__()
        self.cell, self.weights = cell, gaussian_weights(blur_px / cell)
        self.least_left, self.steps = LEAST_LEFT, STEPS
        self.difference_px, self.settled_px = DIFFERENCE_PX, SETTLED_PX
        variance = blur_px**2 + SPLINE_VARIANCE * cell**2
        step = max(float(cell), min(STRIDE * variance**0.5, half_px / 4.0))
        one = torch.arange(-int(half_px / step), int(half_px / step) + 1, dtype=torch.float64) * step
        patch = torch.stack(torch.meshgrid(one, one, indexing="xy"), -1).reshape(-1, 2)
        patch = patch[patch.norm(dim=1) <= half_px]
        window = torch.exp(-0.5 * (patch.norm(dim=1) / (0.75 * half_px)) ** 4)
        self.register_buffer("patch", patch.to(grey.dtype))
        self.register_buffer("corners", torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=grey.dtype))
        level, places = self.prepare(grey).double(), dots_px[None, :, None].double() + patch
        template = self.sample(level, places)[0, ..., None]  # (N, P, 1)
        slope = self.slopes(level, places)[0]  # (N, P, 2)
        mean = (template * window[:, None]).sum(1, keepdim=True) / window.sum()
        noise = torch.exp(mean - template)  # of a logarithm: larger where it is dark
        weight = window[:, None] / noise.square()  # (N, P, 1)
        terms = torch.cat((torch.ones_like(patch[:, :1]), patch, quadratic(patch)), 1).expand(len(dots_px), -1, -1)
        along = self.difference_px * torch.eye(2, dtype=torch.float64)
        further = [(self.slopes(level, places + one) - self.slopes(level, places - one))[0] for one in along]
        # second derivatives: what strain and focus make of the blur of a dot's edge
        curved = torch.stack((further[0][..., 0], further[0][..., 1], further[1][..., 1]), -1) / (2.0 * self.difference_px)
        columns = torch.cat((slope, template - mean, terms, slope * patch[:, :1], slope * patch[:, 1:], curved), 2)
        weighed = columns * weight
        normal = weighed.mT @ columns
        ridge = RIDGE * torch.diag(normal.diagonal(dim1=1, dim2=2).mean(0).clamp_min(1e-12))
        matrix = torch.linalg.solve(normal + ridge, weighed.mT)  # (N, 16, P)
        # unit noise, alike in neighbours by blur, in the shares, and what of it is left in the residual
        alike = torch.exp(-torch.cdist(patch, patch).square() / (4.0 * variance))
        shares = ((matrix * noise.mT) @ alike) * noise.mT  # (N, 16, P)
        covariance = shares @ matrix.mT
        residual = window.sum() - 2.0 * (shares * weighed.mT).sum((1, 2)) + (normal * covariance).sum((1, 2))
        by_bend = torch.einsum("nkp,npj,pq->nkjq", matrix[:, :2], slope, quadratic(patch))
        buffers = {"weight": weight[..., 0], "columns": columns, "matrix": matrix, "by_bend": by_bend, "unit_residual": residual}
        for name, value in (buffers | {"unit_covariance": covariance[:, :2, :2], "darkness": normal[:, 2, 2]}).items():
            self.register_buffer(name, value.to(grey.dtype))

    def prepare(self, grey: Tensor) -> Tensor:
        """The level (B, 1, h, w) of log light (B, 1, H, W)."""
        return blur(nn.functional.avg_pool2d(grey, self.cell) if self.cell > 1 else grey, self.weights)

    def search(self, level: Tensor, place: Tensor, most_px: float) -> tuple[Tensor, Tensor]:
        """Places (B, N, 2) px after steps of at most so many px, and whether the dots are there, (B, N) bool."""
        values = self.read(level, self.in_cells(place[:, :, None] + self.patch))  # linear between pixels: near enough
        fit = self.fit(values)
        moving = torch.ones_like(place[..., 0]) > 0.0
        for _ in range(self.steps):
            moving = moving & (fit[..., 2] > 0.5 * self.least_left)
            change = -fit[..., :2] / torch.where(moving, fit[..., 2], 1.0)[..., None]
            length = change.square().sum(-1, keepdim=True).sqrt()
            place = place + torch.where(moving[..., None], change * (most_px / length.clamp_min(most_px)), 0.0)
            moving = moving & (length[..., 0] > self.settled_px)
            if not bool(moving.any()):
                break
            values = self.read(level, self.in_cells(place[:, :, None] + self.patch))
            fit = self.fit(values)
        return place, self.left(values, fit)[0] > self.least_left

    def step(self, level: Tensor, place: Tensor, around: Tensor, warp: Tensor) -> Tensor:
        """Places (B, N, 2) px after a step by the templates' derivatives; patches (B, N, P, 2) px are warped by (B, N, 2, 2)."""
        fit = self.fit(self.sample(level, place[:, :, None] + around))
        return place - (warp @ fit[..., :2, None])[..., 0] / fit[..., 2:3].clamp_min(self.least_left)

    def settle(self, level: Tensor, place: Tensor, around: Tensor, most_px: float) -> tuple[Tensor, Tensor, Tensor]:
        """Places (B, N, 2) px after a step by the frame's own derivatives, their covariance px^2, and whether the dots are there.

        Patches are (B, N, P, 2) px. The gradient is that of the place where steps end: where the shares of the derivatives are
        zero, their change by the frame is minus their change by the place, times the motion (implicit function theorem).
        """
        places = place[:, :, None] + around
        values = self.sample(level, places)
        fit = self.fit(values)
        along = self.difference_px * torch.eye(2, dtype=place.dtype, device=place.device)
        ahead = [self.fit(self.sample(level.detach(), places.detach() + one))[..., :2] for one in along]
        by_place = (torch.stack(ahead, -1) - fit.detach()[..., :2, None]) / self.difference_px  # (B, N, 2, 2)
        determinant = by_place[..., 0, 0] * by_place[..., 1, 1] - by_place[..., 0, 1] * by_place[..., 1, 0]
        left, squares = self.left(values.detach(), fit.detach())
        there = (left > self.least_left) & (determinant > 0.1 * self.least_left**2)
        adjugate = torch.stack((by_place[..., 1, 1], -by_place[..., 0, 1], -by_place[..., 1, 0], by_place[..., 0, 0]), -1)
        inverse = adjugate.reshape(by_place.shape) / torch.where(there, determinant, 1.0)[..., None, None]
        change = torch.where(there[..., None], -(inverse @ fit[..., :2, None])[..., 0], 0.0).clamp(-most_px, most_px)
        variance = (squares / self.unit_residual)[..., None, None]
        return place + change, variance * (inverse @ self.unit_covariance @ inverse.mT), there

    def left(self, values: Tensor, fit: Tensor) -> tuple[Tensor, Tensor]:
        """Share (B, N) that is left of dots, less what patches (B, N, P) hold beside the fit, and the weighted squares of this."""
        squares = (self.weight * (values - (self.columns @ fit[..., None])[..., 0]).square()).sum(-1)
        return fit[..., 2] - (squares / self.darkness).sqrt(), squares

    def fit(self, values: Tensor) -> Tensor:
        """Shares of the columns (B, N, 16) in patches (B, N, P)."""
        return (self.matrix @ values[..., None])[..., 0]

    def slopes(self, level: Tensor, places: Tensor) -> Tensor:
        """Slopes (B, N, P, 2) of a level at places (B, N, P, 2), by px."""
        along = self.difference_px * torch.eye(2, dtype=places.dtype, device=places.device)
        changes = [self.sample(level, places + one) - self.sample(level, places - one) for one in along]
        return torch.stack(changes, -1) / (2.0 * self.difference_px)

    def sample(self, level: Tensor, places: Tensor) -> Tensor:
        """A level (B, 1, h, w) at places (B, N, P, 2) px, through a cubic B-spline: four bilinear samples with its weights.

        Source:
            Sigg and Hadwiger, Fast third-order texture filtering, GPU Gems 2, 2005, chapter 20.
        """
        at = self.in_cells(places)
        whole = at.detach().floor()
        t = at - whole
        s = 1.0 - t
        first, last = s * s * s / 6.0, t * t * t / 6.0
        far = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s) + last  # weight of the pixels beyond; that of the others is the rest
        near = 1.0 - far
        before, apart = whole - first / near, 1.0 + last / far + first / near
        corners = self.corners[:, None, None]
        light = self.read(level, (before[:, None] + apart[:, None] * corners).flatten(1, 2))  # (B, 4 N, P)
        weight = near[:, None] + (far - near)[:, None] * corners
        return (light.reshape(weight.shape[:-1]) * weight[..., 0] * weight[..., 1]).sum(1)

    def in_cells(self, places: Tensor) -> Tensor:
        """Places of the image in pixels of the level."""
        return places if self.cell == 1 else (places + 0.5) / float(self.cell) - 0.5

    def read(self, level: Tensor, at: Tensor) -> Tensor:
        """A level (B, 1, h, w) at places (B, M, P, 2) in its pixels, linear between them: (B, M, P)."""
        scale = 2.0 / torch.tensor([level.shape[3] - 1.0, level.shape[2] - 1.0], dtype=at.dtype, device=at.device)
        image = level.expand(at.shape[0], -1, -1, -1)
        return nn.functional.grid_sample(image, at * scale - 1.0, "bilinear", "border", align_corners=True)[:, 0]


def quadratic(places: Tensor) -> Tensor:
    """Halves of squares and the product of places (..., 2): (..., 3), the terms of a bend."""
    x, y = places[..., 0], places[..., 1]
    return torch.stack((0.5 * x * x, x * y, 0.5 * y * y), -1)
