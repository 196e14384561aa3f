"""What several checks need of an image and its calibration, each measured once and only when a check asks for it."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from ..compensate import Relight
from ..core.cells import whole_cell_means
from ..core.checks import QUANTISATION_STD
from ..core.frame import Conditions, DepthOutput, Frame
from ..core.geometry import angles_deg, lengths, normal_from_gradient
from ..core.levels import BRIGHT, DARKEST, LIT
from ..core.noise import noise_std
from ..model import Calibration
from ..model.lights import inverse_light_matrix
from ..model.usable import Flaw, FrameCheck
from ..pipeline import DepthPipeline
from ..skin import DotMotion, motion_of_unit
from ..skin.weight import WEIGHT_CELLS, spread_of
from .camera import levels_of

MISFITS = 0.05
"""Share of a contact in which the length of the normals may be off by three standard deviations; without a cause it is 0.003."""

LEAST_GREY, GREY_OVER_COLOUR = 0.006, 1.8
"""Least change of brightness of free skin that is reported, relative, and how many times that of its colour it must be."""


@dataclass
class Examination:
    """One image (3, H, W), its calibration, an image without contact of now if there is one, and what is measured of them."""

    unit: Calibration
    raw: Tensor
    given: Tensor | None

    def __post_init__(self) -> None:
        unit = self.unit
        self.exponent = unit.sensor.exponent
        self.value = self.value_of(unit.background)
        self.image = self.without_markers(self.raw)
        self.levels = min(levels_of(self.raw), levels_of(self.value) if unit.measured and self.exponent == 1.0 else math.inf)
        least = 0.0 if math.isinf(self.levels) else 1.0 / self.levels / math.sqrt(12.0)
        self.noise = noise_std(self.image[None])[0].float().clamp_min(max(QUANTISATION_STD, least))
        self.expected_noise = torch.sqrt(self.noise**2 + unit.noise_std.float() ** 2)

    def value_of(self, light: Tensor) -> Tensor:
        """The image value of linear light."""
        return light.float().clamp(0.0, 1.0) ** (1.0 / self.exponent)

    def without_markers(self, image: Tensor) -> Tensor:
        """The image (3, H, W) with printed markers filled."""
        return image if self.unit.markers is None else self.unit.markers(image[None])[0]

    # ---- the pipeline ----

    @cached_property
    def pipeline(self) -> DepthPipeline:
        """The pipeline of the unit."""
        return DepthPipeline.from_calibration(self.unit, "precise").eval()

    def read(self, value: Tensor) -> tuple[Frame, Tensor]:
        """The frame of an image (3, H, W), compensated and weighted, and its slopes (1, 2, H, W) before they are weighted."""
        with torch.no_grad():
            frame, slopes = self.pipeline.frame_of(value[None].to(self.unit.background.dtype))
        return frame, slopes.double()

    @cached_property
    def frame_and_slopes(self) -> tuple[Frame, Tensor]:
        """Those of the image."""
        return self.read(self.raw)

    @property
    def frame(self) -> Frame:
        """The frame that the pipeline makes of the image."""
        return self.frame_and_slopes[0]

    @cached_property
    def output(self) -> DepthOutput:
        """What the pipeline gives for the image."""
        with torch.no_grad():
            result: DepthOutput = self.pipeline(self.raw[None].to(self.unit.background.dtype))
        return result

    @cached_property
    def motion(self) -> DotMotion | None:
        """Of the skin's printed dots; None where there are none."""
        follow = motion_of_unit(self.unit)
        with torch.no_grad():
            return None if follow is None else follow(self.raw[None].float(), self.output.depth_mm.float())

    @cached_property
    def moved(self) -> Tensor:
        """(H, W) bool, where the skin has moved."""
        return self.output.deformed[0, 0]

    @cached_property
    def free(self) -> Tensor:
        """(H, W) bool, skin on which the pipeline sees no movement, neither dark nor clipped."""
        usable = (self.image > DARKEST).all(0) & (self.image < BRIGHT).all(0)
        return (self.frame.weight[0, 0] <= 0.0) & usable

    @cached_property
    def free_deg(self) -> float:
        """Spread of the slopes that the pipeline reads, before it takes them to be none, where the skin has changed least."""
        cells = whole_cell_means(self.frame_and_slopes[1], max(1, min(self.image.shape[1:]) // WEIGHT_CELLS))
        return math.degrees(math.atan(float(spread_of(cells.abs().flatten(2), 1e-9).max())))

    # ---- the camera ----

    @property
    def is_fine(self) -> bool:
        """Whether the image has nearly 8 bits or more."""
        return self.levels >= 200

    @cached_property
    def noise_deg(self) -> float:
        """Effect of the image's noise on normals, degrees."""
        return self.degrees_of(self.noise)

    def degrees_of(self, std: Tensor) -> float:
        """Median angle by which noise (3,) of the image value changes the normal of undeformed skin."""
        noise = torch.randn(self.value.shape, generator=torch.Generator().manual_seed(0))
        noisy = (self.value + noise * std.reshape(3, 1, 1)).clamp(0.0, 1.0)
        normals = (normal_from_gradient(self.read(value)[1]) for value in (self.value, noisy))
        return float(angles_deg(*normals)[0].nan_to_num(0.0).median())

    @cached_property
    def check(self) -> FrameCheck:
        """Compares images with the background."""
        return FrameCheck(self.value)

    @cached_property
    def flaw(self) -> Flaw | None:
        """Why the image cannot be used."""
        return self.check.flaw(self.raw[None])

    @cached_property
    def flaw_of_given(self) -> Flaw | None:
        """Why the image without contact cannot be used."""
        return None if self.given is None else self.check.flaw(self.given[None])

    def failed_in(self, image: Tensor) -> list[int]:
        """Channels that are black everywhere in an image (3, H, W), and were not at calibration."""
        level, background = image.flatten(1).quantile(0.99, dim=1), self.value.flatten(1).median(dim=1).values
        return [j for j in range(3) if level[j] < max(DARKEST, 4.0 * float(self.noise[j])) and background[j] > LIT]

    # ---- the light ----

    @cached_property
    def conditions(self) -> Conditions:
        """What the image was seen under."""
        return self.conditions_of(self.raw)

    def conditions_of(self, value: Tensor) -> Conditions:
        """The same of an image (3, H, W)."""
        with torch.no_grad():
            return self.pipeline.conditions(value[None].to(self.unit.background.dtype))

    @cached_property
    def calibration_light(self) -> Conditions | None:
        """The light of the background over that of the lights' own image; None where the calibration has only one of them."""
        unit = self.unit
        if unit.lights is None or not unit.measured:
            return None
        with torch.no_grad():
            block = Relight(unit.model_image, self.exponent, unit.saturation_light)
            light = block.terms(unit.background_without_ambient[None])
        return None if light is None else Conditions(light, torch.zeros(1, 3), torch.zeros(1))

    @cached_property
    def grey_change(self) -> float:
        """RMS of an uneven change of brightness of free skin that the channels share, if they share most of it; else 0.

        An LED changes one channel; a slope takes light from one channel and gives it to another; dirt takes it from all.
        """
        side = max(1, min(self.image.shape[1:]) // WEIGHT_CELLS)
        with torch.no_grad():
            light = self.pipeline.compensate(self.raw[None].to(self.unit.background.dtype)) / self.unit.flat.clamp_min(1e-6)
        free = whole_cell_means(self.free[None, None].double(), side)[0, 0] > 0.5
        log = whole_cell_means(light.double(), side)[0].clamp_min(1e-3).log()[:, free]
        if log.shape[1] < 100 or not self.unit.measured:
            return 0.0
        log = log - log.median(dim=1, keepdim=True).values
        shared = log.mean(0)
        noise = self.exponent * self.expected_noise.double() / self.value.flatten(1).double().mean(1).clamp_min(0.02) / side
        own = max(0.0, float((log - shared).abs().median() / 0.6745) ** 2 - float(noise.square().mean())) ** 0.5
        level = float(shared.abs().median() / 0.6745)
        return level if level > max(LEAST_GREY, 3.0 * float(noise.mean())) and level > GREY_OVER_COLOUR * own else 0.0

    # ---- the surface ----

    @cached_property
    def dark(self) -> Tensor:
        """(3, H, W) bool, channels without light where the background has some."""
        black = (3.0 * self.noise.reshape(3, 1, 1)).clamp_min(1.5 / 255.0)
        return (self.image < black) & (self.value > 4.0 * black)

    @cached_property
    def length_error(self) -> Tensor | None:
        """The error of the normals' length in standard deviations, (N,), where skin has moved, or anywhere; None: not known.

        Three lights over-determine a slope by one value: the normal that the light matrix gives must have length one. Gloss
        makes it longer; light from elsewhere, by blur or other skin, shorter.
        """
        unit = self.unit
        if unit.lights is None or not self.is_fine:
            return None
        lights, pitch = unit.lights, unit.sensor.mm_per_pixel
        inverse = inverse_light_matrix(self.output.depth_mm, lights.position_mm, lights.albedo, pitch)[0]
        normal = (inverse * self.frame.image).sum(1)
        length = lengths(normal, 0)
        share = ((normal / length)[:, None] * inverse).sum(0)  # derivative of the length by each channel
        ratio = (self.noise / unit.noise_std.float()).clamp_min(1.0).reshape(3, 1, 1)
        noise = lengths(share * unit.compensated_noise_std * ratio, 0)
        usable = ~self.dark.any(0) & (self.raw < BRIGHT).all(0) & (self.raw == self.image).all(0)
        inside = usable & self.moved if bool(self.moved.any()) else usable
        return ((length - 1.0) / noise)[inside] if int(inside.sum()) >= 20 else None
