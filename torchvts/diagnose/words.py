"""A change of light in words a lab understands: what it is, by how much, and what to do."""

import math
from typing import NamedTuple

import torch

from ..model.calibration import Calibration
from .light_change import CHANNELS, Change


class Words(NamedTuple):
    """A finding's name, text and value, and its least severity, where that does not follow from its cost."""

    name: str
    text: str
    value: float
    least: str = "note"


def in_words(change: Change, calibration: Calibration, since: str, cost_deg: float) -> Words:
    """Name a change.

    Args:
        change: not "same". calibration: the unit's. since: "than at calibration", or what else the light is compared with.
        cost_deg: mean error of normals that it causes; nan where that is not known.
    """
    numbers, most = change.numbers, float(change.effect.max())
    colors = [CHANNELS[j] for j in change.hypothesis.channels]
    pay = f"or accept {cost_deg:.1f} degrees" if math.isfinite(cost_deg) else "its cost in degrees is not known"
    first = float(numbers[0]) if len(numbers) else 0.0
    ratio = math.exp(first) - 1.0

    if change.name == "channels_swapped":
        moved = [CHANNELS[j] for j in range(3) if change.hypothesis.channels[j] != j]
        return Words("channels_swapped", _swapped(moved), most, "fault")
    if change.name == "channels_mixed" and first > 0.75:
        return Words("channels_swapped", _swapped(colors), first, "fault")
    if change.name == "channels_mixed":
        text = f"{first:.0%} of the {colors[0]} light is read as {colors[1]}, and back: a matter of the camera or its driver, {pay}"
        return Words("channels_mixed", text, first)
    if change.name == "channel":
        text = f"{colors[0]} channel {abs(ratio):.1%} {_brighter(ratio)} {since}: recalibrate {pay}"
        return Words("channel_level", text, ratio)
    if change.name == "channels":
        levels = ", ".join(f"{CHANNELS[j]} {math.exp(float(numbers[j])) - 1.0:+.1%}" for j in range(3))
        furthest = math.exp(float(numbers[int(numbers.abs().argmax())])) - 1.0
        return Words("channel_level", f"the channels' levels are other {since} ({levels}): recalibrate {pay}", furthest)
    if change.name == "exposure":
        text = f"the image is {abs(ratio):.1%} {_brighter(ratio)} {since}: exposure or lamps; recalibrate {pay}"
        return Words("exposure", text, ratio)
    if change.name == "ambient":
        level = float(numbers[:3].mean())  # light becomes gain * light + level
        if level > 0:
            text = f"light of {level:.3f} that is not the lamps' is added everywhere: shade the sensor, or recalibrate, {pay}"
            return Words("ambient_light", text, level)
        level = level / math.exp(float(numbers[3]) if len(numbers) > 3 else 0.0)
        text = f"a black level of {-level:.3f} is taken off every value: switch it off in the camera, {pay}"
        return Words("black_level", text, level)
    if change.name == "gamma":
        power, gamma = math.exp(first), calibration.sensor.exponent / math.exp(first)
        text = f"values are light to another power, as if the sensor file's gamma should be {gamma:.2f}: set it, {pay}"
        return Words("gamma", text, power)
    if change.name == "vignetting":
        text = f"the corners are darker by {first:.0%} {since}: the background takes it out, only noise in the corners grows"
        return Words("vignetting", text, first)
    if change.name == "light_moved":
        text = f"the {colors[0]} light seems to have {_way(change, calibration)}: fix it and recalibrate, {pay}"
        return Words("light_moved", text, most)
    if change.name == "pitch":
        text = f"pixels seem {abs(ratio):.1%} {'larger' if ratio > 0 else 'smaller'} on the skin than mm_per_pixel says, and all "
        return Words("wrong_pitch", text + "depths are off by as much: measure the pitch again", ratio, _from(abs(ratio), 0.01))
    if change.name == "distortion":
        where = "nearer to" if first < 0 else "further from"
        text = f"the corners seem {abs(first):.1%} {where} the middle than through a straight lens: rectify the images"
        return Words("lens_distortion", text, first, _from(abs(first), 0.02))
    if change.name == "gloss":
        text = f"the skin shines: a gloss of {first:.2f} explains the image at rest, and slopes are off by it; coat it matt"
        return Words("specular", text, first, "warning")
    if change.name == "skin_changed":
        text = f"the skin is brighter or darker by {most:.1%}, in all channels alike, {since}: worn or dirty; recalibrate {pay}"
        return Words("skin_changed", text, most)
    if since != THAN_AT_CALIBRATION:
        text = f"the calibration's lights do not explain its own image (off by {most:.1%}): other lights, stray light, or a lens; "
        return Words("lights_misfit", text + "use presses or a prior", most, _from(most, 0.01))
    if change.rest_share < 0.5:
        text = f"only {change.rest_share:.0%} of the skin looks as at calibration, whatever simple change of light is allowed for: "
        return Words("other_unit", text + "another unit, or all its light has changed; recalibrate", most, "fault")
    text = (
        f"light at rest is off by {most:.1%}, unevenly and in each channel otherwise: lamps, or scattered light; recalibrate {pay}"
    )
    return Words("light_changed", text, most)


THAN_AT_CALIBRATION = "than at calibration"


def _swapped(colors: list[str]) -> str:
    return f"channels look swapped ({' and '.join(colors)}): read the image in the order R, G, B"


def _brighter(ratio: float) -> str:
    return "dimmer" if ratio < 0 else "brighter"


def _from(value: float, least: float) -> str:
    return "warning" if value > least else "note"


def _way(change: Change, calibration: Calibration) -> str:
    if calibration.lights is None:
        return f"moved or changed (its light is off by {float(change.effect.max()):.1%})"
    position = calibration.lights.position_mm.detach()
    side = float(position.norm(dim=1).mean() * change.numbers[:2].norm())
    up = float(position[change.hypothesis.channels[0], 2] * torch.expm1(change.numbers[2]))
    return f"moved by about {math.hypot(side, up):.1f} mm"
