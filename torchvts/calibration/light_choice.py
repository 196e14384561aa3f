"""Choose which model of the lights one image supports: candidates of rising size, scored on held-out blocks of the image."""

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..model.report import CandidateRow
from ..model.sensor import Sensor
from .azimuths import wrong_azimuths
from .background import BackgroundPixels, misfit_of_paraboloid
from .lights import POORLY_CONSTRAINED_DEG, LightFit, fit_lights

WORTH = 0.01
"""The smallest model wins whose held-out loss is within this share of the best one's. Unneeded parameters change that loss by
0.1 %, a vignetting of 0.05 at noise 0.005 changes it by 5 %."""

NOTHING_LEFT = 0.003
"""Misfit of the plain lights below which they leave nothing for a larger model to explain."""

EXPLAINED = 0.01
"""Vignetting and ambient light are accepted only if they leave a smaller misfit than this. They imitate other causes:
ambient light reduces the misfit of a camera's gamma of 2.2 to 3 %, with lights that are 11 degrees off and seem good to 1.5."""

LARGE_MISFIT = 0.2
"""Misfit from which lights are no candidate beside another model."""

CLOSED_FORM_MISFIT = 0.1
"""Misfit of the closed-form lights from which no fit is tried beside another model. It is 0.125 to 0.20 on five real sensors; on
drawn rigs at most 0.07, with an ambient light as bright as the lights (0.3), and 0.05 with half of the corners' light lost."""

AZIMUTH_SLACK_DEG = 5.0
"""Free lights further than this, and three standard deviations, from the azimuths in the sensor file are not the sensor's."""

OTHER_GAMMA = 2.2


@dataclass(frozen=True)
class LightChoice:
    """The chosen lights and the candidates.

    Attributes:
        sensor: the sensor with its gamma.
        fit: the lights.
        rows: the table of candidates, the chosen one first.
        reason: why this one.
        complaint: why not to trust it, or "".
    """

    sensor: Sensor
    fit: LightFit
    rows: list[CandidateRow]
    reason: str
    complaint: str


@dataclass
class _Candidate:
    """Lights of one family and gamma, fitted; ``objection`` is why they are rejected whatever their score, or ""."""

    gamma: float
    vignetting: bool
    ambient: bool
    known_azimuth: bool
    parameters: int
    fit: LightFit
    objection: str = ""

    @property
    def plain(self) -> bool:
        """Whether the lights are fitted alone, without vignetting or ambient light."""
        return not self.vignetting and not self.ambient

    @property
    def family(self) -> str:
        return (
            "three lights"
            + " at known azimuths" * self.known_azimuth
            + ", glossy skin" * self.fit.lights.glossy
            + ", vignetting" * self.vignetting
            + ", ambient light" * self.ambient
        )

    @property
    def misfit(self) -> float:
        return float(self.fit.misfit.max())

    def can_win(self, stride: int) -> bool:
        """Whether lights fitted to every ``stride``-th row and column may be good ones on all: noise is that much less there."""
        loosest = float(self.fit.direction_std_deg.max())
        return self.misfit <= LARGE_MISFIT and loosest <= POORLY_CONSTRAINED_DEG * stride

    @property
    def held_out(self) -> float:
        return float(self.fit.held_out.mean())


def choose_lights(background: Tensor, sensor: Sensor, other_models: bool = False, progress: bool = False) -> LightChoice:
    """Choose point lights from one image: free or at the sensor's azimuths, with vignetting or ambient light if they exist.

    All candidates are fitted to a sparse image and scored by the loss on held-out blocks. The smallest within ``WORTH`` of the
    best is then fitted to the whole image. Larger models and the other gamma are tried only where the plain lights leave
    structure.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: its gamma is chosen where it is left open.
        other_models: models other than lights exist: lights that 30 rows show to have a large misfit, or to be constrained so
            poorly that less noise does not help, are then not refined.
        progress: show a bar.
    Raises:
        ValueError: as :func:`fit_lights`.
    Source:
        Stone, JRSS B 36(2), 1974, for held-out choice; Roberts et al., Ecography 40(8), 2017, for holding out blocks.
    """
    linear = dataclasses.replace(sensor, gamma=sensor.exponent, prior=None)
    sparse, small = _sparse(background, linear, 30 if other_models else 60)
    tried = _try(sparse, small, [], progress)
    stride = round(small.mm_per_pixel / sensor.mm_per_pixel)
    refine = not other_models or any(candidate.can_win(stride) for candidate in tried)
    if other_models and refine:
        sparse, small = _sparse(background, linear, 60)
        tried = _try(sparse, small, [], progress)
    if sensor.gamma is None and tried[0].misfit > 0.005:
        tried += _try(sparse, dataclasses.replace(small, gamma=OTHER_GAMMA), tried, progress)
    for candidate in tried:
        candidate.objection = _objection(candidate, tried, sensor)
    chosen = _choose(tried)
    fit, linear = chosen.fit, dataclasses.replace(linear, gamma=chosen.gamma)
    if not fit.failed and refine and not (other_models and chosen.misfit > LARGE_MISFIT):
        fit = _fit(background, linear, chosen.vignetting, chosen.ambient, chosen.known_azimuth, progress)
    final = dataclasses.replace(chosen, fit=fit)
    row = _row(final)
    row["note"] = _note(final)
    if not fit.failed:
        row["held_out"] = chosen.held_out
    complaint = f"background: {fit.message}" if not fit.converged or (row["score_deg"] or 0.0) > POORLY_CONSTRAINED_DEG else ""
    if not complaint and chosen.objection:
        complaint = f"background: {chosen.family}: {chosen.objection}"
    if wrong := _wrong_azimuths(chosen, tried, sensor):
        complaint = f"background: {wrong}"
    rows = [row, *(_row(candidate) for candidate in tried if candidate is not chosen)]
    return LightChoice(linear, fit, rows, _reason(chosen, tried), complaint)


def objection_to_lights(background: Tensor, sensor: Sensor) -> str:
    """Why point lights cannot explain a background, by their closed form on a sparse image and without any fit, or "".

    Fitted lights are chosen beside another model only if they leave next to nothing of the background. The closed form leaves
    more than they do, but not by orders: vignetting and ambient light bend the fall-off of a light, they do not turn it over.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: both gammas are tried where it leaves gamma open.
    Example:
        >>> from torchvts.model.lights import PointLights, flat_image
        >>> lights = PointLights([[25, 0, 30], [-12, 20, 30], [-12, -20, 30]], [900, 900, 900])
        >>> image, sensor = flat_image(lights, 48, 64, 0.6).detach(), Sensor("rig", 48, 64, 0.6)
        >>> objection_to_lights(image, sensor), objection_to_lights(1.0 - image, sensor)
        ('', 'the background of G, B falls off as under no near point light')
    """
    objections = []
    for gamma in (sensor.exponent,) if sensor.gamma is not None else (1.0, OTHER_GAMMA):
        image, small = _sparse(background, dataclasses.replace(sensor, gamma=gamma, prior=None), 30)
        left, far = misfit_of_paraboloid(BackgroundPixels.of(image.detach().to(torch.float64).cpu(), small))
        if bool(far.any()):
            named = ", ".join(name for name, one in zip("RGB", far.tolist(), strict=True) if one)
            objections.append(f"the background of {named} falls off as under no near point light")
        elif float(left.max()) > CLOSED_FORM_MISFIT:
            objections.append(f"the closed-form lights leave a misfit of {float(left.max()):.0%} of the background")
        else:
            return ""
    return objections[0]


def _sparse(background: Tensor, sensor: Sensor, rows: int) -> tuple[Tensor, Sensor]:
    """Rows and columns at an odd stride, about ``rows`` rows, with the image centre kept in the middle."""
    stride = max(1, min(sensor.height, sensor.width) // rows) // 2 * 2 + 1
    row, column = _evenly(sensor.height, stride), _evenly(sensor.width, stride)
    pitch = stride * sensor.mm_per_pixel
    small = dataclasses.replace(
        sensor, height=len(row), width=len(column), mm_per_pixel=pitch, corners_px=None, roi_px=None, raw_size_px=()
    )
    return background[:, row[:, None], column[None, :]], small


def _evenly(size: int, stride: int) -> Tensor:
    """Every stride-th index, with equal margins at both ends."""
    steps = (size - 1) // stride
    steps -= (size - 1 - steps * stride) % 2
    return (size - 1 - steps * stride) // 2 + stride * torch.arange(steps + 1)


def _try(image: Tensor, sensor: Sensor, before: list[_Candidate], progress: bool) -> list[_Candidate]:
    """All candidates at one gamma, the plain ones first; larger ones only while no plain one explains the image."""
    found: list[_Candidate] = []
    for vignetting, ambient in ((False, False), (True, False), (False, True)):
        plain = [one for one in found if one.plain]
        if (vignetting or ambient) and any(one.misfit < NOTHING_LEFT for one in before + plain):
            break
        for known in (False, True) if sensor.light_azimuth_deg is not None else (False,):
            fit = _fit(image, sensor, vignetting, ambient, known, progress)
            found.append(_Candidate(sensor.exponent, vignetting, ambient, known, fit.parameters + int(bool(before)), fit))
    return found


def _fit(image: Tensor, sensor: Sensor, vignetting: bool, ambient: bool, known: bool, progress: bool) -> LightFit:
    return fit_lights(
        image,
        sensor,
        max_steps=50 if vignetting or ambient else 100,  # one that still moves then is poorly constrained
        progress=progress,
        vignetting=vignetting,
        ambient=ambient,
        known_azimuth=known,
        gloss=not known,
    )


def _objection(candidate: _Candidate, tried: list[_Candidate], sensor: Sensor) -> str:
    """Why a candidate is rejected whatever its score, or ""."""
    fit = candidate.fit
    if not fit.converged:
        return fit.message
    if candidate.plain and candidate.gamma != tried[0].gamma and fit.loss_history[-1] > 0.5 * tried[0].fit.loss_history[-1]:
        return f"gamma {candidate.gamma} does not halve the loss"
    if not candidate.plain:
        objection = _objection_to_terms(candidate, tried)
        if objection:
            return objection
    if sensor.light_azimuth_deg is None:
        return ""
    if not candidate.known_azimuth:
        loosest = float(fit.direction_std_deg.max())
        if loosest > POORLY_CONSTRAINED_DEG:
            return f"the image alone constrains the lights to {loosest:.1f} deg only"
        return _off_the_given_azimuths(fit, sensor.light_azimuth_deg)
    if candidate.misfit > 2.0 * EXPLAINED:
        return f"lights at the azimuths of the sensor file leave a smooth misfit of {candidate.misfit:.1%}"
    return ""


def _objection_to_terms(candidate: _Candidate, tried: list[_Candidate]) -> str:
    """Why vignetting or ambient light is rejected: poorly constrained, or it explains too little."""
    fit = candidate.fit
    if candidate.vignetting and fit.vignetting < 2.0 * fit.vignetting_std:
        return f"vignetting {fit.vignetting:.3f} +- {fit.vignetting_std:.3f} is poorly constrained"
    if candidate.ambient:
        negative = bool((fit.ambient < -(2.0 * fit.ambient_std).clamp_min(0.005)).any())
        if negative or not bool((fit.ambient > 2.0 * fit.ambient_std).any()):
            pairs = zip(fit.ambient.tolist(), fit.ambient_std.tolist(), strict=True)
            return f"ambient light {', '.join(f'{v:.3f} +- {s:.3f}' for v, s in pairs)} is poorly constrained"
    base = next(one for one in tried if one.plain and one.gamma == candidate.gamma and one.known_azimuth == candidate.known_azimuth)
    if candidate.misfit > EXPLAINED or candidate.misfit > 0.5 * base.misfit:
        return f"a smooth misfit of {candidate.misfit:.1%} is left, {base.misfit:.1%} without"
    return ""


def _wrong_azimuths(chosen: _Candidate, tried: list[_Candidate], sensor: Sensor) -> str:
    """What is wrong with the azimuths of the sensor file, if free lights explain an image that lights at these do not, or ""."""
    given_deg = sensor.light_azimuth_deg
    if given_deg is None:
        return ""
    free = [one for one in tried if not one.known_azimuth and one.plain and one.fit.converged and one.misfit <= EXPLAINED]
    free = [
        one
        for one in free
        if float(one.fit.direction_std_deg.max()) <= POORLY_CONSTRAINED_DEG and _off_the_given_azimuths(one.fit, given_deg)
    ]
    if not free:
        return ""
    position = min(free, key=lambda one: one.held_out).fit.lights.position_mm.detach().double()
    if not chosen.objection:  # lights at known azimuths may be found on the far side of the centre
        ray = torch.deg2rad(torch.tensor(given_deg, dtype=torch.float64))
        ahead = position[:, 0] * ray.cos() + position[:, 1] * ray.sin()
        if not bool((ahead < 0.0).all()):
            return ""
    return wrong_azimuths(position, given_deg, AZIMUTH_SLACK_DEG)


def _off_the_given_azimuths(fit: LightFit, azimuth_deg: tuple[float, ...]) -> str:
    """Which free light lies clearly beside the azimuth that the sensor file gives it, or ""."""
    position = fit.lights.position_mm.detach().double()
    for name, light, std, given in zip("RGB", position, fit.direction_std_deg.tolist(), azimuth_deg, strict=True):
        off = (math.degrees(math.atan2(float(light[1]), float(light[0]))) - given + 180.0) % 360.0 - 180.0
        steepness = float(light.norm() / light[:2].norm().clamp_min(1e-9))  # a steep light's azimuth is less certain
        if abs(off) > AZIMUTH_SLACK_DEG + 3.0 * std * steepness:
            return f"light {name} is {off:.0f} deg off the azimuth in the sensor file"
    return ""


def _choose(tried: list[_Candidate]) -> _Candidate:
    valid = [candidate for candidate in tried if not candidate.objection]
    if not valid:  # the plain model as the sensor file has it, with its objection as a complaint
        plain = [candidate for candidate in tried if candidate.plain and candidate.gamma == tried[0].gamma]
        return plain[-1]
    enough = (1.0 + WORTH) * min(candidate.held_out for candidate in valid)
    return min((c for c in valid if c.held_out <= enough), key=lambda c: (c.parameters, c.held_out))


def _reason(chosen: _Candidate, tried: list[_Candidate]) -> str:
    if len(tried) == 1:
        return f"{chosen.family}: nothing is left for a larger model"
    first = tried[0]
    text = f"{chosen.family}, gamma {chosen.gamma:g}: " if chosen.gamma != first.gamma else f"{chosen.family}: "
    if chosen.objection:
        return text + f"every candidate is rejected; {chosen.objection}"
    text += f"the smallest within {WORTH:.0%} of the best held-out loss of {len(tried)} candidates"
    if chosen is first:
        return text
    return text + f", misfit {first.misfit:.1%} -> {chosen.misfit:.1%}, loss {first.held_out:.3f} -> {chosen.held_out:.3f}"


def _row(candidate: _Candidate) -> CandidateRow:
    fit = candidate.fit
    row: CandidateRow = {
        "model": "point lights",
        "family": candidate.family,
        "gamma": candidate.gamma,
        "parameters": candidate.parameters,
        "passes": 2,
        "score_deg": None if fit.failed else float(fit.direction_std_deg.max()) if fit.converged else 90.0,
        "note": f"rejected: {candidate.objection}" if candidate.objection else f"held-out loss {candidate.held_out:.4f}",
    }
    if not fit.failed:  # a failed fit has no figures
        row |= {
            "misfit": candidate.misfit,
            "held_out": candidate.held_out,
            "vignetting": fit.vignetting,
            "ambient": fit.ambient.tolist(),
        }
    return row


def _note(chosen: _Candidate) -> str:
    if not chosen.fit.converged:
        return chosen.fit.message
    loosest = float(chosen.fit.direction_std_deg.max())
    return f"one image constrains the lights to {loosest:.1f} deg, with a smooth misfit of {chosen.misfit:.1%}"
