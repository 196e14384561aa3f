"""A change of light as a finding: what it is, by how much, what to do, and how severe it is."""

import dataclasses
import math
from typing import Any

from .examination import Examination
from .findings import Finding, by_cost
from .light import Change

CHANNELS = ("red", "green", "blue")

LEAST_EFFECT = 0.05
"""Relative change of the light below which it is not reported where it costs nothing: presses scatter so much over the skin."""

MISFIT = 0.05
"""The same of a calibration's image, which its lights should explain, from which it is a warning whatever it costs."""

NO_LEVEL = 1.0 / 255.0
"""Light added everywhere that is none, beside another exposure."""

WORDS = {
    "exposure": ("exposure", "the image is {size:.1%} {brighter}: exposure or LEDs; recalibrate", "ratio"),
    "channel": ("channel_level", "{color} channel {size:.1%} {brighter}: recalibrate", "ratio"),
    "channels": ("channel_level", "the levels of the channels differ ({levels}): recalibrate", "furthest"),
    "ambient": ("ambient_light", "ambient light of {level:.3f}, not from the LEDs, is added everywhere: shade the sensor, or "
                "recalibrate", "level"),
    "black": ("black_level", "a black level of {black:.3f} is subtracted from every value: switch it off in the camera", "level"),
    "gamma": ("gamma", "values follow another power of light: gamma in the sensor file should be {gamma:.2f}; or light from "
              "outside is added: shade the sensor first",
              "power"),
    "light_moved": ("light_moved", "the light of the {color} LED is off by {effect:.1%}, unevenly: it has moved, or fades; fix "
                    "it and recalibrate", "effect"),
    "skin_changed": ("skin_changed", "the skin is brighter or darker by {effect:.1%}, equally in all channels: worn, dirty or "
                     "shaded; clean it, or recalibrate", "effect"),
    "light_field": ("light_changed", "the light of free skin is off by {effect:.1%}, unevenly and differently in each channel: "
                    "LEDs, or a press that scatters it; if an image without contact shows it too, recalibrate", "effect"),
    "lights_misfit": ("lights_misfit", "the calibration's lights do not explain its own image (off by {effect:.1%}): other lights, "
                      "stray light, or a lens; use presses or a prior", "effect"),
}  # fmt: skip
"""By the kind of change: name of the finding, message, and which figure is its value."""

BEFORE = {"calibration": "already at calibration: ", "background": "the background shows: ", "image": ""}


def in_words(change: Change, which: str, examination: Examination) -> Finding | None:
    """Report a change of light; None where nothing changed that is worth it.

    Args:
        change: that was found.
        which: "calibration" (its background against its lights), "background" or "image".
        examination: of the image.
    """
    if change.kind is None:
        return None
    if which == "image" and not (change.is_simple and change.effect > LEAST_EFFECT) and not examination.is_no_surface:
        return None  # a press that scatters light, or one that covers the skin, looks the same
    cost_deg = examination.cost_deg(change, which == "calibration")
    severity = by_cost(cost_deg)
    kind, parameters = change.kind.name, change.parameters
    if kind == "ambient" and len(parameters) > 3 and float(parameters[:3].abs().max()) < NO_LEVEL:
        kind, change = "exposure", dataclasses.replace(change, parameters=parameters[3:].log1p())
    elif kind == "ambient" and float(change.parameters[:3].mean()) <= 0:
        kind = "black"
    elif kind == "light_field" and which == "calibration":
        kind = "lights_misfit"
        severity = "warning" if severity == "note" and change.effect > MISFIT else severity
    if severity == "note" and change.effect < LEAST_EFFECT:
        return None
    name, message, value = WORDS[kind]
    figures = _figures(change, examination.exponent)
    return Finding(name, f"{BEFORE[which]}{message.format(**figures)} or accept {cost_deg:.1f} degrees", severity, figures[value])


def _figures(change: Change, exponent: float) -> dict[str, Any]:
    """All figures that the messages name."""
    assert change.kind is not None
    parameters = [float(value) for value in change.parameters]
    ratios = [math.exp(min(value, 50.0)) - 1.0 for value in parameters]
    level = sum(parameters[:3]) / 3.0
    return {
        "effect": change.effect,
        "ratio": ratios[0],
        "size": abs(ratios[0]),
        "brighter": "dimmer than at calibration" if ratios[0] < 0 else "brighter than at calibration",
        "color": CHANNELS[change.kind.channel],
        "levels": ", ".join(f"{color} {ratio:+.1%}" for color, ratio in zip(CHANNELS, ratios)),
        "furthest": max(ratios, key=abs),
        "level": level,
        "black": -level,
        "power": 1.0 + parameters[0],
        "gamma": exponent / max(0.05, 1.0 + parameters[0]),
    }
