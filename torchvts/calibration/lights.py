r"""Fit three point lights to one image without contact.

A point light over a flat skin gives I = rho z / |S - P|^3, so I^(-2/3) is a paraboloid in x and y: a linear fit gives a start.
A robust least-squares loop in image value then finds the lights that fit best.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..core.checks import check_image, check_integer, check_record, check_switch
from ..core.robust import TUKEY, tukey_weight
from ..model.lights import PointLights
from ..model.sensor import Sensor, check_sensor
from .background import BackgroundPixels, at_bound, bounded, from_lights, paraboloid_start, to_lights
from .given_images import check_exposure
from .levenberg import LevenbergMarquardt
from .light_uncertainty import Linearisation, covariance_and_misfit, direction_and_position_std

COARSE_PIXELS = 8000
"""The first loop runs on this many pixels, the second on all."""

NOTHING_LEFT = 0.005
"""Misfit, relative to the light, up to which lights explain an image. A gloss must leave less; with more, another gamma is tried
where the sensor file leaves it open, and depth is not metric."""

GLOSSY_STEPS = 4
"""A glossy skin gets so many times the steps: its loop ends after 70 to 450, in a field of 19 mm with a gloss of 0.3 after 800."""

LEAST_USABLE = 0.02
"""Share of each channel's pixels that a fit needs."""

ENOUGH_STEPS = 20
"""Steps after which one would have lowered the loss: each that does not is followed by one a tenth as long."""

STEP_TOLERANCE_MM = 1e-4
"""The loop ends after three steps that move no light further than this."""

POORLY_CONSTRAINED_DEG = 5.0
"""A light whose direction has a larger standard deviation than this is reported as poorly constrained by the image. Such lights
do not show that there are coloured lights at all."""


@dataclass(frozen=True)
class LightFit:
    """Lights fitted to one image, and how far to trust them.

    Attributes:
        lights: the three lights.
        converged: the loop ended because the lights stopped moving.
        message: how it ended, and the remedy if it did not converge.
        failed: the loop found no lights: it diverged or never moved, or a channel has hardly a usable pixel. ``lights`` are then
            those of the start, and misfit and the last loss are infinite.
        loss_history: robust loss per step, in units of the noise.
        direction_std_deg: (3,), standard deviation of each light's direction seen from the image centre.
        position_std_mm: (3, 3), of each position coordinate.
        misfit: (3,), size of the smooth pattern in the image that the lights cannot explain, relative to the light: 0.02 is 2 %
            of the light, 0 where only noise is left.
    """

    lights: PointLights
    converged: bool
    message: str
    loss_history: list[float] = field(repr=False)
    direction_std_deg: Tensor = field(repr=False)
    position_std_mm: Tensor = field(repr=False)
    misfit: Tensor = field(repr=False)
    failed: bool = False


def fit_lights(
    background: Tensor,
    sensor: Sensor,
    *,
    start: PointLights | None = None,
    max_steps: int = 100,
    progress: bool = False,
    gloss: bool = True,
) -> LightFit:
    """Fit one point light per channel to an image without contact.

    A Levenberg-Marquardt loop fits 4 x 3 parameters to all pixels, with Tukey's biweight against spots, dead pixels and dust.
    Saturated and near-black pixels are left out. Where structure remains that a glossy skin explains down to the noise, the
    lights get a gloss per channel; otherwise the skin is matt, as in the paper.

    Args:
        background: (3, H, W) in [0, 1], R, G, B, of the sensor's size.
        sensor: gives the pixel pitch and ``gamma``.
        start: lights to start from; None takes the closed-form start.
        max_steps: limit of the loop.
        progress: show a bar.
        gloss: try a glossy skin where structure remains.
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
    check_sensor("sensor", sensor)
    if start is not None:
        check_record("start", start, PointLights, "PointLights(position_mm, albedo) makes them")
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    check_integer("max_steps", max_steps, 1)
    check_switch("progress", progress)
    check_switch("gloss", gloss)
    check_exposure(background)
    loop = _Loop(max_steps, progress)
    pixels = BackgroundPixels.of(background.detach().to(torch.float64).cpu(), sensor)
    best = _solve_coarse_to_fine(pixels, paraboloid_start(pixels) if start is None else from_lights(start), loop)
    if gloss and best.converged and bool((best.misfit > 0).all()):
        best = _try_gloss(pixels, best, loop._replace(max_steps=GLOSSY_STEPS * loop.max_steps)) or best
    return _light_fit(background.dtype, pixels, best, max_steps)


class _Loop(NamedTuple):
    """How the optimiser runs: the most steps, whether a bar is shown."""

    max_steps: int
    progress: bool


class _Solution(NamedTuple):
    """Where the optimiser ended; shapes as in :class:`Linearisation` and :class:`LightFit`."""

    parameter: Tensor
    history: list[float]
    converged: bool
    failure: str
    moved_mm: float
    scale: Tensor
    covariance: Tensor
    misfit: Tensor


def _solve_coarse_to_fine(pixels: BackgroundPixels, start: Tensor, loop: _Loop) -> _Solution:
    """On some pixels, and from there on all."""
    coarse = pixels.sample(COARSE_PIXELS)
    near = _solve(coarse, start, loop)
    if len(coarse.x) == len(pixels.x):
        return near
    best = _solve(pixels, near.parameter, loop)
    return best._replace(history=near.history + best.history)


def _try_gloss(pixels: BackgroundPixels, matt: _Solution, loop: _Loop) -> _Solution | None:
    """The solution with a glossy skin, if it explains next to everything in every channel."""
    start = torch.cat((matt.parameter, torch.full_like(matt.parameter[:, :1], 0.05)), dim=1)
    coarse = pixels.sample(COARSE_PIXELS)
    near = glossy = _solve(coarse, start, loop)
    # on few pixels: those of the matt skin too, and any gain, for both figures are rough
    if not _explains(near, _solve(coarse, matt.parameter, loop), 1.0):
        return None
    if len(coarse.x) < len(pixels.x):
        glossy = _solve(pixels, near.parameter, loop)
        if not _explains(glossy, matt):
            return None
    # the width of the lobe is assumed, so the change that the lobe makes counts as uncertainty of the lights
    moved = torch.zeros_like(glossy.parameter)
    moved[:, :4] = glossy.parameter[:, :4] - matt.parameter
    return glossy._replace(
        covariance=glossy.covariance + moved[:, :, None] * moved[:, None, :],
        history=matt.history + near.history + glossy.history,
    )


def _explains(glossy: _Solution, matt: _Solution, part: float = 0.5) -> bool:
    """Whether a lobe leaves at most that part of the matt skin's misfit, and next to nothing, in every channel."""
    less = (glossy.misfit <= part * matt.misfit) & (glossy.misfit < NOTHING_LEFT)
    return glossy.converged and bool((less & (glossy.parameter[:, -1] > 0)).all())


def _solve(pixels: BackgroundPixels, start: Tensor, loop: _Loop) -> _Solution:
    """Levenberg-Marquardt steps with robust weights renewed at each, until the lights stop moving or stay at their bound."""
    parameter = start.clone().requires_grad_()
    optimiser = LevenbergMarquardt(parameter)
    history: list[float] = []
    still, moved, span = 0, math.inf, pixels.span_mm()
    most = loop.max_steps if float(pixels.usable.double().mean(dim=1).min()) >= LEAST_USABLE else 0
    with tqdm(total=loop.max_steps, desc=f"lights, {len(pixels.x)} pixels", disable=not loop.progress or None, leave=False) as bar:
        while len(history) < most and still < 3:
            weight, scale = _robust_weight(pixels.residual(parameter.detach()), pixels.usable)
            before = parameter.detach().clone()
            optimiser.step(pixels.residual, pixels.linearised, weight)
            held = bool(at_bound(parameter.detach(), span).any())
            if held:
                with torch.no_grad():
                    parameter.copy_(bounded(parameter, span))
                optimiser.last_step = parameter.detach() - before
            history.append(float(_tukey_loss(pixels.residual(parameter.detach()), scale)))
            moved = _moved_mm(optimiser.last_step, parameter.detach())
            still = still + 1 if held or moved < STEP_TOLERANCE_MM else 0
            bar.update()
            bar.set_postfix(loss=f"{history[-1]:.4g}")
    parameter = parameter.detach()
    residual, jacobian = pixels.linearised(parameter)
    weight, scale = _robust_weight(residual, pixels.usable)
    fit = Linearisation(pixels, parameter, residual, jacobian, weight / scale.square())
    failure = _failure(fit, scale, math.isinf(moved) and len(history) >= ENOUGH_STEPS)
    if failure:  # nothing is known, nothing explained
        unknown = torch.full_like(start, 1e12).diag_embed()
        nothing = torch.full((3,), torch.inf)
        return _Solution(start, [*history, math.inf], False, failure, math.inf, scale, unknown, nothing)
    covariance, misfit = covariance_and_misfit(fit)
    converged = still == 3 and not bool(at_bound(parameter, span).any())
    return _Solution(parameter, history, converged, "", moved, scale, covariance, misfit)


def _failure(fit: Linearisation, scale: Tensor, never_moved: bool) -> str:
    """Why an end of the loop is no fit at all, or ""."""
    usable = fit.pixels.usable.double().mean(dim=1)
    if float(usable.min()) < LEAST_USABLE:
        channel = "RGB"[int(usable.argmin())]
        return f"only {float(usable.min()):.1%} of channel {channel} is neither saturated nor near black: set the exposure by it"
    if not (fit.is_finite() and bool(torch.isfinite(scale).all())) or never_moved:
        return "the fit of point lights found no step that lowers the loss: the background is no image of point lights"
    return ""


def _robust_weight(residual: Tensor, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Tukey weights (3, N) and robust scale (3, 1) of residuals in units of the noise."""
    scale = (residual.abs().median(dim=1, keepdim=True).values / 0.6745).clamp_min(1.0)
    return usable * tukey_weight(residual / (TUKEY * scale)), scale


def _tukey_loss(residual: Tensor, scale: Tensor) -> Tensor:
    ratio = (residual / (TUKEY * scale)).square().clamp_max(1.0)
    return (scale.square() * TUKEY**2 / 6.0 * (1.0 - (1.0 - ratio) ** 3)).mean()


def _moved_mm(step: Tensor, parameter: Tensor) -> float:
    return float(torch.stack((step[:, 0].abs(), step[:, 1].abs(), (step[:, 2] * parameter[:, 2].exp()).abs())).max())


def _light_fit(dtype: torch.dtype, pixels: BackgroundPixels, best: _Solution, max_steps: int) -> LightFit:
    direction_std, position_std = direction_and_position_std(best.parameter, best.covariance)
    residual = best.scale[:, 0] * pixels.noise / pixels.image.median(dim=1).values
    return LightFit(
        lights=to_lights(best.parameter, dtype),
        converged=best.converged,
        message=_message(best, direction_std, residual, pixels, max_steps),
        failed=bool(best.failure),
        loss_history=best.history,
        direction_std_deg=direction_std,
        position_std_mm=position_std,
        misfit=best.misfit,
    )


def _message(best: _Solution, direction_std: Tensor, relative_residual: Tensor, pixels: BackgroundPixels, max_steps: int) -> str:
    if best.failure:
        return best.failure
    held = at_bound(best.parameter, pixels.span_mm())
    if bool(held.any()):
        named = ", ".join(name for name, one in zip("RGB", held.tolist(), strict=True) if one)
        return (
            f"the background of {named} falls off as under no near point light: the fit ends at the most distant one that is "
            "allowed; calibrate with presses or known lights"
        )
    if not best.converged:
        moving = "" if math.isinf(best.moved_mm) else f", lights still moving {best.moved_mm:.3g} mm per step"
        return f"stopped at {max_steps} steps{moving}: raise max_steps, or the image does not constrain the lights"
    message = f"converged in {len(best.history)} steps"
    poor = [
        f"{name} +-{float(std):.1f} deg" for name, std in zip("RGB", direction_std, strict=True) if std > POORLY_CONSTRAINED_DEG
    ]
    if not poor:
        return message
    return (
        f"{message}, but one image does not constrain {', '.join(poor)}: a residual of {float(relative_residual.max()):.1%} "
        "is left (vignetting or scattered light); calibrate with presses or known lights"
    )
