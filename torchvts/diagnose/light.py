"""The simplest change of light that takes a reference image of the skin into a frame.

Both are compared cell by cell. Each kind of change is linear in a few parameters, fitted robustly, since a contact follows none of
them. The simplest kind is taken that explains nearly all that the most general one does.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.cells import whole_cell_means
from ..core.robust import TUKEY, half_sample_mode, tukey_weight

CELLS = 60
"""Cells along the shorter side."""

SLACK = 0.002
"""Relative difference that nothing needs to explain: half a grey level of 8 bits."""

LEAST, MOST = 0.02, 0.985
"""Values between which a cell is used: others are dark or clipped."""

CUT = 25.0
"""A cell's squared residual, in variances summed over the channels, counts at most this much: five standard deviations."""

UNEXPLAINED = 0.33
"""A simpler kind may leave this share of what the most general one explains: a press scatters light over the skin, unevenly. The
right kind leaves at most 0.01 of drawn frames and 0.31 of real presses, a wrong simpler one at least 0.48."""

Basis = Callable[[Tensor], Tensor]
"""From reference light (3, h, w) to (P, 3, h, w): what each parameter does to the logarithm of the light, or to its ratio."""


class Kind(NamedTuple):
    """A kind of change.

    Attributes:
        name: such as "exposure".
        basis: what its parameters do.
        added: whether they change the ratio of the light, else its logarithm.
        channel: the one that it concerns; -1 for all.
    """

    name: str
    basis: Basis
    added: bool = False
    channel: int = -1


def _levels(light: Tensor) -> Tensor:
    """One parameter for each channel."""
    return torch.eye(3, dtype=light.dtype)[:, :, None, None].expand(3, 3, *light.shape[1:])


def _shared(light: Tensor) -> Tensor:
    return torch.ones_like(light)[None]


def _ambient(light: Tensor) -> Tensor:
    return _levels(light) / light.clamp_min(1e-4)


def _plane_and_bend(light: Tensor) -> Tensor:
    """A polynomial of degree 2 over the image, (6, 1, h, w)."""
    height, width = light.shape[1:]
    y = torch.linspace(-1.0, 1.0, height, dtype=light.dtype)[:, None].expand(height, width)
    x = torch.linspace(-1.0, 1.0, width, dtype=light.dtype)[None].expand(height, width)
    return torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y))[:, None]


def _smooth(light: Tensor) -> Tensor:
    return _plane_and_bend(light).expand(6, 3, *light.shape[1:])


def _field(light: Tensor) -> Tensor:
    return (_levels(light)[:, None] * _plane_and_bend(light)[None]).flatten(0, 1)


def _of(channel: int, basis: Basis) -> Basis:
    """The same for one channel alone."""
    return lambda light: basis(light) * _levels(light)[channel]


KINDS = (
    Kind("exposure", _shared),
    *(Kind("channel", _of(j, _shared), channel=j) for j in range(3)),
    Kind("gamma", lambda light: light.clamp_min(1e-4).log()[None]),
    Kind("channels", _levels),
    Kind("ambient", _ambient, added=True),
    Kind("ambient", lambda light: torch.cat((_ambient(light), _shared(light))), added=True),
    *(Kind("light_moved", _of(j, _smooth), channel=j) for j in range(3)),
    Kind("skin_changed", _smooth),
    Kind("light_field", _field),
)
"""From the simplest to the most general."""


@dataclass(frozen=True)
class Change:
    """The change that was found.

    Attributes:
        kind: of change; None for none.
        parameters: of the kind, (P,).
        effect: mean relative change of the light in the channel where it is largest.
    """

    kind: Kind | None
    parameters: Tensor
    effect: float

    @property
    def is_simple(self) -> bool:
        """Whether it is even, or follows the light: no press scatters light so, and no shape of the skin looks so."""
        return self.kind is not None and self.kind.name not in ("light_field", "skin_changed", "light_moved")

    def factor(self, light: Tensor) -> Tensor:
        """What the reference light (3, H, W) is multiplied by."""
        assert self.kind is not None
        return _factor(self.kind, self.parameters, light.double())

    def undone(self, light: Tensor, reference: Tensor) -> Tensor:
        """Light (3, H, W) of a frame without the change."""
        if self.kind is None:
            return light
        if self.kind.name == "gamma":
            return light.clamp_min(0.0) ** (1.0 / (1.0 + float(self.parameters[0])))
        if self.kind.name == "ambient":
            gain = 1.0 + (float(self.parameters[3]) if len(self.parameters) > 3 else 0.0)
            return (light - self.parameters[:3, None, None].to(light.dtype)) / gain
        return light / self.factor(reference).clamp_min(1e-3).to(light.dtype)


def _factor(kind: Kind, parameters: Tensor, light: Tensor) -> Tensor:
    change = torch.einsum("p,pchw->chw", parameters, kind.basis(light))
    return 1.0 + change if kind.added else change.exp()


def find_change(value: Tensor, reference: Tensor, noise_std: Tensor, exponent: float, error: float = 0.0) -> Change:
    """Find the simplest change that takes the reference into the frame wherever the skin is free of contact.

    Args:
        value: (3, H, W), the frame's values in [0, 1].
        reference: (3, H, W), values without the change.
        noise_std: (3,), noise of the difference between both.
        exponent: light is value to the power of this.
        error: of the values, which cells do not average out, as of few bits.
    """
    side = max(1, min(value.shape[1:]) // CELLS)
    now, before = (whole_cell_means(image[None].double(), side)[0] for image in (value, reference))
    usable = ((now > LEAST) & (now < MOST) & (before > LEAST) & (before < MOST)).all(0).flatten()
    if int(usable.sum()) < 100:
        return Change(None, torch.zeros(0), 0.0)
    light = before**exponent
    sigma = exponent * torch.sqrt((noise_std.double()[:, None, None] / side) ** 2 + error**2) / before
    sigma = torch.sqrt(sigma**2 + (exponent * SLACK) ** 2).flatten(1)[:, usable]
    log = (exponent * (now.clamp_min(1e-4) / before.clamp_min(1e-4)).log()).flatten(1)[:, usable]
    level = torch.stack([_mode(row) for row in log])[:, None]
    nothing = _score(log / sigma)
    fits = []
    for kind in KINDS:
        basis = kind.basis(light).flatten(2)[:, :, usable]
        target, start = (log.exp() - 1.0, level.exp() - 1.0) if kind.added else (log, level)
        parameters, left = _fit(basis / sigma, target / sigma, (target - start) / sigma)
        fits.append((_score(left) + len(parameters) * math.log(left.shape[1]), kind, parameters))
    best = min(score for score, _, _ in fits)
    if best >= nothing:
        return Change(None, torch.zeros(0), 0.0)
    _, kind, parameters = next(fit for fit in fits if fit[0] <= best + UNEXPLAINED * (nothing - best))
    effect = (_factor(kind, parameters, light) - 1.0).abs().flatten(1).median(dim=1).values
    return Change(kind, parameters, float(effect.max()))


def _score(left: Tensor) -> float:
    return float(left.square().sum(0).clamp_max(CUT).sum())


def _fit(basis: Tensor, target: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
    """Least squares with Tukey's weights, whose width shrinks to the noise; ``left`` are residuals to begin with."""
    parameters = torch.zeros(basis.shape[0], dtype=target.dtype)
    width = 1.4826 * float(left.abs().median()) * TUKEY
    for _ in range(14):
        width = max(TUKEY, width)
        weight = tukey_weight(left / width).amin(0).expand_as(target).flatten()
        rows = basis.flatten(1)
        weighted = rows * weight
        normal = weighted @ rows.t()
        normal = normal + torch.diag(normal.diagonal() * 1e-9 + 1e-9)
        parameters = torch.linalg.solve(normal, weighted @ target.flatten())
        left = target - torch.einsum("p,pcn->cn", parameters, basis)
        width *= 0.6
    return parameters, left


def _mode(values: Tensor) -> Tensor:
    """The half-sample mode, of the last eight values or fewer."""
    halvings = max(0, math.ceil(math.log2(len(values) / 8)))
    return half_sample_mode(values.sort().values[None, None], halvings)[0, 0]
