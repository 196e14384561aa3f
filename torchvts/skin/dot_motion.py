"""What the motion of dots says of the skin between them, and of the object that moves it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_mask, check_same_size

LENGTHS = (1.5, 2.2, 3.2, 4.6, 7.0)
"""Lengths of the field, in spacings of the dots, of which the likeliest is taken."""

LEAST_MM = 1e-4
"""Least strength of a field, and least standard deviation of a dot."""

STEPS = 8.0
"""The field is computed at so many places in a spacing, and interpolated."""

TOLERANCE_PX = 0.15
"""Stuck skin differs from its object by at most so much, beside two standard deviations."""


class Slip(NamedTuple):
    """The rigid motion with which most of the contact agrees, and how the skin differs from it; NaN where there is no contact.

    Attributes:
        shift_mm: (B, 2), of the object at the middle of the contact, along x and y.
        turn_deg: (B,), of the object, from x to y of the image.
        stuck_share: (B,), share of the contact's area whose skin moves with the object.
        slip_mm: (B, N, 2), motion of the object less that of the skin at the dots; NaN beside the contact.
    """

    shift_mm: Tensor
    turn_deg: Tensor
    stuck_share: Tensor
    slip_mm: Tensor


class DotMotion(NamedTuple):
    """Motion of printed dots against the skin at rest: mm, along x and y of the image from its middle, and depth.

    Attributes:
        rest_mm: (N, 2), x and y of the dots at rest.
        displacement_mm: (B, N, 3): along x, along y, and depth. Of a dot that is not seen, what its neighbours expect.
        covariance_mm2: (B, N, 3, 3).
        seen: (B, N) bool.
        pinhole_mm: (B, N): how much nearer to the axis of the camera a dot may seem than it is, where the camera is not known.
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch.
    """

    rest_mm: Tensor
    displacement_mm: Tensor
    covariance_mm2: Tensor
    seen: Tensor
    pinhole_mm: Tensor
    height: int
    width: int
    mm_per_pixel: float

    def field(self) -> tuple[Tensor, Tensor]:
        """Displacement of the skin that lies at each pixel at rest, (B, 3, H, W) mm, and its standard deviation, likewise.

        A Gaussian process (Matern 5/2) through the dots that are seen, with mean zero; its length and strength are the likeliest.

        Source:
            Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, eq. 2.25, 2.26, 4.17 and 5.8.
        """
        x, y = self._grid()
        mean, variance = self.at(torch.cartesian_prod(y, x).flip(1))
        both = torch.cat((mean, variance.sqrt()), -1).mT.reshape(-1, 6, len(y), len(x))
        both = nn.functional.interpolate(both, (self.height, self.width), mode="bilinear", align_corners=True)
        return both[:, :3], both[:, 3:]

    def at(self, places_mm: Tensor) -> tuple[Tensor, Tensor]:
        """The field at places of the skin at rest (M, 2), mm: displacement (B, M, 3) and its variance, mm^2, likewise."""
        spacing, rest, known = self.spacing_mm(), self.rest_mm.detach().double(), self.seen[:, None].double()  # (B, 1, N)
        apart, far = torch.cdist(rest, rest) / spacing, torch.cdist(places_mm.double(), rest) / spacing
        values, both = self.displacement_mm.double().mT * known, known[..., None] * known[..., None, :]  # (B, 3, N)
        noise = self.covariance_mm2.detach().double().diagonal(dim1=2, dim2=3).mT.clamp_min(LEAST_MM**2)
        fits = [_likelihood(matern(apart / length) * both, values.detach(), noise) for length in LENGTHS]
        costs, powers = (torch.stack(part) for part in zip(*fits, strict=True))
        best = costs.argmin(dim=0, keepdim=True)  # (1, B, 3)
        power, lengths = powers.gather(0, best)[0, ..., None, None], values.new_tensor(LENGTHS)[best[0]][..., None, None]
        cholesky = torch.linalg.cholesky(power * matern(apart / lengths) * both + torch.diag_embed(noise))
        cross = power * matern(far / lengths) * known[:, :, None]  # (B, 3, M, N)
        mean = (cross @ torch.cholesky_solve(values[..., None], cholesky))[..., 0]
        told = torch.linalg.solve_triangular(cholesky, cross.mT, upper=False).square().sum(-2)
        variance = (power[..., 0] - told).clamp_min(0.0)
        return mean.mT.to(self.displacement_mm.dtype), variance.mT.to(self.displacement_mm.dtype)

    def slip(self, contact: Tensor) -> Slip:
        """How the object moves, and which skin under it does not follow.

        Each place of the contact says, by its displacement and turn, how the object moves, if skin sticks there. The motion counts
        with which the most places agree, deep ones first, because skin under more pressure slips last.

        Args:
            contact: (B, 1, H, W) bool, where the object touches the skin.
        Raises:
            ValueError: another size or number of frames. TypeError: not bool.
        """
        touched = self.touched(contact)
        x, y = self._grid()
        places = torch.cartesian_prod(y, x).flip(1)
        mean, variance = self.at(places)
        inside = self._under(contact, places + mean[..., :2]) & (mean[..., 2] > 0.0)
        turns = self._turns(mean[..., :2].reshape(-1, len(y), len(x), 2), x, y).flatten(1)
        found = [
            _object(places[one], m[one, :2], v[one, :2].mean(-1).sqrt(), turn[one], m[one, 2], TOLERANCE_PX * self.mm_per_pixel)
            for one, m, v, turn in zip(inside, mean, variance, turns, strict=True)
        ]
        shift, turn, pivot, share = (torch.stack(part) for part in zip(*found, strict=True))
        offset = self.rest_mm - pivot[:, None]
        moved = _turned(offset, turn[:, None]) - offset + shift[:, None]
        slip = torch.where(touched[..., None], moved - self.displacement_mm[..., :2], math.nan)
        return Slip(shift, torch.rad2deg(turn), share, slip)

    def touched(self, contact: Tensor) -> Tensor:
        """Which dots are seen in contact, (B, N) bool; arguments and errors are those of :meth:`slip`."""
        check_mask("contact", contact)
        check_batch("contact", contact.to(self.rest_mm.dtype), 1)
        check_same_size("contact", contact, "images", self.height, self.width)
        if contact.shape[0] != len(self.seen):
            raise ValueError(
                f"contact: expected {len(self.seen)} frames like the motion, got {contact.shape[0]}: of another batch?"
            )
        return self._under(contact, self.rest_mm + self.displacement_mm[..., :2]) & self.seen

    def spacing_mm(self) -> float:
        """Usual distance of neighbouring dots."""
        apart = torch.cdist(self.rest_mm, self.rest_mm)
        return float(apart.topk(2, largest=False).values[:, 1].median())

    def _grid(self) -> tuple[Tensor, Tensor]:
        """x and y of a grid over the image, mm, a share of the dots' spacing apart, the first and last pixels on it."""
        step = max(1.0, self.spacing_mm() / self.mm_per_pixel / STEPS)
        sides = [(0.5 * (size - 1.0) * self.mm_per_pixel, math.ceil((size - 1.0) / step) + 1) for size in (self.width, self.height)]
        x, y = (torch.linspace(-half, half, n, dtype=self.rest_mm.dtype, device=self.rest_mm.device) for half, n in sides)
        return x, y

    def _under(self, contact: Tensor, places_mm: Tensor) -> Tensor:
        """Whether places (B, M, 2) of the image are in contact, (B, M) bool."""
        half = places_mm.new_tensor([self.width - 1.0, self.height - 1.0]) * (0.5 * self.mm_per_pixel)
        grid = (places_mm.detach() / half)[:, :, None]
        near = nn.functional.grid_sample(contact.to(places_mm.dtype), grid, mode="nearest", align_corners=True)
        return near[:, 0, :, 0] > 0.5

    @staticmethod
    def _turns(field: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Turn (B, h, w) of the skin around places of a grid, radians, of displacements (B, h, w, 2)."""
        by_y, by_x = torch.gradient(field, spacing=(y, x), dim=(1, 2))
        return torch.atan2(by_x[..., 1] - by_y[..., 0], 2.0 + by_x[..., 0] + by_y[..., 1])


def _object(
    places: Tensor, displacement: Tensor, std: Tensor, turns: Tensor, depth: Tensor, tolerance: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Shift (2,), turn, pivot (2,) and stuck share of an object, of places (M, 2) in contact, their displacements and turns."""
    nothing = places.new_full((), math.nan)
    if len(places) < 3:
        return nothing.expand(2), nothing, nothing.expand(2), nothing
    weight, bound = depth.detach(), tolerance + 2.0 * std.detach()
    pivot = (places * weight[:, None]).sum(0) / weight.sum()
    with torch.no_grad():
        offset = places[None] - places[:, None]  # of all places, as seen from each
        off = _turned(offset, turns[:, None]) - offset + displacement[:, None] - displacement
        agrees = off.square().sum(-1).sqrt() < bound
        stuck = agrees[(agrees.to(weight.dtype) @ weight).argmax()]
    turn = shift = nothing
    for _ in range(3):
        one = (stuck.to(weight.dtype) * weight / bound.square())[:, None]
        one = one / one.sum()
        before, after = places - pivot, places - pivot + displacement
        middle, to = (one * before).sum(0), (one * after).sum(0)
        a, b = before - middle, after - to
        turn = torch.atan2((one[:, 0] * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])).sum(), (one * a * b).sum())
        shift = to - _turned(middle, turn)
        stuck = (_turned(before, turn) + shift - after).detach().square().sum(-1).sqrt() < bound
    return shift, turn, pivot, stuck.to(weight.dtype).mean()


def _turned(places: Tensor, turn: Tensor) -> Tensor:
    """Places (..., 2) turned about the origin by radians (...)."""
    c, s = torch.cos(turn), torch.sin(turn)
    x, y = places[..., 0], places[..., 1]
    return torch.stack((c * x - s * y, s * x + c * y), -1)


def matern(r: Tensor) -> Tensor:
    """Matern 5/2, of distances in lengths."""
    r = math.sqrt(5.0) * r
    return (1.0 + r + r * r / 3.0) * torch.exp(-r)


def _likelihood(kernel: Tensor, values: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Cost of a field with a kernel (B, 1, N, N) through values (B, 3, N), noise likewise, and the strength that fits them best.

    Both are (B, 3), those of x and y alike; the cost is minus twice the logarithm of the likelihood, the strength a variance, mm^2.
    """
    count = kernel.diagonal(dim1=2, dim2=3).sum(-1).clamp_min(1.0)  # (B, 1)
    power, cost = torch.ones_like(values[..., 0]), torch.zeros_like(values[..., 0])
    for _ in range(3):
        cholesky = torch.linalg.cholesky(power[..., None, None] * kernel + torch.diag_embed(noise))
        whitened = torch.linalg.solve_triangular(cholesky, values[..., None], upper=False)[..., 0]
        larger = whitened.square().sum(-1) / count
        larger = torch.cat((larger[:, :2].mean(1, keepdim=True).expand(-1, 2), larger[:, 2:]), 1).clamp_min(1e-6)
        cost = count * larger.log() + 2.0 * cholesky.diagonal(dim1=2, dim2=3).log().sum(-1)
        power = (power * larger).clamp_min(LEAST_MM**2)
    return torch.cat((cost[:, :2].sum(1, keepdim=True).expand(-1, 2), cost[:, 2:]), 1), power
