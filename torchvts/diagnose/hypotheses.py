"""Kinds of changes of the light, lens or wiring: each predicts an image of the skin from a reference by a few parameters."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ..core.geometry import pixel_grid_mm
from ..model import Calibration


@dataclass(frozen=True)
class Grid:
    """Positions on the skin and the reference's light there.

    Attributes:
        x: (N,), mm.
        y: (N,), mm.
        outward: (N,), squared distance from the image centre, 1 in the corners.
        light: (3, N), linear light of the reference.
    """

    x: Tensor
    y: Tensor
    outward: Tensor
    light: Tensor

    @classmethod
    def of(cls, light: Tensor, calibration: Calibration) -> "Grid":
        """The grid of an image (3, h, w) of linear light over the sensor's field of view."""
        height, width = light.shape[1:]
        field_mm = calibration.sensor.field_mm
        x, _ = pixel_grid_mm(height, width, field_mm[1] / width, torch.float64)
        _, y = pixel_grid_mm(height, width, field_mm[0] / height, torch.float64)
        x, y = (axis.expand(height, width).flatten() for axis in (x, y))
        outward = (x**2 + y**2) / (0.25 * sum(side**2 for side in field_mm))
        return cls(x, y, outward, light.flatten(1).double())

    def lit_by(self, position_mm: Tensor, x: Tensor | None = None, y: Tensor | None = None) -> Tensor:
        """Light (3, N) of undeformed skin under lights of unit power at (3, 3), at these or other positions."""
        x, y = self.x if x is None else x, self.y if y is None else y
        squared = (position_mm[:, :1] - x) ** 2 + (position_mm[:, 1:2] - y) ** 2 + position_mm[:, 2:] ** 2
        return position_mm[:, 2:] * squared.rsqrt() / squared


Predict = Callable[[Grid, Tensor], Tensor]


@dataclass(frozen=True)
class Hypothesis:
    """A kind of change.

    Attributes:
        name: such as "exposure".
        size: number of its parameters; all of them are zero where nothing changed.
        predict: maps the reference and the parameters to linear light (3, N).
        channels: the channels that it concerns, or their new order.
        undo: maps linear light (3, H, W) and the parameters to the light without the change; None: by the ratio.
        start: parameters from which the fit starts; zeros if empty.
        burden: counts like so many further parameters.
    """

    name: str
    size: int
    predict: Predict
    channels: tuple[int, ...] = (0, 1, 2)
    undo: Callable[[Tensor, Tensor], Tensor] | None = None
    start: tuple[float, ...] = ()
    burden: float = 0.0


SAME = Hypothesis("same", 0, lambda grid, _: grid.light)


def list_hypotheses(calibration: Calibration, level: Tensor) -> list[Hypothesis]:
    """All kinds of changes, from none to a field of 18 parameters; those of lights only where the calibration has lights.

    Args:
        calibration: of the unit.
        level: (3,), logarithm of the frame's light relative to the reference: where the fits start.
    """
    logs: tuple[float, float, float] = (float(level[0]), float(level[1]), float(level[2]))
    lights = calibration.lights
    return [
        SAME,
        *(_swapped(order) for order in itertools.permutations(range(3)) if order != (0, 1, 2)),
        *(_mixed(pair) for pair in ((0, 2), (0, 1), (1, 2))),
        Hypothesis("exposure", 1, lambda grid, n: grid.light * n.exp(), start=(float(level.median()),)),
        *(Hypothesis("channel", 1, _on_channel(j, lambda _, n: n), (j,), start=(logs[j],)) for j in range(3)),
        Hypothesis("channels", 3, lambda grid, n: grid.light * n.exp()[:, None], start=logs),
        Hypothesis("ambient", 3, lambda grid, n: grid.light + n[:, None], undo=lambda light, n: light - n[:, None, None]),
        Hypothesis(
            "ambient",
            4,
            lambda grid, n: grid.light * n[3].exp() + n[:3, None],
            undo=lambda light, n: (light - n[:3, None, None]) / n[3].exp(),
        ),
        Hypothesis("gamma", 1, lambda grid, n: grid.light ** n.exp(), undo=lambda light, n: light.clamp_min(0.0) ** (-n).exp()),
        Hypothesis("vignetting", 2, lambda grid, n: grid.light * (1.0 - grid.outward * n[0]).clamp_min(0.05) * n[1].exp()),
        *(_of_known_lights(lights.position_mm.detach().double(), logs) if lights is not None else _of_fields(logs)),
        Hypothesis("skin_changed", 6, lambda grid, n: grid.light * (n @ _quadratic(grid)).exp()),
        Hypothesis("light_field", 18, lambda grid, n: grid.light * (n.reshape(3, 6) @ _quadratic(grid)).exp()),
    ]


def _of_known_lights(position: Tensor, logs: tuple[float, float, float]) -> list[Hypothesis]:
    return [
        *(Hypothesis("light_moved", 4, _one_light(position, j), (j,), start=(0.0, 0.0, 0.0, logs[j])) for j in range(3)),
        Hypothesis("pitch", 1, _pitch(position)),
        Hypothesis("distortion", 1, _distortion(position)),
        Hypothesis("gloss", 2, _gloss(position), start=(0.05, 0.0)),
    ]


def _of_fields(logs: tuple[float, float, float]) -> list[Hypothesis]:
    fields = [_on_channel(j, lambda grid, n: n @ _quadratic(grid)) for j in range(3)]
    return [Hypothesis("light_moved", 6, fields[j], (j,), start=(logs[j], 0.0, 0.0, 0.0, 0.0, 0.0)) for j in range(3)]


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


def _on_channel(j: int, exponent: Predict) -> Predict:
    """The light of one channel times exp(exponent)."""

    def predict(grid: Grid, n: Tensor) -> Tensor:
        light = list(grid.light)
        light[j] = light[j] * exponent(grid, n).exp()
        return torch.stack(light)

    return predict


def moved_position(position_mm: Tensor, j: int, parameters: Tensor) -> Tensor:
    """Positions (3, 3) of the lights, light ``j`` moved by the parameters of "light_moved"."""
    lights, parameters = list(position_mm), parameters.to(position_mm.dtype)
    beside = lights[j][:2] + float(position_mm.norm(dim=1).mean()) * parameters[:2]
    lights[j] = torch.cat((beside, lights[j][2:] * parameters[2:3].exp()))
    return torch.stack(lights)


def _one_light(position: Tensor, j: int) -> Predict:
    def predict(grid: Grid, n: Tensor) -> Tensor:
        light = list(grid.light)
        one = slice(j, j + 1)
        ratio = grid.lit_by(moved_position(position, j, n)[one]) / grid.lit_by(position[one])
        light[j] = light[j] * ratio[0] * n[3].exp()
        return torch.stack(light)

    return predict


def _pitch(position: Tensor) -> Predict:
    return lambda grid, n: grid.light * grid.lit_by(position, grid.x * n.exp(), grid.y * n.exp()) / grid.lit_by(position)


def _distortion(position: Tensor) -> Predict:
    def predict(grid: Grid, n: Tensor) -> Tensor:
        factor = 1.0 + n[0] * grid.outward
        return grid.light * grid.lit_by(position, grid.x * factor, grid.y * factor) / grid.lit_by(position)

    return predict


def _gloss(position: Tensor) -> Predict:
    """A lobe around the mirror direction; parameters: its strength, and the logarithm of its exponent over 20.

    Source:
        Blinn, Models of light reflection for computer synthesized pictures, SIGGRAPH 1977.
    """

    def predict(grid: Grid, n: Tensor) -> Tensor:
        away = (position[:, :1] - grid.x) ** 2 + (position[:, 1:2] - grid.y) ** 2
        facing = position[:, 2:] * torch.rsqrt(away + position[:, 2:] ** 2)
        half_way = torch.sqrt(0.5 + 0.5 * facing)
        return grid.light * (1.0 + n[0] * half_way ** (20.0 * n[1].clamp(-2.5, 2.5).exp()) / facing)

    return predict
