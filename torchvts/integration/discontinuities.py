r"""Integration that preserves discontinuities: edges that contradict the rest of the map lose their weight.

A wall that is parallel to the view carries no slope, so least squares smears its height over the whole contact. Here each edge
between two pixels has a weight: first the inverse variance of its slope, then less the more the depth disagrees with it
(iteratively reweighted least squares). Where the skin is undeformed the depth is zero.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..core.geometry import lengths
from .base import Integrator
from .poisson import PoissonBackground, plan_dct
from .transforms import solve_by_fft

WALL_SHARE = 0.001
"""Share of contradicted edges from which a frame has walls; :func:`discontinuity_share` says what was measured."""

SLOPE_STD = 0.05
"""Noise of the slope of flat pixels; a factor of two up or down changes little."""

CONTRADICTED = 2.0
"""Standard deviations from which an edge counts as contradicted."""

RIM_WEIGHT = 0.1
"""Of an edge across the rim of a contact: walls are there."""

LEAST_WEIGHT = 1e-6
"""Of an edge, relative to one between two flat pixels: keeps the system regular where all around a pixel is cut."""

RIM_TOLERANCE_PX = 0.1
"""Added to the standard deviation of a rim edge when it votes for the height of a contact."""

BELOW_ZERO_PX, BELOW_ZERO = 1.0, 0.1
"""Skin lower than that is unlikely to touch the object, and costs so much: enough to decide between two heights of a rim."""

MARGIN_PX = 2
"""Undeformed pixels kept around the contacts when the others are left out."""

PASSES, SETTLED_PX = 12, 0.02
"""The weights are set until no pixel moves by more, at most so often."""

STEPS, RESIDUAL = 300, 1e-3
"""Of each solve by conjugate gradients: most steps, and the residual at which it ends, relative, in the preconditioner's norm."""


class AdaptiveIntegration(Integrator):
    r"""PoissonBackground, and for frames that show walls, depth that may have cliffs: zero where the skin is undeformed.

    A frame has walls where its smooth depth contradicts more than a thousandth of the contact's slopes. Then:

    1. An edge's slope is the mean of its two pixels', as in :func:`poisson_background`; its variance v is the mean of theirs,
       ``s^2 (1 + |g|^2)^2`` (a slope g whose angle is off), plus a twelfth of the square of their difference (a crease may lie
       anywhere between them).
    2. Each contact is solved by itself, cut off along its rim, and set to the height that most of its rim agrees with: a roof
       between two vertical ends stands on its eaves. If as much of the rim agrees with two heights, the one is taken that leaves
       less of the contact below zero: a ramp stands on its low end, not on the cliff at its high one. (The slope of a pixel on
       the rim that is less than half of that further in is an average with the skin beside the object; the rim is then taken to
       lie within such pixels.)
    3. All is solved together with weights 1 / (v (1 + r^2 / (c^2 v))), r being the difference of edge and depth, until the depth
       no longer changes. Edges across the rim have a tenth of the weight.

    Contact is where the gradient is not exactly zero, with gaps of one or two pixels closed; or the part of it whose slopes are no
    noise (a weight of slopes reaches beyond a wall), where the edges then disagree less. Undeformed skin that does not reach the
    image border (a hole) counts as contact, unless none does. Slopes do not determine the height of a flat piece with cliffs all
    around: it stays at the height of the undeformed skin. Without any undeformed pixel, the lowest depth is zero.

    Each solve is by conjugate gradients without a matrix, from the depth so far, with the cosine solver of :func:`poisson_dct` as
    preconditioner. Differentiable with the weights held constant. Takes PoissonDCT's place in a pipeline. Frames of a batch do not
    influence one another.

    Args:
        mm_per_pixel: pixel pitch in mm.
    Source:
        Holland and Welsch, Communications in Statistics 6(9), 1977, for the weights (Cauchy's); Queau, Durou, Aujol,
        Variational methods for normal integration, JMIV 60, 2018, for edges that the others contradict.
    Example:
        >>> from torchvts import poisson_background
        >>> x = torch.arange(-12.0, 12.0)
        >>> roof = torch.zeros(1, 2, 24, 24)
        >>> roof[:, 0, 4:20] = -x.sign() * (x.abs() < 9)  # eaves at x = -9 and 9, vertical ends
        >>> [round(float(solve(roof)[0, 0, 4, 12]), 1) for solve in (AdaptiveIntegration(), poisson_background)]
        [7.7, 3.7]
    """

    poisson = PoissonBackground

    def __init__(self, mm_per_pixel: float = 1.0) -> None:
        super().__init__()
        self.smooth = self.poisson(mm_per_pixel)
        self.mm_per_pixel = self.smooth.mm_per_pixel

    def forward(self, gradient: Tensor) -> Tensor:
        """Depth in mm, (B, 1, H, W).

        Raises:
            ValueError: wrong shape, or H or W below 2. TypeError: not floating point.
        """
        depth: Tensor = self.smooth(gradient)
        chosen = torch.where(discontinuity_share(gradient, depth, self.mm_per_pixel) > WALL_SHARE)[0]
        for k in chosen.tolist():
            depth = depth.index_copy(0, chosen.new_tensor([k]), self.mm_per_pixel * across_walls(gradient[k : k + 1]))
        return depth


def discontinuity_share(gradient: Tensor, depth_mm: Tensor, mm_per_pixel: float) -> Tensor:
    """Share of the contact's edges on which a smooth depth contradicts the gradient it was integrated from, (B,), 0 to 1.

    An edge is contradicted if both differ by more than three standard deviations of its slope; ten that differ by more than two
    count as one, for a low cliff is smeared over many. Measured: 0 on spheres, sines, cones, capsules, letters with soft flanks,
    with noise up to 4 grey levels, and on real balls of a GelSight Mini; 0.016 to 0.028 on wedges and cylinders with vertical
    ends; 0.0004 to 0.01 on stamps with steep flanks.
    """
    gradient, depth = gradient.detach(), depth_mm.detach() / mm_per_pixel
    deformed = (gradient != 0).any(dim=1, keepdim=True)
    wrong, odd, count = (gradient.new_zeros(gradient.shape[0]) for _ in range(3))
    for dim, slope, variance in _edges(gradient):
        one, other = _ends(deformed, dim)
        counts = one | other
        surprise = _misses(depth, dim, slope) / variance * counts
        wrong = wrong + (surprise > 9.0).sum(dim=(1, 2, 3))
        odd = odd + (surprise > 4.0).sum(dim=(1, 2, 3))
        count = count + counts.sum(dim=(1, 2, 3))
    return torch.maximum(wrong, 0.1 * odd) / count.clamp_min(1.0)


def across_walls(gradient: Tensor) -> Tensor:
    """Steps 1 to 3 of :class:`AdaptiveIntegration` for one frame, (1, 2, H, W): depth at unit pitch."""
    anywhere = (gradient != 0).any(dim=1, keepdim=True)
    deformed, steep = _without_gaps(anywhere), anywhere & _steep(gradient.detach())
    found = _solve_contacts(gradient, deformed)
    if bool((steep != deformed).any()):
        found = min(found, _solve_contacts(gradient, steep), key=lambda depth: _disagreement(gradient, depth))
    return found


def _solve_contacts(gradient: Tensor, contact: Tensor) -> Tensor:
    """:func:`_solve_part` of the part of a frame that holds the contacts; depth at unit pitch is zero around it."""
    contacts = _label_contacts(contact)
    if not bool(contacts.any()):
        return 0.0 * gradient[:, 0:1]
    top, bottom, left, right = _box(contacts[0, 0] > 0)
    part = (slice(None), slice(None), slice(top, bottom), slice(left, right))
    depth = _solve_part(gradient[part], contacts[part])
    return nn.functional.pad(depth, [left, gradient.shape[3] - right, top, gradient.shape[2] - bottom])


def _disagreement(gradient: Tensor, depth: Tensor) -> float:
    """Sum over edges of what depth and slopes disagree by, in the robust measure that the weights belong to."""
    edges = _edges(gradient.detach())
    return sum(float(torch.log1p(_surprise(depth.detach(), dim, slope, variance)).sum()) for dim, slope, variance in edges)


def _solve_part(gradient: Tensor, contacts: Tensor) -> Tensor:
    """Depth at unit pitch of contacts with numbers from 1 on."""
    free = contacts > 0
    covered = _covered(gradient.detach(), free)
    edges = _edges(gradient.detach())
    rims = [one != other for one, other in (_ends(covered, dim) for dim, _, _ in edges)]
    bases = [torch.full_like(variance, SLOPE_STD**2) / variance for _, _, variance in edges]
    system = _System(free, gradient)
    with torch.no_grad():
        right = [slope for _, slope, _ in edges]
        cut = [base.masked_fill(rim, 0.0).clamp_min(LEAST_WEIGHT) for rim, base in zip(rims, bases, strict=True)]
        depth = system.solve(cut, _weighted(cut, right), solve_by_fft(-_adjoint(*right), system.plan), 1e-2)
        depth = _set_heights(depth, torch.where(covered, contacts, 0), edges, rims)
        weights, moved = bases, float("inf")
        for _ in range(PASSES):
            factors = [
                torch.where(rim, RIM_WEIGHT, 1.0) / (1.0 + _surprise(depth, *edge)) for rim, edge in zip(rims, edges, strict=True)
            ]
            weights = [(base * factor).clamp_min(LEAST_WEIGHT) for base, factor in zip(bases, factors, strict=True)]
            found = system.solve(weights, _weighted(weights, right), depth, RESIDUAL)
            moved, depth = float((found - depth).abs().amax()), found
            if moved <= SETTLED_PX:
                break
    if torch.is_grad_enabled() and gradient.requires_grad:
        slopes = [slope for _, slope, _ in _edges(gradient)]
        depth = _Solve.apply(_weighted(weights, slopes), system, weights, depth)  # type: ignore[no-untyped-call]
    return depth - depth.amin() if bool(free.all()) else depth


def _covered(gradient: Tensor, free: Tensor) -> Tensor:
    """The free pixels less those on the rim that are seen half beside the object."""
    steepness = lengths(gradient, 1, keepdim=True)
    inner = nn.functional.max_pool2d((~free).to(gradient.dtype), 3, 1, 1) == 0
    further_in = -nn.functional.max_pool2d(torch.where(inner, -steepness, -torch.inf), 3, 1, 1)  # the least of the inner around
    beside = (steepness < 0.5 * further_in) & (further_in > 4.0 * SLOPE_STD) & torch.isfinite(further_in)
    covered: Tensor = free & (inner | ~beside)
    return covered


def _set_heights(depth: Tensor, contacts: Tensor, edges: list[tuple[int, Tensor, Tensor]], rims: list[Tensor]) -> Tensor:
    """Each contact set to the height at which its rim disagrees least with depth zero outside, by the same robust measure."""
    placed = depth
    for number in range(1, int(contacts.amax()) + 1):
        mine = contacts == number
        votes, spread = [], []
        for (dim, slope, variance), rim in zip(edges, rims, strict=True):
            before, after = _ends(depth, dim)
            inside_before, inside_after = _ends(mine, dim)
            std = variance.sqrt() + RIM_TOLERANCE_PX
            for edge, vote in ((rim & inside_before, -slope - before), (rim & inside_after, slope - after)):
                votes.append(vote[edge])
                spread.append(CONTRADICTED * std[edge])
        vote, scale = torch.cat(votes), torch.cat(spread)
        height = depth.new_zeros(())
        if vote.numel() > 0:
            candidates = vote[:: 1 + vote.numel() // 400]
            cost = torch.log1p(((candidates[:, None] - vote) / scale).square()).mean(1)
            inside = depth[mine]
            inside = inside[:: 1 + inside.numel() // 400]
            cost = cost + BELOW_ZERO * (candidates[:, None] + inside < -BELOW_ZERO_PX).to(cost.dtype).mean(1)
            height = candidates[cost.argmin()]
            for _ in range(5):
                weight = 1.0 / (scale.square() + (height - vote).square())
                height = (weight * vote).sum() / weight.sum()
        placed = torch.where(mine, depth + height, placed)
    return placed


class _System:
    """Weighted sums of edges, solved for free pixels; the others are zero."""

    def __init__(self, free: Tensor, like: Tensor) -> None:
        self.free = free.to(like.dtype)
        self.plan = plan_dct(like, like.shape[2], like.shape[3])

    def solve(self, weights: list[Tensor], right: Tensor, start: Tensor, tolerance: float) -> Tensor:
        """Preconditioned conjugate gradients, until the residual is below ``tolerance`` of the right-hand side."""
        right, depth = right * self.free, start * self.free
        residual = right - self._apply(weights, depth)
        search = towards = self._precondition(residual)
        size = float((residual * towards).sum())
        enough = tolerance**2 * float((right * self._precondition(right)).sum())
        for _ in range(STEPS):
            if size <= enough:
                break
            image = self._apply(weights, search)
            step = size / float((search * image).sum())
            depth = depth + step * search
            residual = residual - step * image
            towards = self._precondition(residual)
            before, size = size, float((residual * towards).sum())
            search = towards + (size / before) * search
        return depth

    def _apply(self, weights: list[Tensor], depth: Tensor) -> Tensor:
        return _weighted(weights, [depth[..., 1:] - depth[..., :-1], depth[..., 1:, :] - depth[..., :-1, :]]) * self.free

    def _precondition(self, residual: Tensor) -> Tensor:
        return -solve_by_fft(residual, self.plan) * self.free


class _Solve(torch.autograd.Function):
    """The solution of a system as a function of its right-hand side: backwards, the same system again."""

    @staticmethod
    def forward(ctx: Any, right: Tensor, system: _System, weights: list[Tensor], depth: Tensor) -> Tensor:
        ctx.system, ctx.weights = system, weights
        return depth.clone()

    @staticmethod
    def backward(ctx: Any, *of_depth: Tensor) -> tuple[Tensor, None, None, None]:
        start = torch.zeros_like(of_depth[0])
        return ctx.system.solve(ctx.weights, of_depth[0], start, 1e-8) * ctx.system.free, None, None, None


def _edges(gradient: Tensor) -> list[tuple[int, Tensor, Tensor]]:
    """Dimension, slope and variance of the edges along x, (B, 1, H, W - 1), and along y, (B, 1, H - 1, W)."""
    edges = []
    of_pixel = (SLOPE_STD * (1.0 + gradient.detach().square().sum(1, keepdim=True))).square()
    for axis, dim in ((0, 3), (1, 2)):
        before, after = _ends(gradient[:, axis : axis + 1], dim)
        one, other = _ends(of_pixel, dim)
        edges.append((dim, 0.5 * (before + after), 0.5 * (one + other) + (after - before).detach().square() / 12.0))
    return edges


def _ends(field: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """The first and the second pixel of every edge along ``dim``."""
    length = field.shape[dim] - 1
    return field.narrow(dim, 0, length), field.narrow(dim, 1, length)


def _misses(depth: Tensor, dim: int, slope: Tensor) -> Tensor:
    """Square of what a depth at unit pitch and the slopes of edges along ``dim`` differ by."""
    before, after = _ends(depth, dim)
    return (after - before - slope).square()


def _surprise(depth: Tensor, dim: int, slope: Tensor, variance: Tensor) -> Tensor:
    """The same, relative to that from which an edge counts as contradicted."""
    return _misses(depth, dim, slope) / (CONTRADICTED**2 * variance)


def _weighted(weights: list[Tensor], edges: list[Tensor]) -> Tensor:
    return _adjoint(weights[0] * edges[0], weights[1] * edges[1])


def _adjoint(along_x: Tensor, along_y: Tensor) -> Tensor:
    """Of differences along x (B, 1, H, W - 1) and y (B, 1, H - 1, W): what goes out of each pixel, with its sign."""
    pad = nn.functional.pad
    return pad(along_x, [1, 0]) - pad(along_x, [0, 1]) + pad(along_y, [0, 0, 1, 0]) - pad(along_y, [0, 0, 0, 1])


def _steep(gradient: Tensor) -> Tensor:
    """Pixels (B, 1, H, W) whose slope is no noise, to a pixel: by means of 5 x 5, with crests up to 8 pixels wide filled."""
    mean = nn.functional.avg_pool2d(gradient, 5, 1, 2, count_include_pad=False)
    steep = (lengths(mean, 1, keepdim=True) > SLOPE_STD).to(torch.float32)
    filled = -nn.functional.max_pool2d(-nn.functional.max_pool2d(steep, 9, 1, 4), 9, 1, 4)
    inner = -nn.functional.max_pool2d(-filled, 5, 1, 2)  # means reach two pixels further
    return nn.functional.max_pool2d(inner, 3, 1, 1) > 0


def _without_gaps(deformed: Tensor) -> Tensor:
    """Gaps of one or two pixels closed: a crest whose slope happens to be exactly zero is in contact."""
    grown = nn.functional.max_pool2d(deformed.to(torch.float32), 3, 1, 1)
    return nn.functional.max_pool2d(-grown, 3, 1, 1) < 0


def _label_contacts(deformed: Tensor) -> Tensor:
    """Contacts of a bool mask (1, 1, H, W) numbered from 1 on, int32; the others are 0. Holes belong to the contact around them."""
    import cv2

    mask = deformed[0, 0].cpu().numpy()
    _, outside = cv2.connectedComponents((~mask).astype(np.uint8), connectivity=4)
    border = np.concatenate((outside[0], outside[-1], outside[:, 0], outside[:, -1]))
    open_outside = np.isin(outside, border[border > 0]) if border.any() else ~mask
    _, label = cv2.connectedComponents((~open_outside).astype(np.uint8), connectivity=4)
    return torch.from_numpy(label)[None, None].to(deformed.device)


def _box(mask: Tensor) -> tuple[int, int, int, int]:
    """(top, bottom, left, right) around a mask (H, W) with a margin, of sizes that suit the transform where there is room."""
    bounds: list[int] = []
    for dim, length in ((1, mask.shape[0]), (0, mask.shape[1])):
        places = mask.any(dim=dim).nonzero()
        first, last = max(0, int(places[0]) - MARGIN_PX), min(length, int(places[-1]) + 1 + MARGIN_PX)
        wanted = min(length, -(-(last - first) // 16) * 16)
        first = max(0, min(first, length - wanted))
        bounds += [first, max(last, first + wanted)]
    return bounds[0], bounds[1], bounds[2], bounds[3]
