"""Confidence: bounds of the error of normals and depth, per pixel and per frame, and what they are made of.

The bounds come from what is known before the frame (noise of the camera, conditioning of the inverse model, error of the model on
held-out presses or of its fit) and from what the frame itself shows: its own noise, light that the model does not explain, slopes
that are not integrable, dark or saturated channels, deformation too faint for the mask. They do not cover what no frame shows: a
wrong pitch, a camera that is not orthographic, a calibration of another unit.
"""

import copy
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import torch
from torch import Tensor, nn

from ..compensate import Compensate
from ..core.blur import MOST_BLUR_PX, blur, gaussian_weights
from ..core.checks import (
    check_batch,
    check_field,
    check_float_tensor,
    check_least,
    check_mask,
    check_positive,
    check_record,
    check_same_size,
    check_shape,
    check_switch,
)
from ..core.geometry import GradientFromNormal, gradient_of_depth, lengths
from ..core.noise import noise_std as frame_noise_std
from ..integration import PoissonBackground
from ..model.calibration import Calibration, check_calibration
from ..model.coverage import COVERED, distance_to_presses
from ..model.response_field import TaughtRange
from ..normals import NormalFromIntensity, NormalFromResponse, as_normal_model
from ..skin import ContactMask, ContactSettings, unseen_deg
from ..skin.weight import CELLS, LEAST_SPREAD, RISE
from .depth import DepthOutput, DepthPipeline, eval_around
from .expected_error import expected_model_deg, least_level, light_std_by_fit, model_log_variance

FACTORS = ("noise", "model", "pass", "surface", "saturation", "range")
"""The order of ``factors_deg``: noise through the inverse model, raised where the light does not fit; error of the model; what a
pass with the depth found would change; slopes that are not integrable, and blur; channels that are dark or saturated; slopes and
depths beyond those of the presses that the model was fitted to."""

USEFUL_DEG = 10.0
"""``confidence`` is the probability that a normal is within this of the truth."""

DEPTH_SPREAD = 1.46
"""Spread of depth errors for :func:`bound_at`: that of a Gaussian in one dimension. Normals of point lights have 1, in two."""

RESPONSE_SPREAD = 1.2
"""The same for normals of a response field, whose errors have longer tails."""

BORDER_SHARE = 3.0
"""Share of the held-out variance that is added in the image's corners, by the fourth power of the distance from the middle."""

CURL_SHARE = 0.4
"""Variance of a slope, over the square of its part that is not integrable: half for white noise, less for what is smooth."""

EDGE_SHARE = 3.8
"""Variance of a slope along one axis at an edge, over the largest square of what another blur of the same width takes from it. A
blurred step of height 1 is off by 0.23, root mean square over the band in which that is seen, and another blur takes 0.083."""

EDGE_DEPTH_SHARE = 1.5
"""The same for depth: a blurred kink of depth is too low by 0.4 of what another blur takes 0.165 from, at most; 95 % of a Gaussian
error lie within 1.96 standard deviations."""

GRID_PX2 = 0.6
"""Variance of the blur of normals by differences of depth, px^2: a box of two pixels, and the mean of two neighbours."""

CLIPPED_DEG = 3.0
"""Error of a normal, along one axis, where a light is blocked or a channel is saturated and the other two must do."""

STEEPER_STD = 0.3
"""Standard deviation of what depth does to slopes, ``DepthBrightness.steeper`` times half the longer side: lights usually stand
where it is 0.6 to 1.2."""

INTEGRABLE_SHARE = 1.5
"""Mean error of normals of a response field, over the root mean square of the part of its slopes that is not integrable: 0.9 for
white errors in two dimensions, more for smooth ones; 1.5 to 1.7 on four drawn sensors, 0.8 to 2.3 on real ones."""

FRAME_VARIANCE = 0.1
"""Variance of the logarithm of the error that a frame's integrability states: 0.02 to 0.2 between frames of a unit, and as much
between units."""

SYSTEM_SHARE = 0.5
"""Depth error by a response field, over that of slopes that are all off by one standard deviation in the same direction."""

KINK_PX = 0.08
"""Depth error of the grid where the surface has a kink, pixels, for a contact as steep as 45 degrees."""

UNSEEN_DEG = 5.0
"""Slope, degrees, that every frame should show: where one hides it, a contact may be missed."""

BAND = 0.15
"""Width of the ring around the deformed area that is searched for what the mask missed, over the shorter side of the image."""

LEAST_READ = 0.5
"""Slopes beyond the range are taken to be read to at least this part."""

BEYOND = 1.2
"""A frame leaves the range of the presses where it is this many times as steep or deep: so much do presses themselves differ."""

SPREAD_OF_MEAN = 1.2533
"""Mean length of a two-dimensional Gaussian error, over its standard deviation along one axis."""


class Bounds(NamedTuple):
    """Bounds of the errors of a frame.

    Attributes:
        normal_95_deg: (B, 1, H, W), within which the error of the normal lies with a probability of 95 %.
        depth_95_mm: (B, 1, H, W), the same for depth.
        confidence: (B, 1, H, W), probability that the normal is within :data:`USEFUL_DEG` of the truth.
        frame_confidence: (B,), mean of ``confidence`` over the contact, 1 without contact, times s^4 / (s^4 + m^4): s is the root
            mean square slope of the contact, :data:`UNSEEN_DEG` without one, m the slope that undeformed skin could hide.
        factors_deg: (B, 6, H, W), the standard deviations along one axis that the bound of the normal is made of, in the order of
            :data:`FACTORS`.
    """

    normal_95_deg: Tensor
    depth_95_mm: Tensor
    confidence: Tensor
    frame_confidence: Tensor
    factors_deg: Tensor


class ConfidentOutput(NamedTuple):
    """The fields of :class:`DepthOutput`, then those of :class:`Bounds`: how far the former may be off."""

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor
    deformed: Tensor
    normal_95_deg: Tensor
    depth_95_mm: Tensor
    confidence: Tensor
    frame_confidence: Tensor
    factors_deg: Tensor


def bound_at(bound_95: Tensor, level: float, spread: float = 1.0) -> Tensor:
    """The bound for another probability than 95 %.

    Args:
        bound_95: bounds for 95 %.
        level: probability, above 0 and below 1.
        spread: ``Confidence.spread`` for normals, :data:`DEPTH_SPREAD` for depth.
    Raises:
        ValueError: level out of range.
    Source:
        Weibull's distribution of shape 2 / spread: Rayleigh's (the length of a two-dimensional Gaussian error) at a spread of 1.
    Example:
        >>> [round(float(bound_at(torch.tensor(6.0), level)), 2) for level in (0.5, 0.68, 0.95)]
        [2.89, 3.7, 6.0]
    """
    check_float_tensor("bound_95", bound_95)
    if not 0.0 < check_least("level", level) < 1.0:
        raise ValueError(f"level: expected a probability between 0 and 1, got {level}: 0.95, not 95")
    spread = check_positive("spread", spread)
    factor: float = (math.log(1.0 - level) / math.log(0.05)) ** (0.5 * spread)
    return bound_95 * factor


def beyond_presses(calibration: Calibration, output: DepthOutput | ConfidentOutput) -> list[str]:
    """For each frame what of it is steeper, deeper or elsewhere than the presses of the model, in words; "" where nothing is.

    It is said where 95 % of the contact reach further than :data:`BEYOND` times what 95 % of the presses did, and where half of it
    lies where no press did (:func:`distance_to_presses`). Bounds grow earlier with slope and depth, and
    without a step. Calibrations by lights have no such range, and older files do not know theirs.

    Args:
        calibration: of the unit.
        output: of its pipeline.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> beyond_presses(cal, ConfidentPipeline.from_calibration(cal)(cal.model_image[None]))
        ['']
    """
    check_calibration("calibration", calibration)
    if not isinstance(output, DepthOutput | ConfidentOutput):
        raise TypeError(f"output: expected a DepthOutput, got {type(output).__name__}: the output of the unit's pipeline")
    taught = None if calibration.response is None else calibration.response.taught
    distance = distance_to_presses(calibration)
    texts = []
    for contact, normal, depth in zip(output.contact, output.normal, output.depth_mm, strict=True):
        parts: list[str] = []
        if taught is not None and bool(contact.any()):
            sine = float(lengths(normal[:2], 0)[contact[0]].float().quantile(0.95))
            deepest = float(depth[contact].float().quantile(0.95))
            if sine > min(1.0, BEYOND * taught.sine):
                angle = math.degrees(math.asin(min(1.0, sine)))
                parts.append(f"slopes up to {angle:.0f} degrees; the presses reach {taught.angle_deg:.0f}")
            if deepest > BEYOND * taught.depth_mm:
                parts.append(f"depths up to {deepest:.1f} mm; the presses reach {taught.depth_mm:.1f}")
        if distance is not None and bool(contact.any()):
            elsewhere = float((distance[contact[0].cpu()] > COVERED).double().mean())
            if elsewhere > 0.5:
                parts.append(f"{elsewhere:.0%} of the contact where no ball was pressed")
        texts.append("; ".join(parts))
    return texts


class SlopeErrors(NamedTuple):
    """steep (B, 1, H, W), square of n_z; white and alike (B, 1, H, W), variances of the angle along one axis, radians^2, of
    errors that are independent from pixel to pixel, and of those that are alike all over the contact."""

    steep: Tensor
    white: Tensor
    alike: Tensor


class Confidence(nn.Module):
    """Bounds of a frame's errors, from its image and the output of the pipeline.

    Normals. The noise of the image goes through the inverse model by differences: each channel is moved by its noise, and the
    normal is followed. So conditioning is measured, not assumed. The model's error goes the same way, as light that is off: for
    point lights by how well calibration constrained each of them, for response fields by as much as gives the held-out angle.
    How large the error of a response field is, the part of the frame's slopes that is not integrable says too. Beyond the slopes
    and depths of its presses it grows as the error of a field fitted to their flatter part does on their rims, and as the height
    of the lights is uncertain. Added to this are the change that the next pass would bring, the part of the gradient that is not
    integrable, blur at edges, and a fixed error where a channel is dark or saturated. Outside of the deformed area, where the
    normal is said to be flat, the bound is the faintest tilt that the mask detects, by noise and by the frame's least changed skin.

    Depth. White errors of slope grow with the logarithm of the contact's size; errors of the model add up along the way, which
    is computed by three integrations: all slopes too steep, and all tilted in x and in y. What the mask missed and what the next
    pass would change are integrated as they are.

    Args:
        normals: the calibrated block of the pipeline.
        noise_std: (3, H, W), of the compensated image.
        image_noise_std: (3,), of the image, in image value, at calibration.
        light_std: (3, H, W), error of the light due to the model; for point lights per unit of ``|n - n_flat|``.
        mm_per_pixel: pixel pitch, mm.
        model_deg: mean error of a response field, degrees; 0 for lights.
        model_log_variance: variance of the logarithm of ``model_deg``: the larger, the more a frame's integrability decides; 0 if
            it is not asked.
        least_level: the least factor of the model's variance that a frame may show.
        taught: how steep and deep the presses of a response field were; None if not known.
        measured: whether the background was an image.
        blur_px: of the compensated image.
        spread: of the errors of normals, for :func:`bound_at`.
    Source:
        propagation of noise through photometric stereo: Barsky and Petrou, Signal Processing 86(11), 2006.
    Example:
        >>> from torchvts import ConfidentPipeline, PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> out = ConfidentPipeline.from_calibration(cal)(cal.model_image[None])
        >>> out.normal_95_deg.shape, out.frame_confidence
        (torch.Size([1, 1, 48, 64]), tensor([1.0000]))
    """

    uses_depth: Final[bool]
    by_lights: Final[bool]
    noise: Tensor
    image_noise: Tensor
    light_std: Tensor
    border: Tensor

    def __init__(
        self,
        normals: nn.Module,
        noise_std: Tensor,
        image_noise_std: Tensor,
        light_std: Tensor,
        mm_per_pixel: float,
        *,
        model_deg: float = 0.0,
        model_log_variance: float = 0.0,
        least_level: float = 0.0,
        taught: TaughtRange | None = None,
        measured: bool = True,
        blur_px: float = 0.0,
        spread: float = 1.0,
    ) -> None:
        super().__init__()
        check_record("normals", normals, nn.Module, "the block of the pipeline")
        check_field("noise_std", noise_std)
        check_shape("image_noise_std", image_noise_std, (3,))
        check_float_tensor("light_std", light_std)
        check_shape("light_std", light_std, noise_std.shape, "noise_std")
        mm_per_pixel, spread = check_positive("mm_per_pixel", mm_per_pixel), check_positive("spread", spread)
        check_switch("measured", measured)
        model_deg, blur_px = check_least("model_deg", model_deg), check_least("blur_px", blur_px, 0.0, MOST_BLUR_PX)
        self.normals = as_normal_model(normals)
        self.uses_depth = self.normals.uses_depth
        self.by_lights = isinstance(normals, NormalFromIntensity)
        self.mm_per_pixel = mm_per_pixel
        self.fixed = 1.0 if measured else 0.0
        self.model_variance = (math.radians(model_deg) / SPREAD_OF_MEAN) ** 2
        self.model_log_variance = check_least("model_log_variance", model_log_variance)
        self.least_level = check_least("least_level", least_level)
        if taught is not None:
            check_record("taught", taught, TaughtRange)
        self.taught_sine = 1.0 if taught is None else taught.sine
        self.taught_mm = math.inf if taught is None else taught.depth_mm
        # the excess is read by the very field that errs in it, and may be short by as much
        self.growth = 0.0 if taught is None else taught.growth / max(1.0 - taught.growth, LEAST_READ)
        self.blur_px = blur_px
        edge_px = math.sqrt(2.0 * blur_px**2 + GRID_PX2)  # the camera's own blur is taken to be as wide as the calibration's
        self.weights = gaussian_weights(min(edge_px, MOST_BLUR_PX))
        self.reach = math.ceil(edge_px)
        self.correlation = max(1.0, 2.0 * math.sqrt(math.pi) * blur_px)  # blurred noise is as much larger in the sums
        self.spread = spread
        # TorchScript sees no numbers of the module
        self.clipped_variance = math.radians(CLIPPED_DEG) ** 2
        self.cells, self.sure, self.least_spread, self.faint_deg = CELLS, RISE[1], LEAST_SPREAD, UNSEEN_DEG
        self.detected, self.useful_deg = ContactSettings().sigmas, USEFUL_DEG  # a tilt of so many standard deviations is seen
        self.curl_share, self.edge_share, self.edge_depth_share = CURL_SHARE, EDGE_SHARE, EDGE_DEPTH_SHARE
        self.system_share = 1.0 if self.by_lights else SYSTEM_SHARE**2  # lights that are off are off everywhere
        self.kink_variance_mm = (KINK_PX * mm_per_pixel) ** 2
        height, width = noise_std.shape[1], noise_std.shape[2]
        self.steeper_std = STEEPER_STD / (0.5 * max(height, width) * mm_per_pixel)
        self.integrable_share, self.frame_variance = INTEGRABLE_SHARE, FRAME_VARIANCE
        self.band = max(3, round(BAND * min(height, width)))
        x, y = torch.linspace(-1.0, 1.0, width) * width, torch.linspace(-1.0, 1.0, height) * height
        place = (x.square() + y.square()[:, None]) / float(width**2 + height**2)
        self.register_buffer("border", (BORDER_SHARE * self.model_variance * place.square())[None].to(noise_std.dtype))
        self.register_buffer("noise", noise_std.detach().clone())
        self.register_buffer("image_noise", image_noise_std.detach().clone())
        self.register_buffer("light_std", light_std.detach().clone())
        self.gradient = GradientFromNormal()
        self.integrate = PoissonBackground(mm_per_pixel)

    @classmethod
    def from_calibration(cls, calibration: Calibration, normals: nn.Module | None = None) -> "Confidence":
        """The block of a calibrated unit.

        Args:
            calibration: the unit.
            normals: its block in the pipeline, to share; None makes one.
        Raises:
            TypeError: normals that are not of the calibrated model, of whose errors calibration knows nothing.
        """
        check_calibration("calibration", calibration)
        kind = NormalFromResponse if calibration.response is not None else NormalFromIntensity
        block = kind.from_calibration(calibration) if normals is None else normals
        if not isinstance(block, kind):
            raise TypeError(
                f"normals: expected the calibrated {kind.__name__}, got {type(block).__name__}: of a module put in its place "
                "no error is known"
            )
        sensor, noise = calibration.sensor, calibration.compensated_noise_std
        common: dict[str, Any] = {"measured": calibration.measured, "blur_px": sensor.blur_px}
        if isinstance(block, NormalFromIntensity):
            return cls(block, noise, calibration.noise_std, light_std_by_fit(calibration), sensor.mm_per_pixel, **common)
        model_deg = expected_model_deg(calibration)
        slope_of_change = 0.5 * block.maps[:3].square().sum(dim=(0, 1))  # a relative change of one, in every channel
        usual = float(slope_of_change.median().sqrt().clamp_min(1e-6))
        light = torch.full_like(noise, math.radians(model_deg) / SPREAD_OF_MEAN / usual)
        assert calibration.response is not None
        common |= {"model_deg": model_deg, "spread": RESPONSE_SPREAD, "taught": calibration.response.taught}
        common |= {"model_log_variance": model_log_variance(calibration), "least_level": least_level(calibration)}
        return cls(block, noise, calibration.noise_std, light, sensor.mm_per_pixel, **common)

    def forward(self, images: Tensor, compensated: Tensor, out: DepthOutput, light: Tensor | None = None) -> Bounds:
        """Bounds of a frame.

        Args:
            images: (B, 3, H, W), the input of the pipeline.
            compensated: the same after ``Compensate``.
            out: the output of the pipeline.
            light: (B, 3, 6), the light that ``Compensate`` has divided out, see :class:`~torchvts.core.frame.Conditions`; None for
                none. What it changes unevenly by a share u, a slope of u would change, too: a contact may be part of it.
        Raises:
            ValueError: wrong shapes, or another size than the calibrated one.
        """
        self._check(images, compensated, out)
        sigma = self._noise_of(images)
        own_noise = self._own_noise(compensated)
        base = self._normals(compensated, None, own_noise)
        noise, model = self._through_the_inverse(base, compensated, sigma, own_noise)
        n_z = out.normal[:, 2:3]
        steep = n_z.square()  # an error of slope turns the normal by so much, at most along one axis
        model = model * (2.0 - 2.0 * n_z) if self.by_lights else model + self.border  # |n - n_flat|^2
        again = self._normals(compensated, out.depth_mm, own_noise) if self.uses_depth else base
        change = torch.sqrt((again - out.normal).square().sum(1, keepdim=True) + 1e-12)
        clipped = torch.zeros_like(noise)
        if self.by_lights:
            shadowed = self.normals.shadowed
            dark = shadowed.dark(compensated, shadowed.noise_of_frames(own_noise, compensated))
            dark = dark | (compensated >= shadowed.saturated_above)
            clipped = self.clipped_variance * dark.any(dim=1, keepdim=True).to(noise.dtype)
            noise = noise * self._unexplained(compensated, out.depth_mm, again, dark, sigma)
        curl, edges = self._not_integrable(out.depth_mm, out.gradient, steep, noise)
        surface = curl + edges
        beyond = torch.zeros_like(noise)
        if not self.by_lights:
            model = model * self._level(base, again, out, noise, edges)
            beyond = self._beyond(out)
        if self.by_lights:
            bound = _length_95(change, torch.sqrt(noise + model + clipped + 1e-12), 1.0)
        else:  # the raw slopes of another pass scatter about those of the depth
            variance = noise + model + surface + beyond + 0.5 * change.square()
            bound = _length_95(torch.zeros_like(change), torch.sqrt(variance + 1e-12), 1.06)
        unseen = unseen_deg(self.gradient(base.detach()), self.cells, self.sure, self.least_spread)
        if light is not None:
            if light.shape != (images.shape[0], 3, 6):
                raise ValueError(f"light: expected ({images.shape[0]}, 3, 6), got {light.shape}: conditions.light of these images")
            uneven = light[:, :, 1:].square().sum(dim=2) / light[:, :, 0].square().clamp_min(1e-6)
            uneven = torch.sqrt(uneven.sum(dim=1).detach() / 1.5)  # of lights 120 degrees apart; u where all slopes are u
            unseen = torch.sqrt(unseen.square() + torch.rad2deg(torch.atan(uneven)).square())
        hidden = torch.deg2rad(unseen)[:, None, None, None].maximum(self.detected * torch.sqrt(noise + 1e-12))
        bound = torch.where(out.deformed, bound, hidden)
        normal_95 = torch.rad2deg(bound).clamp_max(180.0)
        inside = out.deformed.to(noise.dtype)
        slopes = SlopeErrors(steep, noise + surface, self.system_share * (model + clipped) + beyond)
        depth_95 = self._depth_95(out.depth_mm, out.gradient, again, inside, slopes)
        # the inverse of bound_at
        likely = 1.0 - torch.exp(math.log(0.05) * (self.useful_deg / normal_95) ** (2.0 / self.spread))
        contact = out.contact.to(noise.dtype)
        count = contact.sum(dim=(1, 2, 3))
        frame = torch.where(count > 0, (likely * contact).sum(dim=(1, 2, 3)) / count.clamp_min(1.0), torch.ones_like(count))
        slope = torch.rad2deg(torch.acos(n_z.detach().clamp(-1.0, 1.0))).square() * contact  # degrees^2
        slope = torch.where(count > 0, slope.sum(dim=(1, 2, 3)) / count.clamp_min(1.0), torch.full_like(count, self.faint_deg**2))
        frame = frame * slope.square() / (slope.square() + unseen.square().square()).clamp_min(1e-6)
        parts = torch.cat((noise.sqrt(), model.sqrt(), change, surface.sqrt(), clipped.sqrt(), beyond.sqrt()), dim=1)
        return Bounds(normal_95, depth_95, likely, frame, torch.rad2deg(parts))

    def _check(self, images: Tensor, compensated: Tensor, out: DepthOutput) -> None:
        height, width = self.noise.shape[1], self.noise.shape[2]
        if not torch.jit.is_scripting():
            check_record("out", out, DepthOutput, "what the pipeline returns")
        for name, tensor, channels in (
            ("images", images, 3),
            ("compensated", compensated, 3),
            ("depth_mm", out.depth_mm, 1),
            ("gradient", out.gradient, 2),
            ("normal", out.normal, 3),
        ):
            check_batch(name, tensor, channels)
            check_same_size(name, tensor, "the calibration", height, width)
            if tensor.shape[0] != images.shape[0]:
                raise ValueError(f"{name}: expected {images.shape[0]} frames like images, got {tensor.shape[0]}: of another batch?")
        for name, mask in (("contact", out.contact), ("deformed", out.deformed)):
            check_mask(name, mask)
            if mask.shape != out.depth_mm.shape:
                raise ValueError(f"{name}: expected bool like depth_mm, got {mask.shape} {mask.dtype}")

    def _unexplained(self, compensated: Tensor, depth_mm: Tensor, normal: Tensor, dark: Tensor, sigma: Tensor) -> Tensor:
        """Factor by which light that no normal explains exceeds the noise, at least 1: (B, 1, H, W).

        Three channels give two slopes and a check: a third of the noise is left over.
        """
        left = (compensated - self.normals.lights(depth_mm, normal, self.mm_per_pixel)).masked_fill(dark, 0.0)
        left = 3.0 * _smooth(left.square().sum(1, keepdim=True)) / sigma.square().sum(1, keepdim=True)
        return (left / 1.7).clamp_min(1.0)

    def _noise_of(self, images: Tensor) -> Tensor:
        """(B, 3, H, W): noise of the compensated frame, the calibrated one raised where the frame has more."""
        more = (frame_noise_std(images.detach()) / self.image_noise).clamp_min(1.0).square()
        factor = torch.sqrt((more + self.fixed) / (1.0 + self.fixed))  # the background's part is what it was
        return self.noise[None] * factor[:, :, None, None]

    def _own_noise(self, compensated: Tensor) -> Tensor | None:
        """The noise of each frame (B, 3) that its normals get, if they ask for it."""
        return self.normals.noise_of(compensated) if self.by_lights else None

    def _normals(self, compensated: Tensor, depth_mm: Tensor | None, own_noise: Tensor | None) -> Tensor:
        return self.normals(compensated, depth_mm, own_noise) if self.by_lights else self.normals(compensated, depth_mm)

    def _through_the_inverse(
        self, base: Tensor, compensated: Tensor, sigma: Tensor, own_noise: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Variances along one axis of the angle, radians^2, by noise and by the light's error."""
        noise = torch.zeros_like(base[:, 0:1])
        model = torch.zeros_like(noise)
        for k in range(3):
            step = torch.zeros_like(compensated)
            step[:, k : k + 1] = sigma[:, k : k + 1]
            turn = 0.5 * (self._normals(compensated + step, None, own_noise) - base).square().sum(1, keepdim=True)
            noise = noise + turn
            model = model + turn * (self.light_std[k : k + 1] / sigma[:, k : k + 1]).square()
        return noise, model

    def _level(self, base: Tensor, again: Tensor, out: DepthOutput, noise: Tensor, edges: Tensor) -> Tensor:
        """Factor (B, 1, 1, 1) of the model's variance: what calibration expects, and what the frame shows, by their certainties.

        Wrong slopes are in part the gradient of no surface. That part is seen in every frame, in the mean over the contact, with
        noise and edges taken out.
        """
        slope = gradient_of_depth(out.depth_mm, self.mm_per_pixel)
        up = torch.rsqrt(slope.square().sum(1, keepdim=True) + 1.0)
        surface = torch.cat((-slope * up, up), dim=1)
        weight = out.contact.to(noise.dtype) * self.model_variance / (self.model_variance + edges)
        total = weight.sum(dim=(1, 2, 3), keepdim=True)
        first = ((base - surface).square().sum(1, keepdim=True) * weight).sum(dim=(1, 2, 3), keepdim=True)
        second = ((again - surface).square().sum(1, keepdim=True) * weight).sum(dim=(1, 2, 3), keepdim=True)
        # the pass that depth was integrated from
        odd = torch.minimum(first, second) - (noise * weight).sum(dim=(1, 2, 3), keepdim=True)
        found = self.integrable_share**2 * (odd / total.clamp_min(1e-6)).clamp_min(1e-6)
        expected = 1.5708 * self.model_variance  # square of the mean error
        share = self.model_log_variance / (self.model_log_variance + self.frame_variance)
        level = ((found / max(expected, 1e-12)) ** share).clamp_min(self.least_level)
        return torch.where(total > 1.0, level, torch.ones_like(total))

    def _beyond(self, out: DepthOutput) -> Tensor:
        """Variance of the angle beyond the slopes and depths that were taught."""
        sine = torch.sqrt(out.normal[:, :2].square().sum(1, keepdim=True))
        steeper = self.growth * (sine - self.taught_sine).clamp_min(0.0)
        deeper = self.steeper_std * (out.depth_mm - self.taught_mm).clamp_min(0.0) * sine
        return 0.5 * (steeper.square() + deeper.square()) / out.normal[:, 2:3].square().clamp_min(0.05)

    def _not_integrable(self, depth_mm: Tensor, gradient: Tensor, steep: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Variances by the part of the gradient that is not integrable, beyond noise, and by what blur took from edges."""
        odd = _smooth((gradient_of_depth(depth_mm, self.mm_per_pixel) - gradient).square().sum(1, keepdim=True)) * steep.square()
        odd = self.curl_share * (odd - 3.0 * noise).clamp_min(0.0)
        edges = torch.zeros_like(odd)
        if self.blur_px > 0.0:
            taken = (blur(gradient, self.weights) - gradient).square().sum(1, keepdim=True)
            taken = nn.functional.max_pool2d(taken, 2 * self.reach + 1, 1, self.reach)
            edges = self.edge_share * taken * steep.square()
        return odd, edges

    def _depth_95(self, depth_mm: Tensor, gradient: Tensor, again: Tensor, inside: Tensor, errors: SlopeErrors) -> Tensor:
        steep = errors.steep
        # the next pass inside the deformed area, and around it what the mask has missed, smoothed
        beyond = 1.0 - inside
        better = self.gradient(again)
        around = _smooth(better * beyond) / _smooth(beyond).clamp_min(0.04) * _grown(inside, self.band)
        better = torch.where(inside > 0, better, around)
        std = torch.sqrt(errors.alike + 1e-14) / steep.clamp_min(0.05) * inside
        length = torch.sqrt(gradient.square().sum(1, keepdim=True) + std.square() + 1e-12)
        none = torch.zeros_like(std)
        tilts = torch.cat((torch.cat((std, none), 1), torch.cat((none, std), 1)))
        # what the next pass would change, without what the pipeline's zero has taken out of depth
        found: Tensor = self.integrate(torch.cat((better - gradient, std * gradient / length, tilts)))
        found = found.reshape(4, depth_mm.shape[0], 1, depth_mm.shape[2], depth_mm.shape[3])
        count = inside.sum(dim=(1, 2, 3), keepdim=True).clamp_min(1.0)
        mean = (errors.white / steep.square().clamp_min(0.01) * inside).sum(dim=(1, 2, 3), keepdim=True) / count
        growth = 0.2 + torch.log1p(torch.sqrt(count / math.pi)) / (2.0 * math.pi)
        scatter = mean * growth * (self.correlation * self.mm_per_pixel) ** 2
        kink = self.kink_variance_mm * gradient.square().sum(dim=(1, 2, 3), keepdim=True) / count
        system = found[1:].square().sum(0)
        return found[0].abs() + 1.96 * torch.sqrt(scatter + kink + system + self._blunted(depth_mm))

    def _blunted(self, depth_mm: Tensor) -> Tensor:
        """Variance of depth by what blur took from its edges, mm^2."""
        if self.blur_px == 0.0:
            return torch.zeros_like(depth_mm)
        taken = (blur(depth_mm, self.weights) - depth_mm).square()
        return self.edge_depth_share * nn.functional.max_pool2d(taken, 2 * self.reach + 1, 1, self.reach)


class ConfidentPipeline(nn.Module):
    """A pipeline that also bounds its errors: images (B, 3, H, W) to a :class:`ConfidentOutput`.

    Args:
        pipe: the pipeline.
        confidence: from the same calibration.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> pipe = ConfidentPipeline(DepthPipeline.from_calibration(cal), Confidence.from_calibration(cal))
        >>> pipe(cal.model_image[None])._fields[5:]
        ('normal_95_deg', 'depth_95_mm', 'confidence', 'frame_confidence', 'factors_deg')
    """

    def __init__(self, pipe: DepthPipeline, confidence: Confidence) -> None:
        super().__init__()
        check_record("pipe", pipe, DepthPipeline, "DepthPipeline.from_calibration makes one")
        check_record("confidence", confidence, Confidence, "Confidence.from_calibration makes one")
        self.pipe = pipe
        self.relights = isinstance(pipe.compensate, Compensate)
        self.confidence = confidence = copy.copy(confidence)  # whose number below is of this pipeline
        if isinstance(pipe.mask, ContactMask):
            confidence.detected = pipe.mask.sigmas

    @classmethod
    def from_calibration(
        cls,
        calibration: Calibration,
        mode: str = "fast",
        *,
        normals: nn.Module | None = None,
        integrate: nn.Module | None = None,
        contact: ContactSettings | None = None,
    ) -> "ConfidentPipeline":
        """As :meth:`DepthPipeline.from_calibration`.

        Raises:
            TypeError: no Calibration; or ``normals`` that are not the calibrated model.
        """
        pipe = DepthPipeline.from_calibration(calibration, mode, normals=normals, integrate=integrate, contact=contact)
        return eval_around(cls(pipe, Confidence.from_calibration(calibration, pipe.normals)), normals, integrate)

    if TYPE_CHECKING:

        def __call__(self, images: Tensor) -> ConfidentOutput: ...

    def forward(self, images: Tensor) -> ConfidentOutput:
        """As :meth:`DepthPipeline.forward`."""
        out: DepthOutput = self.pipe(images)
        compensate = self.pipe.compensate
        light = compensate.light_of(images) if self.relights else None
        bounds: Bounds = self.confidence(images, compensate(images), out, light)
        return ConfidentOutput(
            out.depth_mm,
            out.gradient,
            out.normal,
            out.contact,
            out.deformed,
            bounds.normal_95_deg,
            bounds.depth_95_mm,
            bounds.confidence,
            bounds.frame_confidence,
            bounds.factors_deg,
        )


def _length_95(bias: Tensor, std: Tensor, tail: float) -> Tensor:
    """95 % quantile of the length of a two-dimensional Gaussian of that standard deviation around a bias."""
    return bias + tail * std * (1.645 + 0.803 * std / (std + bias))


def _smooth(values: Tensor) -> Tensor:
    """Mean over 5 x 5 pixels."""
    return nn.functional.avg_pool2d(nn.functional.pad(values, [2, 2, 2, 2], mode="replicate"), 5, 1)


def _grown(mask: Tensor, reach: int) -> Tensor:
    """A mask of zeros and ones, wider by ``reach`` pixels along rows and columns; by running sums, whatever the reach."""
    for dim in (3, 2):
        pad = [reach + 1, reach, 0, 0] if dim == 3 else [0, 0, reach + 1, reach]
        total = nn.functional.pad(mask, pad).cumsum(dim)
        length = mask.shape[dim]
        mask = (total.narrow(dim, 2 * reach + 1, length) - total.narrow(dim, 0, length) > 0.5).to(mask.dtype)
    return mask
