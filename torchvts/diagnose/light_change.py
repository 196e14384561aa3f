r"""What has become of the skin at rest: which simple change of light, lens or wiring takes one image into another.

A frame is compared with a reference, cell by cell. Each hypothesis (the same; one channel dimmer; ambient light; a light moved;
...) predicts the frame from the reference by a few numbers. They are fitted robustly, since a contact follows none of them, and
the winner has the least truncated squared residual plus log N for each of its numbers.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..calibration import falloff
from ..core.geometry import pixel_grid_mm
from ..model.calibration import Calibration

CELLS = 60
"""Cells along the shorter side."""

SLACK = 0.002
"""What no hypothesis needs to explain, relative to the value: half a grey level of 8 bits."""

FULL = 0.985
"""Values from here on may be clipped: such a cell tells nothing of the light."""

CUT = 25.0
"""A cell's squared residual, in variances summed over the channels, counts at most so much: five sigmas."""

TRIFLE = 0.0025
"""Light that differs less than this, RMS, is not told from the same: hypotheses so close are one."""

UNTOLD = 0.02
"""A simpler hypothesis may leave so much of what there was to explain."""

SCATTER, UNTOLD_SCATTER = 0.015, 0.3
"""The same for real sensors, whose presses scatter light over the skin: uneven by 1.5 %."""

CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True)
class Grid:
    """Places, (N,) each, and the reference's linear light there, (3, N): x and y in mm, outward 1 in the corners."""

    x: Tensor
    y: Tensor
    outward: Tensor
    light: Tensor
    reference: Calibration

    @classmethod
    def of(cls, light: Tensor, calibration: Calibration) -> "Grid":
        """Of an image (3, h, w) of linear light over the sensor's field of view."""
        height, width = light.shape[1:]
        pitch_x = calibration.sensor.field_mm[1] / width
        pitch_y = calibration.sensor.field_mm[0] / height
        x, _ = pixel_grid_mm(height, width, pitch_x, torch.float64)
        _, y = pixel_grid_mm(height, width, pitch_y, torch.float64)
        x, y = (axis.expand(height, width).flatten() for axis in (x, y))
        squared = x**2 + y**2
        return cls(
            x, y, squared / (0.25 * sum(side**2 for side in calibration.sensor.field_mm)), light.flatten(1).double(), calibration
        )

    def lit_by(self, position_mm: Tensor, x: Tensor | None = None, y: Tensor | None = None) -> Tensor:
        """Flat skin's light (3, N) under lights of unit power at (3, 3), at these or other places."""
        x, y = self.x if x is None else x, self.y if y is None else y
        squared = (position_mm[:, :1] - x) ** 2 + (position_mm[:, 1:2] - y) ** 2 + position_mm[:, 2:] ** 2
        return position_mm[:, 2:] * squared**-1.5


Predict = Callable[[Grid, Tensor], Tensor]


@dataclass(frozen=True)
class Hypothesis:
    """A kind of change. ``predict`` maps the reference and ``size`` numbers, all zero for no change, to linear light (3, N)."""

    name: str
    size: int
    predict: Predict
    channels: tuple[int, ...] = (0, 1, 2)
    undo: Callable[[Tensor, Tensor], Tensor] | None = None
    start: tuple[float, ...] = ()
    burden: float = 0.0


SAME = Hypothesis("same", 0, lambda grid, _: grid.light)


@dataclass(frozen=True)
class Change:
    """The change that was found.

    Attributes:
        hypothesis: the kind. numbers: its numbers.
        follows: (h, w) bool, cells that it explains. departs: (h, w), how far the others are off,
            relative, less what the channels share: dust is dark in all of them alike, a contact is not.
        effect: (3,), mean change of the light, relative.
    """

    hypothesis: Hypothesis
    numbers: Tensor
    follows: Tensor
    departs: Tensor
    effect: Tensor

    @property
    def name(self) -> str:
        return self.hypothesis.name

    @property
    def rest_share(self) -> float:
        """Share of cells that follow it."""
        return float(self.follows.double().mean())

    def predicted(self, light: Tensor, calibration: Calibration) -> Tensor:
        """What the reference (3, H, W), linear light, would look like."""
        return self.hypothesis.predict(Grid.of(light, calibration), self.numbers).reshape(light.shape).to(light.dtype)

    def undone(self, image_light: Tensor, reference_light: Tensor, calibration: Calibration) -> Tensor:
        """Linear light of a frame (3, H, W) as it would be without the change."""
        if self.hypothesis.undo is not None:
            return self.hypothesis.undo(image_light.double(), self.numbers).to(image_light.dtype)
        ratio = reference_light.clamp_min(1e-4) / self.predicted(reference_light, calibration).clamp_min(1e-4)
        return image_light * ratio


def cell_means(image: Tensor) -> Tensor:
    """Means over square cells, (C, h, w)."""
    side = max(1, min(image.shape[1], image.shape[2]) // CELLS)
    return nn.functional.avg_pool2d(image[None].double(), side, ceil_mode=False)[0]


def compare(
    image: Tensor,
    reference_light: Tensor,
    noise_std: Tensor,
    calibration: Calibration,
    rounding: float = 0.0,
    dead: Tensor | None = None,
) -> Change:
    """The simplest change that takes the reference into the frame wherever that is at rest.

    Args:
        image: (3, H, W), value in [0, 1]. reference_light: (3, H, W), linear light.
        noise_std: (3,), of the difference between both, in value.
        calibration: names gamma, pitch and, if it has them, lights.
        rounding: error that cells do not average out, in value. dead: (3,) bool, channels to leave out.
    """
    exponent = calibration.sensor.exponent
    side = max(1, min(image.shape[1:]) // CELLS)
    target = cell_means(image)
    height, width = target.shape[1:]
    cropped = reference_light[:, : height * side, : width * side]
    reference = cell_means(cropped.clamp_min(0.0) ** (1.0 / exponent))
    grid = Grid.of(reference**exponent, calibration)
    full = nn.functional.max_pool2d(torch.maximum(image, reference_light.clamp(0, 1) ** (1.0 / exponent))[None], side)[0] > FULL
    usable = ~full.flatten(1) & (target.flatten(1) > 0.02)
    if dead is not None:
        usable = usable & ~dead[:, None]
    target, value = target.flatten(1), reference.flatten(1)
    slack = (SLACK * torch.maximum(target, value)) ** 2 + rounding**2
    sigma = torch.sqrt((noise_std.double()[:, None] / side) ** 2 + slack)
    fits: list[tuple[float, Hypothesis, Tensor, Tensor]] = []
    ratio = target.clamp_min(1e-3) ** exponent / grid.light.clamp_min(1e-6)
    level = torch.stack([_mode(row[ok]) if bool(ok.any()) else row.new_ones(()) for row, ok in zip(ratio, usable)]).log()
    for hypothesis in _hypotheses(calibration, level):
        numbers, residual = _fit(hypothesis, grid, target, sigma, usable, exponent)
        squared = (residual**2 * usable).sum(0)
        score = float(squared.clamp_max(CUT).sum()) + (hypothesis.size + hypothesis.burden) * math.log(squared.numel())
        fits.append((score, hypothesis, numbers, squared))
    _, best, numbers, squared = min(fits, key=lambda fit: fit[0])
    predicted = best.predict(grid, numbers)
    told = usable.any(0) & (squared < CUT)
    # of hypotheses that foretell the same light but for a trifle, the simplest
    trifle, untold = (TRIFLE, UNTOLD) if calibration.lights is not None else (SCATTER, UNTOLD_SCATTER)
    same, least = fits[0][0], min(score for score, *_ in fits)
    for score, other, other_numbers, other_squared in fits:
        apart = ((other.predict(grid, other_numbers) / predicted.clamp_min(1e-6) - 1.0) * usable)[:, told]
        close = bool(told.any()) and float(apart.square().mean(1).max().sqrt()) < trifle
        if close and other.size < best.size and (other.name == "same" or score < least + untold * (same - least)):
            best, numbers, squared = other, other_numbers, other_squared
            break
    predicted = best.predict(grid, numbers)
    told = usable.any(0) & (squared < CUT)
    effect = torch.where(usable, (predicted / grid.light.clamp_min(1e-6) - 1.0).abs(), 0.0).sum(1) / usable.sum(1).clamp_min(1)
    off = (target / predicted.clamp_min(1e-6) ** (1.0 / exponent) - 1.0) * usable
    departs = ((off - off.sum(0) / usable.sum(0).clamp_min(1)).abs() * usable).amax(0)
    departs = torch.where(told, 0.0, departs)
    return Change(best, numbers, told.reshape(height, width), departs.reshape(height, width), effect)


def _mode(values: Tensor) -> Tensor:
    """The half-sample mode."""
    values = values.sort().values
    while len(values) > 8:
        half = (len(values) + 1) // 2
        start = int((values[half - 1 :] - values[: len(values) - half + 1]).argmin())
        values = values[start : start + half]
    return values.median()


def _fit(
    hypothesis: Hypothesis, grid: Grid, target: Tensor, sigma: Tensor, usable: Tensor, exponent: float
) -> tuple[Tensor, Tensor]:
    """Numbers and residuals in sigmas (3, N): Gauss-Newton under Tukey's weights, whose width shrinks to the noise."""

    def residual(numbers: Tensor) -> Tensor:
        return (hypothesis.predict(grid, numbers).clamp_min(1e-6) ** (1.0 / exponent) - target) / sigma

    numbers = torch.tensor(hypothesis.start or (0.0,) * hypothesis.size, dtype=torch.float64)
    now = residual(numbers)
    if hypothesis.size == 0:
        return numbers, now
    width = 0.0
    step_size = 1e-4
    for turn in range(14):
        length = torch.where(usable, now.abs(), torch.nan)
        width = max(4.685, 4.685 * 1.4826 * float(length.nanmedian())) if turn == 0 else max(4.685, 0.6 * width)
        weight = ((1.0 - (now / width) ** 2).clamp_min(0.0) ** 2 * usable).flatten()
        columns = torch.stack(
            [
                ((residual(numbers + step_size * e) - now) / step_size).flatten()
                for e in torch.eye(hypothesis.size, dtype=torch.float64)
            ],
            1,
        )
        weighted = columns * weight[:, None]
        normal = weighted.t() @ columns
        normal = normal + torch.diag(normal.diagonal() * 1e-6 + 1e-9)
        step = torch.linalg.solve(normal, -weighted.t() @ now.flatten())
        step = step * min(1.0, 0.5 / max(float(step.abs().max()), 1e-12))
        numbers = numbers + step
        now = residual(numbers)
        if width <= 4.685 and float(step.abs().max()) < 1e-5:
            break
    return numbers, now.nan_to_num(1e3)


def _hypotheses(calibration: Calibration, level: Tensor) -> list[Hypothesis]:
    """From no change to fields of 18 numbers; those of lights only where the calibration has lights.

    Args:
        level: (3,), logarithm of the light at rest relative to the reference: where searches begin.
    """
    logs: tuple[float, float, float] = (float(level[0]), float(level[1]), float(level[2]))
    all_alike = float(level.median())
    found = [SAME]
    for order in itertools.permutations(range(3)):
        if order != (0, 1, 2):
            found.append(_swapped(order))
    found += [_mixed(pair) for pair in ((0, 2), (0, 1), (1, 2))]
    found.append(Hypothesis("exposure", 1, lambda grid, n: grid.light * n.exp(), start=(all_alike,)))
    found += [Hypothesis("channel", 1, _one_channel(j), (j,), start=(logs[j],)) for j in range(3)]
    found.append(Hypothesis("channels", 3, lambda grid, n: grid.light * n.exp()[:, None], start=logs))
    found.append(Hypothesis("ambient", 3, lambda grid, n: grid.light + n[:, None], undo=lambda light, n: light - n[:, None, None]))
    found.append(
        Hypothesis(
            "ambient",
            4,
            lambda grid, n: grid.light * n[3].exp() + n[:3, None],
            undo=lambda light, n: (light - n[:3, None, None]) / n[3].exp(),
        )
    )
    found.append(
        Hypothesis("gamma", 1, lambda grid, n: grid.light ** n.exp(), undo=lambda light, n: light.clamp_min(0.0) ** (-n).exp())
    )
    found.append(Hypothesis("vignetting", 2, lambda grid, n: grid.light * falloff(grid.outward, n[0]) * n[1].exp()))
    if calibration.lights is not None:
        position = calibration.lights.position_mm.detach().double()
        found += [Hypothesis("light_moved", 4, _one_light(position, j), (j,), start=(0.0, 0.0, 0.0, logs[j])) for j in range(3)]
        found.append(Hypothesis("pitch", 1, _pitch(position)))
        found.append(Hypothesis("distortion", 1, _distortion(position)))
        found.append(Hypothesis("gloss", 2, _gloss(position), start=(0.05, 0.0)))
    else:
        found += [Hypothesis("light_moved", 6, _one_field(j), (j,), start=(logs[j], 0.0, 0.0, 0.0, 0.0, 0.0)) for j in range(3)]
    found.append(Hypothesis("skin_changed", 6, lambda grid, n: grid.light * (n @ _quadratic(grid)).exp()))
    found.append(Hypothesis("light_field", 18, lambda grid, n: grid.light * (n.reshape(3, 6) @ _quadratic(grid)).exp()))
    return found


def _quadratic(grid: Grid) -> Tensor:
    half = grid.x.abs().max()
    u, v = grid.x / half, grid.y / half
    return torch.stack((torch.ones_like(u), u, v, u * u, u * v, v * v))


def _swapped(order: tuple[int, ...]) -> Hypothesis:
    back = [order.index(j) for j in range(3)]
    index = list(order)
    return Hypothesis(
        "channels_swapped", 0, lambda grid, _: grid.light[index], tuple(index), lambda light, _: light[back], burden=1.0
    )


def _mixed(pair: tuple[int, int]) -> Hypothesis:
    order = [0, 1, 2]
    order[pair[0]], order[pair[1]] = pair[1], pair[0]

    def predict(grid: Grid, n: Tensor) -> Tensor:
        return (1.0 - n[0]) * grid.light + n[0] * grid.light[order]

    def undo(light: Tensor, n: Tensor) -> Tensor:
        share = float(n[0])
        if abs(1.0 - 2.0 * share) < 0.05:
            return light
        return ((1.0 - share) * light - share * light[order]) / (1.0 - 2.0 * share)

    return Hypothesis("channels_mixed", 1, predict, pair, undo, start=(0.2,))


def _one_channel(j: int) -> Predict:
    def predict(grid: Grid, n: Tensor) -> Tensor:
        factor = torch.ones(3, 1, dtype=torch.float64)
        factor[j] = n.exp()
        return grid.light * factor

    return predict


def _one_field(j: int) -> Predict:
    def predict(grid: Grid, n: Tensor) -> Tensor:
        factor = torch.ones_like(grid.light)
        factor[j] = (n @ _quadratic(grid)).exp()
        return grid.light * factor

    return predict


def _one_light(position: Tensor, j: int) -> Predict:
    reach = float(position.norm(dim=1).mean())

    def predict(grid: Grid, n: Tensor) -> Tensor:
        moved = position.clone()
        moved[j, :2] = moved[j, :2] + reach * n[:2]
        moved[j, 2] = moved[j, 2] * n[2].exp()
        ratio = grid.lit_by(moved) / grid.lit_by(position)
        power = torch.zeros(3, 1, dtype=torch.float64)
        power[j] = n[3]
        return grid.light * ratio * power.exp()

    return predict


def _pitch(position: Tensor) -> Predict:
    return lambda grid, n: grid.light * grid.lit_by(position, grid.x * n.exp(), grid.y * n.exp()) / grid.lit_by(position)


def _distortion(position: Tensor) -> Predict:
    def predict(grid: Grid, n: Tensor) -> Tensor:
        factor = 1.0 + n[0] * grid.outward
        return grid.light * grid.lit_by(position, grid.x * factor, grid.y * factor) / grid.lit_by(position)

    return predict


def _gloss(position: Tensor) -> Predict:
    """A lobe around the mirror direction; its strength, and the logarithm of its exponent over 20.

    Source:
        Blinn, Models of light reflection for computer synthesized pictures, SIGGRAPH 1977.
    """

    def predict(grid: Grid, n: Tensor) -> Tensor:
        away = (position[:, :1] - grid.x) ** 2 + (position[:, 1:2] - grid.y) ** 2
        facing = position[:, 2:] * torch.rsqrt(away + position[:, 2:] ** 2)
        half_way = torch.sqrt(0.5 + 0.5 * facing)
        return grid.light * (1.0 + n[0] * half_way ** (20.0 * n[1].clamp(-2.5, 2.5).exp()) / facing)

    return predict
