"""Which model of the lights one image supports: candidates of rising size, scored on blocks of the image held out."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..model.sensor import Sensor
from .lights import LOOSE_DEG, LightFit, fit_lights

WORTH = 0.01
"""The smallest model wins whose held-out loss is within this share of the best one's. Extra numbers move that loss by 0.1 % where
there is nothing for them to find, and by 5 % under a vignetting of 0.05 at noise 0.005."""

NOTHING_LEFT = 0.003
"""Relative structure below which the plain lights leave nothing for a larger model to explain."""

EXPLAINED = 0.01
"""Vignetting and ambient light are believed only if they leave less relative structure than this. They imitate other causes:
ambient light takes a camera's gamma of 2.2 down to 3 % of structure, with lights that are 11 degrees off and seem good to 1.5."""

HOPELESS_MISFIT = 0.2
"""Relative structure that lights leave unexplained, from which they are no candidate beside another model."""

AZIMUTH_SLACK_DEG = 5.0
"""Free lights further than this, and three standard deviations, from where the drawing has them are not the sensor's."""

OTHER_GAMMA = 2.2


@dataclass(frozen=True)
class LightChoice:
    """The lights chosen, and what they were chosen from.

    Attributes:
        sensor: the sensor with its gamma. fit: the lights.
        rows: the table of candidates, the chosen one first.
        reason: why this one, in words. complaint: why not to trust it, or "".
    """

    sensor: Sensor
    fit: LightFit
    rows: list[dict[str, Any]]
    reason: str
    complaint: str


@dataclass
class _Candidate:
    gamma: float
    vignetting: int
    ambient: bool
    known_azimuth: bool
    numbers: int
    fit: LightFit
    against: str = ""

    @property
    def plain(self) -> bool:
        return not self.vignetting and not self.ambient

    @property
    def family(self) -> str:
        return (
            "three lights"
            + " at known azimuths" * self.known_azimuth
            + ", glossy skin" * self.fit.lights.glossy
            + ("", ", vignetting", ", vignetting of fourth order")[self.vignetting]
            + ", ambient light" * self.ambient
        )

    @property
    def misfit(self) -> float:
        return float(self.fit.misfit.max())

    @property
    def held_out(self) -> float:
        return float(self.fit.held_out.mean())


def choose_lights(background: Tensor, sensor: Sensor, other_models: bool = False, progress: bool = False) -> LightChoice:
    """Point lights from one image: free or at the azimuths the sensor names, with vignetting and ambient light if they are there.

    All candidates are fitted to a sparse image, scored by the loss on blocks held out, and the smallest within ``WORTH`` of the
    best is fitted to the whole image. Larger models and the other gamma are tried only where the plain lights leave structure.

    Args:
        background: (3, H, W) in [0, 1]. sensor: its gamma is chosen where it is left open.
        other_models: there are other models than lights: lights that leave much unexplained in 30 rows are looked at no closer.
        progress: show a bar.
    Raises:
        ValueError: as :func:`fit_lights`.
    Source:
        Stone, JRSS B 36(2), 1974, for held-out choice; Roberts et al., Ecography 40(8), 2017, for holding out blocks.
    """
    linear = dataclasses.replace(sensor, gamma=sensor.exponent, prior=None)
    sparse, small = _sparse(background, linear, 30 if other_models else 60)
    tried = _try(sparse, small, [], progress)
    if other_models and min(candidate.misfit for candidate in tried) <= HOPELESS_MISFIT:  # worth a closer look
        sparse, small = _sparse(background, linear, 60)
        tried = _try(sparse, small, [], progress)
    if sensor.gamma is None and tried[0].misfit > 0.005:
        tried += _try(sparse, dataclasses.replace(small, gamma=OTHER_GAMMA), tried, progress)
    for candidate in tried:
        candidate.against = _against(candidate, tried, sensor)
    chosen = _choose(tried)
    fit, linear = chosen.fit, dataclasses.replace(linear, gamma=chosen.gamma)
    if not (other_models and chosen.misfit > HOPELESS_MISFIT):
        fit = _fit(background, linear, chosen.vignetting, chosen.ambient, chosen.known_azimuth, progress)
    reason = _reason(chosen, tried)
    rows = [_row(candidate) for candidate in tried if candidate is not chosen]
    final = dataclasses.replace(chosen, fit=fit)
    row = _row(final) | {"held_out": chosen.held_out, "note": _note(final)}
    complaint = f"background: {fit.message}" if not fit.converged or row["score_deg"] > LOOSE_DEG else ""
    if not complaint and chosen.against:
        complaint = f"background: {chosen.family}: {chosen.against}"
    return LightChoice(linear, fit, [row, *rows], reason, complaint)


def _sparse(background: Tensor, sensor: Sensor, rows: int) -> tuple[Tensor, Sensor]:
    """Every so manieth row and column, about ``rows`` rows, the image centre kept in the middle."""
    stride = max(1, min(sensor.height, sensor.width) // rows) // 2 * 2 + 1
    row, column = _evenly(sensor.height, stride), _evenly(sensor.width, stride)
    pitch = stride * sensor.mm_per_pixel
    small = dataclasses.replace(sensor, height=len(row), width=len(column), mm_per_pixel=pitch, corners_px=None, roi_px=None)
    return background[:, row[:, None], column[None, :]], small


def _evenly(size: int, stride: int) -> Tensor:
    """Every stride-th index, as much left out before the first as behind the last."""
    steps = (size - 1) // stride
    steps -= (size - 1 - steps * stride) % 2
    return (size - 1 - steps * stride) // 2 + stride * torch.arange(steps + 1)


def _try(image: Tensor, sensor: Sensor, before: list[_Candidate], progress: bool) -> list[_Candidate]:
    """All candidates at one gamma, the plain ones first; larger ones as long as nothing explains the image."""
    found: list[_Candidate] = []
    for vignetting, ambient in ((0, False), (1, False), (0, True), (1, True), (2, False), (2, True)):
        plain = vignetting == 0 and not ambient
        # where one explains the image, its peers are still tried, to be compared with it, but nothing larger, no other gamma's
        smaller = [one for one in found if one.plain or vignetting == 2]
        if not plain and any(one.misfit < NOTHING_LEFT for one in before + smaller):
            break
        for known in (False, True) if sensor.light_azimuth_deg is not None else (False,):
            fit = _fit(image, sensor, vignetting, ambient, known, progress)
            found.append(_Candidate(sensor.exponent, vignetting, ambient, known, fit.numbers + int(bool(before)), fit))
    return found


def _fit(image: Tensor, sensor: Sensor, vignetting: int, ambient: bool, known: bool, progress: bool) -> LightFit:
    extra = vignetting > 0 or ambient
    return fit_lights(
        image,
        sensor,
        max_steps=50 if extra else 100,  # one that moves on after that is not pinned
        progress=progress,
        vignetting=vignetting,
        ambient=ambient,
        known_azimuth=known,
        gloss=not known,
    )


def _against(candidate: _Candidate, tried: list[_Candidate], sensor: Sensor) -> str:
    """What speaks against a candidate whatever its score, or ""."""
    fit = candidate.fit
    if not fit.converged:
        return fit.message
    base = next(one for one in tried if one.plain and one.gamma == candidate.gamma and one.known_azimuth == candidate.known_azimuth)
    if candidate.plain and candidate.gamma != tried[0].gamma and fit.loss_history[-1] > 0.5 * tried[0].fit.loss_history[-1]:
        return f"gamma {candidate.gamma} does not halve the loss"
    if candidate.vignetting and fit.vignetting < 2.0 * fit.vignetting_std:
        return f"vignetting {fit.vignetting:.3f} +- {fit.vignetting_std:.3f} is not pinned"
    if candidate.ambient:
        low = bool((fit.ambient < -(2.0 * fit.ambient_std).clamp_min(0.005)).any())
        if low or not bool((fit.ambient > 2.0 * fit.ambient_std).any()):
            pairs = zip(fit.ambient.tolist(), fit.ambient_std.tolist(), strict=True)
            return f"ambient light {', '.join(f'{v:.3f} +- {s:.3f}' for v, s in pairs)} is not pinned"
    if not candidate.plain and (candidate.misfit > EXPLAINED or candidate.misfit > 0.5 * base.misfit):
        return f"a smooth misfit of {candidate.misfit:.1%} is left, {base.misfit:.1%} without"
    if sensor.light_azimuth_deg is not None:
        if not candidate.known_azimuth:
            loosest = float(fit.direction_std_deg.max())
            if loosest > LOOSE_DEG:
                return f"the image alone leaves the lights {loosest:.1f} deg loose"
            return _off_the_drawing(fit, sensor.light_azimuth_deg)
        if candidate.misfit > 2.0 * EXPLAINED:
            return f"lights at the azimuths of the sensor file leave a smooth misfit of {candidate.misfit:.1%}"
    return ""


def _off_the_drawing(fit: LightFit, azimuth_deg: tuple[float, ...]) -> str:
    position = fit.lights.position_mm.detach().double()
    for name, light, std, drawn in zip("RGB", position, fit.direction_std_deg.tolist(), azimuth_deg, strict=True):
        off = (math.degrees(math.atan2(float(light[1]), float(light[0]))) - drawn + 180.0) % 360.0 - 180.0
        seen = float(light.norm() / light[:2].norm().clamp_min(1e-9))  # a steep light's azimuth is known worse than its direction
        if abs(off) > AZIMUTH_SLACK_DEG + 3.0 * std * seen:
            return f"light {name} stands {off:.0f} deg off the azimuth in the sensor file"
    return ""


def _choose(tried: list[_Candidate]) -> _Candidate:
    sound = [candidate for candidate in tried if not candidate.against]
    if not sound:  # nothing is believed: the plain model of what the file says, and its own doubts
        plain = [candidate for candidate in tried if candidate.plain and candidate.gamma == tried[0].gamma]
        return plain[-1]
    enough = (1.0 + WORTH) * min(candidate.held_out for candidate in sound)
    return min((c for c in sound if c.held_out <= enough), key=lambda c: (c.numbers, c.held_out))


def _reason(chosen: _Candidate, tried: list[_Candidate]) -> str:
    if len(tried) == 1:
        return f"{chosen.family}: nothing is left for a larger model"
    first = tried[0]
    words = f"{chosen.family}, gamma {chosen.gamma:g}: " if chosen.gamma != first.gamma else f"{chosen.family}: "
    if chosen.against:
        return words + f"no candidate is borne out; {chosen.against}"
    words += f"the smallest within {WORTH:.0%} of the best held-out loss of {len(tried)} candidates"
    if chosen is first:
        return words
    return words + f", misfit {first.misfit:.1%} -> {chosen.misfit:.1%}, loss {first.held_out:.3f} -> {chosen.held_out:.3f}"


def _row(candidate: _Candidate) -> dict[str, Any]:
    fit = candidate.fit
    against = f"not taken: {candidate.against}" if candidate.against else f"held-out loss {candidate.held_out:.4f}"
    return {
        "model": "point lights",
        "family": candidate.family,
        "gamma": candidate.gamma,
        "parameters": candidate.numbers,
        "passes": 2,
        "score_deg": float(fit.direction_std_deg.max()) if fit.converged else 90.0,
        "misfit": candidate.misfit,
        "held_out": candidate.held_out,
        "vignetting": fit.vignetting,
        "ambient": fit.ambient.tolist(),
        "note": against,
    }


def _note(chosen: _Candidate) -> str:
    if not chosen.fit.converged:
        return chosen.fit.message
    loosest = float(chosen.fit.direction_std_deg.max())
    return f"one image leaves the lights {loosest:.1f} deg loose, with a smooth misfit of {chosen.misfit:.1%}"
