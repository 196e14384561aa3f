"""What speaks against given presses, sizes and backgrounds: doubts, each a sentence with its figure and its remedy."""

import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.arrays import array_of
from ..core.levels import SATURATED
from ..core.views import Views
from ..model.calibration import Calibration
from ..model.report import NOT_CHECKED
from ..model.response_field import ResponseField
from ..model.sensor import Sensor
from .contacts import Contact, differing, uneven_light, used
from .field import Family, seen_slopes
from .lights import NOTHING_LEFT
from .outliers import PRESS_GAIN

SURE = 2.5
"""Standard deviations from which a doubt is raised: one in 80 of right sets, if they are Gaussian."""

UNIT_GAIN = 0.15
"""Standard deviation of the logarithm of a unit's slopes by the prior of its type over the true ones."""

WIDTH_ERROR = 0.05
"""Standard deviation of the width of a contact, in radii of the ball, that all presses of a set share: where its rim is seen."""

MOST_DOUBTED = 1 / 3
"""Share of presses that may each contradict all others: more of them contradict each other."""

DISAGREEING = 4.0
"""So many standard deviations of a mean square about the usual one, which is sqrt(2 / N) of N presses, and presses disagree."""

UNEVEN_PRESSES = 0.03
"""Unevenness that the light of all presses has in common from which it is named; a press alone makes 0.024 in the median."""

RIM_SINE = 0.7
"""Part of a ball's sine that is left at the rim of its contact: about the middle of its fall."""

UNSEEN = 0.5
"""A direction of slopes of which a field finds less than this part of what it finds of the other is not seen."""

SAME_TYPE = 0.27
"""Median difference of a background from the prior's pattern, logarithm of the light, up to which a unit is of the prior's
type."""

SHIFTED = 0.15
"""The same, from which a frame is cropped otherwise, not only shifted as units are: whole frames of a GelSight Mini have 0.17."""

STANDING_OUT = 0.01
"""Share of a background that differs clearly from fitted lights, from which it may hold a contact."""


class CalibrationWarning(UserWarning):
    """A calibration was made but should not be trusted as it is."""


class Doubt(NamedTuple):
    """A sentence, and whether it puts the scale of depth in doubt."""

    text: str
    of_scale: bool = False


class Width(NamedTuple):
    """Width of contacts in radii of their balls, and its standard deviation; (0, 0) where few show the rim of theirs."""

    times: float
    std: float


def of_presses(contacts: Sequence[Contact], field: ResponseField, pitch_mm: float, width: Width) -> list[Doubt]:
    """Presses that were left out, sizes that the presses themselves contradict, and slopes that are not seen.

    Args:
        contacts: of all presses, located.
        field: fitted to those that are used.
        pitch_mm: pixel pitch, mm.
        width: of those, see :func:`width_of`.
    """
    good = used(contacts)
    uneven = uneven_light(good)
    other = [Doubt(_other_light(uneven))] if uneven > UNEVEN_PRESSES else []
    found = other + [Doubt(f"{contact.name}: left out: {contact.reason}") for contact in contacts if contact.reason]
    found += [Doubt(f"{contact.name}: {contact.doubt}") for contact in good if contact.doubt]
    found += _sizes_by_each_other(good) + _directions(field, good)
    return [*found, Doubt(too_wide(width, pitch_mm), True)] if width.times > 1.0 - width.std else found


def _other_light(uneven: float) -> str:
    return (
        f"presses: their light differs from the background's by {uneven:.0%} unevenly (usual: less than {UNEVEN_PRESSES:.0%}): "
        "another gamma, saturation or white balance of the camera: take background, presses and frames with the same settings"
    )


def of_sizes(contacts: Sequence[Contact], pitch_mm: float) -> list[Doubt]:
    """Diameters that are all wrong by the same factor, or a wrong pitch, which only a prior can show.

    Args:
        contacts: of all presses, located by the prior, with their gains.
        pitch_mm: pixel pitch, mm.
    """
    gains = [math.log(max(contact.metrics["gain"], 1e-3)) for contact in contacts if "gain" in contact.metrics]
    if not gains:
        return []
    gain, std = statistics.median(gains), _std_by_prior(len(gains))
    if abs(gain) < SURE * std:
        return []
    low, high = (math.exp(gain + sign * std) for sign in (-1.0, 1.0))
    return [
        Doubt(
            f"presses: by the sensor's prior the balls seem {math.exp(-gain):.2f} times as wide as given, units differ by "
            f"{std:.0%}: diameters that are {1 / high:.2f} to {1 / low:.2f} times as large, or an mm_per_pixel of "
            f"{low * pitch_mm:.3g} to {high * pitch_mm:.3g}, would fit: measure both",
            True,
        )
    ]


def _std_by_prior(count: int) -> float:
    return math.hypot(UNIT_GAIN, PRESS_GAIN / math.sqrt(count))


def _sizes_by_each_other(good: Sequence[Contact]) -> list[Doubt]:
    """Presses that contradict each other all over, so that none stands out: sizes exchanged, or one size given for two."""
    known = [contact for contact in good if "gain_std" in contact.metrics]
    if not known:
        return []
    logs = [math.log(max(contact.metrics["gain"], 1e-3)) for contact in known]
    middle = statistics.median(logs)
    squares = [((log - middle) / one.metrics["gain_std"]) ** 2 for log, one in zip(logs, known, strict=True) if not one.doubt]
    few_doubted = len(known) - len(squares) <= MOST_DOUBTED * len(known)
    if few_doubted and statistics.mean(squares) < 1.0 + DISAGREEING * math.sqrt(2.0 / len(squares)):
        return []
    return [
        Doubt(
            f"presses: by each other the balls seem {math.exp(-max(logs)):.2f} to {math.exp(-min(logs)):.2f} times as wide as "
            "given: are diameters exchanged, or one given for two sizes, or images saturated or compressed? --candidates prints "
            "what each press says",
            True,
        )
    ]


def _directions(field: ResponseField, good: Sequence[Contact]) -> list[Doubt]:
    """Slopes of one direction that are not seen."""
    _, parts, directions = torch.linalg.svd(seen_slopes(field, good))
    seen = float(parts[1] / parts[0].clamp_min(1e-6))
    if seen > UNSEEN:
        return []
    angle = math.degrees(math.atan2(float(directions[1, 1]), float(directions[1, 0]))) % 180.0
    return [
        Doubt(
            f"presses: slopes along {angle:.0f} degrees from x are found {seen:.2f} times as large as those across (usual: 0.86 "
            "and more): LEDs on one line show no slopes across it: put one beside the line",
            True,
        )
    ]


def width_of(field: ResponseField, good: Sequence[Contact], pitch_mm: float) -> Width:
    """The median width of contacts."""
    family, weight = Family.of(field), field.tensor()
    located = [c for c in good if not (c.known and c.radius_known)]
    found = [_free_width(c, weight @ family.terms(c), pitch_mm) for c in located]
    widths = [width for width in found if width is not None]
    if not widths or 2 * len(widths) < len(located):
        return Width(0.0, 0.0)
    median = statistics.median(widths)
    spread = statistics.median(abs(width - median) for width in widths) / 0.6745
    return Width(median, math.hypot(WIDTH_ERROR, spread / math.sqrt(len(widths))))


def _free_width(contact: Contact, sine: Tensor, pitch_mm: float) -> float | None:
    """Radius at which the sine (2, N) has ceased to rise as that of a ball does, in radii of the given ball; None where it has not.

    A sine rises evenly as long as the skin lies on a ball of whatever size, so this knows nothing of the given diameter.
    """
    dx, dy, r = contact.polar()
    inward, ball = -(sine * torch.stack((dx, dy))).sum(0) / r.clamp_min(1e-9), r / contact.radius_mm
    core = r < 0.5 * contact.contact_radius_mm
    rise = float((inward * ball)[core].sum() / ball[core].square().sum().clamp_min(1e-9))
    ring = (r / pitch_mm).round().long()
    kept, count = (ring > 0) & ~contact.saturated, int(ring.max()) + 1
    total = torch.zeros(2, count, dtype=torch.float64).index_add_(1, ring[kept], torch.stack((inward, ball))[:, kept])
    total = torch.nn.functional.avg_pool1d(total[None], 5, 1, 2)[0]
    below = total[0] < RIM_SINE * rise * total[1]
    start = max(2, int(0.5 * contact.contact_radius_mm / pitch_mm))
    ends = below[start:].nonzero()
    return (start + int(ends[0])) * pitch_mm / contact.radius_mm if len(ends) and rise > 0.0 else None


def too_wide(width: Width, pitch_mm: float) -> str:
    """That contacts are as wide as their balls, or wider, as no contact is."""
    return (
        f"presses: expected contacts narrower than their balls, got {width.times:.2f} +- {width.std:.2f} times as wide: either "
        f"mm_per_pixel, {pitch_mm:g}, is too large (at most {pitch_mm / width.times:.3g} is possible), or radii were given for "
        "diameters"
    )


def of_error(stated_deg: float, contacts: Sequence[Contact]) -> list[Doubt]:
    """An error that is larger than the slopes that it is of: undeformed skin would be as good an answer.

    Args:
        stated_deg: to expect over the skin, degrees.
        contacts: of all presses.
    """
    steep = [min(1.0, contact.contact_radius_mm / contact.radius_mm) for contact in used(contacts)]
    slope_deg = math.degrees(2.0 / 3.0 * math.asin(statistics.median(steep)))  # about the mean over a disc
    if stated_deg < slope_deg:
        return []
    return [
        Doubt(
            f"presses: normals are expected to be off by {stated_deg:.0f} degrees, and those of the presses are only "
            f"{slope_deg:.0f} from the skin's: they tell nothing of slopes: were they of a ball, one contact each?",
            True,
        )
    ]


def not_checked(contacts: Sequence[Contact], sensor: Sensor, width: Width, depth_mm: Sequence[float]) -> Doubt:
    """What the images cannot show of sizes and pitch.

    Args:
        contacts: of all presses.
        sensor: with the prior that they were fitted from, if any.
        width: of the contacts, see :func:`width_of`.
        depth_mm: of presses, by the calibration; who pressed knows about how deep they were.
    """
    which = "the presses" if len(depth_mm) == len(used(contacts)) else f"{len(depth_mm)} of the presses"
    deep = f", by which {which} are {min(depth_mm):.2g} to {max(depth_mm):.2g} mm deep" if depth_mm else ""
    if sensor.prior is not None:
        return Doubt(
            f"{NOT_CHECKED}: the sensor's prior shows a wrong diameter or mm_per_pixel only beyond a factor of "
            f"{math.exp(SURE * _std_by_prior(len(used(contacts)))):.1f}: scale rests on what was given{deep}; an object of "
            "known height would check it"
        )
    most = f"{sensor.mm_per_pixel / width.times:.3g}" if width.times else ""
    limit = f" (an mm_per_pixel up to {most} would fit the contacts)" if most else ""
    seen = f"{deep}: is that so? Without" if deep else ": without"
    alone = [contact.name for contact in used(contacts) if SURE * contact.metrics.get("gain_std", math.inf) > math.log(2.0)]
    named = ", ".join(alone[:3]) + (f" and {len(alone) - 3} more" if len(alone) > 3 else "")
    return Doubt(
        f"{NOT_CHECKED}: the scale rests on the diameters and the mm_per_pixel that were given{seen} a prior no "
        f"image shows whether they are right{limit}; press an object of known height to check them"
        + (f"; a radius for a diameter would not show in {named}: press the same ball beside it" if alone else "")
    )


def of_type(background: Tensor, sensor: Sensor) -> list[Doubt]:
    """A background of another sensor type than the prior's, turned, swapped or cropped otherwise.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: with a prior.
    Example:
        >>> sensor = Sensor.load("gelsight_mini")
        >>> image = sensor.prior.background(240, 320, 0.0634).clamp(0, 1)
        >>> of_type(image, sensor), "turned by 180" in of_type(image.flip(1, 2), sensor)[0].text
        ([], True)
    """
    assert sensor.prior is not None
    light = background.detach().cpu().float() ** sensor.prior.response.gamma
    usual = sensor.prior.background(sensor.height, sensor.width, sensor.mm_per_pixel).float().clamp_min(1e-3)
    views = Views(array_of(usual))
    cells = views.cells(array_of(light * (usual.mean() / light.mean())))
    difference, view = views.difference(cells), views.other(cells)
    if view is not None and not (view.cropped and difference < SHIFTED):
        return [
            Doubt(
                f"background: held against images of sensor '{sensor.name}' it {view.what} ({view.undone:.0%} off them with that "
                f"undone, {view.same:.0%} as it is): turn, swap or crop the images as that sensor's are"
                + (", else mm_per_pixel is wrong" if view.cropped else ""),
                True,
            )
        ]
    if difference <= SAME_TYPE:
        return []
    return [
        Doubt(
            f"background: its light is {difference:.0%} off that of sensor '{sensor.name}' in the median, at most {SAME_TYPE:.0%} "
            "is usual, and it fits no better turned, mirrored or with channels swapped: another type of sensor, or an LED "
            "has failed: give presses of a ball",
            True,
        )
    ]


def of_fitted_lights(unit: Calibration) -> list[Doubt]:
    """A background that differs from the lights that were fitted to it: smoothly, in places, or as a gloss would."""
    model = unit.model_image
    spread = (model - unit.background).abs().flatten(1).median(dim=1).values / 0.6745
    # contact changes the light by more than 5 % and is wider than dirt: 5 sigmas of the residual and of 1 % of the model
    saturated = (unit.background > SATURATED) | (model > 0.95)
    change = (unit.background - model).masked_fill(saturated, 0.0)
    standing_out = float(differing(change, spread.reshape(3, 1, 1) + 0.01 * model).double().mean())
    left = max(unit.report.get("misfit", [0.0]))
    found = []
    if left > NOTHING_LEFT:
        found.append(
            Doubt(
                f"background: the lights leave a smooth misfit of {left:.1%} of it (vignetting, scattered light, another gamma?): "
                f"depth may be wrong by {min(1.0, 30.0 * left):.0%}: press a ball three times to measure it",
                True,
            )
        )
    if standing_out > STANDING_OUT:
        found.append(
            Doubt(
                f"background: {standing_out:.1%} of the image differs from the fitted lights by more than 5 times their residual "
                f"({', '.join(f'{v:.4f}' for v in spread.tolist())}): contact in the calibration image? take it again without "
                "contact",
                True,
            )
        )
    if unit.lights is not None and unit.lights.glossy:
        found.append(
            Doubt(
                f"background: it fits a skin with a gloss of {float(unit.lights.gloss.max()):.2f}, and hardly worse a matt one and "
                "a camera whose black is a fraction of a grey level above 0, or frames that were averaged: one image cannot tell "
                "them apart, and depth differs by a tenth or more: press a ball three times to measure it"
            )
        )
    return found
