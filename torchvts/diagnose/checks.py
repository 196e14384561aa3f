"""The checks of an image, one table: what is measured, from which value on it is reported, in which words, and how severe it is."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch

from ..integration import integrate_perspective
from ..pipeline import beyond_presses
from .camera import blockiness, levels_of, texture_share
from .examination import BLOCKY, COPLANAR, Examination, largest_residual
from .findings import Finding
from .light_change import CHANNELS, Change
from .light_findings import find_light_change
from .surface import LengthError, cast_shadow_share, normal_noise_deg, peaks, transition_width_mm

WARNING_DEG = 0.5
"""Error of normals from which noise is a warning; from twelve times that it is a fault."""

EXPLAINS_LENGTH = frozenset({
    "ambient_light", "black_level", "gamma", "channels_mixed", "channels_swapped", "specular", "lights_misfit", "other_unit",
    "skin_changed", "light_changed",
})  # fmt: skip
"""Findings that by themselves make normals longer or shorter than one: their length then shows nothing else."""

LOOKS_LIKE_CONTACT = frozenset({"skin_changed", "new_spots", "few_bits", "compressed", "other_unit", "light_changed", "noise"})
"""Findings that the contact mask may take for contact: the number and outline of contacts then mean nothing."""

Figures = dict[str, Any]
"""What a check measured: ``value`` is compared with its limits, all of it may stand in its message."""


@dataclass(frozen=True)
class Check:
    """A possible finding.

    Attributes:
        name: of the finding.
        measure: the value, figures with "value" among them, or the finding itself; None where the check does not apply.
        message: what it is, with figures by name in braces, and what to do.
        severity: "note", "warning" or "fault", or a function of the figures.
        above: reported where the value is larger than this,
        below: and smaller than this.
        unless: findings that make this one meaningless.
        last: whether nothing further is checked where it is found.
    """

    name: str
    measure: Callable[[Examination], Figures | float | Finding | None]
    message: str = ""
    severity: str | Callable[[Figures], str] = "warning"
    above: float = -math.inf
    below: float = math.inf
    unless: frozenset[str] = frozenset()
    last: bool = False

    def __call__(self, examination: Examination, found: set[str]) -> Finding | None:
        """The finding, if there is one; ``found`` are the names of those before it."""
        if found & self.unless:
            return None
        measured = self.measure(examination)
        if measured is None or isinstance(measured, Finding):
            return measured
        figures = measured if isinstance(measured, dict) else {"value": measured}
        if not self.above < figures["value"] < self.below:
            return None
        severity = self.severity if isinstance(self.severity, str) else self.severity(figures)
        return Finding(self.name, self.message.format(**figures), severity, figures["value"])


def run_checks(examination: Examination) -> Iterator[Finding]:
    """All findings, in the order of the table."""
    names: set[str] = set()
    for check in CHECKS:
        finding = check(examination, names)
        if finding is not None:
            names.add(finding.name)
            yield finding
            if check.last:
                return


# ---- what is measured ----------------------------------------------------------------------------------------------------------


def _by_cost(figures: Figures) -> str:
    return "fault" if figures["cost"] >= 12.0 * WARNING_DEG else "warning" if figures["cost"] >= WARNING_DEG else "note"


def _light_change(change: Change | None, which: str, e: Examination) -> Finding | None:
    return None if change is None else find_light_change(change, which, e)


def _coplanar(e: Examination) -> Figures | None:
    return {"value": e.spread, "cost": e.noise_deg} if e.spread < COPLANAR else None


def _contact(change: Change | None, least_free: float) -> float | None:
    """The largest residual of a background that shows a contact."""
    if change is None or largest_residual(change) <= 12 or change.free_share <= least_free:
        return None
    return float(change.residual.max())


def _bits(e: Examination) -> Figures | None:
    if e.is_fine:
        return None
    which = "image" if levels_of(e.raw) == e.levels else "calibration's image"
    cost = normal_noise_deg(e.blocks, torch.full((3,), 1.0 / e.levels / math.sqrt(12.0)))
    return {"value": float(round(math.log2(e.levels + 1))), "which": which, "cost": cost}


def _block_steps(e: Examination) -> Figures | None:
    if not e.is_fine:
        return None
    steps = max(e.steps, blockiness(e.value) if e.calibration.measured else 1.0)
    return {"value": steps, "which": "image" if e.steps > BLOCKY else "calibration's image"}


def _noise(e: Examination) -> Figures | None:
    """Noise of the image, degrees of it, and how many times that at calibration it is."""
    if not e.is_fine or bool(e.black_channels(e.image).any()):
        return None
    return {"value": float((e.noise / e.calibrated_noise).max()), "level": float(e.noise.max()), "cost": e.noise_deg}


def _more_noise(e: Examination) -> Figures | None:
    figures = _noise(e)
    return figures if figures is not None and figures["cost"] > WARNING_DEG else None


def _always_noisy(e: Examination) -> Figures | None:
    figures = _noise(e)
    if figures is None or figures["cost"] <= 3.0 * WARNING_DEG or e.spread < COPLANAR:
        return None
    return {**figures, "value": figures["level"]}


def _empty(e: Examination) -> float | None:
    return float(e.image.mean()) if e.is_empty else None


def _other_view(e: Examination) -> Finding | None:
    """An image that is cropped, turned or mirrored otherwise than the calibration's.

    Swapped channels are found as a change of light, and a flat contact over all of the skin looks like an image that shows more.
    """
    view = e.other_view
    if not view or "swapped" in view or "shows more" in view:
        return None
    return Finding("other_view", f"{view}: take both in the same way", "fault", e.free_share or 0.0)


def _failed_leds(e: Examination) -> Figures:
    failed = e.black_channels(e.image)
    return {"value": float(failed.sum()), "colors": " and ".join(CHANNELS[j] for j in range(3) if failed[j])}


def _spots(e: Examination) -> Figures | None:
    if not e.calibration.measured or e.spots.pixels < 3:
        return None
    dead = f", {e.spots.dead} dead pixels among them" if e.spots.dead else ""
    return {"value": float(e.spots.number), "share": e.spots.pixels / e.spots.mask.numel(), "dead": dead}


def _texture(e: Examination) -> float | None:
    if not e.calibration.measured or not e.is_fine:
        return None
    left, error = texture_share(e.image, e.expected, e.calibrated_noise, e.free_skin)
    return left if error < 0.05 else None


def _gloss(e: Examination) -> float | None:
    return e.length.longer if e.length is not None and e.length.mean > 0.003 else None


def _length(e: Examination, kind: str) -> LengthError | None:
    """The error of the normals' length if this is what explains it: "bounce", "move" or "blur"."""
    length = e.length
    if length is None or length.sigmas < 20.0 or length.amount < 0.05:
        return None
    found = length.pattern.split()[0]
    if found == "bounce" and length.narrow:  # narrow mixing, such as colours at half resolution, is no inter-reflection
        found = "blur"
    if found != "bounce" and int(e.spots.mask.sum()) >= 3:
        return None
    return length if found == kind else None


def _sigmas(length: LengthError | None) -> float | None:
    return None if length is None else length.sigmas


def _inter_reflection(e: Examination) -> float | None:
    length = _length(e, "bounce")
    return None if length is None else length.amount


def _saturated(e: Examination) -> Figures | None:
    contact = e.surface.contact
    inside = float(e.clipped[contact if bool(contact.any()) else torch.ones_like(contact)].double().mean())
    anywhere = float(e.clipped.double().mean())
    if inside <= 0.01 and anywhere <= 0.02:
        return None
    where = f"{inside:.0%} of the contact" if inside > 0.01 and bool(contact.any()) else f"{anywhere:.0%} of the image"
    return {"value": max(inside, anywhere), "where": where, "inside": inside}


def _number_of_contacts(e: Examination) -> float:
    sensor = e.calibration.sensor
    noise_mm = sensor.mm_per_pixel * math.radians(e.noise_deg)
    return float(max(e.contacts.count, peaks(e.surface.output.depth_mm[0, 0], e.surface.contact, noise_mm)))


def _steepest(e: Examination) -> Figures | None:
    inside = torch.where(e.surface.contact, e.surface.steepness, 0.0)
    steep = float(inside.flatten().quantile(1.0 - 0.02 * e.contacts.share))
    return {"value": math.degrees(math.atan(steep))} if steep > 1.3 else None


def _beyond_presses(e: Examination) -> Figures | None:
    text = beyond_presses(e.calibration, e.surface.output)[0]
    return {"value": math.degrees(math.atan(float(e.surface.steepness[e.surface.contact].max()))), "text": text} if text else None


def _shadow(e: Examination) -> float:
    contact = e.surface.contact
    return float((e.surface.dark.any(1)[0] & contact).double().sum() / contact.double().sum().clamp_min(1))


def _cast_shadow(e: Examination) -> Figures:
    remedy = "fast mode takes it for a slope; use precise mode, or raise the LEDs"
    if e.calibration.lights is None:
        remedy = "it is taken for a slope; raise the LEDs"
    return {"value": cast_shadow_share(e.surface, e.noise), "remedy": remedy}


def _transition(e: Examination) -> float | None:
    sensor = e.calibration.sensor
    width = transition_width_mm(e.surface)
    return width if width > max(3.0, 2.0 * sensor.blur_px + 2.0) * sensor.mm_per_pixel else None


def _deep_press(e: Examination) -> Figures | None:
    unit = e.calibration
    if unit.lights is None:
        return None
    value = e.mended_light[None].to(unit.background.dtype) ** (1.0 / e.exponent)
    fast = e.blocks.output(value, "fast").depth_mm
    off_px = float((fast - e.surface.output.depth_mm).abs().max()) / unit.sensor.mm_per_pixel
    return {"value": off_px, "deepest": e.deepest_mm} if off_px >= 0.5 else None


def _perspective(e: Examination) -> Figures | None:
    """Effect of a near camera on depth, where the calibration knows its height: no image shows it."""
    height, pitch = e.calibration.report.get("camera_height_mm"), e.calibration.sensor.mm_per_pixel
    if isinstance(height, bool) or not isinstance(height, int | float) or not 0 < height < math.inf:
        return None
    perspective = integrate_perspective(e.surface.output.gradient, pitch, float(height))
    off_px = float((perspective - e.surface.output.depth_mm).abs().max()) / pitch
    return {"value": off_px, "height": height} if off_px >= 0.1 else None


# ---- the table -----------------------------------------------------------------------------------------------------------------

_CONTACT = "contact in the {} image: take it again with nothing touching the skin"
_NO_FREE_SKIN = "contact covers the whole skin, or all light has changed: no free skin to compare with; leave some skin free"

CHECKS = (
    # the calibration
    Check("calibration_saturated", lambda e: float((e.value > 0.99).any(0).double().mean()),
          "{value:.0%} of the calibration image is saturated: reduce the exposure and calibrate again", above=0.05),
    Check("contact_in_calibration", lambda e: e.structure, _CONTACT.format("calibration"), "fault", above=0.0),
    Check("markers", lambda e: None if e.calibration.markers is None else float((e.raw != e.image).any(0).double().mean()),
          "printed markers cover {value:.0%} of the image: they are filled from the pixels around them, which hides details",
          "note"),
    Check("lights_coplanar", _coplanar, "the lights lie nearly in one plane (smallest singular value of their directions "
          "{value:.2f}, usual is 0.8): noise alone changes normals by {cost:.1f} degrees; increase the distance of the LEDs"),
    Check("lights_misfit", lambda e: _light_change(e.calibration_change, "calibration", e)),
    Check("contact_in_calibration", lambda e: _contact(e.calibration_change, 0.5), _CONTACT.format("calibration"), "fault"),
    # the background of now
    Check("light_changed", lambda e: _light_change(e.background_change, "background", e)),
    Check("contact_in_background", lambda e: _contact(e.background_change, 0.3), _CONTACT.format("background"), "fault",
          unless=frozenset({"other_unit"})),
    # the camera
    Check("few_bits", _bits, "the {which} has only {value:.0f} bits: rounding changes normals by {cost:.1f} degrees; read the "
          "camera with 8 bits or more", _by_cost),
    Check("compressed", _block_steps, "the {which} was compressed: steps at the borders of 8 x 8 blocks are {value:.1f} times "
          "those inside; take uncompressed images, or JPEG of quality 95 and more", above=BLOCKY),
    Check("noise", _more_noise, "noise is {value:.1f} times that at calibration and changes normals by {cost:.1f} degrees: more "
          "light, less gain, or average several frames", lambda figures: _by_cost({"cost": 0.5 * figures["cost"]}), above=3.0),
    Check("noise", _always_noisy, "noise of {value:.3f} changes normals by {cost:.1f} degrees, at calibration too: more light, "
          "less gain, or average several frames", unless=frozenset({"noise"})),
    Check("no_picture", _empty, "the image has one value everywhere: lens covered, no LEDs, or no picture from the camera",
          "fault", last=True),
    Check("led_failed", _failed_leds, "the {colors} LED has failed (its channel is black everywhere): check LED and cable; with "
          "two LEDs left modes precise and auto still find a rough depth, with one none does", "fault", above=0.0, last=True),
    Check("other_view", _other_view, last=True),
    # the skin
    Check("no_free_skin", lambda e: e.free_share, _NO_FREE_SKIN),
    Check("light_changed", lambda e: _light_change(None if e.is_wide_contact else e.change, "image", e)),
    Check("new_spots", _spots, "{value:.0f} spots that were not there at calibration ({share:.1%} of the image{dead}): clean the "
          "skin, or recalibrate", lambda figures: "warning" if figures["value"] >= 3 else "note"),
    Check("skin_changed", lambda e: e.wear, "the skin's brightness has changed by {value:.1%} (RMS), unevenly and nearly equally "
          "in all channels: worn, stained or dirty; clean it, or recalibrate", above=0.0),
    Check("blurred", _texture, "the image is blurred or moved: only {value:.0%} of the skin's fine texture is left; focus, clean "
          "the lens, mount the camera firmly", below=0.6),
    Check("specular", _gloss, "{value:.0%} of the contact is brighter than any matt slope: the skin is glossy (specular); use a "
          "matt coating, or softer light", above=0.03, unless=EXPLAINS_LENGTH),
    Check("inter_reflection", _inter_reflection, "slopes look washed out, as if about {value:.0%} of the light came from other "
          "skin (inter-reflection) or from around: use a darker gel or coating", unless=EXPLAINS_LENGTH),
    Check("moved", lambda e: _sigmas(_length(e, "move")),
          "the image is blurred by motion: rims are mixed along one direction; use a shorter exposure, or move "
          "slower", unless=EXPLAINS_LENGTH),
    Check("blurred", lambda e: _sigmas(_length(e, "blur")),
          "the image is blurred: rims are mixed with their surroundings; focus the camera, take colours at "
          "full resolution", unless=EXPLAINS_LENGTH),
    # the scene
    Check("saturated", _saturated, "the image is saturated in {where}: reduce the exposure",
          lambda figures: "fault" if figures["inside"] > 0.3 else "warning"),
    Check("no_free_skin", lambda e: 1.0 if e.contacts.count == 0 and e.is_wide_contact else None, _NO_FREE_SKIN),
    Check("no_contact", lambda e: 0.0 if e.contacts.count == 0 else None, "no contact: nothing is above the noise", "note",
          last=True, unless=frozenset({"no_free_skin"})),
    Check("contact_covers_image", lambda e: e.contacts.share, "contact covers {value:.0%} of the image: little free skin is left "
          "to compare with, and depth beyond the border is not seen", "note", above=0.4, unless=LOOKS_LIKE_CONTACT),
    Check("no_free_skin", lambda e: 1.0 - e.contacts.share if e.contacts.share > 0.97 else None, _NO_FREE_SKIN,
          unless=LOOKS_LIKE_CONTACT),
    Check("contact_at_border", lambda e: e.contacts.share if e.contacts.at_border else None, "the contact reaches the image "
          "border: the part beyond is not seen, and depth there is less certain", "note", unless=LOOKS_LIKE_CONTACT),
    Check("several_contacts", _number_of_contacts, "{value:.0f} contacts, or summits of one", "note", above=1.0,
          unless=LOOKS_LIKE_CONTACT),
    Check("faint_contact", lambda e: e.deepest_mm if e.deepest_mm < e.calibration.sensor.mm_per_pixel else None,
          "faint contact: {value:.3f} mm at its deepest, less than a pixel; its rim is below the noise", "note"),
    Check("steep_walls", _steepest, "walls of {value:.0f} degrees: a light may be blocked there, and integration cannot keep a "
          "step; use precise mode, trust the top only", "note"),
    Check("beyond_presses", _beyond_presses, "{text}: normals and depth are extrapolated there; calibrate again with "
          "presses of a smaller ball, deeper, or in that place"),
    Check("shadow", _shadow, "a light is blocked in {value:.0%} of the contact: slopes there are estimated from two lights; press "
          "less, or raise the LEDs", lambda figures: "warning" if figures["value"] > 0.3 else "note", above=0.01),
    Check("cast_shadow", _cast_shadow, "a shadow falls on {value:.1%} of the image, on flat skin: {remedy}", above=0.002),
    Check("transition_zone", _transition, "the skin slopes down over {value:.1f} mm around the contact: the gel sags, or the "
          "object is round there; the contact is smaller than the mask", "note",
          unless=LOOKS_LIKE_CONTACT | {"blurred", "moved"}),
    Check("deep_press", _deep_press, "deep press ({deepest:.1f} mm): fast mode is off by {value:.1f} px; use precise or auto",
          "note"),
    Check("perspective", _perspective, "the camera is {height:.0f} mm above the skin: if it is read as looking straight down, "
          "depth is off by {value:.1f} px; use PerspectiveIntegration",
          lambda figures: "warning" if figures["value"] > 0.5 else "note"),
)  # fmt: skip
