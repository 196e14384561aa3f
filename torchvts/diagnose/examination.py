"""What several checks need of an image and its calibration, each measured once and only when a check asks for it."""

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from ..calibration import ROUGH, channel_structure
from ..core.checks import QUANTISATION_STD
from ..core.geometry import angles_deg, lengths
from ..core.noise import noise_std
from ..model import Calibration, PointLights
from ..stream import FrameCheck
from .camera import Spots, blockiness, levels_of, new_spots
from .hypotheses import SAME, moved_position
from .light_change import SATURATED, Change, cell_means, compare
from .surface import (
    Blocks,
    LengthError,
    Regions,
    Surface,
    fit_length_error,
    least_spread,
    noise_with_rounding,
    normal_noise_deg,
    regions,
)

COPLANAR = 0.3
"""Smallest singular value of the lights' directions below which they nearly lie in one plane."""

BLOCKY = 1.18
"""Ratio of steps at the borders of 8 x 8 blocks to those inside above which an image was compressed; noise alone stays below 1.1,
a JPEG of quality 95 has 1.2 to 1.3."""

LEAST_FREE = 0.15
"""Share of the image that must follow a change of light for the change to be believed."""


@dataclass
class Examination:
    """One image, its calibration, and what is measured of them.

    Attributes:
        calibration: of the unit.
        raw: (3, H, W), the image.
        given: (3, H, W), an image without contact of now, or None.
    """

    calibration: Calibration
    raw: Tensor
    given: Tensor | None

    def __post_init__(self) -> None:
        unit = self.calibration
        self.exponent = unit.sensor.exponent
        self.light = unit.background.float().clamp(0.0, 1.0)
        self.value = self.light ** (1.0 / self.exponent)
        self.image = self.without_markers(self.raw)
        self.levels = min(levels_of(self.raw), levels_of(self.value) if unit.measured and self.exponent == 1.0 else math.inf)
        self.rounding = 0.0 if self.levels >= 255 else 0.5 / self.levels
        self.noise = noise_with_rounding(noise_std(self.image[None])[0].float(), self.levels)
        self.calibrated_noise = unit.noise_std.float()
        self.blocks = Blocks.of(unit)

    def without_markers(self, image: Tensor) -> Tensor:
        """The image (3, H, W) with printed markers filled."""
        return image if self.calibration.markers is None else self.calibration.markers(image[None])[0]

    # ---- the camera ----

    @property
    def is_fine(self) -> bool:
        """Whether the image has nearly 8 bits or more."""
        return self.levels >= 200

    @cached_property
    def steps(self) -> float:
        """Steps at the borders of the image's 8 x 8 blocks over those inside."""
        return blockiness(self.image)

    @cached_property
    def noise_deg(self) -> float:
        """Effect of the image's noise on normals, degrees."""
        return normal_noise_deg(self.blocks, self.noise)

    @cached_property
    def clipped(self) -> Tensor:
        """(H, W) bool, pixels with a saturated channel."""
        return (self.raw > 0.99).any(0)

    # ---- the light ----

    @cached_property
    def spread(self) -> float:
        """Smallest singular value of the lights' directions; infinite without lights."""
        return math.inf if self.calibration.lights is None else least_spread(self.calibration.lights)

    def black_channels(self, image: Tensor) -> Tensor:
        """(3,) bool, channels that are black everywhere and were not at calibration."""
        level, background = image.flatten(1).quantile(0.99, dim=1), self.value.flatten(1).median(dim=1).values
        return (level < (4.0 * self.noise).clamp_min(0.02)) & (background > 0.06)

    @cached_property
    def is_empty(self) -> bool:
        """Whether all channels are even, where the background is not: by cells, so that noise does not matter."""
        even, usual = (cell_means(image).flatten(1).std(dim=1) for image in (self.image, self.value))
        return bool((even < 0.05 * usual).all()) and bool((usual > 0.002).all())

    @cached_property
    def other_view(self) -> str:
        """In which way the image is cropped or turned otherwise than the calibration's, or ""."""
        check = FrameCheck.from_calibration(self.calibration)
        return "" if check is None else check.other_view(self.raw[None])

    def compare(self, image: Tensor, noise: Tensor) -> Change:
        """The change from the calibration's background to an image (3, H, W) with noise (3,)."""
        noise = torch.sqrt(self.calibrated_noise**2 + noise**2)
        return compare(image, self.light, noise, self.calibration, self.rounding)

    @cached_property
    def calibration_change(self) -> Change | None:
        """The change from the lights' own image to the background; None where the calibration has only one of them."""
        unit = self.calibration
        if unit.lights is None or not unit.measured:
            return None
        model = unit.model_image.float()
        lit = unit.background_without_ambient.float().clamp(0.0, 1.0) ** (1.0 / self.exponent)
        return compare(lit, model, self.calibrated_noise, unit, self.rounding)

    @cached_property
    def background_change(self) -> Change | None:
        """The change from the calibration's background to the given one."""
        if self.given is None:
            return None
        given = self.without_markers(self.given)
        if bool(self.black_channels(given).any()):
            return None  # the image will show it too
        return self.compare(given, noise_std(given[None])[0].float().clamp_min(QUANTISATION_STD))

    @cached_property
    def _found_change(self) -> Change:
        return self.compare(self.image, self.noise)

    @cached_property
    def is_wide_contact(self) -> bool:
        """Whether a smooth change of all light is rather a wide contact: then its normals keep the length one."""
        unit, change = self.calibration, self._found_change
        if unit.lights is None or change.name not in ("light_field", "light_moved", "skin_changed", "pitch", "distortion"):
            return False
        light = change.predicted(self.light, unit)
        if unit.measured:
            light = light * (unit.model_image / unit.background_without_ambient.clamp_min(1e-6)).float()
        normal = (unit.inverse.float() * light[None]).sum(1)
        length, tilt = lengths(normal, 0) - 1.0, lengths(normal[:2], 0)
        return float(length.square().mean().sqrt()) < 0.3 * float(tilt.square().mean().sqrt())

    @cached_property
    def free_share(self) -> float | None:
        """Share of the skin that follows the change of light, where it is too small for the change to be believed; else None."""
        share = self._found_change.free_share
        return share if not self.is_wide_contact and share < LEAST_FREE and self.is_fine else None

    @cached_property
    def change(self) -> Change:
        """The change from the calibration's background to the image."""
        change = self._found_change
        if self.is_wide_contact:
            return dataclasses.replace(change, effect=torch.zeros(3))
        if self.free_share is not None:
            return dataclasses.replace(change, hypothesis=SAME, parameters=torch.zeros(0), effect=torch.zeros(3))
        return change

    @cached_property
    def expected(self) -> Tensor:
        """(3, H, W), value of the background after the change of light."""
        return self.change.predicted(self.light, self.calibration).clamp(0.0, 1.0) ** (1.0 / self.exponent)

    def cost_deg(self, change: Change, of_calibration: bool) -> float:
        """Mean angle between the image's normals with and without the change; nan where it is not known."""
        unit, image = self.calibration, self.image[None]
        other = unit
        mended = self.image**self.exponent
        if change.name == "light_moved" and unit.lights is not None:
            position = moved_position(unit.lights.position_mm.detach(), change.hypothesis.channels[0], change.parameters)
            lights = PointLights(position, unit.lights.albedo.detach().clone(), unit.lights.gloss).requires_grad_(False)
            background = unit.background if of_calibration else change.predicted(unit.background, unit)
            other = dataclasses.replace(unit, lights=lights, background=background)
        elif change.name == "vignetting":
            return 0.0
        elif change.name in ("pitch", "distortion", "gloss") or (change.name == "light_field" and of_calibration):
            return math.nan
        else:
            mended = change.undone(mended, self.light, unit).clamp(0.0, 1.0)
            if of_calibration:
                background = change.undone(unit.background, unit.model_image, unit).clamp(1e-4, 1.0)
                other = dataclasses.replace(unit, background=background)
        blocks = self.blocks if other is unit else Blocks.of(other)
        normal = blocks.normal(mended[None] ** (1.0 / self.exponent))
        angle = angles_deg(self.blocks.normal(image), normal)[0]
        tilted = normal[0, 2] < math.cos(math.radians(3.0))
        angle = torch.where(torch.isfinite(angle), angle, 0.0)
        return max(float(angle.mean()), float(angle[tilted].mean()) if float(tilted.double().mean()) > 0.01 else 0.0)

    # ---- the skin ----

    @cached_property
    def structure(self) -> float:
        """Structure between the channels of the background, as a contact has it, where no light model could show it; else 0."""
        unit = self.calibration
        if not unit.measured or unit.markers is not None or unit.lights is not None or unit.sensor.markers:
            return 0.0
        structure = channel_structure(self.value)
        return structure if structure > ROUGH else 0.0

    @cached_property
    def spots(self) -> Spots:
        """Spots that were not there at calibration."""
        unit, contact = self.calibration, self.surface.contact
        # where lights stand close together a slope, too, takes light from all channels
        if not unit.measured or unit.markers is not None or self.spread < COPLANAR or self.steps > BLOCKY:
            return Spots(0, 0, 0, torch.zeros_like(contact))
        noise = torch.sqrt(self.noise**2 + self.calibrated_noise**2)
        return new_spots(self.image, self.expected, noise, max(6, min(self.image.shape[1:]) // 10), contact)

    @cached_property
    def free_skin(self) -> Tensor:
        """(H, W) bool, pixels that follow the change of light and are not saturated."""
        follows = nn.functional.interpolate(self.change.follows[None, None].float(), size=self.image.shape[1:])[0, 0] > 0.5
        return follows & ~(self.raw > 0.98).any(0)

    @cached_property
    def wear(self) -> float:
        """RMS of an uneven change of brightness that the channels share, if they share most of it and it is not noise; else 0.

        An LED changes one channel; a slope takes light from one channel and gives it to another; dirt takes it from all. Medians
        over cells are used for the RMS, so that a contact does not count.
        """
        if not self.calibration.measured or self.change.name == "vignetting":
            return 0.0
        cells, background = cell_means(self.image), cell_means(self.value)
        usable = ((cells > 0.03) & (cells < SATURATED) & (background > 0.03)).all(0)
        if float(usable.double().mean()) < 0.3:
            return 0.0
        log = self.exponent * (cells / background).log()[:, usable]
        log = log - log.median(dim=1, keepdim=True).values
        shared = log.mean(0)
        own = (log - shared).abs().median() / 0.6745
        noise = torch.sqrt(self.noise**2 + self.calibrated_noise**2).double() / (self.image.shape[1] // cells.shape[1])
        sigma = self.exponent * torch.sqrt(noise**2 + self.rounding**2) / background[:, usable].mean(1)
        level = float(shared.abs().median() / 0.6745)
        own_beyond_noise = math.sqrt(max(0.0, float(own) ** 2 - float(sigma.square().mean())))
        return level if level > max(0.006, 3.0 * float(sigma.mean())) and level > 1.8 * own_beyond_noise else 0.0

    # ---- the surface ----

    @cached_property
    def mended_light(self) -> Tensor:
        """(3, H, W), linear light of the image without the change of light."""
        light = self.image**self.exponent
        if self.is_wide_contact or self.change.name == "same":
            return light
        return self.change.undone(light, self.light, self.calibration).clamp(0.0, 1.0)

    @cached_property
    def surface(self) -> Surface:
        """The frame after the pipeline."""
        return Surface.of(self.mended_light, self.blocks, self.noise)

    @cached_property
    def length(self) -> LengthError | None:
        """Error of the normals' length; None where it is not known, or where rounding or compression spoils it everywhere."""
        if not self.is_fine or self.steps > BLOCKY:
            return None
        invalid = self.spots.mask | (self.raw > 0.98).any(0)
        if self.calibration.markers is not None:
            invalid = invalid | (self.raw != self.image).any(0)
        return fit_length_error(self.surface, invalid)

    @cached_property
    def contacts(self) -> Regions:
        """The contacts of the frame."""
        sensor = self.calibration.sensor
        return regions(self.surface.contact, max(4, int((0.02 * min(sensor.height, sensor.width)) ** 2)))

    @cached_property
    def deepest_mm(self) -> float:
        """Largest depth in a contact."""
        return float(torch.where(self.surface.contact, self.surface.output.depth_mm[0, 0], 0.0).max())


def largest_residual(change: Change) -> int:
    """Number of cells of the largest part that differs by 3 % and more, specks removed."""
    import cv2

    far = (change.residual > 0.03).numpy().astype(np.uint8)
    opened = cv2.morphologyEx(far, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    return int(stats[1:, cv2.CC_STAT_AREA].max(initial=0))
