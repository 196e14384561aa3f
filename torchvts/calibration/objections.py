"""What speaks against given presses, sizes and backgrounds, each in a sentence for the user."""

import dataclasses
import math
import statistics
from collections.abc import Sequence

import torch

from ..core.arrays import array_of
from ..core.views import Views
from ..model.calibration import SATURATED, Calibration
from ..model.report import Report
from ..model.response_field import ResponseField
from ..model.sensor import Sensor
from .by_lights import NOTHING_LEFT
from .contacts import ROUGH, Contact, channel_structure, differing, used
from .field import seen_slopes
from .lights import POORLY_CONSTRAINED_DEG

WIDE = 0.86
"""Contact radius over the ball's, in the median over presses, from which sizes are wrong: it is 0.55 to 0.78 on eleven real and
eight drawn sensors, 0.8 to 0.95 with a pitch that is twice too large. Presses that are all deep are no mistake."""

RATHER_WIDE = 0.8
"""The same, from which there is a warning: radii given for diameters had 0.84 and 0.855 on two drawn sensors."""

WIDE_OUTLINE = 1.75
"""The same of the outline of the strong change of light: 0.54 to 1.61, and 1.4 to 3.2."""

ENOUGH = 5
"""Presses from which contact radii are known well enough for that; outlines do not hang on where the balls are found."""

ALIKE = 1.15
"""Gains of presses by the prior that are the same to within this factor show one mistake of all."""

FAR = 1.65
"""Such a factor that no unit differs so much from the prior of its type: 0.87 to 1 on three units; 0.62 to 1 by one to four presses
of a DIGIT and the prior of another. From :data:`USUAL_GAIN` on there is a warning."""

USUAL_GAIN = 1.15
"""The prior's slopes divided by those of the balls are within this factor: 0.93 to 1.00 on a GelSight Mini."""

MANY, DISAGREEING = 6, 1.8
"""From so many presses, and so many standard deviations of their gains about the median (RMS), presses disagree with each other:
sets of right presses of ten real and eight drawn sensors have at most 1.64, with two balls exchanged or doubled 1.6 to 4.3."""

UNSEEN = 0.6
"""A direction of slopes of which a field finds less than this part of what it finds of the other is not seen: it is 0.86 to 1 on
twelve real sets and eight drawn sensors, 0.3 and 0.4 with LEDs on one line."""

SAME_TYPE = 0.27
"""Median difference of a background from the prior's pattern, logarithm of the light, up to which a unit is of the prior's type: it
is 0.03 to 0.08 on three GelSight Minis and 0.06 and 0.26 on two DIGITs, at most 0.24 with the frame shifted by 8 %, and at least
0.30 on 18 sensors of other types."""


SHIFTED = 0.15
"""The same, from which a frame is cropped otherwise, not only shifted as units are: whole frames of a GelSight Mini have 0.17."""


STANDING_OUT = 0.01
"""Share of a background that differs clearly from fitted lights, from which it may hold a contact."""


class CalibrationWarning(UserWarning):
    """A calibration was made but should not be trusted as it is."""


def to_scale(report: Report) -> str:
    """Why depth is not in mm, as far as is known; "" where nothing speaks against it. Presses that are left out do not.

    This alone decides it: it becomes ``report["objection"]``, which streams, commands and confidence read.
    """
    if report.get("objection"):
        return report["objection"]
    doubt = _doubt_in_lights(report)
    return doubt and f"{doubt}: calibrate with presses of a ball"


def _doubt_in_lights(report: Report) -> str:
    if report["source"] == "stand_in":
        return "the positions of the sensor file's lights do not fit the background"
    if report.get("standing_out", 0.0) > STANDING_OUT:
        return "the background may hold a contact"
    if report["model"] != "point_lights" or any(row["used"] for row in report.get("presses", [])):
        return ""
    if report["source"] == "sensor_file":
        return "the lights are the sensor file's, not this unit's"
    if not report.get("converged", True):
        return "the fit of the lights did not converge"
    if max(report.get("direction_std_deg", [0.0])) > POORLY_CONSTRAINED_DEG:
        return "the background does not constrain the lights"
    return _misfit(report)


def _misfit(report: Report) -> str:
    """What is wrong with depth where lights leave a smooth part of the background, such as vignetting; "" where they do not."""
    left = max(report.get("misfit", [0.0]))
    if left <= NOTHING_LEFT:
        return ""
    return (
        f"the lights leave a smooth misfit of {left:.1%} of the background (vignetting, scattered light, another gamma?): "
        f"depth may be wrong by {min(1.0, 30.0 * left):.0%}"
    )


def to_contacts(contacts: Sequence[Contact]) -> list[str]:
    """Presses that were left out."""
    return [f"{contact.name}: left out: {contact.reason}" for contact in contacts if contact.reason]


def to_diameters_by_prior(used: Sequence[Contact]) -> list[str]:
    """Diameters that are all wrong by the same factor, which only the prior can show."""
    gain = statistics.median(contact.metrics["gain"] for contact in used)
    if abs(math.log(max(gain, 1e-3))) <= math.log(USUAL_GAIN):
        return []
    return [
        f"presses: by the sensor's prior the balls seem {1.0 / gain:.2f} times as wide as given: wrong diameter or pitch? "
        "if they are right, this unit differs from the prior's, and more presses will show it"
    ]


def to_diameters_by_others(used: Sequence[Contact]) -> list[str]:
    """Presses that contradict each other all over, so that none stands out: sizes exchanged, or one size given for two."""
    known = [contact.metrics for contact in used if "gain_std" in contact.metrics]
    if len(known) < MANY:
        return []
    logs = [math.log(max(metrics["gain"], 1e-3)) for metrics in known]
    middle = statistics.median(logs)
    apart = math.sqrt(statistics.mean(((log - middle) / one["gain_std"]) ** 2 for log, one in zip(logs, known, strict=True)))
    if apart < DISAGREEING:
        return []
    return [
        f"presses: by each other the balls seem {math.exp(-max(logs)):.2f} to {math.exp(-min(logs)):.2f} times as wide as given: "
        "are diameters exchanged, or one given for two sizes, or images saturated or compressed? --candidates prints what each "
        "press says"
    ]


def to_sizes(contacts: Sequence[Contact], mm_per_pixel: float) -> str:
    """Why contacts are too wide for their balls, in the median over those that are used; "" where they are not.

    One wrong diameter among right ones is found by the others (outliers.py). Where all are wrong by one factor, presses agree with
    each other: a field fitted to them makes the same mistake, and even promises more accuracy.
    """
    located = _located(contacts)
    if not located:
        return ""
    wide = _width(located)
    outline = statistics.median(contact.outline_mm / contact.radius_mm for contact in located)
    if (wide < WIDE or len(located) < ENOUGH) and outline < WIDE_OUTLINE:
        return ""
    return (
        f"presses: expected contacts narrower than their balls, got contacts {wide:.2f} times as wide as the balls, and outlines "
        f"{outline:.2f} times (0.5 to 0.8, and 0.6 to 1.6, are usual): either mm_per_pixel, {mm_per_pixel:g}, is too large, "
        "or radii were given for diameters"
    )


def to_deep_presses(contacts: Sequence[Contact]) -> list[str]:
    """Contacts that are as wide as those of deep presses, or of balls given by their radii."""
    located = _located(contacts)
    if len(located) < ENOUGH or _width(located) < RATHER_WIDE:
        return []
    return [
        f"presses: contacts are {_width(located):.2f} times as wide as their balls (0.5 to 0.8 are usual): were radii given for "
        "diameters, or balls pressed by more than two fifths of their radius?"
    ]


def _located(contacts: Sequence[Contact]) -> list[Contact]:
    return [contact for contact in used(contacts) if not (contact.known and contact.radius_known)]


def _width(contacts: Sequence[Contact]) -> float:
    return statistics.median(contact.contact_radius_mm / contact.radius_mm for contact in contacts)


def to_directions(field: ResponseField, used: Sequence[Contact]) -> str:
    """Why slopes of one direction are not seen; "" where all are."""
    _, parts, directions = torch.linalg.svd(seen_slopes(field, used))
    seen = float(parts[1] / parts[0].clamp_min(1e-6))
    if seen > UNSEEN:
        return ""
    angle = math.degrees(math.atan2(float(directions[1, 1]), float(directions[1, 0]))) % 180.0
    return (
        f"presses: expected colours that change with slopes of all directions, got slopes along {angle:.0f} degrees from x that "
        f"are found {seen:.2f} times as large as those across (0.86 and more is usual): LEDs on one line show no slopes across it: "
        "put one beside the line"
    )


def to_sizes_by_prior(contacts: Sequence[Contact]) -> str:
    """Why the prior contradicts the sizes of all presses alike; "" where it does not, or where they differ from each other."""
    logs = [math.log(max(contact.metrics["gain"], 1e-3)) for contact in contacts if "gain" in contact.metrics]
    if len(logs) < 0.5 * len(contacts) or not logs:
        return ""
    middle = statistics.median(logs)
    alike = statistics.median(abs(value - middle) for value in logs) < math.log(ALIKE)
    if not alike or abs(middle) < math.log(FAR):
        return ""
    return (
        f"presses: by the sensor's prior all balls seem {math.exp(-middle):.2f} times as wide as given, on a background like that "
        "of the prior: wrong diameters (radii, inches?), or a wrong mm_per_pixel"
    )


def to_background_of_prior(background: torch.Tensor, sensor: Sensor) -> list[str]:
    """A background of another sensor type than the prior's, turned, swapped or cropped otherwise, or one with a contact.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: with a prior.
    Example:
        >>> sensor = Sensor.load("gelsight_mini")
        >>> image = sensor.prior.background(240, 320, 0.0634).clamp(0, 1)
        >>> to_background_of_prior(image, sensor), "turned by 180" in to_background_of_prior(image.flip(1, 2), sensor)[0]
        ([], True)
    """
    assert sensor.prior is not None
    light = background.detach().cpu().float() ** sensor.prior.response.gamma
    usual = sensor.prior.background(sensor.height, sensor.width, sensor.mm_per_pixel).float().clamp_min(1e-3)
    views = Views(array_of(usual))
    cells = views.cells(array_of(light * (usual.mean() / light.mean())))
    seen = f"its pattern of light is not that of the unit on which the prior of sensor '{sensor.name}' was fitted"
    found = []
    difference, view = views.difference(cells), views.other(cells)
    if view is not None and not (view.cropped and difference < SHIFTED):
        found.append(f"background: {seen}: it {view.in_words()}: turn, swap or crop the images as the sensor's are")
    elif difference > SAME_TYPE:
        found.append(
            f"background: {seen}: they differ by {difference:.0%} in the median, at most {SAME_TYPE:.0%} is usual, and no turned, "
            "mirrored or channel-swapped one fits: another sensor type, or an LED failed"
        )
    structure = channel_structure(background)
    if structure > ROUGH and not sensor.markers:
        found.append(
            f"background: structure between the channels of {structure:.2f}, a background stays below {ROUGH}: contact in the "
            "calibration image? take it again without"
        )
    return found


def to_background_of_lights(unit: Calibration) -> tuple[Calibration, list[str]]:
    """A background that differs from fitted lights in places, or that a gloss explains; the calibration with the first in its
    report. Units whose lights were not fitted stay as they are."""
    if unit.report["source"] != "background":
        return unit, []
    model = unit.model_image
    spread = (model - unit.background).abs().flatten(1).median(dim=1).values / 0.6745
    # contact changes the light by more than 5 % and is wider than dirt: 5 sigmas of the residual and of 1 % of the model
    saturated = (unit.background > SATURATED) | (model > 0.95)
    change = (unit.background - model).masked_fill(saturated, 0.0)
    standing_out = float(differing(change, spread.reshape(3, 1, 1) + 0.01 * model).double().mean())
    report = unit.report.copy()
    report["residual_std"], report["standing_out"] = spread.tolist(), standing_out
    found = [f"background: {text}: press a ball three times to measure it"] if (text := _misfit(report)) else []
    if standing_out > STANDING_OUT:
        found.append(
            f"background: {standing_out:.1%} of the image differs from the fitted lights by more than 5 times their residual "
            f"({', '.join(f'{v:.4f}' for v in spread.tolist())}): contact in the calibration image? take it again without"
        )
    if unit.lights is not None and unit.lights.glossy:
        found.append(
            f"background: it fits a skin with a gloss of {float(unit.lights.gloss.max()):.2f}, and hardly worse a matt one and a "
            "camera whose black is a fraction of a grey level above 0, or frames that were averaged: one image cannot tell them "
            "apart, and depth differs by a tenth or more: press a ball three times to measure it"
        )
    return dataclasses.replace(unit, report=report), found
