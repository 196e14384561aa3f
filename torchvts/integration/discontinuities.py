r"""Integration that preserves discontinuities: edges that contradict the rest of the map lose their weight.

A wall that is parallel to the view carries no slope, so least squares smears its height over the whole contact. Here each edge
between two pixels has a weight: first the inverse variance of its slope, then less the more the depth disagrees with it
(iteratively reweighted least squares). Where the skin is undeformed the depth is zero.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_float_tensor, check_integer, check_positive, check_same_size, check_shape
from ..core.geometry import lengths
from .base import Integrator
from .poisson import PoissonBackground, check_gradient, laplace_plan, solve_laplace
from .screened import check_known

SLOPE_STD = 0.05
"""Noise of the slope of flat pixels; a factor of two up or down changes little."""

LEAST_WEIGHT = 1e-6
"""Of an edge, relative to one between two flat pixels: keeps the system regular where all around a pixel is cut."""

RIM_TOLERANCE_PX = 0.1
"""Added to the standard deviation of a rim edge when it votes for the height of a contact."""

BELOW_ZERO_PX, BELOW_ZERO = 1.0, 0.1
"""Skin lower than that is unlikely to touch the object, and costs so much: enough to decide between two heights of a rim."""

MARGIN_PX = 2
"""Undeformed pixels kept around the contacts when the others are left out."""


class DiscontinuitySolution(NamedTuple):
    """What :meth:`DiscontinuityIntegration.solve` found.

    Attributes:
        depth_mm: (B, 1, H, W).
        converged: (B,) bool, whether the depth settled before the passes ran out.
        passes: (B,) int64, times that the weights were set.
        iterations: (B,) int64, conjugate-gradient steps in all.
    """

    depth_mm: Tensor
    converged: Tensor
    passes: Tensor
    iterations: Tensor


def integrate_discontinuities(
    gradient: Tensor,
    mm_per_pixel: float = 1.0,
    contact: Tensor | None = None,
    weight: Tensor | None = None,
    known_mm: Tensor | None = None,
    known_weight: Tensor | None = None,
) -> Tensor:
    r"""Integrate a gradient map into depth that may have cliffs, zero where the skin is undeformed.

    1. An edge's slope is the mean of its two pixels', as in :func:`poisson_background`; its variance v is the mean of theirs,
       ``s^2 (1 + |g|^2)^2`` (a slope g whose angle is off), plus a twelfth of the square of their difference (a crease may lie
       anywhere between them).
    2. Each contact is solved by itself, cut off along its rim, and set to the height that most of its rim agrees with: a roof
       between two vertical ends stands on its eaves. If as much of the rim agrees with two heights, the one is taken that leaves
       less of the contact below zero: a ramp stands on its low end, not on the cliff at its high one. (The slope of a pixel on
       the rim that is less than half of that further in is an average with the skin beside the object; the rim is then taken to
       lie within such pixels.)
    3. All is solved together with weights 1 / (v (1 + r^2 / (c^2 v))), r being the difference of edge and depth, until the depth
       no longer changes. Edges across the rim have a tenth of the weight: cliffs are there.

    Each solve is by conjugate gradients without a matrix, from the depth so far, with the cosine solver of :func:`poisson_dct` as
    preconditioner. Differentiable with the weights held constant.

    Slopes do not determine the height of a flat piece with cliffs all around. It stays at the height of the undeformed skin, unless
    ``known_mm`` gives depths from elsewhere: a contact with such depths stands where they say, not where its rim does.

    Args:
        gradient: (B, 2, H, W), (dz/dx, dz/dy), mm per mm.
        mm_per_pixel: pixel pitch in mm.
        contact: bool (B, 1, H, W); None takes pixels whose gradient is not exactly zero, and gaps of one or two pixels between
            them; or of these the part whose slopes are no noise (a weight of slopes reaches beyond a wall), where the edges then
            disagree less. Undeformed skin that does not reach the image border (a hole) counts as contact, unless none does.
        weight: (B, 1, H, W) in [0, 1], how far each pixel's slope is to be trusted; 0 for missing: bridged as by a membrane.
            None for 1.
        known_mm: (B, 1, H, W), depth of pixels that is known from elsewhere, mm; needs ``known_weight``.
        known_weight: (B, 1, H, W), at least 0, how much each counts beside the others of its contact, not per mm^2 as in
            :class:`PoissonDCT`. All of a contact together weigh as one edge between two flat pixels: they give its height, the
            slopes its shape.
    Returns:
        Depth in mm, (B, 1, H, W). Without any undeformed pixel, the lowest depth is zero.
    Raises:
        ValueError: wrong shape, or H or W below 2, or one of two arguments that go together. TypeError: not floating point.
    Source:
        Holland and Welsch, Communications in Statistics 6(9), 1977, for the weights (Cauchy's); Queau, Durou, Aujol,
        Variational methods for normal integration, JMIV 60, 2018, for edges that the others contradict.
    Example:
        >>> from torchvts import poisson_background
        >>> x = torch.arange(-12.0, 12.0)
        >>> roof = torch.zeros(1, 2, 24, 24)
        >>> roof[:, 0, 4:20] = -x.sign() * (x.abs() < 9)  # eaves at x = -9 and 9, vertical ends
        >>> [round(float(solve(roof)[0, 0, 4, 12]), 1) for solve in (integrate_discontinuities, poisson_background)]
        [7.7, 3.7]
    """
    return DiscontinuityIntegration(mm_per_pixel).solve(gradient, contact, weight, known_mm, known_weight).depth_mm


class DiscontinuityIntegration(Integrator):
    """Module for :func:`integrate_discontinuities`.

    Args:
        mm_per_pixel: pixel pitch in mm.
        slope_std: s, noise of the slope of flat pixels.
        threshold: c, standard deviations from which an edge counts as contradicted.
        rim_weight: of an edge across the rim of the contact, in (0, 1].
        max_passes: bound of step 3.
        max_iterations: bound of the conjugate-gradient steps of each solve.
        residual: of a solve, relative, in the preconditioner's norm.
        tolerance_px: the depth has settled when no pixel moves by more, in pixels of pitch.
    """

    def __init__(
        self,
        mm_per_pixel: float = 1.0,
        *,
        slope_std: float = SLOPE_STD,
        threshold: float = 2.0,
        rim_weight: float = 0.1,
        max_passes: int = 12,
        max_iterations: int = 300,
        residual: float = 1e-3,
        tolerance_px: float = 0.02,
    ) -> None:
        super().__init__()
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.slope_std = check_positive("slope_std", slope_std)
        self.threshold = check_positive("threshold", threshold)
        self.rim_weight = check_positive("rim_weight", rim_weight, 1.0)
        self.max_passes = check_integer("max_passes", max_passes, 1)
        self.max_iterations = check_integer("max_iterations", max_iterations, 1)
        self.residual = check_positive("residual", residual)
        self.tolerance_px = check_positive("tolerance_px", tolerance_px)

    def forward(self, gradient: Tensor) -> Tensor:
        return self.solve(gradient).depth_mm

    def solve(
        self,
        gradient: Tensor,
        contact: Tensor | None = None,
        weight: Tensor | None = None,
        known_mm: Tensor | None = None,
        known_weight: Tensor | None = None,
    ) -> DiscontinuitySolution:
        """Depth with its status; arguments as :func:`integrate_discontinuities`."""
        check_gradient(gradient, 2)
        if not bool(torch.isfinite(gradient).all()):
            raise ValueError("gradient: expected finite values, got NaN or infinite ones: set them to 0 and give them the weight 0")
        height, width = gradient.shape[2], gradient.shape[3]
        anywhere = (gradient != 0).any(dim=1, keepdim=True)
        deformed = _without_gaps(anywhere) if contact is None else contact
        steep = anywhere & _steep(gradient.detach(), self.slope_std) if contact is None else contact
        trust = torch.ones_like(gradient[:, 0:1]) if weight is None else weight
        for name, value in (("contact", deformed), ("weight", trust)):
            check_shape(name, value, (gradient.shape[0], 1, height, width), "gradient")
            if (value.dtype == torch.bool) != (name == "contact"):
                kind = "bool: threshold it" if name == "contact" else "a number from 0 to 1: weight.float() of a mask"
                raise TypeError(f"{name}: expected {kind.split(':')[0]}, got {value.dtype}:{kind.split(':')[1]}")
        check_float_tensor("weight", trust)
        if not bool(((trust >= 0) & (trust <= 1)).all()):
            raise ValueError(f"weight: expected values from 0 to 1, got {float(trust.min()):g} to {float(trust.max()):g}")
        trust = trust.to(gradient.dtype)
        known = self._known(gradient, known_mm, known_weight)
        depths, status = [], []
        for frame, mask, other, sure, data in zip(
            *(each.unsqueeze(1) for each in (gradient, deformed, steep, trust, known)), strict=True
        ):
            found = self._solve_contacts(frame, label_contacts(mask), sure, data)
            if bool((other != mask).any()):
                second = self._solve_contacts(frame, label_contacts(other), sure, data)
                found = min(found, second, key=lambda one: self._disagreement(frame, one[0], sure))
            depths.append(self.mm_per_pixel * found[0])
            status.append(found[1:])
        kinds = (torch.bool, torch.int64, torch.int64)
        columns = [torch.tensor([row[k] for row in status], dtype=kind, device=gradient.device) for k, kind in enumerate(kinds)]
        return DiscontinuitySolution(torch.cat((gradient[:0, 0:1], *depths)), columns[0], columns[1], columns[2])

    def _solve_contacts(self, gradient: Tensor, contacts: Tensor, trust: Tensor, known: Tensor) -> tuple[Tensor, bool, int, int]:
        """:meth:`_solve_frame` of the part of an image that holds the contacts; depth at unit pitch is zero around it."""
        if not bool(contacts.any()):
            return torch.zeros_like(trust) + 0.0 * gradient[:, 0:1], True, 0, 0
        top, bottom, left, right = _box(contacts[0, 0] > 0)
        part = (slice(None), slice(None), slice(top, bottom), slice(left, right))
        depth, still, passes, iterations = self._solve_frame(gradient[part], contacts[part], trust[part], known[part])
        height, width = gradient.shape[2], gradient.shape[3]
        return nn.functional.pad(depth, [left, width - right, top, height - bottom]), still, passes, iterations

    def _disagreement(self, gradient: Tensor, depth: Tensor, trust: Tensor) -> float:
        """Sum over edges of what depth and slopes disagree by, in the robust measure that the weights belong to."""
        total = 0.0
        for dim, slope, variance in zip((3, 2), *_edges(gradient.detach(), self.slope_std), strict=True):
            before, after = _ends(depth.detach(), dim)
            first, second = _ends(trust, dim)
            surprise = (after - before - slope).square() / (self.threshold**2 * variance)
            total += float((first * second * torch.log1p(surprise)).sum())
        return total

    def _known(self, gradient: Tensor, known_mm: Tensor | None, known_weight: Tensor | None) -> Tensor:
        """(B, 2, H, W): depth known from elsewhere, at unit pitch, and its weight."""
        if known_mm is None or known_weight is None:
            if known_mm is not None or known_weight is not None:
                raise ValueError("known_mm, known_weight: expected both or neither, got one of them")
            return torch.zeros_like(gradient)
        check_known(gradient, known_mm, known_weight)
        parts = (known_mm / self.mm_per_pixel, known_weight)
        return torch.cat([part.expand(gradient[:, :1].shape) for part in parts], dim=1).to(gradient.dtype)

    def _solve_frame(self, gradient: Tensor, contacts: Tensor, trust: Tensor, known: Tensor) -> tuple[Tensor, bool, int, int]:
        """Depth at unit pitch, whether it settled, passes, conjugate-gradient steps."""
        free = contacts > 0
        covered = self._covered(gradient.detach(), free)
        slopes, variances = _edges(gradient, self.slope_std)
        rims, bases, bridged = [], [], []
        for dim, variance in zip((3, 2), variances, strict=True):
            one, other = _ends(covered, dim)
            rims.append(one != other)
            first, second = _ends(trust, dim)
            sure = first * second
            bases.append(sure * self.slope_std**2 / variance)
            bridged.append(slopes[3 - dim] * (sure > 0))  # missing slopes count as zero, at the least weight: a membrane
        slopes = bridged
        known_in = torch.bincount(contacts.flatten().long(), known[:, 1].flatten(), int(contacts.amax()) + 1).to(known.dtype)
        pull = known[:, 1:2] / known_in.clamp_min(1e-12)[contacts.long()] * free
        system = _System(free, gradient, known[:, 0:1], pull, self.max_iterations)
        with torch.no_grad():
            right = [slope.detach() for slope in slopes]
            cut = [
                torch.where(rim, torch.zeros_like(base), base).clamp_min(LEAST_WEIGHT)
                for rim, base in zip(rims, bases, strict=True)
            ]
            start = solve_laplace(-_adjoint(*right), system.plan) * system.free
            depth = system.solve(cut, _adjoint(cut[0] * right[0], cut[1] * right[1]), start, 1e-2)
            by_rim = torch.where(covered & (known_in[contacts.long()] == 0), contacts, 0)
            depth = self._set_heights(depth, by_rim, right, variances, rims)
            weights, passes, moved = bases, 0, float("inf")
            while passes < self.max_passes and moved > self.tolerance_px:
                weights = []
                for dim, slope, variance, rim, base in zip((3, 2), right, variances, rims, bases, strict=True):
                    before, after = _ends(depth, dim)
                    surprise = (after - before - slope).square() / (self.threshold**2 * variance)
                    factor = torch.where(rim, self.rim_weight, 1.0) / (1.0 + surprise)
                    weights.append((base * factor).clamp_min(LEAST_WEIGHT))
                found = system.solve(weights, _adjoint(weights[0] * right[0], weights[1] * right[1]), depth, self.residual)
                moved = float((found - depth).abs().amax())
                depth, passes = found, passes + 1
        if torch.is_grad_enabled() and gradient.requires_grad:
            right_side = _adjoint(weights[0] * slopes[0], weights[1] * slopes[1])
            depth = _Solve.apply(right_side, system, weights, depth)  # type: ignore[no-untyped-call]
        if bool(free.all()):
            depth = depth - depth.amin()
        return depth, moved <= self.tolerance_px, passes, system.iterations

    def _covered(self, gradient: Tensor, free: Tensor) -> Tensor:
        """The free pixels less those on the rim that are seen half beside the object."""
        steepness = lengths(gradient, 1, keepdim=True)
        inner = nn.functional.max_pool2d((~free).to(gradient.dtype), 3, 1, 1) == 0
        further_in = -nn.functional.max_pool2d(torch.where(inner, -steepness, -torch.inf), 3, 1, 1)  # the least of the inner around
        beside = (steepness < 0.5 * further_in) & (further_in > 4.0 * self.slope_std) & torch.isfinite(further_in)
        covered: Tensor = free & (inner | ~beside)
        return covered

    def _set_heights(
        self, depth: Tensor, contacts: Tensor, slopes: list[Tensor], variances: list[Tensor], rims: list[Tensor]
    ) -> Tensor:
        """Each contact set to the height at which its rim disagrees least with depth zero outside, by the same robust measure."""
        placed = depth
        for number in range(1, int(contacts.amax()) + 1):
            mine = contacts == number
            votes, spread = [], []
            for dim, slope, variance, rim in zip((3, 2), slopes, variances, rims, strict=True):
                before, after = _ends(depth, dim)
                inside_before, inside_after = _ends(mine, dim)
                std = variance.sqrt() + RIM_TOLERANCE_PX
                for edge, vote in ((rim & inside_before, -slope - before), (rim & inside_after, slope - after)):
                    votes.append(vote[edge])
                    spread.append(self.threshold * std[edge])
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

    def extra_repr(self) -> str:
        return f"mm_per_pixel={self.mm_per_pixel}, slope_std={self.slope_std}"


def discontinuity_share(gradient: Tensor, depth_mm: Tensor, mm_per_pixel: float = 1.0) -> Tensor:
    """Share of the contact's edges on which a depth contradicts the gradient it was integrated from: the sign of cliffs.

    An edge is contradicted if both differ by more than three standard deviations of its slope, as :func:`integrate_discontinuities`
    estimates them; ten that differ by more than two count as one, for a low cliff is smeared over many.

    Args:
        gradient: (B, 2, H, W), mm per mm.
        depth_mm: (B, 1, H, W), of :func:`poisson_background`.
        mm_per_pixel: pixel pitch, mm.
    Returns:
        (B,), 0 to 1; 0 without contact. Measured: 0 on spheres, sines, cones, capsules, letters with soft flanks, with noise up
        to 4 grey levels, and on real balls of a GelSight Mini; 0.016 to 0.028 on wedges and cylinders with vertical ends;
        0.0004 to 0.01 on stamps with steep flanks.
    Raises:
        ValueError: wrong shapes. TypeError: not floating point.
    Example:
        >>> discontinuity_share(torch.zeros(1, 2, 8, 8), torch.zeros(1, 1, 8, 8))
        tensor([0.])
    """
    check_batch("gradient", gradient, 2)
    check_batch("depth_mm", depth_mm, 1)
    check_same_size("depth_mm", depth_mm, "gradient", gradient.shape[2], gradient.shape[3])
    gradient, depth = gradient.detach(), depth_mm.detach() / mm_per_pixel
    deformed = (gradient != 0).any(dim=1, keepdim=True)
    slopes, variances = _edges(gradient, SLOPE_STD)
    wrong, odd, count = (gradient.new_zeros(gradient.shape[0]) for _ in range(3))
    for dim, slope, variance in zip((3, 2), slopes, variances, strict=True):
        before, after = _ends(depth, dim)
        one, other = _ends(deformed, dim)
        counts = one | other
        surprise = (after - before - slope).square() / variance * counts
        wrong = wrong + (surprise > 9.0).sum(dim=(1, 2, 3))
        odd = odd + (surprise > 4.0).sum(dim=(1, 2, 3))
        count = count + counts.sum(dim=(1, 2, 3))
    return torch.maximum(wrong, 0.1 * odd) / count.clamp_min(1.0)


class AdaptiveIntegration(Integrator):
    """PoissonBackground, and :class:`DiscontinuityIntegration` for frames whose :func:`discontinuity_share` is above ``share``.

    Takes PoissonDCT's place in a pipeline. Frames of a batch do not influence one another.

    Example:
        >>> AdaptiveIntegration(0.05)(torch.zeros(1, 2, 8, 8)).shape
        torch.Size([1, 1, 8, 8])
    """

    poisson = PoissonBackground

    def __init__(self, mm_per_pixel: float = 1.0, *, share: float = 0.001) -> None:
        super().__init__()
        self.share = check_positive("share", share, 1.0)
        self.mm_per_pixel = mm_per_pixel
        self.smooth = self.poisson(mm_per_pixel)
        self.cliffs = DiscontinuityIntegration(mm_per_pixel)

    def forward(self, gradient: Tensor) -> Tensor:
        depth: Tensor = self.smooth(gradient)
        chosen = torch.where(discontinuity_share(gradient, depth, self.mm_per_pixel) > self.share)[0]
        if chosen.numel() == 0:
            return depth
        return depth.index_copy(0, chosen, self.cliffs(gradient[chosen]))


class _System:
    """Weighted sums of edges, and depths that are known with some weight, solved for free pixels; the others are zero."""

    def __init__(self, free: Tensor, like: Tensor, known: Tensor, pull: Tensor, max_iterations: int) -> None:
        self.free = free.to(like.dtype)
        self.pull = pull
        self.pulled = pull * known
        self.plan = laplace_plan(like)
        self.max_iterations = max_iterations
        self.iterations = 0

    def solve(self, weights: list[Tensor], right: Tensor, start: Tensor, tolerance: float) -> Tensor:
        """Preconditioned conjugate gradients, until the residual is below ``tolerance`` of the right-hand side, in the
        preconditioner's norm. The right-hand side is that of the edges."""
        right = (right + self.pulled) * self.free
        depth = start * self.free
        residual = right - self._apply(weights, depth)
        search = towards = self._precondition(residual)
        size = float((residual * towards).sum())
        enough = tolerance**2 * float((right * self._precondition(right)).sum())
        for _ in range(self.max_iterations):
            if size <= enough:
                break
            image = self._apply(weights, search)
            step = size / float((search * image).sum())
            depth = depth + step * search
            residual = residual - step * image
            towards = self._precondition(residual)
            before, size = size, float((residual * towards).sum())
            search = towards + (size / before) * search
            self.iterations += 1
        return depth

    def _apply(self, weights: list[Tensor], depth: Tensor) -> Tensor:
        along_x, along_y = depth[..., 1:] - depth[..., :-1], depth[..., 1:, :] - depth[..., :-1, :]
        return _adjoint(weights[0] * along_x, weights[1] * along_y) * self.free + self.pull * depth

    def _precondition(self, residual: Tensor) -> Tensor:
        return -solve_laplace(residual, self.plan) * self.free


class _Solve(torch.autograd.Function):
    """The solution of a system as a function of its right-hand side: backwards, the same system again."""

    @staticmethod
    def forward(ctx: Any, right: Tensor, system: _System, weights: list[Tensor], depth: Tensor) -> Tensor:
        ctx.system, ctx.weights = system, weights
        return depth.clone()

    @staticmethod
    def backward(ctx: Any, *of_depth: Tensor) -> tuple[Tensor, None, None, None]:
        start = torch.zeros_like(of_depth[0])
        system = ctx.system
        of_edges = of_depth[0] - system.pulled  # solve adds what is known, which does not depend on the slopes
        return system.solve(ctx.weights, of_edges, start, 1e-8) * system.free, None, None, None


def _edges(gradient: Tensor, slope_std: float) -> tuple[list[Tensor], list[Tensor]]:
    """Slope and variance of the edges along x, (B, 1, H, W - 1), and along y, (B, 1, H - 1, W)."""
    slopes, variances = [], []
    of_pixel = (slope_std * (1.0 + gradient.detach().square().sum(1, keepdim=True))).square()
    for axis, dim in ((0, 3), (1, 2)):
        before, after = _ends(gradient[:, axis : axis + 1], dim)
        one, other = _ends(of_pixel, dim)
        slopes.append(0.5 * (before + after))
        variances.append(0.5 * (one + other) + (after - before).detach().square() / 12.0)
    return slopes, variances


def _ends(field: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """The first and the second pixel of every edge along ``dim``."""
    length = field.shape[dim] - 1
    return field.narrow(dim, 0, length), field.narrow(dim, 1, length)


def _adjoint(along_x: Tensor, along_y: Tensor) -> Tensor:
    """Of differences along x (B, 1, H, W - 1) and y (B, 1, H - 1, W): what goes out of each pixel, with its sign."""
    pad = nn.functional.pad
    return pad(along_x, [1, 0]) - pad(along_x, [0, 1]) + pad(along_y, [0, 0, 1, 0]) - pad(along_y, [0, 0, 0, 1])


def _steep(gradient: Tensor, slope_std: float) -> Tensor:
    """Pixels (B, 1, H, W) whose slope is no noise, to a pixel: by means of 5 x 5, with crests up to 8 pixels wide filled."""
    mean = nn.functional.avg_pool2d(gradient, 5, 1, 2, count_include_pad=False)
    steep = (lengths(mean, 1, keepdim=True) > slope_std).to(torch.float32)
    filled = -nn.functional.max_pool2d(-nn.functional.max_pool2d(steep, 9, 1, 4), 9, 1, 4)
    inner = -nn.functional.max_pool2d(-filled, 5, 1, 2)  # means reach two pixels further
    return nn.functional.max_pool2d(inner, 3, 1, 1) > 0


def _without_gaps(deformed: Tensor) -> Tensor:
    """Gaps of one or two pixels closed: a crest whose slope happens to be exactly zero is in contact."""
    grown = nn.functional.max_pool2d(deformed.to(torch.float32), 3, 1, 1)
    return nn.functional.max_pool2d(-grown, 3, 1, 1) < 0


def label_contacts(deformed: Tensor) -> Tensor:
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
