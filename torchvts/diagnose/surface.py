"""A frame's surface and its normals: contacts, steepness, shadows, and where the light does not fit any surface.

Three lights over-determine a slope by one value: the normal that the light matrix gives must have length one. Gloss makes it
longer; inter-reflection and mixed pixels (blur) make it shorter, each at places of its own.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from ..compensate import Compensate, SmoothDrift
from ..core.blur import blur, gaussian_weights
from ..core.checks import QUANTISATION_STD
from ..core.geometry import GradientFromNormal, angles_deg, lengths
from ..integration import PoissonDCT
from ..model import Calibration, PointLights
from ..model.lights import inverse_light_matrix
from ..normals import NormalFromIntensity, NormalFromResponse
from ..pipeline import DepthOutput, DepthPipeline
from ..skin import ContactMask

SPREADS_PX = (1.5, 3.0, 6.0)
"""Blurs that the normals are compared with, in pixels of a 160 x 120 image and in proportion for others."""


@dataclass(frozen=True)
class Blocks:
    """The blocks that turn a unit's images into normals, made once: finding the defects of a background takes longest."""

    calibration: Calibration
    compensate: nn.Module
    normals: nn.Module

    @classmethod
    def of(cls, calibration: Calibration) -> "Blocks":
        """The blocks of a unit."""
        block = NormalFromIntensity if calibration.lights is not None else NormalFromResponse
        return cls(calibration, Compensate.from_calibration(calibration).eval(), block.from_calibration(calibration).eval())

    def normal(self, image: Tensor) -> Tensor:
        """Unit normals (1, 3, H, W) of an image, float64."""
        with torch.no_grad():
            found: Tensor = self.normals(self.compensate(image.clamp(0.0, 1.0).to(self.calibration.background.dtype))).double()
        return found

    def output(self, image: Tensor, mode: str) -> DepthOutput:
        """The pipeline of these blocks, in a mode: "fast" or "precise"."""
        pitch = self.calibration.sensor.mm_per_pixel
        chain = (
            self.compensate,
            ContactMask.from_calibration(self.calibration),
            self.normals,
            GradientFromNormal(),
            PoissonDCT(pitch),
        )
        smooth = None if self.calibration.response is None else SmoothDrift()
        with torch.no_grad():
            result: DepthOutput = DepthPipeline(*chain, mm_per_pixel=pitch, mode=mode, smooth=smooth).eval()(image)
        return result


@dataclass(frozen=True)
class Surface:
    """A frame after the pipeline.

    Attributes:
        calibration: of the unit.
        output: of the pipeline.
        compensated: (1, 3, H, W), compensated image.
        length_error: (1, 1, H, W), length of the normals less one; None with response fields.
        length_noise: (1, 1, H, W), its noise; None with response fields.
        dark: (1, 3, H, W) bool, channels without light where the background has some.
    """

    calibration: Calibration
    output: DepthOutput
    compensated: Tensor
    length_error: Tensor | None
    length_noise: Tensor | None
    dark: Tensor

    @classmethod
    def of(cls, light: Tensor, blocks: Blocks, noise_std: Tensor) -> "Surface":
        """From linear light (3, H, W), with the noise (3,) of its value."""
        calibration = blocks.calibration
        value = light.clamp(0.0, 1.0) ** (1.0 / calibration.sensor.exponent)
        image = value[None].to(calibration.background.dtype)
        output = blocks.output(image, "precise")
        with torch.no_grad():
            compensated = blocks.compensate(image)
        background = calibration.background.clamp_min(0.0) ** (1.0 / calibration.sensor.exponent)
        black = (3.0 * noise_std.reshape(3, 1, 1)).clamp_min(1.5 / 255.0).to(background.dtype)
        filled = value if calibration.markers is None else calibration.markers(image)[0]
        dark = ((filled < black) & (background > 4.0 * black))[None]
        if calibration.lights is None:
            return cls(calibration, output, compensated, None, None, dark)
        lights = calibration.lights
        inverse = inverse_light_matrix(output.depth_mm, lights.position_mm, lights.albedo, calibration.sensor.mm_per_pixel)
        normal = (inverse * compensated[:, None]).sum(2)
        error = lengths(normal, 1, keepdim=True) - 1.0
        ratio = noise_std.to(background.dtype).reshape(3, 1, 1) / calibration.noise_std.reshape(3, 1, 1)
        noise = calibration.compensated_noise_std * ratio.clamp_min(1.0)
        share = (output.normal[:, :, None] * inverse).sum(1)  # derivative of the length by each channel
        spread = torch.sqrt((share * noise[None]).square().sum(1, keepdim=True))
        return cls(calibration, output, compensated, error, spread, dark)

    @property
    def contact(self) -> Tensor:
        """(H, W) bool."""
        deformed: Tensor = self.output.deformed[0, 0]
        return deformed

    @property
    def steepness(self) -> Tensor:
        """(H, W), mm per mm."""
        return lengths(self.output.gradient[0], 0)


@dataclass(frozen=True)
class LengthError:
    """How the normals' length deviates from one.

    Attributes:
        pattern: the template that explains most of it: "blur", "move" or "bounce" and its size.
        sigmas: how many standard deviations the template explains.
        amount: share of the template that is in the error.
        narrow: whether a blur of 1.5 pixels explains nearly as much.
        longer: share of the contact where the length is above one by more than 6 standard deviations.
        mean: mean error in the contact.
    """

    pattern: str
    sigmas: float
    amount: float
    narrow: bool
    longer: float
    mean: float


def fit_length_error(surface: Surface, invalid: Tensor) -> LengthError | None:
    """Regress the error of the length on what blur, movement and inter-reflection would leave.

    Args:
        surface: the frame.
        invalid: (H, W) bool, pixels that, with their neighbours, are not used.
    Returns:
        None with response fields, and where the contact is too small.
    """
    error, noise = surface.length_error, surface.length_noise
    if error is None or noise is None:
        return None
    left_out = surface.dark.any(1, keepdim=True) | invalid
    valid = ~(nn.functional.max_pool2d(left_out.to(error.dtype), 5, 1, 2) > 0) & torch.isfinite(error)
    inside = valid & surface.output.deformed
    if int(inside.sum()) < 20:
        return None
    sigma = noise[valid].median()
    bounded = error.clamp(-12.0 * sigma, 12.0 * sigma) * valid  # so that one spot is not taken for a blur
    sigmas: dict[str, float] = {}
    amount: dict[str, float] = {}
    for name, template in _templates(surface).items():
        shape = template * valid
        power = shape.square().sum().clamp_min(1e-12)
        along = (bounded * shape).sum()
        sigmas[name] = float(along / (power.sqrt() * sigma))
        amount[name] = float(along / power)
    best = max(sigmas, key=lambda name: sigmas[name])
    longer = float((error[inside] > 6.0 * noise[inside]).double().mean())
    return LengthError(
        best, sigmas[best], amount[best], sigmas["blur 1.5"] > 0.85 * sigmas[best], longer, float(error[inside].mean())
    )


def _templates(surface: Surface) -> dict[str, Tensor]:
    """Errors of the length (1, 1, H, W) that blur, movement along four directions, and inter-reflection would leave."""
    normal = surface.output.normal
    scale = normal.shape[2] / 120.0
    templates: dict[str, Tensor] = {}
    for spread in SPREADS_PX:
        templates[f"blur {spread:g}"] = lengths(blur(normal, gaussian_weights(spread * scale)), 1, keepdim=True) - 1.0
    for name, shift in (("x", (0, 1)), ("y", (1, 0)), ("down", (1, 1)), ("up", (1, -1))):
        for length in (5, 9, 17):
            templates[f"move {name} {length}"] = _moved(normal, shift, max(3, int(length * scale))) - 1.0
    for spread in (1.0, 2.0, 4.0):
        spread_px = spread / surface.calibration.sensor.mm_per_pixel
        if spread_px < 0.2 * normal.shape[2]:
            mean = blur(normal, gaussian_weights(spread_px))
            templates[f"bounce {spread:g}"] = (normal * mean).sum(1, keepdim=True) / lengths(mean, 1, keepdim=True) - 1.0
    return templates


def _moved(normal: Tensor, shift: tuple[int, int], length: int) -> Tensor:
    reach = length // 2
    padded = nn.functional.pad(normal, [reach, reach, reach, reach], mode="replicate")
    height, width = normal.shape[2:]
    total = torch.zeros_like(normal)
    steps = range(-reach, reach + 1)
    for k in steps:
        top, left = reach + k * shift[0], reach + k * shift[1]
        total = total + padded[:, :, top : top + height, left : left + width]
    return lengths(total / len(steps), 1, keepdim=True)


def normal_noise_deg(blocks: Blocks, noise_std: Tensor) -> float:
    """Median angle in degrees by which noise (3,) of the image value changes the normal of undeformed skin."""
    unit = blocks.calibration
    background = (unit.background.clamp_min(0.0) ** (1.0 / unit.sensor.exponent))[None]
    noise = torch.randn(background.shape, generator=torch.Generator().manual_seed(0)).to(background.dtype)
    noisy = background + noise * noise_std.to(background.dtype).reshape(1, 3, 1, 1)
    return float(angles_deg(blocks.normal(background), blocks.normal(noisy)).median())


def least_spread(lights: PointLights) -> float:
    """Smallest singular value of the lights' unit directions at the image centre: 0 in one plane, 1 at right angles."""
    directions = lights.direction.detach().double()
    return float(torch.linalg.svdvals(directions)[-1])


@dataclass(frozen=True)
class Regions:
    """The contacts of a frame.

    Attributes:
        count: how many.
        share: of the image that they cover.
        at_border: whether one of them meets the border.
    """

    count: int
    share: float
    at_border: bool


def regions(contact: Tensor, least_px: int) -> Regions:
    """Connected parts of a mask (H, W) with at least ``least_px`` pixels and a twentieth of the largest part."""
    import cv2

    number, _, stats, _ = cv2.connectedComponentsWithStats(contact.numpy().astype(np.uint8), connectivity=8)
    least = max(least_px, 0.05 * stats[1:, cv2.CC_STAT_AREA].max(initial=0))
    kept = [k for k in range(1, number) if stats[k, cv2.CC_STAT_AREA] >= least]
    height, width = contact.shape

    def meets_border(k: int) -> bool:
        left, top, wide, high = (int(stats[k, part]) for part in range(4))
        return left == 0 or top == 0 or left + wide == width or top + high == height

    sizes = [int(stats[k, cv2.CC_STAT_AREA]) for k in kept]
    return Regions(len(kept), sum(sizes) / contact.numel(), any(meets_border(k) for k in kept))


def peaks(depth_mm: Tensor, contact: Tensor, noise_mm: float) -> int:
    """Summits of the depth (H, W) that stand above the saddles between them by a fifth of the deepest and five times its noise.

    Source:
        the h-domes of Vincent, Morphological grayscale reconstruction, IEEE Trans. Image Processing 2(2), 1993.
    """
    import cv2

    depth = cv2.GaussianBlur(np.where(contact.numpy(), depth_mm.double().numpy(), 0.0), (0, 0), 1.5)
    top = float(depth.max())
    prominence = max(0.2 * top, 5.0 * noise_mm)
    if top <= prominence:
        return 0
    marker, kernel = depth - prominence, np.ones((3, 3), np.uint8)
    for _ in range(4 * max(depth.shape)):  # flood from (depth - prominence) under depth; what stands out are domes
        grown = np.minimum(cv2.dilate(marker, kernel), depth)
        if float(np.abs(grown - marker).max()) < 1e-9:
            break
        marker = grown
    dome = depth - marker
    number, label = cv2.connectedComponents((dome > 1e-6 * prominence).astype(np.uint8), connectivity=8)
    heights = [float(dome[label == k].max()) for k in range(1, number)]
    return max(1, sum(height > 0.999 * prominence for height in heights))


def transition_width_mm(surface: Surface) -> float:
    """Distance from the rim of the mask to where the skin is steepest, mm: nearly zero where the object ends with a kink."""
    import cv2

    contact = surface.contact.numpy().astype(np.uint8)
    padded = np.pad(contact, 1, mode="edge")
    inward = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    deepest = int(min(float(inward.max()), float(sum(contact.shape))))
    if deepest < 3 or bool(contact.all()):
        return 0.0
    ring = np.clip(np.ceil(inward).astype(int), 0, deepest)
    steep = surface.steepness.double().numpy()
    count = np.bincount(ring.ravel(), minlength=deepest + 1)[1:]
    mean = np.bincount(ring.ravel(), weights=steep.ravel(), minlength=deepest + 1)[1:] / np.maximum(count, 1)
    mean = np.where(count >= 8, mean, 0.0)
    reached = np.argmax(mean >= 0.9 * mean.max())
    return float(reached) * surface.calibration.sensor.mm_per_pixel


def cast_shadow_share(surface: Surface, noise_std: Tensor) -> float:
    """Share of the image where one light is missing while the two others are as on undeformed skin: in a cast shadow."""
    if not bool(surface.dark.any()):
        return 0.0
    flat = surface.calibration.flat[None]
    off = (surface.compensated / flat.clamp_min(1e-6) - 1.0).abs()
    undeformed = off < (6.0 * surface.calibration.compensated_noise_std / flat.clamp_min(1e-6)).clamp_min(0.03)
    lost = surface.dark & undeformed.roll(1, 1) & undeformed.roll(2, 1)
    return float(lost.any(1).double().mean())


def noise_with_rounding(frame_noise: Tensor, levels: float) -> Tensor:
    """Noise (3,) of a frame, not below that of rounding to its levels."""
    least = 0.0 if math.isinf(levels) else 1.0 / levels / math.sqrt(12.0)
    return frame_noise.clamp_min(max(QUANTISATION_STD, least))
