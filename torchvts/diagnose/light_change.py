"""Finds the simplest change of light, lens or wiring that takes a reference image of the skin into a frame.

The frame is compared with the reference cell by cell. Each hypothesis (:mod:`.hypotheses`) predicts the frame by a few parameters.
They are fitted robustly, since a contact follows none of them. The best hypothesis has the least truncated squared residual plus
log N for each of its parameters.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..core.robust import TUKEY, half_sample_mode, tukey_weight
from ..model import Calibration
from .hypotheses import Grid, Hypothesis, list_hypotheses

CELLS = 60
"""Cells along the shorter side."""

SLACK = 0.002
"""Difference that no hypothesis needs to explain, relative to the value: half a grey level of 8 bits."""

SATURATED = 0.985
"""Values from here on may be clipped; such cells are not used."""

LEAST_LIGHT = 1e-6
"""Light below counts as this much."""

CUT = 25.0
"""A cell's squared residual, in variances summed over the channels, counts at most this much: five standard deviations."""

NEGLIGIBLE = 0.0025
"""Hypotheses that predict the same light within this RMS difference are not distinguished."""

UNEXPLAINED = 0.02
"""A simpler hypothesis may leave this share of the explainable residual."""

SCATTER, UNEXPLAINED_SCATTER = 0.015, 0.3
"""The same two for response fields: presses on real sensors scatter light over the skin, uneven by 1.5 %."""

CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class Change:
    """The change that was found.

    Attributes:
        hypothesis: its kind.
        parameters: of the hypothesis.
        follows: (h, w) bool, cells that the change explains.
        residual: (h, w), relative difference of the other cells, less what the channels share: dust is dark in all channels, a
            contact is not.
        effect: (3,), mean relative change of the light.
    """

    hypothesis: Hypothesis
    parameters: Tensor
    follows: Tensor
    residual: Tensor
    effect: Tensor

    @property
    def name(self) -> str:
        return self.hypothesis.name

    @property
    def largest_effect(self) -> float:
        """Mean relative change of the light in the channel where it is largest."""
        return float(self.effect.max())

    @property
    def free_share(self) -> float:
        """Share of the cells that follow the change."""
        return float(self.follows.double().mean())

    def predicted(self, light: Tensor, calibration: Calibration) -> Tensor:
        """The reference (3, H, W), linear light, after the change."""
        return self.hypothesis.predict(Grid.of(light, calibration), self.parameters).reshape(light.shape).to(light.dtype)

    def undone(self, image_light: Tensor, reference_light: Tensor, calibration: Calibration) -> Tensor:
        """Linear light of a frame (3, H, W) without the change."""
        if self.hypothesis.undo is not None:
            return self.hypothesis.undo(image_light.double(), self.parameters).to(image_light.dtype)
        ratio = reference_light.clamp_min(1e-4) / self.predicted(reference_light, calibration).clamp_min(1e-4)
        return image_light * ratio


def cell_means(image: Tensor) -> Tensor:
    """Means over square cells, (C, h, w)."""
    return nn.functional.avg_pool2d(image[None].double(), cell_side(image), ceil_mode=False)[0]


def cell_side(image: Tensor) -> int:
    """Side of a cell, pixels."""
    return max(1, min(image.shape[1], image.shape[2]) // CELLS)


def compare(image: Tensor, reference_light: Tensor, noise_std: Tensor, calibration: Calibration, rounding: float = 0.0) -> Change:
    """Find the simplest change that takes the reference into the frame wherever the skin is free of contact.

    Args:
        image: (3, H, W), value in [0, 1].
        reference_light: (3, H, W), linear light.
        noise_std: (3,), of the difference between both, in value.
        calibration: gives gamma, pitch and, if it has them, lights.
        rounding: error that cells do not average out, in value.
    """
    cells = _Cells.of(image, reference_light, noise_std, calibration, rounding)
    ratio = cells.target.clamp_min(1e-3) ** cells.exponent / cells.grid.light.clamp_min(1e-6)
    level = torch.stack([_mode(row[ok]) if bool(ok.any()) else row.new_ones(()) for row, ok in zip(ratio, cells.usable)]).log()
    fits = [_fit(hypothesis, cells) for hypothesis in list_hypotheses(calibration, level)]
    best = _simplest(fits, cells, calibration.lights is not None)
    predicted = best.hypothesis.predict(cells.grid, best.parameters)
    usable, follows = cells.usable, cells.follow(best)
    change = (predicted / cells.grid.light.clamp_min(1e-6) - 1.0).abs()
    effect = torch.where(usable, change, 0.0).sum(1) / usable.sum(1).clamp_min(1)
    off = (cells.target / predicted.clamp_min(1e-6) ** (1.0 / cells.exponent) - 1.0) * usable
    residual = ((off - off.sum(0) / usable.sum(0).clamp_min(1)).abs() * usable).amax(0)
    residual = torch.where(follows, 0.0, residual)
    return Change(best.hypothesis, best.parameters, follows.reshape(cells.size), residual.reshape(cells.size), effect)


class _Fit(NamedTuple):
    """A fitted hypothesis: its score (less is better), parameters, and squared residual (N,) in variances."""

    score: float
    hypothesis: Hypothesis
    parameters: Tensor
    squared: Tensor


@dataclass(frozen=True)
class _Cells:
    """What is fitted: cells (3, N) of a frame, the grid of the reference, standard deviations, and which cells are usable."""

    grid: Grid
    target: Tensor
    sigma: Tensor
    usable: Tensor
    exponent: float
    size: tuple[int, int]

    @classmethod
    def of(cls, image: Tensor, reference_light: Tensor, noise_std: Tensor, calibration: Calibration, rounding: float) -> "_Cells":
        exponent, side = calibration.sensor.exponent, cell_side(image)
        target = cell_means(image)
        height, width = target.shape[1:]
        cropped = reference_light[:, : height * side, : width * side]
        reference = cell_means(cropped.clamp_min(0.0) ** (1.0 / exponent))
        grid = Grid.of(reference**exponent, calibration)
        brightest = torch.maximum(image, reference_light.clamp(0, 1) ** (1.0 / exponent))
        saturated = nn.functional.max_pool2d(brightest[None], side)[0] > SATURATED
        usable = ~saturated.flatten(1) & (target.flatten(1) > 0.02)
        target, value = target.flatten(1), reference.flatten(1)
        slack = (SLACK * torch.maximum(target, value)) ** 2 + rounding**2
        sigma = torch.sqrt((noise_std.double()[:, None] / side) ** 2 + slack)
        return cls(grid, target, sigma, usable, exponent, (height, width))

    def residual(self, light: Tensor) -> tuple[Tensor, Tensor]:
        """In standard deviations, where the light is (3, N); and its derivative by the light."""
        value = light.clamp_min(LEAST_LIGHT) ** (1.0 / self.exponent)
        slope = torch.where(light > LEAST_LIGHT, value / (self.exponent * self.sigma * light), 0.0)
        return (value - self.target) / self.sigma, slope

    def follow(self, fit: _Fit) -> Tensor:
        """(N,) bool, cells that a fit explains."""
        return self.usable.any(0) & (fit.squared < CUT)


def _simplest(fits: list[_Fit], cells: _Cells, has_lights: bool) -> _Fit:
    """The fit with the best score; of fits that predict the same light but for a negligible difference, the simplest.

    ``fits`` begins with "same", and simpler ones come first.
    """
    best = min(fits, key=lambda fit: fit.score)
    predicted = best.hypothesis.predict(cells.grid, best.parameters)
    follows = cells.follow(best)
    negligible, unexplained = (NEGLIGIBLE, UNEXPLAINED) if has_lights else (SCATTER, UNEXPLAINED_SCATTER)
    limit = best.score + unexplained * (fits[0].score - best.score)
    for fit in fits:
        other = fit.hypothesis
        difference = ((other.predict(cells.grid, fit.parameters) / predicted.clamp_min(1e-6) - 1.0) * cells.usable)[:, follows]
        close = bool(follows.any()) and float(difference.square().mean(1).max().sqrt()) < negligible
        if close and other.size < best.hypothesis.size and (other.name == "same" or fit.score < limit):
            return fit
    return best


def _mode(values: Tensor) -> Tensor:
    """The half-sample mode, of the last eight values or fewer."""
    halvings = max(0, math.ceil(math.log2(len(values) / 8)))
    return half_sample_mode(values.sort().values[None, None], halvings)[0, 0]


def _fit(hypothesis: Hypothesis, cells: _Cells) -> _Fit:
    """Fit by Gauss-Newton with Tukey's weights, whose width shrinks to the noise."""
    predict = partial(hypothesis.predict, cells.grid)
    parameters = torch.tensor(hypothesis.start or (0.0,) * hypothesis.size, dtype=torch.float64)
    light = predict(parameters)
    now, slope = cells.residual(light)
    width, step_size = 0.0, 1e-4
    steps = step_size * torch.eye(hypothesis.size, dtype=torch.float64)
    for turn in range(14 if hypothesis.size else 0):
        if turn == 0:
            width = 1.4826 * float(torch.where(cells.usable, now.abs(), torch.nan).nanmedian()) * TUKEY
        else:
            width *= 0.6
        width = max(TUKEY, width)
        weight = (tukey_weight(now / width) * cells.usable).flatten()
        change = (torch.func.vmap(predict)(parameters + steps) - light) / step_size
        rows = (change * slope).flatten(1)
        weighted = rows * weight
        normal = weighted @ rows.t()
        normal = normal + torch.diag(normal.diagonal() * 1e-6 + 1e-9)
        step = torch.linalg.solve(normal, -weighted @ now.flatten())
        step = step * min(1.0, 0.5 / max(float(step.abs().max()), 1e-12))
        parameters = parameters + step
        light = predict(parameters)
        now, slope = cells.residual(light)
        if width <= TUKEY and float(step.abs().max()) < 1e-5:
            break
    if hypothesis.size:
        now = now.nan_to_num(1e3)
    squared = (now**2 * cells.usable).sum(0)
    complexity = (hypothesis.size + hypothesis.burden) * math.log(squared.numel())
    return _Fit(float(squared.clamp_max(CUT).sum()) + complexity, hypothesis, parameters, squared)
