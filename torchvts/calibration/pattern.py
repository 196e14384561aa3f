"""Whether a background shows the pattern of light that a sensor's prior was fitted with, or that pattern turned or swapped."""

from itertools import permutations, product
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.geometry import pixel_grid_mm
from ..model.response_field import SensorPrior, position_basis
from ..model.sensor import Sensor

CELLS = 24
"""Cells along the shorter side on which patterns are compared: the light of LEDs is smooth, skins are not."""

ALIKE = 0.8
"""Correlation from which a background has the prior's pattern. It is 0.96 to 0.98 for two more units of a GelSight Mini, and at
most 0.57 for five other sensors and 0.25 for Minis turned by 180 degrees."""

FAINTEST = 0.4
"""Least contrast of the pattern relative to the prior's."""

BETTER = 0.8
"""A changed pattern is named if it leaves less than this part of what the prior's pattern as it is leaves unexplained. A GelSight
Mini looks almost the same mirrored left to right: the mirrored pattern leaves 1.7 to 4.8 times as much on three units, 1.1 to 4.6
times with the frame shifted by 6 to 9 % of the width."""

SHIFT = 0.2
"""Largest shift of the frame that is allowed for, in half-widths."""

UNCROPPED = (0.1, 1.0 / 7.0, 0.2)
"""Shares of each side that the camera's whole frame may show beyond the sensor's field of view."""

TURNS = ((False, 1, 1), (False, -1, -1), (False, -1, 1), (False, 1, -1), (True, 1, -1), (True, -1, 1), (True, 1, 1), (True, -1, -1))
"""Symmetries of a rectangle and of a square: whether x and y are swapped, and the signs of both afterwards."""

IN_WORDS = (
    "as it is",
    "turned by 180 degrees",
    "mirrored left to right",
    "mirrored top to bottom",
    "turned by 90 degrees",
    "turned by 270 degrees",
    "mirrored at its diagonal",
    "mirrored at its other diagonal",
)


class PatternMatch(NamedTuple):
    """How a background compares with that of the prior's unit.

    Attributes:
        likeness: correlation of the patterns as they are: the smaller one of that of the channels' shapes, and that of the
            differences between the channels.
        contrast: of the background's pattern, relative to the prior's.
        fits: the pattern is the prior's, and no changed one is clearly better.
        named: what explains the background better, in words; "" for nothing.
        named_likeness: its correlation.
    """

    likeness: float
    contrast: float
    fits: bool
    named: str
    named_likeness: float


def compare_patterns(background: Tensor, sensor: Sensor) -> PatternMatch:
    """Compare a background with the pattern of light of the sensor's prior.

    The pattern is the logarithm of the light, less the mean of each channel: exposure and white balance do not enter. Hypotheses
    are the prior's pattern as it is, turned, mirrored and with channels swapped, and a background that shows the camera's whole
    frame rather than its middle.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: with a prior.
    Example:
        >>> sensor = Sensor.load("gelsight_mini")
        >>> image = sensor.prior.background(240, 320, 0.0634).clamp(0, 1)
        >>> compare_patterns(image, sensor).fits, compare_patterns(image.flip(1, 2), sensor).named
        (True, 'turned by 180 degrees')
    """
    assert sensor.prior is not None
    log, x, y = cells_of_log(background, sensor)
    seen = _Seen(sensor.prior.response.gamma * log, x, y, sensor.prior)
    plain = seen.shifted(_Hypothesis())
    others = [
        _Hypothesis(turn, channels)
        for turn, channels in product(range(8), permutations(range(3)))
        if (turn, channels) != (0, (0, 1, 2))
    ]
    other = max(others, key=lambda one: seen.likeness(one).whole)
    found = [(other, seen.shifted(other), seen.shifted(_Hypothesis(in_square=True)) if other.turn > 3 else plain)]
    found += [(one, seen.likeness(one), plain) for one in (_Hypothesis(beyond=beyond) for beyond in UNCROPPED)]
    clear = [(one.in_words(), like.least) for one, like, reference in found if like.least >= ALIKE and like.better_than(reference)]
    named, likeness = clear[0] if clear else ("", plain.least)
    fits = plain.least >= ALIKE and plain.contrast >= FAINTEST and not named
    return PatternMatch(plain.least, plain.contrast, fits, named, likeness)


def cells_of_log(background: Tensor, sensor: Sensor) -> tuple[Tensor, Tensor, Tensor]:
    """Logarithm of the light on coarse cells (3, h, w), and their positions x and y, (h, w) each, mm."""
    cell = max(1, min(sensor.height, sensor.width) // CELLS)
    x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, torch.float64)
    size = (sensor.height, sensor.width)
    stack = torch.cat((background.detach().cpu().double(), x.expand(1, *size), y.expand(1, *size)))
    cells = torch.nn.functional.avg_pool2d(stack[None], cell)[0]
    return cells[:3].clamp_min(1e-3).log(), cells[3], cells[4]


class _Likeness(NamedTuple):
    """Correlation of the channels' shapes and of their differences, of both together, and the relative contrast."""

    least: float
    whole: float
    contrast: float

    def better_than(self, other: "_Likeness") -> bool:
        return self.whole > 0.0 and 1.0 - self.whole**2 < BETTER * (1.0 - max(other.whole, 0.0) ** 2)


class _Hypothesis(NamedTuple):
    """How the background came from the pattern: its turn, its channels, and the share of each side that was not cut off."""

    turn: int = 0
    channels: tuple[int, ...] = (0, 1, 2)
    beyond: float = 0.0
    in_square: bool = False

    def in_words(self) -> str:
        if self.beyond > 0.0:
            return f"the camera's whole frame, with about {self.beyond:.0%} too much on each side"
        if self.channels == (0, 1, 2):
            return IN_WORDS[self.turn]
        swapped = "with channels in the order " + "".join("RGB"[c] for c in self.channels)
        return swapped if self.turn == 0 else f"{IN_WORDS[self.turn]}, {swapped}"


class _Seen(NamedTuple):
    """Logarithm of a background on cells, (3, h, w), their positions, (h, w), mm, and the prior that it is compared with."""

    log: Tensor
    x: Tensor
    y: Tensor
    prior: SensorPrior

    def likeness(self, hypothesis: _Hypothesis, shift_mm: tuple[float, float] = (0.0, 0.0)) -> _Likeness:
        """How alike background and pattern are under a hypothesis."""
        swapped, across, down = TURNS[hypothesis.turn]
        u, v = (self.y, self.x) if swapped else (self.x, self.y)
        inside = 1.0 - 2.0 * hypothesis.beyond
        basis = position_basis((across * u + shift_mm[0]) / inside, (down * v + shift_mm[1]) / inside, self.prior.half_mm, 4)
        pattern = torch.tensordot(torch.tensor(self.prior.log_background, dtype=torch.float64), basis, 1)[list(hypothesis.channels)]
        width, height = float(self.x.abs().max()), float(self.y.abs().max())
        if swapped or hypothesis.in_square:  # what a turn by 90 degrees leaves inside
            width = height = min(width, height)
        part = (self.x.abs() <= inside * width) & (self.y.abs() <= inside * height)
        return _compare(self.log[:, part], pattern[:, part])

    def shifted(self, hypothesis: _Hypothesis) -> _Likeness:
        """The same with the frame shifted to where both are most alike: no two units have it at the same place."""
        reach = [SHIFT * float(self.x.abs().max()) * step for step in (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0)]
        return max((self.likeness(hypothesis, (dx, dy)) for dx in reach for dy in reach[::2]), key=lambda like: like.whole)


def _compare(one: Tensor, other: Tensor) -> _Likeness:
    """How alike two patterns (3, N) are."""
    one, other = (values - values.mean(dim=1, keepdim=True) for values in (one, other))
    colours = [torch.stack((values[0] - values[1], values[2] - values[1])) for values in (one, other)]
    whole = [torch.cat((values, colour)) for values, colour in zip((one, other), colours, strict=True)]
    least = min(_correlation(one, other), _correlation(*colours))
    return _Likeness(least, _correlation(*whole), float(whole[0].norm() / whole[1].norm().clamp_min(1e-12)))


def _correlation(one: Tensor, other: Tensor) -> float:
    return float((one * other).sum() / (one.norm() * other.norm()).clamp_min(1e-12))
