"""The examination: light, camera, skin and scene, one after the other."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..calibration.background import falloff, outwardness
from ..calibration.contacts import ROUGH, channel_structure
from ..core.checks import QUANTISATION_STD, check_field, check_range
from ..core.noise import noise_std
from ..integration import integrate_perspective
from ..model.calibration import Calibration, check_calibration
from ..model.lights import PointLights
from .camera import Spots, blockiness, levels_of, new_spots, texture_share
from .findings import SEVERITIES, Diagnosis, Finding
from .light_change import CHANNELS, FULL, SAME, Change, cell_means, compare
from .surface import (
    Reader,
    Relief,
    angle_deg,
    cast_shadow_share,
    least_spread,
    length_misfit,
    lit_noise,
    normal_noise_deg,
    peaks,
    regions,
    skirt_mm,
)
from .words import THAN_AT_CALIBRATION, in_words

USUAL_DRIFT = 0.05
"""Light of real lamps drifts, and a press scatters light over the skin: by 2 % on one GelSight Mini, by 5 % on another. What a
response field, which levels every frame, sees below this is worth no more than a note."""

NO_DRIFT = 0.01
"""Below this a smooth change of light is not worth a word."""

OF_THE_MODEL = {
    "ambient_light", "black_level", "gamma", "channels_mixed", "channels_swapped", "specular", "lights_misfit", "other_unit",
    "skin_changed", "light_changed",
}  # fmt: skip
"""What makes normals longer or shorter than one by itself: then their length says nothing more."""

FLOODED = {"skin_changed", "new_spots", "few_bits", "compressed", "other_unit", "light_changed", "noise"}
"""What may pass for contact: then its outline and number mean nothing."""

BLOCKY = 1.18
"""Steps at the borders of 8 x 8 blocks over those inside from which an image was compressed; noise alone stays below 1.1, a
JPEG of quality 95 is at 1.2 to 1.3."""

LEAST_REST = 0.15
"""Part of the image that must follow a change of light for it to be believed."""

COPLANAR = 0.3
"""Smallest singular value of the lights' directions below which they nearly lie in one plane."""

WORTH_DEG = 0.5
"""Error of normals from which a change is a warning; from six times that it is a fault."""


def diagnose(background: Tensor | None, image: Tensor, calibration: Calibration) -> Diagnosis:
    """Name what is wrong with an image, or with the calibration it would be read by, in words and with figures.

    Every finding is a test of a hypothesis against the noise of the images; what cannot be seen from these three is not guessed.

    Args:
        background: (3, H, W), the sensor now, without contact, in [0, 1]; None if there is no such image.
        image: (3, H, W) or (1, 3, H, W) in [0, 1], the frame in question.
        calibration: what it would be read by.
    Returns:
        The findings, the worst first. An image of another size is a finding, and then the only one.
    Raises:
        ValueError, TypeError: not an RGB image, values outside [0, 1] or not finite, no calibration.
    Source:
        this project; docs/diagnose.md says what each finding means and how often it is right.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> unit = Calibration.from_lights(lights, Sensor("rig", 96, 128, 0.25))
        >>> print(diagnose(None, unit.background[[2, 1, 0]], unit).findings[0])
        fault: channels look swapped (red and blue): read the image in the order R, G, B [channels_swapped]
    """
    check_calibration("calibration", calibration)
    image = _one_image("image", image)
    given = None if background is None else _one_image("background", background)
    sensor = calibration.sensor
    for name, frame in (("image", image), ("background", given)):
        if frame is not None and tuple(frame.shape[1:]) != (sensor.height, sensor.width):
            size = f"{frame.shape[1]} x {frame.shape[2]}"
            message = (
                f"{name} is {size} pixels, the calibration is for {sensor.height} x {sensor.width}: another camera mode or sensor; "
                "rectify or resize it as at calibration"
            )
            return Diagnosis.of([Finding("wrong_size", message, "fault", frame.shape[2] / sensor.width)])
    return Diagnosis.of(_Examination(calibration, image, given).findings())


def _one_image(name: str, image: Tensor) -> Tensor:
    if isinstance(image, Tensor) and image.dim() == 4 and image.shape[0] == 1:
        image = image[0]
    check_field(name, image)
    check_range(name, image)
    return image.detach().cpu().float().clamp(0.0, 1.0)


@dataclass
class _Examination:
    """One image, its calibration, and what several tests need."""

    calibration: Calibration
    image: Tensor
    given: Tensor | None

    def __post_init__(self) -> None:
        unit = self.calibration
        self.exponent = unit.sensor.exponent
        self.light = unit.background.float().clamp(0.0, 1.0)
        self.value = self.light ** (1.0 / self.exponent)
        self.raw = self.image
        if unit.markers is not None:
            self.image = unit.markers(self.image[None])[0]
        self.levels = min(levels_of(self.raw), levels_of(self.value) if unit.measured and self.exponent == 1.0 else math.inf)
        self.rounding = 0.0 if self.levels >= 255 else 0.5 / self.levels
        self.noise = lit_noise(noise_std(self.image[None])[0].float(), self.levels)
        self.calibrated_noise = unit.noise_std.float()
        self.blocks = blockiness(self.image)
        self.dead = self._dead(self.image)
        self.reader = Reader.of(unit)
        self.coplanar = unit.lights is not None and least_spread(unit.lights) < COPLANAR

    def findings(self) -> list[Finding]:
        found = self._calibration()
        found += self._background()
        found += self._camera()
        if self._is_empty():
            message = (
                "the image shows nothing of the skin, one value everywhere: lens covered, no lamps, or no picture from the camera"
            )
            return [*found, Finding("no_picture", message, "fault", float(self.image.mean()))]
        if bool(self.dead.any()):
            lost = " and ".join(CHANNELS[j] for j in range(3) if self.dead[j])
            message = (
                f"the {lost} light is dead (its channel is black everywhere): check lamp and cable; with two lights left modes "
                "precise and auto still find a rough depth, with one none does"
            )
            return found + [Finding("light_dead", message, "fault", float(self.dead.sum()))]
        change = self._compare(self.image)
        relief_like = self._is_relief(change)
        if relief_like:
            change = dataclasses.replace(change, effect=torch.zeros(3))
        elif change.rest_share < LEAST_REST and self.levels >= 200:
            found.append(self._nothing_at_rest(change.rest_share))
            change = dataclasses.replace(change, hypothesis=SAME, numbers=torch.zeros(0), effect=torch.zeros(3))
        else:
            found += self._light(change, "image")
        light = self.image**self.exponent
        if not relief_like and change.name != "same":
            light = change.undone(light, self.light, self.calibration).clamp(0.0, 1.0)
        relief = Relief.of(light, self.reader, self.noise)
        spots = self._spots(change, relief.contact)
        found += self._skin(change, spots)
        said = {finding.name for finding in found}
        if "skin_changed" in said:  # the better word for it
            found = [finding for finding in found if finding.name != "light_changed"]
        if not said & OF_THE_MODEL:
            found += self._misfit(relief, spots.mask)
        return found + self._scene(light, relief, {finding.name for finding in found})

    # what both images say of the light

    def _dead(self, image: Tensor) -> Tensor:
        level, rest = image.flatten(1).quantile(0.99, dim=1), self.value.flatten(1).median(dim=1).values
        return (level < (4.0 * self.noise).clamp_min(0.02)) & (rest > 0.06)

    def _nothing_at_rest(self, share: float) -> Finding:
        message = "the whole skin is touched, or all light has changed: nothing to level on; leave some skin at rest in the image"
        return Finding("nothing_at_rest", message, "warning", share)

    def _is_empty(self) -> bool:
        """Whether all channels are even, where the skin at rest is not: by cells, so that noise does not matter."""
        even, rest = (cell_means(image).flatten(1).std(dim=1) for image in (self.image, self.value))
        return bool((even < 0.05 * rest).all()) and bool((rest > 0.002).all())

    def _compare(self, image: Tensor) -> Change:
        noise = torch.sqrt(self.calibrated_noise**2 + self.noise**2)
        return compare(image, self.light, noise, self.calibration, self.rounding)

    def _is_relief(self, change: Change) -> bool:
        """Whether a smooth change of all light is rather a wide contact: then its normals keep the length one."""
        unit = self.calibration
        if unit.lights is None or change.name not in ("light_field", "light_moved", "skin_changed", "pitch", "distortion"):
            return False
        compensated = (
            (unit.model_image / unit.background_without_ambient.clamp_min(1e-6)).float()
            if unit.measured
            else torch.ones_like(self.light)
        )
        light = change.predicted(self.light, unit) * compensated
        normal = (unit.inverse.float() * light[None]).sum(1)
        length, tilt = normal.norm(dim=0) - 1.0, normal[:2].norm(dim=0)
        return float(length.square().mean().sqrt()) < 0.3 * float(tilt.square().mean().sqrt())

    def _calibration(self) -> list[Finding]:
        """The calibration's own image against its own lights."""
        unit = self.calibration
        found: list[Finding] = []
        full = float((self.value > 0.99).any(0).double().mean())
        if full > 0.05:
            message = f"{full:.0%} of the calibration image is saturated: expose shorter and calibrate again"
            found.append(Finding("calibration_saturated", message, "warning", full))
        if unit.measured and unit.markers is None:
            rough = channel_structure(self.value)
            if unit.lights is None and rough > ROUGH and not unit.sensor.markers:
                found.append(self._contact_at_rest("calibration", rough))
        if unit.markers is not None:
            share = float((self.raw != self.image).any(0).double().mean())
            message = (
                f"printed markers cover {share:.0%} of the image: they are filled from around them, so no detail is seen there"
            )
            found.append(Finding("markers", message, "note", share))
        if unit.lights is None:
            return found
        if self.coplanar:
            spread = least_spread(unit.lights)
            gain = normal_noise_deg(self.reader, self.noise)
            message = (
                f"the lights stand nearly in one plane (smallest singular value of their directions {spread:.2f}, 0.8 is usual): "
                f"noise alone makes normals waver by {gain:.1f} degrees; move the lights apart"
            )
            found.append(Finding("lights_coplanar", message, "warning", spread))
        if unit.measured:
            change = compare(self._lit_value(), self._model(), self.calibrated_noise, unit, self.rounding)
            found += self._light(change, "calibration")
            if _blob(change) > 12 and change.rest_share > 0.5:
                found.append(self._contact_at_rest("calibration", float(change.departs.max())))
        return found

    def _lit_value(self) -> Tensor:
        return self.calibration.background_without_ambient.float().clamp(0.0, 1.0) ** (1.0 / self.exponent)

    def _model(self) -> Tensor:
        """The lights' own image, with the fall-off of the lens that calibration found."""
        unit = self.calibration
        model = unit.model_image.float()
        vignetting = unit.report.get("vignetting", 0.0)
        if vignetting != 0.0:
            model = model * falloff(outwardness(unit.sensor), vignetting).float()
        return model

    def _contact_at_rest(self, which: str, value: float) -> Finding:
        message = f"no clean background: contact in the {which} image; take it again with nothing touching the skin"
        return Finding(f"contact_in_{which}", message, "fault", value)

    def _background(self) -> list[Finding]:
        if self.given is None:
            return []
        unit = self.calibration
        given = self.given if unit.markers is None else unit.markers(self.given[None])[0]
        if bool(self._dead(given).any()):
            return []  # the image will say so too
        noise = noise_std(given[None])[0].float().clamp_min(QUANTISATION_STD)
        change = compare(given, self.light, torch.sqrt(self.calibrated_noise**2 + noise**2), unit, self.rounding)
        found = self._light(change, "background")
        strange = any(finding.name == "other_unit" for finding in found)
        if _blob(change) > 12 and change.rest_share > 0.3 and not strange:
            found.append(self._contact_at_rest("background", float(change.departs.max())))
        return found

    def _light(self, change: Change, which: str) -> list[Finding]:
        """A change of the light in words. ``which``: "calibration" (its image against its lights), "background" or "image"."""
        if change.name == "same":
            return []
        most = float(change.effect.max())
        cost = self._cost_deg(change, which)
        since = "than the calibration's lights say" if which == "calibration" else THAN_AT_CALIBRATION
        words = in_words(change, self.calibration, since, cost)
        by_cost = "fault" if cost >= 6.0 * WORTH_DEG else "warning" if cost >= WORTH_DEG else "note"
        severity = min(by_cost, words.least, key=SEVERITIES.index)
        if words.name == "lights_misfit" and most < 0.5 * NO_DRIFT:
            return []
        if self.calibration.response is not None and words.name != "channels_swapped":
            if most < NO_DRIFT:
                return []
            if most < USUAL_DRIFT:
                severity = "note"
            elif severity == "note":
                severity = "warning"
        says = {"calibration": "at calibration already: ", "background": "the background shows: "}.get(which, "")
        return [Finding(words.name, says + words.text, severity, words.value)]

    def _cost_deg(self, change: Change, which: str) -> float:
        """Mean angle between the image's normals as they are and as they would be without the change; nan if that is not known."""
        unit, image = self.calibration, self.image[None]
        other = unit
        mended = self.image**self.exponent
        at_rest = which != "calibration"
        if change.name == "light_moved" and unit.lights is not None:
            j, numbers = change.hypothesis.channels[0], change.numbers
            position, albedo = unit.lights.position_mm.detach().clone(), unit.lights.albedo.detach().clone()
            reach = float(position.norm(dim=1).mean())
            position[j, :2] += reach * numbers[:2].to(position.dtype)
            position[j, 2] *= float(numbers[2].exp())
            background = change.predicted(unit.background, unit) if at_rest else unit.background
            lights = PointLights(position, albedo, unit.lights.gloss).requires_grad_(False)
            other = dataclasses.replace(unit, lights=lights, background=background)
        elif change.name in ("pitch", "distortion", "gloss", "vignetting") or (change.name == "light_field" and not at_rest):
            return math.nan if change.name != "vignetting" else 0.0
        else:
            mended = change.undone(mended, self.light, unit).clamp(0.0, 1.0)
            if not at_rest:
                background = change.undone(unit.background, unit.model_image, unit).clamp(1e-4, 1.0)
                other = dataclasses.replace(unit, background=background)
        reader = self.reader if other is unit else Reader.of(other)
        normal = reader.normal(mended[None] ** (1.0 / self.exponent))
        angle = angle_deg(self.reader.normal(image), normal)
        tilted = normal[0, 2] < math.cos(math.radians(3.0))
        angle = torch.where(torch.isfinite(angle), angle, 0.0)
        return max(float(angle.mean()), float(angle[tilted].mean()) if float(tilted.double().mean()) > 0.01 else 0.0)

    # what the camera did

    def _camera(self) -> list[Finding]:
        unit = self.calibration
        found: list[Finding] = []
        if self.levels < 200:
            bits = round(math.log2(self.levels + 1))
            which = "image" if levels_of(self.raw) == self.levels else "calibration's image"
            cost = normal_noise_deg(self.reader, torch.full((3,), 1.0 / self.levels / math.sqrt(12.0)))
            message = (
                f"the {which} has {bits} bits only: rounding makes normals waver by {cost:.1f} degrees; read the camera with 8 "
                "bits or more"
            )
            found.append(Finding("few_bits", message, _by_cost(cost), float(bits)))
        steps = max(self.blocks, blockiness(self.value) if unit.measured else 1.0)
        if self.levels >= 200 and steps > BLOCKY:
            which = "image" if self.blocks > BLOCKY else "calibration's image"
            message = (
                f"the {which} was compressed: steps at the borders of 8 x 8 blocks are {steps:.1f} times "
                "those inside; take uncompressed images, or a JPEG quality of 95 and more"
            )
            found.append(Finding("compressed", message, "warning", steps))
        ratio = float((self.noise / self.calibrated_noise).max())
        cost = normal_noise_deg(self.reader, self.noise)
        if self.levels >= 200 and not bool(self.dead.any()):
            if ratio > 3.0 and cost > WORTH_DEG:
                message = (
                    f"noise is {ratio:.1f} times that at calibration and makes normals waver by {cost:.1f} degrees: more light, "
                    "less gain, or average frames"
                )
                found.append(Finding("noise", message, _by_cost(0.5 * cost), ratio))
            elif cost > 3.0 * WORTH_DEG and not self.coplanar:
                level = float(self.noise.max())
                message = (
                    f"noise of {level:.3f} makes normals waver by {cost:.1f} degrees, at calibration too: more light, less gain, "
                    "or average frames"
                )
                found.append(Finding("noise", message, "warning", level))
        return found

    # what lies on the skin

    def _expected(self, change: Change) -> Tensor:
        return change.predicted(self.light, self.calibration).clamp(0.0, 1.0) ** (1.0 / self.exponent)

    def _spots(self, change: Change, contact: Tensor) -> Spots:
        unit = self.calibration
        # where lights stand together a slope, too, takes light from all
        if not unit.measured or unit.markers is not None or self.coplanar or self.blocks > BLOCKY:
            return Spots(0, 0, 0, torch.zeros_like(contact))
        noise = torch.sqrt(self.noise**2 + self.calibrated_noise**2)
        return new_spots(self.image, self._expected(change), noise, max(6, min(self.image.shape[1:]) // 10), contact)

    def _skin(self, change: Change, spots: Spots) -> list[Finding]:
        found: list[Finding] = []
        if not self.calibration.measured:
            return found
        if spots.pixels >= 3:
            dead = f", {spots.dead} dead pixels among them" if spots.dead else ""
            share = spots.pixels / spots.mask.numel()
            message = (
                f"{spots.number} spots that were not there at calibration ({share:.1%} of the image{dead}): clean the skin, or "
                "recalibrate"
            )
            found.append(Finding("new_spots", message, "warning" if spots.number >= 3 else "note", float(spots.number)))
        worn = self._worn(change)
        if worn > 0.0:
            message = (
                f"the skin's brightness has changed by {worn:.1%} (RMS), unevenly and in all channels nearly alike: worn, stained "
                "or dirty; clean it, or recalibrate"
            )
            found.append(Finding("skin_changed", message, "warning", worn))
        follows = torch.nn.functional.interpolate(change.follows[None, None].float(), size=self.image.shape[1:])[0, 0] > 0.5
        follows = follows & ~(self.raw > 0.98).any(0)
        left, error = texture_share(self.image, self._expected(change), self.calibrated_noise, follows)
        if self.levels >= 200 and error < 0.05 and left < 0.6:
            message = (
                f"the image is blurred or moved: only {left:.0%} of the skin's fine texture is left; focus, clean the lens, mount "
                "the camera firmly"
            )
            found.append(Finding("blurred", message, "warning", left))
        return found

    def _worn(self, change: Change) -> float:
        """RMS of an uneven change of brightness that the channels share, if they share most of it and it is no noise; else 0.

        A lamp changes one channel; a slope takes light from one and gives it to another; what lies on the skin takes it from all.
        Medians over cells stand for RMS, so a contact does not count.
        """
        if change.name == "vignetting":
            return 0.0
        cells, rest = cell_means(self.image), cell_means(self.value)
        usable = ((cells > 0.03) & (cells < FULL) & (rest > 0.03)).all(0)
        if float(usable.double().mean()) < 0.3:
            return 0.0
        log = self.exponent * (cells / rest).log()[:, usable]
        log = log - log.median(dim=1, keepdim=True).values
        shared = log.mean(0)
        own = (log - shared).abs().median() / 0.6745
        side = self.image.shape[1] // cells.shape[1]
        noise = torch.sqrt(self.noise**2 + self.calibrated_noise**2).double() / side
        sigma = self.exponent * torch.sqrt(noise**2 + self.rounding**2) / rest[:, usable].mean(1)
        level = float(shared.abs().median() / 0.6745)
        own_beyond_noise = math.sqrt(max(0.0, float(own) ** 2 - float(sigma.square().mean())))
        return level if level > max(0.006, 3.0 * float(sigma.mean())) and level > 1.8 * own_beyond_noise else 0.0

    # what the frame shows

    def _scene(self, light: Tensor, relief: Relief, names: set[str]) -> list[Finding]:
        sensor = self.calibration.sensor
        found: list[Finding] = []
        outlined = not names & FLOODED
        contact = relief.contact
        least = max(4, int((0.02 * min(sensor.height, sensor.width)) ** 2))
        found_regions = regions(contact, least)
        clipped = (self.raw > 0.99).any(0)
        touched = contact if bool(contact.any()) else torch.ones_like(contact)
        full = float(clipped[touched].double().mean())
        anywhere = float(clipped.double().mean())
        if full > 0.01 or anywhere > 0.02:
            where = f"{full:.0%} of the contact" if full > 0.01 and bool(contact.any()) else f"{anywhere:.0%} of the image"
            severity = "fault" if full > 0.3 else "warning"
            found.append(Finding("saturated", f"the image is saturated in {where}: expose shorter", severity, max(full, anywhere)))
        if found_regions.count == 0:
            found.append(Finding("no_contact", "no contact: nothing stands out of the noise", "note", 0.0))
            return found
        depth = relief.output.depth_mm[0, 0]
        top = float(torch.where(contact, depth, 0.0).max())
        share = found_regions.share
        if share > 0.4 and outlined:
            message = (
                f"contact covers {share:.0%} of the image: little skin at rest is left to level on, and depth beyond the border "
                "is not seen"
            )
            found.append(Finding("contact_covers_image", message, "note", share))
        if share > 0.97 and outlined:
            found.append(self._nothing_at_rest(1.0 - share))
        if found_regions.at_border and outlined:
            message = "the contact reaches the image border: what lies beyond is not seen, and depth there is less certain"
            found.append(Finding("contact_at_border", message, "note", share))
        noise_mm = sensor.mm_per_pixel * math.radians(normal_noise_deg(self.reader, self.noise))
        summits = peaks(depth, contact, noise_mm)
        count = max(found_regions.count, summits)
        if count > 1 and outlined:
            found.append(Finding("several_contacts", f"{count} contacts, or summits of one", "note", float(count)))
        if top < sensor.mm_per_pixel:
            message = f"faint contact: {top:.3f} mm at its deepest, less than a pixel; its rim is lost in noise"
            found.append(Finding("faint_contact", message, "note", top))
        steep = float(torch.where(contact, relief.steepness, 0.0).flatten().quantile(1.0 - 0.02 * share))
        if steep > 1.3:
            angle = math.degrees(math.atan(steep))
            message = (
                f"walls of {angle:.0f} degrees: a light may be blocked there, and integration cannot hold a cliff; use precise "
                "mode, trust the top only"
            )
            found.append(Finding("steep_walls", message, "note", angle))
        dark = float((relief.dark.any(1)[0] & contact).double().sum() / contact.double().sum().clamp_min(1))
        if dark > 0.01:
            message = (
                f"a light is blocked in {dark:.0%} of the contact: slopes there rest on two lights and a guess; press less, or "
                "raise the lights"
            )
            found.append(Finding("shadow", message, "warning" if dark > 0.3 else "note", dark))
        cast = cast_shadow_share(relief, self.noise)
        if cast > 0.002:
            cure = "fast mode reads it as a slope; use precise mode, or raise the lights"
            if self.calibration.lights is None:
                cure = "it will be read as a slope; raise the lights"
            message = f"a shadow falls on {cast:.1%} of the image, on skin that is flat: {cure}"
            found.append(Finding("cast_shadow", message, "warning", cast))
        skirt = skirt_mm(relief)
        sharp = outlined and not names & {"blurred", "moved", "shadow"}
        if sharp and skirt > max(3.0, 2.0 * sensor.blur_px + 2.0) * sensor.mm_per_pixel:
            message = (
                f"the skin slopes down over {skirt:.1f} mm around the contact: the gel sags, or the object is round there; "
                "contact is smaller than the mask"
            )
            found.append(Finding("skirt", message, "note", skirt))
        found += self._depth_of_press(light, relief, top) + self._perspective(relief)
        return found

    def _depth_of_press(self, light: Tensor, relief: Relief, top: float) -> list[Finding]:
        unit = self.calibration
        if unit.lights is None:
            return []
        value = light[None].to(unit.background.dtype) ** (1.0 / self.exponent)
        fast = self.reader.output(value, "fast").depth_mm
        off_px = float((fast - relief.output.depth_mm).abs().max()) / unit.sensor.mm_per_pixel
        if off_px < 0.5:
            return []
        message = f"deep press ({top:.1f} mm): fast mode is off by {off_px:.1f} px; use precise or auto"
        return [Finding("deep_press", message, "note", off_px)]

    def _perspective(self, relief: Relief) -> list[Finding]:
        """What a near camera does to the depth, where the calibration tells its height: no image shows it."""
        height, pitch = self.calibration.report.get("camera_height_mm"), self.calibration.sensor.mm_per_pixel
        if isinstance(height, bool) or not isinstance(height, int | float) or not 0 < height < math.inf:
            return []
        seen = integrate_perspective(relief.output.gradient, pitch, float(height))
        off_px = float((seen - relief.output.depth_mm).abs().max()) / pitch
        if off_px < 0.1:
            return []
        message = (
            f"the camera stands {height:.0f} mm above the skin: read as if it looked straight down, depth is off by "
            f"{off_px:.1f} px; use PerspectiveIntegration"
        )
        return [Finding("perspective", message, "warning" if off_px > 0.5 else "note", off_px)]

    def _misfit(self, relief: Relief, spots: Tensor) -> list[Finding]:
        if self.levels < 200 or self.blocks > BLOCKY:  # these break the length everywhere
            return []
        unsound = spots | (self.raw > 0.98).any(0)
        if self.calibration.markers is not None:
            unsound = unsound | (self.raw != self.image).any(0)
        misfit = length_misfit(relief, unsound)
        if misfit is None:
            return []
        if misfit.longer > 0.03 and misfit.mean > 0.003:
            message = (
                f"{misfit.longer:.0%} of the contact is brighter in all than any matt slope: the skin shines (specular); a matt "
                "coating, or softer light"
            )
            return [Finding("specular", message, "warning", misfit.longer)]
        best = max(misfit.sigmas, key=lambda name: misfit.sigmas[name])
        sigmas, amount = misfit.sigmas[best], misfit.amount[best]
        if sigmas < 20.0 or amount < 0.05:
            return []
        sharp = misfit.sigmas["blur 1.5"] > 0.85 * sigmas  # narrow mixing, such as colours at half resolution, is no bounced light
        if best.startswith("bounce") and not sharp:
            message = (
                f"slopes look washed out, as when roughly {amount:.0%} of the light comes by way of other skin "
                "(inter-reflection) or from around: darker gel or coating"
            )
            return [Finding("inter_reflection", message, "warning", amount)]
        if int(spots.sum()) >= 3:
            return []
        if best.startswith("move"):
            message = "the image is moved: rims are mixed along one direction; shorter exposure, or slower motion"
            return [Finding("moved", message, "warning", sigmas)]
        message = "the image is blurred: rims are mixed with what is beside them; focus the camera, take colours at full resolution"
        return [Finding("blurred", message, "warning", sigmas)]


def _by_cost(cost: float) -> str:
    return "fault" if cost >= 12.0 * WORTH_DEG else "warning" if cost >= WORTH_DEG else "note"


def _blob(change: Change) -> int:
    """Cells of the largest part that departs by 3 % and more, specks removed."""
    import cv2

    far = (change.departs > 0.03).numpy().astype(np.uint8)
    opened = cv2.morphologyEx(far, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    return int(stats[1:, cv2.CC_STAT_AREA].max(initial=0))
