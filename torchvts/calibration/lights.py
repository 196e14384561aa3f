r"""Three point lights from one non-contact image.

A point light over a flat skin gives I = rho z / |S - P|^3, so I^(-2/3) is a paraboloid in x and y: a linear fit gives a start
that needs no guess. A robust least-squares loop in image value then finds the lights that fit best, and the curvature there,
together with what the model leaves unexplained, says how well the image pins them.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..core.checks import check_image, check_integer, check_record
from ..model.lights import PointLights
from ..model.sensor import Sensor, check_sensor
from .background import (
    AMBIENT,
    GLOSS,
    OF_THE_CAMERA,
    TUKEY,
    VIGNETTING,
    VIGNETTING_4,
    RestPixels,
    falloff,
    free_numbers,
    from_lights,
    paraboloid_start,
    to_lights,
)
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
        vignetting: share of the light that the lens loses in the image corners; 0 where it was not fitted.
        falloff: the coefficients of the second and fourth power of the distance from the centre that make it up.
        ambient: (3,), constant light in linear light; 0 where it was not fitted.
        vignetting_std, ambient_std: standard deviations of these, infinite where they were not fitted.
        numbers: how many numbers were fitted.
        held_out: (16,), loss of each block of the image under the lights fitted to all others: mean log of 1 + the square of
            the residual in units of three times the noise.
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
    vignetting: float = 0.0
    falloff: tuple[float, float] = (0.0, 0.0)
    ambient: Tensor = field(default_factory=lambda: torch.zeros(3), repr=False)
    vignetting_std: float = torch.inf
    ambient_std: Tensor = field(default_factory=lambda: torch.full((3,), torch.inf), repr=False)
    numbers: int = 12
    held_out: Tensor = field(default_factory=lambda: torch.zeros(16), repr=False)


def fit_lights(
    background: Tensor,
    sensor: Sensor,
    *,
    start: PointLights | None = None,
    max_steps: int = 100,
    progress: bool = False,
    vignetting: int = 0,
    ambient: bool = False,
    known_azimuth: bool = False,
    gloss: bool = True,
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
        vignetting: fit the lens's fall-off too, by 1 or 2 numbers. ambient: fit a constant light too, one number a channel. A
            skin fitted with either stays matt.
        gloss: try a glossy skin where structure remains.
        known_azimuth: the lights stand where ``sensor.light_azimuth_deg`` says, their distance and height are fitted.
    Returns:
        A :class:`LightFit`. Read ``converged`` and ``direction_std_deg`` before using the lights.
    Raises:
        ValueError: wrong shape or range, a black, saturated or featureless image; a known azimuth that the sensor does not know.
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
    check_sensor("sensor", sensor)
    if start is not None:
        check_record("start", start, PointLights, "PointLights(position_mm, albedo) makes them")
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_integer("max_steps", max_steps, 1)
    if vignetting not in (0, 1, 2):
        raise ValueError(f"vignetting: expected 0, 1 or 2 numbers, got {vignetting!r}")
    check_exposure(background)
    azimuth = None
    if known_azimuth:
        if sensor.light_azimuth_deg is None:
            raise ValueError(f"known_azimuth: sensor '{sensor.name}' names no light_azimuth_deg: add it to the sensor file")
        azimuth = torch.deg2rad(torch.tensor(sensor.light_azimuth_deg, dtype=torch.float64))
    plain = RestPixels.of(background.detach().to(torch.float64).cpu(), sensor)
    terms = (VIGNETTING, VIGNETTING_4)[:vignetting] + (AMBIENT,) * ambient
    pixels = plain._replace(terms=terms)
    starts = [paraboloid_start(plain) if start is None else from_lights(start)]
    if vignetting and start is None:  # lights that fall off by themselves leave the lens little: start from the other side, too
        brightened = plain._replace(image=plain.image / falloff(plain.outward, 0.3) ** plain.exponent)
        starts.append(paraboloid_start(brightened))
    # some thousand pixels bring the lights near, all of them finish
    coarse = pixels.every(_COARSE_PIXELS)
    nears = [_solve(coarse, _with_terms(one, terms, azimuth), azimuth, max_steps, progress) for one in starts]
    near = best = min(nears, key=lambda solution: solution.history[-1])
    if len(coarse.x) < len(pixels.x):
        best = _solve(pixels, near.parameter, azimuth, max_steps, progress)
        best = best._replace(history=near.history + best.history)
    if gloss and not terms and best.converged and bool((best.misfit > 0).all()) and float(best.misfit.max()) < NOT_GLOSS:
        # structure is left that noise does not explain: a glossy skin? Only if that leaves next to nothing in every channel
        shiny = pixels._replace(terms=(GLOSS,))
        with_gloss = torch.cat((best.parameter, torch.full_like(best.parameter[:, :1], 0.05)), dim=1)
        near = glossy = _solve(shiny.every(_COARSE_PIXELS), with_gloss, azimuth, max_steps, progress)
        if len(coarse.x) < len(pixels.x):
            glossy = _solve(shiny, near.parameter, azimuth, max_steps, progress) if _explains(near, best) else best
        if _explains(glossy, best):
            # the width of the lobe is assumed: what choosing the lobe moved is as uncertain as the lights are
            moved = torch.zeros_like(glossy.parameter)
            moved[:, :4] = glossy.parameter[:, :4] - best.parameter
            best = glossy._replace(
                covariance=glossy.covariance + moved[:, :, None] * moved[:, None, :],
                history=best.history + near.history + glossy.history,
            )
            pixels = shiny
    return _tell(background, pixels, best, azimuth, max_steps)


def _tell(background: Tensor, pixels: RestPixels, best: "_Solution", azimuth: Tensor | None, max_steps: int) -> LightFit:
    parameter, history, scale, terms = best.parameter, best.history, best.scale, pixels.terms
    direction_std, position_std = _spread(parameter, best.covariance)
    loose = [f"{name} +-{float(std):.1f} deg" for name, std in zip("RGB", direction_std, strict=True) if std > LOOSE_DEG]
    message = f"converged in {len(history)} steps"
    if not best.converged:
        message = (
            f"stopped at {max_steps} steps, lights still moving {best.moved_mm:.3g} mm a step: "
            "raise max_steps, or the image pins no light"
        )
    elif loose:
        percent = float((scale[:, 0] * pixels.noise / pixels.image.median(dim=1).values).max())
        message += (
            f", but one image does not pin {', '.join(loose)}: a smooth misfit of {percent:.1%} is left (vignetting or scattered "
            "light); calibrate with presses or known lights"
        )
    fitted: dict[str, Any] = {}
    variance = torch.diagonal(best.covariance, dim1=1, dim2=2)
    if VIGNETTING in terms:
        part = [4 + k for k, name in enumerate(terms) if name in OF_THE_CAMERA]
        corner = best.covariance[0][part][:, part].sum().clamp_min(0.0).sqrt()
        powers = [*parameter[0, part].tolist(), 0.0][:2]
        fitted |= {"vignetting": sum(powers), "falloff": tuple(powers), "vignetting_std": float(corner)}
    if AMBIENT in terms:
        k = 4 + terms.index(AMBIENT)
        fitted |= {"ambient": parameter[:, k], "ambient_std": variance[:, k].sqrt()}
    return LightFit(
        lights=to_lights(parameter, terms, background.dtype),
        converged=best.converged,
        message=message,
        loss_history=history,
        direction_std_deg=direction_std,
        position_std_mm=position_std,
        residual_std=scale[:, 0] * pixels.noise,
        noise_std=pixels.noise,
        misfit=best.misfit,
        inlier_fraction=float((best.weight > 0).double().mean()),
        numbers=free_numbers(terms, azimuth).shape[2],
        held_out=best.held_out,
        **fitted,
    )


class _Solution(NamedTuple):
    parameter: Tensor
    history: list[float]
    converged: bool
    moved_mm: float
    weight: Tensor
    scale: Tensor
    covariance: Tensor
    misfit: Tensor
    held_out: Tensor


def _with_terms(start: Tensor, terms: tuple[str, ...], azimuth: Tensor | None) -> Tensor:
    """A start (3, 4) with its terms at zero, moved to the known azimuths."""
    start = torch.cat((start, torch.zeros(3, len(terms), dtype=start.dtype)), dim=1)
    if azimuth is not None:
        ray = torch.stack((azimuth.cos(), azimuth.sin()), dim=1)
        along = (start[:, :2] * ray).sum(1, keepdim=True).maximum(0.1 * start[:, 2:3].exp())
        start[:, :2] = along * ray
    return start


def _solve(pixels: RestPixels, start: Tensor, azimuth: Tensor | None, max_steps: int, progress: bool) -> _Solution:
    """The optimiser loop: Levenberg-Marquardt steps, the robust weights renewed at each, until the lights lie still."""
    parameter = start.clone().requires_grad_()
    tie = free_numbers(pixels.terms, azimuth)
    tied = azimuth is not None or VIGNETTING in pixels.terms
    optimiser = LevenbergMarquardt(parameter, tie=tie if tied else None)
    history: list[float] = []
    still, moved = 0, float("inf")
    with tqdm(total=max_steps, desc=f"lights, {len(pixels.x)} pixels", disable=not progress, leave=False) as bar:
        while len(history) < max_steps and still < 3:
            weight, scale = _robust_weight(pixels.residual(parameter.detach()), pixels.usable)
            optimiser.step(pixels.residual, weight / scale.square() if tied else weight)
            history.append(float(_tukey_loss(pixels.residual(parameter.detach()), scale)))
            moved = _moved_mm(optimiser.last_step, parameter.detach())
            still = still + 1 if moved < STEP_TOLERANCE_MM else 0
            bar.update()
            bar.set_postfix(loss=f"{history[-1]:.4g}")
    parameter = parameter.detach()
    left, jacobian = residual_and_jacobian(pixels.residual, parameter)
    weight, scale = _robust_weight(left, pixels.usable)
    if not bool(torch.isfinite(left).all() & torch.isfinite(jacobian).all() & torch.isfinite(scale).all()):
        # the lights ran away: nothing is known of them, and nothing explained
        lost = 1e6 * torch.eye(parameter.shape[1], dtype=parameter.dtype).expand(3, -1, -1)
        return _Solution(start, [*history, 1e6], False, 1e6, weight, scale, lost, torch.ones(3), torch.full((16,), 1e6))
    covariance, misfit = _covariance(pixels, left, jacobian, pixels.model(parameter), weight / scale.square(), tie)
    held_out = _held_out(pixels, left, jacobian, weight / scale.square(), tie)
    return _Solution(parameter, history, still == 3, moved, weight, scale, covariance, misfit, held_out)


def _explains(glossy: _Solution, matt: _Solution) -> bool:
    """Whether a lobe takes at least half of what a matt skin leaves, and leaves next to nothing, in every channel."""
    less = (glossy.misfit < 0.5 * matt.misfit) & (glossy.misfit < GLOSS_MISFIT)
    return glossy.converged and bool((less & (glossy.parameter[:, -1] > 0)).all())


_COARSE_PIXELS = 8000

GLOSS_MISFIT = 0.01
"""A glossy skin is believed only if it leaves less relative structure than this."""

NOT_GLOSS = 0.1
"""A matt skin that leaves more relative structure than this is not tried as a glossy one: no gloss of the width assumed does."""

STEP_TOLERANCE_MM = 1e-4
"""The loop ends after three steps that move no light further than this."""

LOOSE_DEG = 5.0
"""A light whose direction is known no better than this is reported as not pinned by the image."""


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
            raise ValueError(
                f"background: expected light below the camera's limit, got a channel {name} that is saturated "
                f"in {saturated:.0%} of the image: lower the exposure"
            )
        if float(channel.max() - channel.min()) < 1e-6:
            raise ValueError(
                f"background: expected light that varies, got a channel {name} that is constant at {mean:.4f}: "
                "not a camera image of a lit skin"
            )


def _robust_weight(residual: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Tukey weights (3, N) and robust scale (3, 1) of residuals in units of the noise."""
    scale = (residual.abs().median(dim=1, keepdim=True).values / 0.6745).clamp_min(1.0)
    return usable * (1.0 - (residual / (TUKEY * scale)) ** 2).clamp_min(0.0) ** 2, scale


def _tukey_loss(residual: Tensor, scale: Tensor) -> Tensor:
    ratio = (residual / (TUKEY * scale)).square().clamp_max(1.0)
    return (scale.square() * TUKEY**2 / 6.0 * (1.0 - (1.0 - ratio) ** 3)).mean()


def _moved_mm(step: Tensor, parameter: Tensor) -> float:
    return float(torch.stack((step[:, 0].abs(), step[:, 1].abs(), (step[:, 2] * parameter[:, 2].exp()).abs())).max())


def _covariance(
    pixels: RestPixels, residual: Tensor, jacobian: Tensor, model: Tensor, weight: Tensor, tie: Tensor
) -> tuple[Tensor, Tensor]:
    r"""Covariance (3, K, K) of the parameters, and the misfit (3,), both honest about what the model does not explain.

    Vignetting, scattered light and uneven skin act as a smooth relative gain. It is a random effect here: Legendre products
    up to degree 4 whose standard deviation tau / degree^2 falls as bending energy has it; the part of the residual that
    the model cannot imitate gives tau, one per channel, by moments. What such a gain does to the fitted lights adds to the
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
    # everything below needs products of columns only: those of the parameters (K), the gains (14) and the residual (1)
    products = []
    for c in range(3):
        columns = torch.cat((jacobian[c], gain * relative[c], residual[c : c + 1]))
        products.append((columns * weight[c]) @ columns.t())
    k = jacobian.shape[1]
    numbers = torch.stack([tie[c].t() @ products[c][:k, :k] @ tie[c] for c in range(3)]).sum(0)
    pull = torch.stack([tie[c].t() @ products[c][:k, -1] for c in range(3)]).sum(0)
    inverse = _inverse(numbers)
    covariance, misfits = inverse.clone(), []
    for c in range(3):
        shared = tie[c].t() @ products[c][:k, k:-1]  # (F, 14)
        carried = inverse @ shared  # what the numbers do when the gain is there and not in the model
        free = products[c][k:-1, k:-1] - shared.t() @ carried
        rest = products[c][k:-1, -1] - carried.t() @ pull
        explained = rest @ torch.linalg.pinv(free, rtol=1e-10, hermitian=True) @ rest
        tau_squared = ((explained - gain.shape[0]) / torch.trace(free)).clamp_min(0.0)
        covariance += tau_squared * carried @ carried.t()
        misfits.append(tau_squared.sqrt())
    return tie @ covariance @ tie.transpose(1, 2), torch.stack(misfits)


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse of a normal matrix; what the image does not pin at all gets a huge variance, not none."""
    size = torch.diagonal(matrix).clamp_min(1e-20).sqrt()
    values, vectors = torch.linalg.eigh(matrix / (size[:, None] * size))
    inverse: Tensor = (vectors / values.clamp_min(1e-13)) @ vectors.t() / (size[:, None] * size)
    return inverse


def _held_out(pixels: RestPixels, residual: Tensor, jacobian: Tensor, weight: Tensor, tie: Tensor) -> Tensor:
    """Loss (16,) of each block of the image under the numbers that fit all others best, to first order.

    The other blocks pull the numbers by what this block's pixels no longer do: one Gauss-Newton step, as exact as that for a
    linear model. A block, not a pixel, is left out because what a wrong model leaves is smooth.
    """
    row = ((pixels.y / pixels.y.abs().max() + 1.0) * 2.0).long().clamp(0, 3)
    column = ((pixels.x / pixels.x.abs().max() + 1.0) * 2.0).long().clamp(0, 3)
    block = 4 * row + column
    parts, pulls = [], []
    for b in range(16):
        inside = torch.nonzero(block == b)[:, 0]
        columns = tie.transpose(1, 2) @ jacobian[:, :, inside]  # (3, F, n)
        weighted = columns * weight[:, None, inside]
        parts.append((weighted @ columns.transpose(1, 2)).sum(0))
        pulls.append((weighted @ residual[:, inside, None]).sum(0)[:, 0])
    whole = torch.stack(parts).sum(0)
    losses = []
    for b in range(16):
        inside = torch.nonzero(block == b)[:, 0]
        step = _inverse(whole - parts[b]) @ pulls[b]
        left = residual[:, inside] + ((tie @ step)[:, None] @ jacobian[:, :, inside])[:, 0]
        usable = pixels.usable[:, inside]
        losses.append((torch.log1p(left.square() / 9.0) * usable).sum() / usable.sum().clamp_min(1))
    return torch.stack(losses)


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
