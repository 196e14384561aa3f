r"""Three point lights from one non-contact image.

A point light over a flat skin gives I = rho z / |S - P|^3, so I^(-2/3) is a paraboloid in x and y: a linear fit gives a start
that needs no guess. A robust least-squares loop in image value then finds the lights that fit best, and the curvature there,
together with what the model leaves unexplained, says how well the image pins them.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..core.checks import QUANTISATION_STD, check_image, check_integer
from ..core.geometry import pixel_grid_mm
from ..core.noise import noise_std
from ..core.sensor import Sensor
from ..shading import PointLights, microfacet
from .levenberg import LevenbergMarquardt, residual_and_jacobian


@dataclass(frozen=True)
class LightFit:
    """Lights fitted to one image, and how far to trust them.

    Attributes:
        lights: the three lights.
        converged: the loop ended because the lights stopped moving.
        message: how it ended, and the remedy if it did not converge.
        loss_history: robust loss per step, in units of the noise.
        direction_std_deg: (3,), standard deviation of each light's direction seen from the image centre.
        position_std_mm: (3, 3), of each position coordinate.
        residual_std: (3,), robust standard deviation of image minus model, in image value.
        noise_std: (3,), noise of the image by itself, in image value.
        misfit: (3,), relative structure that the model leaves unexplained (0 where only noise is left).
        inlier_fraction: share of the pixels that the robust loss kept.
    """

    lights: PointLights
    converged: bool
    message: str
    loss_history: list[float] = field(repr=False)
    direction_std_deg: Tensor = field(repr=False)
    position_std_mm: Tensor = field(repr=False)
    residual_std: Tensor = field(repr=False)
    noise_std: Tensor = field(repr=False)
    misfit: Tensor = field(repr=False)
    inlier_fraction: float = 1.0


def fit_lights(
    background: Tensor,
    sensor: Sensor,
    *,
    start: PointLights | None = None,
    max_steps: int = 100,
    progress: bool = False,
) -> LightFit:
    """Fit one point light per channel to an image without contact.

    A Levenberg-Marquardt loop on 4 x 3 numbers over all pixels, with Tukey's biweight against spots, dead pixels and dust.
    Saturated and near-black pixels are left out. Where structure remains that a glossy skin explains down to the noise, the
    lights get a gloss per channel; else the skin stays matt, as in the paper.

    Args:
        background: (3, H, W) in [0, 1], R, G, B, of the sensor's size.
        sensor: gives the pixel pitch and ``gamma``.
        start: lights to start from; None takes the closed-form start.
        max_steps: bound of the loop. progress: show a bar.
    Returns:
        A :class:`LightFit`. Read ``converged`` and ``direction_std_deg`` before using the lights.
    Raises:
        ValueError: wrong shape or range, a black, saturated or featureless image.
    Source:
        eq. 6-7 of the paper; Beaton and Tukey, Technometrics 16, 1974, for the loss.
    Example:
        >>> sensor = Sensor(name="rig", height=48, width=64, mm_per_pixel=0.6)
        >>> truth = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> flat = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, 48, 64)
        >>> fit = fit_lights(truth(torch.zeros(1, 1, 48, 64), flat, 0.6)[0].detach(), sensor)
        >>> fit.converged, bool((fit.lights.position_mm - truth.position_mm).abs().max() < 0.01)
        (True, True)
    """
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_integer("max_steps", max_steps, 1)
    check_exposure(background)
    pixels = _Pixels.of(background.detach().to(torch.float64).cpu(), sensor)
    noise = pixels.noise

    def solve(parameter: Tensor) -> _Solution:
        # some thousand pixels bring the lights near, all of them finish
        near = _solve(pixels.every(_COARSE_PIXELS), parameter, max_steps, progress)
        fit = _solve(pixels, near.parameter, max_steps, progress)
        return fit._replace(history=near.history + fit.history)

    best = solve(_paraboloid_start(pixels) if start is None else _from_lights(start))
    if best.converged and bool((best.misfit > 0).all()):
        # structure is left that noise does not explain: a glossy skin? Only if that leaves next to nothing in every channel
        with_gloss = torch.cat((best.parameter, torch.full_like(best.parameter[:, :1], 0.05)), dim=1)
        near = _solve(pixels.every(_COARSE_PIXELS), with_gloss, max_steps, progress)
        glossy = _solve(pixels, near.parameter, max_steps, progress) if _explains(near, best) else best
        if _explains(glossy, best):
            # the width of the lobe is assumed: what choosing the lobe moved is as uncertain as the lights are
            moved = glossy.parameter[:, :4] - best.parameter
            best = glossy._replace(
                covariance=glossy.covariance + moved[:, :, None] * moved[:, None, :],
                history=best.history + near.history + glossy.history,
            )
    parameter, history, scale, misfit = best.parameter, best.history, best.scale, best.misfit
    lights = _to_lights(parameter, background.dtype)
    direction_std, position_std = _spread(parameter, best.covariance)
    loose = [f"{name} +-{float(std):.1f} deg" for name, std in zip("RGB", direction_std, strict=True) if std > LOOSE_DEG]
    message = f"converged in {len(history)} steps"
    if not best.converged:
        message = (
            f"stopped at {max_steps} steps, lights still moving {best.moved_mm:.3g} mm a step: "
            "raise max_steps, or the image pins no light"
        )
    elif loose:
        percent = float((scale[:, 0] * noise / pixels.image.median(dim=1).values).max())
        message += (
            f", but one image does not pin {', '.join(loose)}: a smooth misfit of {percent:.1%} is left (vignetting or scattered "
            "light); calibrate with presses or known lights"
        )
    return LightFit(
        lights=lights,
        converged=best.converged,
        message=message,
        loss_history=history,
        direction_std_deg=direction_std,
        position_std_mm=position_std,
        residual_std=scale[:, 0] * noise,
        noise_std=noise,
        misfit=misfit,
        inlier_fraction=float((best.weight > 0).double().mean()),
    )


class _Pixels(NamedTuple):
    """What is fitted: positions in mm (N,), image values and which of them count (3, N), noise (3,), 1 / gamma."""

    x: Tensor
    y: Tensor
    image: Tensor
    usable: Tensor
    noise: Tensor
    exponent: float

    @classmethod
    def of(cls, value: Tensor, sensor: Sensor) -> "_Pixels":
        x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, value.dtype)
        x, y = (axis.expand(value.shape[1:]).flatten() for axis in (x, y))
        noise = noise_std(value[None])[0].clamp_min(QUANTISATION_STD)
        image = value.flatten(1)
        every = cls(x, y, image, image < 0.995, noise, 1.0 / sensor.exponent)
        # a pixel that noise could clip at black or white is left out, judged by the model so that noise does not choose
        expected, margin = every.model(_paraboloid_start(every)), 2.5 * noise[:, None]
        return every._replace(usable=every.usable & (expected > margin) & (expected < 1.0 - margin))

    def every(self, count: int) -> "_Pixels":
        """An even choice of about ``count`` pixels; an odd stride walks through all columns."""
        stride = max(1, len(self.x) // count) | 1
        part = [t[..., ::stride] for t in (self.x, self.y, self.image, self.usable)]
        return _Pixels(part[0], part[1], part[2], part[3], self.noise, self.exponent)

    def model(self, parameter: Tensor) -> Tensor:
        """Image values (3, N) of lights (3, 4 or 5): x, y, log z, log albedo, gloss."""
        a, b, log_z, log_rho = (parameter[:, k : k + 1] for k in range(4))
        squared = (self.x - a) ** 2 + (self.y - b) ** 2 + torch.exp(2.0 * log_z)
        log_light = log_rho + log_z - 1.5 * torch.log(squared)  # eq. 1 at rest
        if parameter.shape[1] == 5:
            n_l = torch.exp(log_z) * torch.rsqrt(squared)
            lobe = microfacet(n_l, torch.ones_like(n_l), torch.sqrt(0.5 + 0.5 * n_l))
            log_light = log_light + torch.log1p(parameter[:, 4:5].clamp_min(0.0) * lobe)
        return torch.exp(self.exponent * log_light)

    def residual(self, parameter: Tensor) -> Tensor:
        """Model minus image in units of the noise, (3, N)."""
        return (self.model(parameter) - self.image) / self.noise[:, None]


class _Solution(NamedTuple):
    parameter: Tensor
    history: list[float]
    converged: bool
    moved_mm: float
    weight: Tensor
    scale: Tensor
    covariance: Tensor
    misfit: Tensor


def _solve(pixels: _Pixels, start: Tensor, max_steps: int, progress: bool) -> _Solution:
    """The optimiser loop: Levenberg-Marquardt steps, the robust weights renewed at each, until the lights lie still."""
    parameter = start.clone().requires_grad_()
    optimiser = LevenbergMarquardt(parameter)
    history: list[float] = []
    still, moved = 0, float("inf")
    with tqdm(total=max_steps, desc=f"lights, {len(pixels.x)} pixels", disable=not progress, leave=False) as bar:
        while len(history) < max_steps and still < 3:
            weight, scale = _robust_weight(pixels.residual(parameter.detach()), pixels.usable)
            optimiser.step(pixels.residual, weight)
            history.append(float(_tukey_loss(pixels.residual(parameter.detach()), scale)))
            moved = _moved_mm(optimiser.last_step, parameter.detach())
            still = still + 1 if moved < STEP_TOLERANCE_MM else 0
            bar.update()
            bar.set_postfix(loss=f"{history[-1]:.4g}")
    parameter = parameter.detach()
    left, jacobian = residual_and_jacobian(pixels.residual, parameter)
    weight, scale = _robust_weight(left, pixels.usable)
    covariance, misfit = _covariance(pixels, left, jacobian, pixels.model(parameter), weight, scale)
    return _Solution(parameter, history, still == 3, moved, weight, scale, covariance, misfit)


def _explains(glossy: _Solution, matt: _Solution) -> bool:
    """Whether a lobe takes at least half of what a matt skin leaves, and leaves next to nothing, in every channel."""
    less = (glossy.misfit < 0.5 * matt.misfit) & (glossy.misfit < GLOSS_MISFIT)
    return glossy.converged and bool((less & (glossy.parameter[:, -1] > 0)).all())


_COARSE_PIXELS = 8000

GLOSS_MISFIT = 0.01
"""A glossy skin is believed only if it leaves less relative structure than this."""

STEP_TOLERANCE_MM = 1e-4
"""The loop ends after three steps that move no light further than this."""

LOOSE_DEG = 5.0
"""A light whose direction is known no better than this is reported as not pinned by the image."""

_TUKEY = 4.685  # 95 % efficiency under Gaussian noise


def check_exposure(background: Tensor) -> None:
    """Raise unless every channel of a background has light, is not saturated, and has some shape.

    Raises:
        ValueError: names the channel and the figure.
    """
    for name, channel in zip("RGB", background.detach(), strict=True):
        mean, saturated = float(channel.mean()), float((channel > 0.995).double().mean())
        if mean < 0.02:
            raise ValueError(
                f"background: expected light in channel {name}, got a mean of {mean:.4f}: black image, lamp or exposure off"
            )
        if saturated > 0.5:
            raise ValueError(f"background: channel {name} is saturated in {saturated:.0%} of the image: lower the exposure")
        if float(channel.max() - channel.min()) < 1e-6:
            raise ValueError(f"background: channel {name} is constant at {mean:.4f}: not a camera image of a lit skin")


def _paraboloid_start(pixels: _Pixels) -> Tensor:
    """I^(-2/3) = (rho z)^(-2/3) (x^2 + y^2 - 2 a x - 2 b y + a^2 + b^2 + z^2): weighted linear least squares per channel."""
    x, y, image, exponent, noise = pixels.x, pixels.y, pixels.image, pixels.exponent, pixels.noise
    span = float(x.abs().max().maximum(y.abs().max()))
    u, v = x / span, y / span
    columns = torch.stack((u * u + v * v, u, v, torch.ones_like(u)))  # (4, N)
    light = image.clamp(1e-3, 1.0) ** (1.0 / exponent)
    target = light ** (-2.0 / 3.0)
    # d target / d value, inverted: what weighs residuals as in image value
    weight = (
        (image > 3.0 * noise[:, None]) * (image < 0.995) * (light ** (5.0 / 3.0) * image.clamp_min(1e-3) ** (1 - 1 / exponent)) ** 2
    )
    robust = torch.ones_like(weight)
    solution = torch.zeros(3, 4, dtype=image.dtype)
    for _ in range(8):
        weighted = columns * (weight * robust)[:, None]  # (3, 4, N)
        solution = torch.linalg.solve(weighted @ columns.t(), weighted @ target[:, :, None])[:, :, 0]
        residual = (target - solution @ columns).abs() * weight.sqrt()
        scale = residual.median(dim=1, keepdim=True).values.clamp_min(1e-12) / 0.6745
        robust = (1.0 - (residual / (_TUKEY * scale)) ** 2).clamp_min(0.0) ** 2
    curvature = solution[:, 0].clamp_min(1e-6 * target.mean(1))  # a light infinitely far leaves no curvature
    a, b = -0.5 * solution[:, 1] / curvature, -0.5 * solution[:, 2] / curvature
    z = (solution[:, 3] / curvature - a * a - b * b).clamp_min(0.01).sqrt()
    return torch.stack((a * span, b * span, (z * span).log(), -1.5 * (curvature / span**2).log() - (z * span).log()), dim=1)


def _robust_weight(residual: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Tukey weights (3, N) and robust scale (3, 1) of residuals in units of the noise."""
    scale = (residual.abs().median(dim=1, keepdim=True).values / 0.6745).clamp_min(1.0)
    return usable * (1.0 - (residual / (_TUKEY * scale)) ** 2).clamp_min(0.0) ** 2, scale


def _tukey_loss(residual: Tensor, scale: Tensor) -> Tensor:
    ratio = (residual / (_TUKEY * scale)).square().clamp_max(1.0)
    return (scale.square() * _TUKEY**2 / 6.0 * (1.0 - (1.0 - ratio) ** 3)).mean()


def _moved_mm(step: Tensor, parameter: Tensor) -> float:
    return float(torch.stack((step[:, 0].abs(), step[:, 1].abs(), (step[:, 2] * parameter[:, 2].exp()).abs())).max())


def _from_lights(lights: PointLights) -> Tensor:
    position, albedo = lights.position_mm.detach().double().cpu(), lights.albedo.detach().double().cpu()
    return torch.cat((position[:, :2], position[:, 2:].log(), albedo[:, None].log()), dim=1)


def _to_lights(parameter: Tensor, dtype: torch.dtype) -> PointLights:
    position = torch.cat((parameter[:, :2], parameter[:, 2:3].exp()), dim=1)
    gloss = parameter[:, 4].to(dtype) if parameter.shape[1] == 5 else None
    return PointLights(position.to(dtype), parameter[:, 3].exp().to(dtype), gloss)


def _covariance(
    pixels: _Pixels, residual: Tensor, jacobian: Tensor, model: Tensor, weight: Tensor, scale: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Covariance (3, 4, 4) of the parameters, and the misfit (3,), both honest about what the model does not explain.

    Vignetting, scattered light and uneven skin act as a smooth relative gain. It is a random effect here: Legendre products
    up to degree 4 whose standard deviation tau / degree^2 falls as bending energy has it; the part of the residual that
    lights cannot imitate gives tau, one per channel, by moments. What such a gain does to the fitted lights adds to the
    Gauss-Newton covariance. Where only noise is left, tau = 0 and nothing is added.

    Source:
        Searle, Casella, McCulloch, Variance Components, 1992 (Henderson's method 3); Bjorck, Numerical Methods for Least
        Squares Problems, 1996, for the covariance.
    """
    u, v = pixels.x / pixels.x.abs().max(), pixels.y / pixels.y.abs().max()
    relative = pixels.exponent * model / pixels.noise[:, None]  # residual per relative gain
    in_u, in_v = _legendre(u), _legendre(v)
    orders = [(i, j) for i in range(5) for j in range(5 - i) if i + j > 0]
    gain = torch.stack([in_u[i] * in_v[j] / (i + j) ** 2 for i, j in orders])  # (14, N)
    covariances, misfits = [], []
    for c in range(3):
        root = weight[c].sqrt() / scale[c]
        lights = (jacobian[c] * root).t()  # (N, K)
        gains = (gain * (relative[c] * root)).t()  # (N, 14)
        rest = residual[c] * root
        basis = torch.linalg.qr(lights).Q
        gains_free = gains - basis @ (basis.t() @ gains)
        explained = torch.linalg.qr(gains_free).Q.t() @ rest
        tau_squared = ((explained.square().sum() - gains.shape[1]) / gains_free.square().sum()).clamp_min(0.0)
        inverse = torch.linalg.pinv(lights.t() @ lights, rtol=1e-15, hermitian=True)
        carried = inverse @ (lights.t() @ gains)  # what the lights do when the gain is there and not in the model
        covariances.append((inverse + tau_squared * carried @ carried.t())[:4, :4])
        misfits.append(tau_squared.sqrt())
    return torch.stack(covariances), torch.stack(misfits)


def _legendre(t: Tensor) -> list[Tensor]:
    return [torch.ones_like(t), t, 1.5 * t**2 - 0.5, 2.5 * t**3 - 1.5 * t, (35 * t**4 - 30 * t**2 + 3) / 8]


def _spread(parameter: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations of each light's direction (deg, (3,)) and position (mm, (3, 3))."""
    position = torch.cat((parameter[:, :2], parameter[:, 2:3].exp()), dim=1)
    to_mm = torch.ones(3, 3, dtype=parameter.dtype)
    to_mm[:, 2] = position[:, 2]
    covariance_mm = covariance[:, :3, :3] * to_mm[:, :, None] * to_mm[:, None, :]
    distance = position.norm(dim=1)
    direction = position / distance[:, None]
    across = torch.eye(3, dtype=parameter.dtype) - direction[:, :, None] * direction[:, None, :]
    variance = torch.diagonal(across @ covariance_mm @ across, dim1=1, dim2=2).sum(1)
    direction_std = torch.rad2deg(variance.clamp_min(0).sqrt() / distance).clamp_max(90.0)
    return direction_std, torch.diagonal(covariance_mm, dim1=1, dim2=2).clamp_min(0).sqrt()
