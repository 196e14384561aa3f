"""The model of a background image: point lights over an undeformed skin, pixel by pixel, as their fit needs it."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import QUANTISATION_STD
from ..core.geometry import pixel_grid_mm
from ..core.levels import SATURATED
from ..core.noise import noise_std
from ..core.robust import TUKEY, tukey_weight
from ..model.lights import PointLights, log_slope_of_lobe, microfacet
from ..model.sensor import Sensor

FURTHEST = 30.0
"""Most distant light, in half-widths of the image."""


class BackgroundPixels(NamedTuple):
    """The pixels of a background.

    Attributes:
        x: (N,), mm.
        y: (N,), mm.
        image: (3, N), image values.
        usable: (3, N) bool, neither saturated nor near black.
        noise: (3,), standard deviation of the image values.
        exponent: 1 / gamma.
    """

    x: Tensor
    y: Tensor
    image: Tensor
    usable: Tensor
    noise: Tensor
    exponent: float

    @classmethod
    def of(cls, value: Tensor, sensor: Sensor) -> "BackgroundPixels":
        """All pixels of an image (3, H, W)."""
        x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, value.dtype)
        x, y = (axis.expand(value.shape[1:]).flatten() for axis in (x, y))
        noise = noise_std(value[None])[0].clamp_min(QUANTISATION_STD)
        image = value.flatten(1)
        pixels = cls(x, y, image, image < SATURATED, noise, 1.0 / sensor.exponent)
        # leave out pixels that noise could clip at black or white; the model decides, so that noise does not select
        expected, margin = pixels.model(paraboloid_start(pixels)), 2.5 * noise[:, None]
        return pixels._replace(usable=pixels.usable & (expected > margin) & (expected < 1.0 - margin))

    def sample(self, count: int) -> "BackgroundPixels":
        """About ``count`` evenly chosen pixels. The stride is odd, so that all columns occur."""
        stride = max(1, len(self.x) // count) | 1
        part = {name: getattr(self, name)[..., ::stride] for name in ("x", "y", "image", "usable")}
        return self._replace(**part)

    def span_mm(self) -> float:
        """Half of the longer side of the image, mm."""
        return float(self.x.abs().max().maximum(self.y.abs().max()))

    def model(self, parameter: Tensor) -> Tensor:
        """Image values (3, N) of lights (3, 4): x, y, log z, log albedo; (3, 5) of a glossy skin: and the strength of its lobe."""
        a, b, log_z, log_rho = (parameter[:, k : k + 1] for k in range(4))
        squared = (self.x - a) ** 2 + (self.y - b) ** 2 + torch.exp(2.0 * log_z)
        log_light = log_rho + log_z - 1.5 * torch.log(squared)  # eq. 1 on a flat skin
        if parameter.shape[1] > 4:
            n_l = torch.exp(log_z) * torch.rsqrt(squared)
            lobe = microfacet(n_l, torch.ones_like(n_l), torch.sqrt(0.5 + 0.5 * n_l))
            log_light = log_light + torch.log1p(parameter[:, 4:].clamp_min(0.0) * lobe)
        return torch.exp(self.exponent * log_light)

    def residual(self, parameter: Tensor) -> Tensor:
        """Model minus image in units of the noise, (3, N)."""
        return (self.model(parameter) - self.image) / self.noise[:, None]

    def linearised(self, parameter: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals (3, N), and their derivatives (3, K, N) in the lights (3, K): those of :meth:`model`, by hand."""
        value = self.model(parameter)
        a, b, z = parameter[:, 0:1], parameter[:, 1:2], parameter[:, 2:3].exp()
        x, y = self.x - a, self.y - b
        inverse = 1.0 / (x**2 + y**2 + z**2)
        along = torch.stack((x * inverse, y * inverse, 1.0 - z**2 * inverse), dim=1)  # of the logarithm of z / distance
        slopes = torch.empty(3, parameter.shape[1], len(self.x), dtype=value.dtype)
        slopes[:, 0:2], slopes[:, 2], slopes[:, 3] = 3.0 * along[:, 0:2], 3.0 * along[:, 2] - 2.0, 1.0
        if parameter.shape[1] > 4:
            gloss, n_l = parameter[:, 4:].clamp_min(0.0), z * torch.sqrt(inverse)
            n_h = torch.sqrt(0.5 + 0.5 * n_l)
            lobe = microfacet(n_l, torch.ones_like(n_l), n_h)
            share = 1.0 / (1.0 + gloss * lobe)
            slopes[:, 0:3] += (gloss * lobe * share * n_l * log_slope_of_lobe(n_l, n_h))[:, None] * along
            slopes[:, 4] = torch.where(parameter[:, 4:] >= 0.0, lobe * share, 0.0)
        slopes *= (self.exponent * value)[:, None]
        return (value - self.image) / self.noise[:, None], slopes / self.noise[:, None, None]


def paraboloid_start(pixels: BackgroundPixels) -> Tensor:
    """Closed-form lights (3, 4), from weighted linear least squares per channel.

    I^(-2/3) = (rho z)^(-2/3) (x^2 + y^2 - 2 a x - 2 b y + a^2 + b^2 + z^2) is linear in x^2 + y^2, x, y and 1.
    """
    x, y, image, exponent, noise = pixels.x, pixels.y, pixels.image, pixels.exponent, pixels.noise
    span = pixels.span_mm()
    u, v = x / span, y / span
    columns = torch.stack((u * u + v * v, u, v, torch.ones_like(u)))  # (4, N)
    light = image.clamp(1e-3, 1.0) ** (1.0 / exponent)
    target = light ** (-2.0 / 3.0)
    # (d value / d target)^2: weights residuals as residuals in image value
    weight = (
        (image > 3.0 * noise[:, None])
        * (image < SATURATED)
        * (light ** (5.0 / 3.0) * image.clamp_min(1e-3) ** (1 - 1 / exponent)) ** 2
    )
    robust = torch.ones_like(weight)
    solution = torch.zeros(3, 4, dtype=image.dtype)
    for _ in range(8):
        weighted = columns * (weight * robust)[:, None]  # (3, 4, N)
        solution = torch.linalg.solve(weighted @ columns.t(), weighted @ target[:, :, None])[:, :, 0]
        residual = (target - solution @ columns).abs() * weight.sqrt()
        scale = residual.median(dim=1, keepdim=True).values.clamp_min(1e-12) / 0.6745
        robust = tukey_weight(residual / (TUKEY * scale))
    curvature = solution[:, 0].clamp_min(1e-6 * target.mean(1))  # a light at infinity leaves no curvature
    a, b = -0.5 * solution[:, 1] / curvature, -0.5 * solution[:, 2] / curvature
    z = (solution[:, 3] / curvature - a * a - b * b).clamp_min(0.01).sqrt()
    log_rho = -1.5 * (curvature / span**2).log() - (z * span).log()
    start = bounded(torch.stack((a * span, b * span, (z * span).log(), log_rho), dim=1), span)
    level: Tensor = (light.log() - pixels.model(start).clamp_min(1e-30).log() / exponent).median(dim=1).values
    # where no paraboloid fits, the closed form misses the brightness as well
    start[:, 3] += torch.where(level.abs() > math.log(2.0), level, torch.zeros_like(level))
    return start


def bounded(parameter: Tensor, span: float) -> Tensor:
    """Parameters (3, K) with lights beyond ``FURTHEST`` times ``span`` (mm) moved there, as bright at the centre."""
    position = torch.cat((parameter[:, :2], parameter[:, 2:3].exp()), dim=1)
    factor = (position.norm(dim=1) / (FURTHEST * span)).clamp_min(1.0)[:, None]
    moved = parameter.clone()
    moved[:, :2] = parameter[:, :2] / factor
    # at least 5 degrees above the skin: a lower light there lights nothing
    moved[:, 2:3] = torch.where(
        factor > 1.0, (parameter[:, 2:3] - factor.log()).clamp_min(math.log(0.09 * FURTHEST * span)), parameter[:, 2:3]
    )
    moved[:, 3:4] = parameter[:, 3:4] - 2.0 * factor.log()  # I = rho z / |S|^3 at the centre
    return moved


def at_bound(parameter: Tensor, span: float) -> Tensor:
    """(3,) bool: lights that :func:`bounded` holds."""
    position = torch.cat((parameter[:, :2], parameter[:, 2:3].exp()), dim=1)
    held: Tensor = position.norm(dim=1) > 0.99 * FURTHEST * span
    return held


def from_lights(lights: PointLights) -> Tensor:
    """Parameters (3, 4) of lights."""
    position, albedo = lights.position_mm.detach().double().cpu(), lights.albedo.detach().double().cpu()
    return torch.cat((position[:, :2], position[:, 2:].log(), albedo[:, None].log()), dim=1)


def to_lights(parameter: Tensor, dtype: torch.dtype) -> PointLights:
    """The lights of parameters (3, 4), or (3, 5) of a glossy skin."""
    position = torch.cat((parameter[:, :2], parameter[:, 2:3].exp()), dim=1)
    gloss = parameter[:, 4].clamp_min(0.0).to(dtype) if parameter.shape[1] > 4 else None
    return PointLights(position.to(dtype), parameter[:, 3].exp().to(dtype), gloss)
