"""The checks of an image, one table: what is measured, from which value on it is reported, in which words, and how severe it is."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch

from ..calibration import ROUGH, channel_structure
from ..compensate.light import unevenness
from ..core.frame import Conditions
from ..core.geometry import lengths
from ..core.levels import SATURATED
from ..model.markers import FEWEST_DOTS
from ..model.stated_error import stated_deg, stated_error_deg
from ..model.summary import SATURATED_SHARE
from ..model.usable import Flaw, FrameCheck
from ..pipeline import UNEVEN, UNSEEN_DEG, DepthPipeline, usual_unseen_deg
from .camera import blockiness, levels_of, new_spots, pattern_likeness, texture_share
from .examination import MISFITS, Examination
from .findings import FAULT_DEG, WARNING_DEG, Finding, by_cost

CHANNELS = ("red", "green", "blue")

LIGHT_REPORTED = 0.05
"""Change of a channel's light that is reported, relative."""

ROUGH_FREE_DEG = 6.0
"""Spread of the slopes that the least changed skin of a frame may seem to have: 0.3 to 4 degrees on real sensors, 4 where a press
scatters light over all of a small sensor."""

OTHER_DEG = 1.2
"""The same from which it is asked whether the frame is from another unit of its type: 1.4 to 5 degrees on three of one type."""

OTHER_PATTERN = 0.945
"""Unlikeness of the skin's fine pattern from which it is another's, or another part of it is seen."""

BEYOND = 2.0
"""Error that the calibration states for a contact, over that for its own presses, from which it is said."""

BLOCKY = 1.18
"""Ratio of steps at the borders of 8 x 8 blocks to those inside above which an image was compressed; noise alone stays below 1.1,
a JPEG of quality 95 has 1.2 to 1.3."""

COPLANAR = 0.3
"""Smallest singular value of the lights' directions below which they nearly lie in one plane."""

FINDINGS = {
    "swapped": ("channels_swapped", "; read the image in the order R, G, B"),
    "turned": ("other_view", "; take both in the same way"),
    "shows_less": ("other_view", "; take both in the same way"),
}
"""The finding of a flaw of the view (:class:`torchvts.model.usable.Flaw`), and what to do."""

Figures = dict[str, Any]
"""What a check measured: ``value`` is compared with its limit, all of it may stand in its message."""


@dataclass(frozen=True)
class Check:
    """A possible finding.

    Attributes:
        name: of the finding.
        measure: the value, figures with "value" among them, or the finding itself; None where the check does not apply.
        message: what it is, with figures by name in braces, and what to do.
        severity: "note", "warning" or "fault", or a function of the figures.
        above: reported where the value is larger than this.
        alone: asked only where nothing is wrong so far: it would mean nothing.
        last: nothing further is asked where it is found.
    """

    name: str
    measure: Callable[[Examination], Figures | float | Finding | None]
    message: str = ""
    severity: str | Callable[[Figures], str] = "warning"
    above: float = -math.inf
    alone: bool = False
    last: bool = False

    def __call__(self, examination: Examination) -> Finding | None:
        """The finding, if there is one."""
        measured = self.measure(examination)
        if measured is None or isinstance(measured, Finding):
            return measured
        figures = measured if isinstance(measured, dict) else {"value": measured}
        if not figures["value"] > self.above:
            return None
        severity = self.severity if isinstance(self.severity, str) else self.severity(figures)
        return Finding(self.name, self.message.format(**figures), severity, figures["value"])


def run_checks(examination: Examination) -> Iterator[Finding]:
    """All findings, in the order of the table; one that makes the rest meaningless ends it."""
    found: list[Finding] = []
    for check in CHECKS:
        if check.alone and any(finding.severity != "note" for finding in found):
            continue
        finding = check(examination)
        if finding is not None:
            found.append(finding)
            yield finding
            if check.last:
                return


# ---- what is measured: the calibration ----------------------------------------------------------------------------------------


def _clipped_at_calibration(e: Examination) -> float:
    return float((e.value > SATURATED).any(0).double().mean())


def _contact_at_calibration(e: Examination) -> float | None:
    """Structure between the channels as a contact has it; with lights, a contact that their pipeline finds in the background."""
    unit = e.unit
    if not unit.measured or unit.markers is not None or unit.sensor.markers or _clipped_at_calibration(e) > SATURATED_SHARE:
        return None
    if unit.lights is None:
        structure = channel_structure(e.value)
        return structure if structure > ROUGH else None
    model = type(unit).from_lights(unit.lights, unit.sensor)
    pipeline = DepthPipeline.from_calibration(model, "precise").eval()
    with torch.no_grad():
        return _contact(pipeline(e.value[None].to(model.background.dtype)).contact)


def _contact(mask: torch.Tensor) -> float | None:
    """Share of the image that is in contact, beyond specks."""
    share = float(mask.double().mean())
    return share if share > 0.005 else None


def _contact_in_background(e: Examination) -> float | None:
    light = _light_of_background(e)  # what light in another place makes looks like a contact
    if e.given is None or light is None or light["uneven"] > UNEVEN or e.failed_in(e.given):
        return None
    with torch.no_grad():
        return _contact(e.pipeline(e.given[None].to(e.unit.background.dtype)).contact)


def _coplanar(e: Examination) -> Figures | None:
    spread = least_spread(e)
    return {"value": spread, "cost": e.noise_deg} if spread < COPLANAR else None


def least_spread(e: Examination) -> float:
    """Smallest singular value of the lights' unit directions at the image centre: 0 in one plane, 1 at right angles."""
    if e.unit.lights is None:
        return math.inf
    return float(torch.linalg.svdvals(e.unit.lights.direction.detach().double())[-1])


# ---- the camera ----------------------------------------------------------------------------------------------------------------


def _bits(e: Examination) -> Figures | None:
    if e.is_fine:
        return None
    which = "image" if levels_of(e.raw) == e.levels else "calibration's image"
    cost = e.degrees_of(torch.full((3,), 1.0 / e.levels / math.sqrt(12.0)))
    return {"value": float(round(math.log2(e.levels + 1))), "which": which, "cost": cost}


def _block_steps(e: Examination) -> Figures | None:
    if not e.is_fine:
        return None
    ratio, step = blockiness(e.image)
    return {"value": ratio, "cost": e.degrees_of(torch.full((3,), step))} if ratio > BLOCKY else None


def _noise(e: Examination) -> Figures | None:
    """Noise of the image, degrees of it, and how many times that at calibration it is."""
    if not e.is_fine or e.noise_deg <= 2.0 * WARNING_DEG:
        return None
    ratio = float((e.noise / e.unit.noise_std).max())
    return {"value": float(e.noise.max()), "cost": e.noise_deg, "ratio": ratio} if ratio > 3.0 or e.noise_deg > FAULT_DEG else None


def _unusable(flaw: Flaw | None, what: str) -> Finding | None:
    if flaw is None or flaw.name == "shows_more":  # a contact over all of the skin looks so, too
        return None
    name, remedy = FINDINGS.get(flaw.name, ("no_picture", ""))
    return Finding(name, f"the {what} {flaw.text}{remedy}", "fault", 1.0)


def _failed(e: Examination, image: torch.Tensor | None, flaw: Flaw | None) -> Figures:
    """Number of the channels that an image has lost; of an image without light :func:`_unusable` says more."""
    lit = image is not None and (flaw is None or flaw.name not in ("one_colour", "dark"))
    failed = e.failed_in(image) if image is not None and lit else []
    rough = "with two LEDs left mode precise still finds a rough depth, with one none does"
    left = "the response of this unit needs all of them" if e.unit.lights is None else rough
    return {"value": float(len(failed)), "colors": " and ".join(CHANNELS[j] for j in failed), "left": left}


def _saturated(e: Examination) -> Figures | None:
    clipped = (e.raw > SATURATED).any(0)
    inside = float(clipped[e.moved].double().mean()) if bool(e.moved.any()) else 0.0
    anywhere = float(clipped.double().mean())
    where = f"{inside:.0%} of the contact" if inside > anywhere else f"{anywhere:.0%} of the image"
    return {"value": max(inside, anywhere), "where": where, "inside": inside}


# ---- the light and the skin ----------------------------------------------------------------------------------------------------


def _change_of(conditions: Conditions | None) -> Figures | None:
    """Levels of the light in the three channels, and how uneven its change is where it is most uneven."""
    if conditions is None:
        return None
    levels, uneven = conditions.light[0, :, 0], float(unevenness(conditions.light).max())
    furthest = float(levels[(levels - 1.0).abs().argmax()]) - 1.0
    text = ", ".join(f"{name} {float(level):.0%}" for name, level in zip(CHANNELS, levels))
    return {"value": max(abs(furthest), uneven), "levels": text, "uneven": uneven}


def _light_of_background(e: Examination) -> Figures | None:
    return None if e.given is None or e.flaw_of_given else _change_of(e.conditions_of(e.given))


def _light_at_calibration(e: Examination) -> Figures | Finding | None:
    light = _change_of(e.calibration_light)
    if light is None:
        return None
    view = FrameCheck(e.value_of(e.unit.model_image)).other_view(e.value[None])
    if view is not None and view.name == "swapped":
        text = f"already at calibration the image {view.text}; read images in the order R, G, B"
        return Finding("channels_swapped", text, "fault", 1.0)
    return light


def _by_unevenness(figures: Figures) -> str:
    return "warning" if figures["uneven"] > UNEVEN else "note"


def _unseen(e: Examination) -> Figures:
    """Slope that the least changed skin hides, and how many times that at calibration it is."""
    unseen = float(e.conditions.unseen_deg)
    return {"value": unseen, "times": unseen / usual_unseen_deg(e.unit, e.pipeline)}


def _rough(e: Examination) -> Figures:
    """Spread of the slopes of undeformed skin."""
    covered = not bool(e.output.contact.any())
    return {"value": e.free_deg, "read": "reads no depth" if covered else "does not know the undeformed skin"}


def _other_unit(e: Examination) -> float | Finding | None:
    """Unlikeness of the skin's fine pattern, where the least changed skin seems to have slopes; or that more than it is in view."""
    light = _change_of(e.conditions)
    alike = e.free_deg < OTHER_DEG and (light is None or light["uneven"] < UNEVEN)
    if not e.unit.measured or not e.is_fine or alike:
        return None
    likeness = pattern_likeness(e.image, e.without_markers(e.value), e.unit.noise_std, e.free)
    if likeness is not None and 1.0 - likeness > OTHER_PATTERN and (view := e.check.other_view(e.raw[None])) is not None:
        return Finding("other_view", f"the frame {view.text}; take both in the same way", "warning", 1.0 - likeness)
    return None if likeness is None else 1.0 - likeness


def _spots(e: Examination) -> Figures | None:
    # where lights stand close together a slope, too, takes light from all channels; steps of blocks look like spots
    if not e.unit.measured or e.unit.markers is not None or least_spread(e) < COPLANAR or blockiness(e.image)[0] > BLOCKY:
        return None
    widest = max(6, min(e.image.shape[1:]) // 10)
    number, pixels, dead = new_spots(e.image, e.value, e.expected_noise, widest, e.frame.weight[0, 0] <= 0.0)
    if pixels < 3:
        return None
    text = f", {dead} dead pixels among them" if dead else ""
    return {"value": float(number), "share": pixels / e.moved.numel(), "dead": text}


def _texture_lost(e: Examination) -> float | None:
    if not e.unit.measured or not e.is_fine:
        return None
    left = texture_share(e.image, e.without_markers(e.value), e.noise, e.unit.noise_std, e.free)
    return None if left is None else 1.0 - left


def _length(e: Examination, sign: float) -> float | None:
    """Share of the contact where normals are longer (+1) or shorter (-1) than one, if that is the more frequent."""
    error = e.length_error if e.unit.metric and bool(e.moved.any()) and blockiness(e.image)[0] <= BLOCKY else None
    if error is None:
        return None
    this, other = (float((s * error > 3.0).double().mean()) for s in (sign, -sign))
    return this if this > other else None


def _dots(e: Examination) -> Figures | None:
    """Share of the background's dots that the image does not show."""
    if e.motion is None:
        return None
    seen, every = int(e.motion.seen.sum()), e.motion.seen.numel()
    return {"value": 1.0 - seen / every, "seen": seen, "all": every}


def _dots_alike(e: Examination) -> Figures | None:
    """Shift of the dots of free skin, px, where they moved alike."""
    if e.motion is None:
        return None
    pitch, size = e.motion.mm_per_pixel, (e.motion.width, e.motion.height)
    x, y = (e.motion.rest_mm / pitch + 0.5 * torch.tensor([size[0] - 1.0, size[1] - 1.0])).round().long().T
    moved = e.motion.displacement_mm[0, e.motion.seen[0] & e.free[y, x], :2] / pitch
    if len(moved) < FEWEST_DOTS:
        return None
    shift = moved.median(dim=0).values
    length, spread = float(shift.norm()), float((moved - shift).norm(dim=1).median())
    return {"value": length, "mm": length * pitch} if spread < 0.3 * length else None


# ---- the scene -----------------------------------------------------------------------------------------------------------------


def _no_contact(e: Examination) -> float | None:
    return None if bool(e.output.contact.any()) else float(e.output.depth_mm.max())


def _at_border(e: Examination) -> float | None:
    mask = e.output.contact[0, 0]
    edge = torch.cat((mask[0], mask[-1], mask[:, 0], mask[:, -1]))
    return float(edge.double().mean()) if bool(edge.any()) else None


def _steepest(e: Examination) -> float:
    inside = lengths(e.output.gradient[0], 0)[e.moved]  # mm per mm
    return math.degrees(math.atan(float(inside.float().quantile(0.98)))) if len(inside) else 0.0


def _beyond_presses(e: Examination) -> Figures | None:
    """Mean error that the calibration states for the contact, over that for its own presses."""
    own_deg = e.unit.report.get("own_deg")
    if e.unit.covariance is None or own_deg is None or not bool(e.output.contact.any()):
        return None
    expected = float(stated_error_deg(e.unit, e.frame.image)[e.output.contact].mean())
    own = float(stated_deg(own_deg, torch.zeros(())))
    upright = e.output.normal[:, 2:3][e.output.contact].float().clamp(-1.0, 1.0)
    return {"value": expected / own, "expected": expected, "slope": float(torch.rad2deg(torch.acos(upright)).mean())}


def _shadow(e: Examination) -> float:
    dark = e.dark.any(0)
    return float(dark[e.moved].double().mean()) if bool(e.moved.any()) else 0.0


def _cast_shadow(e: Examination) -> float:
    """Share of the image where one light is missing while the two others are as on undeformed skin."""
    flat = e.unit.flat
    off = (e.frame.image[0] / flat.clamp_min(1e-6) - 1.0).abs()
    undeformed = off < (6.0 * e.unit.compensated_noise_std / flat.clamp_min(1e-6)).clamp_min(0.03)
    return float((e.dark & undeformed.roll(1, 0) & undeformed.roll(2, 0)).any(0).double().mean())


# ---- the table -----------------------------------------------------------------------------------------------------------------

_CONTACT = "contact in the {} image, or {}: take it again with nothing touching the skin"

CHECKS = (
    # the calibration
    Check("calibration_saturated", _clipped_at_calibration,
          "{value:.0%} of the calibration image is saturated: reduce the exposure and calibrate again", above=SATURATED_SHARE),
    Check("contact_in_calibration", _contact_at_calibration, _CONTACT.format(
        "calibration", "LEDs that the lights do not fit, for which presses of a ball help"), "fault"),
    Check("lights_coplanar", _coplanar, "the lights lie nearly in one plane (smallest singular value of their directions "
          "{value:.2f}, usual is 0.8): noise alone changes normals by {cost:.1f} degrees; increase the distance of the LEDs"),
    Check("lights_misfit", _light_at_calibration, "the calibration's lights do not explain its own image ({levels}; uneven by "
          "{uneven:.1%}): other lights, stray light, or a lens; use presses or a prior", above=LIGHT_REPORTED),
    # the background of now
    Check("led_failed", lambda e: _failed(e, e.given, e.flaw_of_given), "the {colors} LED has failed (its channel of the "
          "background is black everywhere): check LED and cable; {left}", "fault", above=0.0),
    Check("no_picture", lambda e: _unusable(e.flaw_of_given, "background")),
    Check("contact_in_background", _contact_in_background, _CONTACT.format("background", "in the calibration's"), "fault"),
    Check("light_changed", _light_of_background, "the background's light is {levels} of that at calibration, uneven by "
          "{uneven:.1%}: what is smooth is divided out", _by_unevenness, above=LIGHT_REPORTED),
    # the camera
    Check("few_bits", _bits, "the {which} has only {value:.0f} bits: rounding changes normals by {cost:.1f} degrees; read the "
          "camera with 8 bits or more", lambda figures: by_cost(figures["cost"])),
    Check("compressed", _block_steps, "the image was compressed: steps at the borders of 8 x 8 blocks are {value:.1f} times "
          "those inside. The steps alone change normals by {cost:.1f} degrees; what was lost inside blocks comes on top, unseen: "
          "take uncompressed images, or JPEG of quality 95 and more",
          lambda figures: by_cost(figures["cost"])),
    Check("noise", _noise, "noise of {value:.3f}, {ratio:.1f} times that at calibration, changes normals by {cost:.1f} degrees: "
          "more light, less gain, or average several frames", lambda figures: by_cost(0.5 * figures["cost"])),
    Check("led_failed", lambda e: _failed(e, e.image, e.flaw), "the {colors} LED has failed (its channel is black everywhere): "
          "check LED and cable; {left}", "fault", above=0.0, last=True),
    Check("no_picture", lambda e: _unusable(e.flaw, "frame"), last=True),
    Check("saturated", _saturated, "the image is saturated in {where}: reduce the exposure",
          lambda figures: "note" if figures["value"] < 0.1 else "fault" if figures["inside"] > 0.3 else "warning", above=0.02),
    # the light and the skin
    Check("no_free_skin", _rough, "even the least changed skin seems to have slopes of {value:.0f} degrees, and the pipeline "
          "{read}: contact covers everything, or this is another unit, or its light has changed (half an LED off, gamma?); leave "
          "skin free, or recalibrate",
          "fault", above=ROUGH_FREE_DEG, last=True),
    Check("other_unit", _other_unit, "the skin has not the fine pattern that it had at calibration: another unit, or its skin was "
          "changed; use its own calibration, or calibrate again", above=OTHER_PATTERN),
    Check("light_changed", lambda e: _change_of(e.conditions), "the light of free skin is {levels} of that at calibration, "
          "uneven by {uneven:.1%}: what is smooth is divided out, gamma, saturation, ambient light or another unit are not: set "
          "the camera as at calibration, shade the sensor, or recalibrate", _by_unevenness, above=LIGHT_REPORTED),
    Check("unseen_slopes", _unseen, "the least changed skin scatters {times:.0f} times as much as at calibration: slopes below "
          "{value:.0f} degrees are in doubt", "note", above=UNSEEN_DEG),
    Check("new_spots", _spots, "{value:.0f} spots that were not there at calibration ({share:.1%} of the image{dead}): clean the "
          "skin, or recalibrate", lambda figures: "warning" if figures["share"] > 0.001 else "note"),
    Check("skin_changed", lambda e: e.grey_change, "the skin's brightness has changed by {value:.1%} (RMS), unevenly and nearly "
          "equally in all channels: worn, stained or dirty, light from outside, or the camera has moved; clean and shade it, or "
          "recalibrate", above=0.0),
    Check("blurred", _texture_lost, "the image is blurred or moved: {value:.0%} of the skin's fine texture is lost; focus, clean "
          "the lens, mount the camera firmly", above=0.6),
    Check("specular", lambda e: _length(e, 1.0), "{value:.0%} of the contact is brighter than any matt slope: the skin is "
          "glossy (specular); use a matt coating, or softer light", above=MISFITS, alone=True),
    Check("blurred", lambda e: _length(e, -1.0), "{value:.0%} of the contact gets light from its surroundings: the image is "
          "blurred or moved, or other skin lights it (inter-reflection); focus, expose shorter, use a darker coating",
          above=MISFITS, alone=True),
    Check("dots_lost", _dots, "only {seen:.0f} of the skin's {all:.0f} printed dots are found: another skin or another pattern, a "
          "background that was pressed, or a frame that jumped; motion of dots needs the unit's own background", above=0.5),
    Check("dots_shifted", _dots_alike, "the dots of free skin have all moved alike by {value:.1f} px ({mm:.2f} mm): the camera or "
          "the gel has moved in its frame, or all skin is sheared; calibrate again where nothing touches it", "note", above=0.5),
    # the scene
    Check("no_contact", _no_contact, "no contact: nothing is above the noise", "note", last=True),
    Check("contact_at_border", _at_border, "the contact reaches the image border: the part beyond is not seen, and depth there "
          "is less certain", "note", alone=True),
    Check("steep_walls", _steepest, "walls of {value:.0f} degrees: a light may be blocked there, and integration cannot keep a "
          "step; use precise mode, trust the top only", "note", above=52.0),
    Check("beyond_presses", _beyond_presses, "normals of this contact are expected to be off by {expected:.0f} degrees, "
          "{value:.1f} times as much as on the presses: it is steeper, deeper or elsewhere, unless the frame is spoilt; calibrate "
          "again with presses of a smaller ball, deeper, or in that place",
          lambda figures: "warning" if figures["expected"] > figures["slope"] else "note", above=BEYOND),
    Check("shadow", _shadow, "a light is blocked in {value:.0%} of the contact: slopes there are estimated from two lights; press "
          "less, or raise the LEDs", lambda figures: "warning" if figures["value"] > 0.3 else "note", above=0.01),
    Check("cast_shadow", _cast_shadow, "a shadow falls on {value:.1%} of the image, on flat skin: modes fast and those of response "
          "fields take it for a slope; use precise mode with known lights, or raise the LEDs", above=0.002),
)  # fmt: skip
