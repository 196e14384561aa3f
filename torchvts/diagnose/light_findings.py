"""A change of light as a finding: what it is, by how much, what to do, and how severe it is."""

import math
from typing import Any, NamedTuple

import torch

from ..model import Calibration
from .examination import Examination
from .findings import SEVERITIES, Finding
from .light_change import CHANNELS, Change

WARNING_DEG = 0.5
"""Error of normals from which a change is a warning; from six times that it is a fault."""

USUAL_DRIFT = 0.05
"""The light of real LEDs drifts, and a press scatters light over the skin: by 2 % on one GelSight Mini, by 5 % on another. With a
response field, which normalises the light of every frame, a change below this is only a note."""

NO_DRIFT = 0.01
"""A smooth change of light below this is not reported."""


SCATTERED_PER_MM = 0.1
"""Most that a press changes the light of free skin for each mm of its depth, relative: 2 to 9 % at a mm on five real sensors."""


class Kind(NamedTuple):
    """How a kind of change is reported.

    Attributes:
        name: of the finding.
        message: with figures by name in braces.
        value: which figure is the finding's value.
        least: least severity,
        beyond: where the value is larger than this.
    """

    name: str
    message: str
    value: str
    least: str = "note"
    beyond: float = -1.0


_SWAPPED = "channels look swapped ({swapped}): read the image in the order R, G, B"

KINDS = {
    "channels_swapped": Kind("channels_swapped", _SWAPPED, "most", "fault"),
    "channels_exchanged": Kind("channels_swapped", _SWAPPED, "first", "fault"),
    "channels_mixed": Kind("channels_mixed", "{first:.0%} of the {color} light is read as {second_color}, and vice versa: check "
                           "the camera and its driver, {otherwise}", "first"),
    "channel": Kind("channel_level", "{color} channel {size:.1%} {brighter} {since}: recalibrate {otherwise}", "ratio"),
    "channels": Kind("channel_level", "the levels of the channels differ {since} ({levels}): recalibrate {otherwise}", "furthest"),
    "exposure": Kind("exposure", "the image is {size:.1%} {brighter} {since}: exposure or LEDs; recalibrate {otherwise}", "ratio"),
    "ambient": Kind("ambient_light", "ambient light of {level:.3f}, not from the LEDs, is added everywhere: shade the sensor, or "
                    "recalibrate, {otherwise}", "level"),
    "black": Kind("black_level", "a black level of {black:.3f} is subtracted from every value: switch it off in the camera, "
                  "{otherwise}", "minus_black"),
    "gamma": Kind("gamma", "values follow another power of light, as if the sensor file's gamma should be {gamma:.2f}: set it, "
                  "{otherwise}", "power"),
    "vignetting": Kind("vignetting", "the corners are darker by {first:.0%} {since}: the background compensates it, only noise in "
                       "the corners grows", "first"),
    "light_moved": Kind("light_moved", "the {color} LED seems to have {moved}: fix it and recalibrate, {otherwise}", "most"),
    "pitch": Kind("wrong_pitch", "pixels seem {size:.1%} {larger} on the skin than mm_per_pixel says, and all depths are wrong by "
                  "the same factor: measure the pitch again", "ratio", "warning", 0.01),
    "distortion": Kind("lens_distortion", "the corners seem {first_size:.1%} {nearer} the centre than through a straight lens: "
                       "rectify the images", "first", "warning", 0.02),
    "gloss": Kind("specular", "the skin is glossy: a gloss of {first:.2f} explains the background, and slopes are wrong by it; use "
                  "a matt coating", "first", "warning"),
    "skin_changed": Kind("skin_changed", "the skin is brighter or darker by {most:.1%}, equally in all channels, {since}: worn or "
                         "dirty; recalibrate {otherwise}", "most"),
    "lights_misfit": Kind("lights_misfit", "the calibration's lights do not explain its own image (off by {most:.1%}): other "
                          "lights, stray light, or a lens; use presses or a prior", "most", "warning", 0.01),
    "other_unit": Kind("other_unit", "only {free:.0%} of the skin looks as at calibration, even if a simple change of light is "
                       "allowed: another unit, or all its light has changed; recalibrate", "most", "fault"),
    "light_field": Kind("light_changed", "the light of free skin is off by {most:.1%}, unevenly and differently in each channel: "
                        "LEDs, or scattered light; recalibrate {otherwise}", "most"),
}  # fmt: skip

SCATTERED = Kind("light_changed", "the light of free skin is off by {most:.1%}, unevenly: a press this deep can scatter so "
                 "much, which the pipeline divides out; if an image without contact shows it too, recalibrate", "most")  # fmt: skip


def find_light_change(change: Change, which: str, examination: Examination) -> Finding | None:
    """Report a change of light.

    Args:
        change: that was found.
        which: "calibration" (its background against its lights), "background" or "image".
        examination: of the image.
    Returns:
        None where nothing changed that is worth reporting.
    """
    if change.name == "same":
        return None
    unit, of_calibration = examination.calibration, which == "calibration"
    cost_deg = examination.cost_deg(change, of_calibration)
    kind = _kind(change, of_calibration)
    scattered = unit.response is not None and change.largest_effect <= SCATTERED_PER_MM * examination.deepest_mm
    if scattered and which == "image" and kind.name == "light_changed":
        kind = SCATTERED
    figures = _figures(change, unit, cost_deg)
    figures["since"] = "than the calibration's lights predict" if of_calibration else "than at calibration"
    value = figures[kind.value]
    if kind.name == "lights_misfit" and change.largest_effect < 0.5 * NO_DRIFT:
        return None
    by_cost = "fault" if cost_deg >= 6.0 * WARNING_DEG else "warning" if cost_deg >= WARNING_DEG else "note"
    least = kind.least if abs(value) > kind.beyond else "note"
    severity = min(by_cost, least, key=SEVERITIES.index)
    if unit.response is not None and kind.name != "channels_swapped":
        if change.largest_effect < NO_DRIFT:
            return None
        if change.largest_effect < USUAL_DRIFT:
            severity = "note"
        elif severity == "note" or kind is SCATTERED:
            severity = "warning"
    before = {"calibration": "already at calibration: ", "background": "the background shows: "}.get(which, "")
    return Finding(kind.name, before + kind.message.format(**figures), severity, value)


def _kind(change: Change, of_calibration: bool) -> Kind:
    name = change.name
    if name == "channels_mixed" and float(change.parameters[0]) > 0.75:
        name = "channels_exchanged"
    elif name == "ambient" and float(change.parameters[:3].mean()) <= 0:
        name = "black"
    elif name == "light_field" and of_calibration:
        name = "lights_misfit"
    elif name == "light_field" and change.free_share < 0.5:
        name = "other_unit"
    return KINDS[name]


def _figures(change: Change, calibration: Calibration, cost_deg: float) -> dict[str, Any]:
    """All figures that messages of changes name."""
    parameters, channels = change.parameters, change.hypothesis.channels
    first = float(parameters[0]) if len(parameters) else 0.0
    ratio = math.exp(first) - 1.0
    figures: dict[str, Any] = {
        "most": change.largest_effect,
        "free": change.free_share,
        "first": first,
        "first_size": abs(first),
        "nearer": "nearer to" if first < 0 else "further from",
        "ratio": ratio,
        "size": abs(ratio),
        "brighter": "dimmer" if ratio < 0 else "brighter",
        "larger": "larger" if ratio > 0 else "smaller",
        "color": CHANNELS[channels[0]],
        "second_color": CHANNELS[channels[-1]],
        "swapped": " and ".join(CHANNELS[j] for j in sorted(channels) if len(channels) < 3 or channels[j] != j),
        "otherwise": f"or accept {cost_deg:.1f} degrees" if math.isfinite(cost_deg) else "its cost in degrees is not known",
    }
    if change.name == "channels":
        ratios = [math.exp(float(parameters[j])) - 1.0 for j in range(3)]
        figures["levels"] = ", ".join(f"{color} {ratio:+.1%}" for color, ratio in zip(CHANNELS, ratios))
        figures["furthest"] = ratios[int(parameters.abs().argmax())]
    elif change.name == "ambient":  # light becomes gain * light + level
        level = float(parameters[:3].mean())
        black = level / math.exp(float(parameters[3]) if len(parameters) > 3 else 0.0)
        figures |= {"level": level, "black": -black, "minus_black": black}
    elif change.name == "gamma":
        figures |= {"power": math.exp(first), "gamma": calibration.sensor.exponent / math.exp(first)}
    elif change.name == "light_moved":
        figures["moved"] = _movement(change, calibration)
    return figures


def _movement(change: Change, calibration: Calibration) -> str:
    if calibration.lights is None:
        return f"moved or changed (its light is off by {change.largest_effect:.1%})"
    position = calibration.lights.position_mm.detach()
    side = float(position.norm(dim=1).mean() * change.parameters[:2].norm())
    up = float(position[change.hypothesis.channels[0], 2] * torch.expm1(change.parameters[2]))
    return f"moved by about {math.hypot(side, up):.1f} mm"
