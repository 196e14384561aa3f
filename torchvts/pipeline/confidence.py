"""Confidence: bounds of the error of normals and depth, per pixel and per frame, and what they are made of.

A bound is the 95 % quantile of a sum of variances: noise, spread, model, surface. It does not cover what no frame shows: a wrong
pitch or ball, a camera that is not orthographic.
"""

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import torch
from torch import Tensor, nn

from ..compensate import Compensate
from ..core.blur import MOST_BLUR_PX, blur, gaussian_weights
from ..core.cells import cells_to_pixels, whole_cell_means
from ..core.checks import (
    check_batch,
    check_float_tensor,
    check_least,
    check_mask,
    check_positive,
    check_record,
    check_same_size,
    check_tensor,
)
from ..core.geometry import GradientFromNormal
from ..core.levels import BLACK, SATURATED
from ..core.noise import noise_std as frame_noise_std
from ..integration import PoissonBackground
from ..model.calibration import PEDESTAL, Calibration, check_calibration
from ..model.response_field import CHANGE_SCALE, MAX_SLOPE
from ..model.stated_error import StatedError
from ..normals import NormalFromIntensity, NormalFromResponse
from ..skin import ContactSettings, unseen_deg
from ..skin.weight import LEAST_SLOPE_SPREAD, WEIGHT_CELLS, WEIGHT_RISE
from .depth import DepthOutput, DepthPipeline, eval_around

FACTORS = ("noise", "spread", "model", "surface")
"""The order of ``factors_deg``: noise of the image through the inverse model; slopes of the frame's least changed skin, which has
none; error of the model that its calibration states; slopes that no surface can have."""

USEFUL_DEG = 10.0
"""``confidence`` is the probability that a normal is within this of the truth."""

UNSEEN_DEG = 5.0
"""Slope, degrees, that every frame should show: where one hides it, a contact may be missed."""

SPREAD_OF_MEAN = 1.2533
"""Mean length of a two-dimensional Gaussian error, over its standard deviation along one axis."""

OF_SENSORS, OF_TYPE = 4.0, 12.0
"""Presses that all sensors, and the prior of a type, count for where the size of a field's error is estimated from its presses."""

RESPONSE_SPREAD = 1.2
"""Spread of the errors of normals of a response field for :func:`bound_at`, which have longer tails."""

DEPTH_SPREAD = 1.46
"""Spread of depth errors for :func:`bound_at`: that of a Gaussian in one dimension. Normals of point lights have 1, in two."""

CURL_SHARE = 0.5
"""Variance of a slope along one axis, over the square of its part that is not integrable: errors without a preferred direction are
as often the gradient of a surface as not."""

EDGE_SHARE = 3.8
"""Variance of a slope along one axis at an edge, over the largest square of what another blur of the same width takes from it. A
blurred step of height 1 is off by 0.23, root mean square over the band in which that is seen, and another blur takes 0.083."""

EDGE_DEPTH_SHARE = 1.5
"""The same for depth: a blurred kink of depth is too low by 0.4 of what another blur takes 0.165 from, at most; 95 % of a Gaussian
error lie within 1.96 standard deviations."""

ALIKE = 0.5
"""Share of the variance of a field's slopes that is alike over all of a contact, as a gain; half of it as a tilt along each axis.
What is left changes its sign within the contact. Of point lights all of it is alike."""

GRID_PX2 = 0.6
"""Variance of the blur of normals by differences of depth, px^2: a box of two pixels, and the mean of two neighbours."""

CLIPPED_DEG = 3.0
"""Error of a normal, along one axis, where a light is blocked or a channel is saturated and the other two must do."""

KINK_PX = 0.08
"""Depth error of the grid where the surface has a kink, pixels, for a contact as steep as 45 degrees."""

MISFIT_SHARE = 3.0
"""Error of the light per unit of tilt, over the part of the background that fitted lights leave unexplained."""

FAINT_PATTERN = 0.1
"""Pattern of light over which an uneven change of it shows a gamma: presses make one of 0.03, and gammas differ by 0.3."""

MISSED = 0.15
"""Radius, over the shorter side of the image, of a contact that may be missed, as steep as could have hidden: half of that deep."""

AROUND = 30
"""Slopes that no surface can have tell of the error in so many parts of the shorter side around them."""


class ConfidentOutput(NamedTuple):
    """The fields of :class:`~torchvts.core.frame.DepthOutput`, then how far they may be off.

    Attributes:
        normal_95_deg: (B, 1, H, W), within which the error of the normal lies with a probability of 95 %.
        depth_95_mm: (B, 1, H, W), the same for depth.
        confidence: (B, 1, H, W), probability that the normal is within :data:`USEFUL_DEG` of the truth.
        frame_confidence: (B,), mean of ``confidence`` over the contact, without one over all of the frame, times s^4 / (s^4 + m^4):
            s is the root mean square slope of the contact, :data:`UNSEEN_DEG` without one, m the slope that undeformed skin could
            hide. 0 where a frame has collapsed; :func:`torchvts.pipeline.doubts_of` says why.
        factors_deg: (B, 4, H, W), the standard deviations along one axis that the bound of the normal is made of, in the order of
            :data:`FACTORS`.
    """

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


class Confidence(nn.Module):
    """Bounds of a frame's errors, from its image and the output of the pipeline.

    Normals. The variance of a normal is a sum of four. *Noise* of the image goes through the inverse model by differences: each
    channel is moved by its noise, and the normal is followed. So conditioning is measured, not assumed. *Spread*: the frame's least
    changed skin seems to have slopes and has none; those of the contact are wrong by as much. *Model*: what the calibration states,
    for response fields by the covariance of their coefficients, for point lights by how well the fit constrained each of them, sent
    through the inverse model as light that is off. *Surface*: the slopes that the model gives with the depth found, less those of
    the output. For a response field, whose output has the slopes of that depth, they are the gradient of no surface; and blur takes
    from its edges. Where the skin has not moved, and the normal is said to be flat, the bound is the slope that could have hidden
    there.

    Depth. White errors of slope grow with the logarithm of the contact's size. Those of model and spread add up along the way, by
    three integrations: all slopes too steep, and all tilted in x and in y. What another pass would change is integrated as it is.
    Where the skin has not moved, a small contact as steep as could have hidden may have been missed.

    Args:
        calibration: of the unit.
        normals: its block in the pipeline, to share; None makes one.
    Raises:
        TypeError: no Calibration, or normals that are not of the calibrated model, of whose errors calibration knows nothing.
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

    def __init__(self, calibration: Calibration, normals: nn.Module | None = None) -> None:
        super().__init__()
        check_calibration("calibration", calibration)
        self.by_lights = calibration.response is None
        kind = NormalFromIntensity if self.by_lights else NormalFromResponse
        block = kind.from_calibration(calibration) if normals is None else normals
        if not isinstance(block, kind):
            raise TypeError(
                f"normals: expected the calibrated {kind.__name__}, got {type(block).__name__}: of a module put in its place "
                "no error is known"
            )
        self.normals, self.uses_depth = block, block.uses_depth
        noise_std, mm_per_pixel = calibration.compensated_noise_std, calibration.sensor.mm_per_pixel
        self.mm_per_pixel = mm_per_pixel
        self.blur_px = blur_px = calibration.sensor.blur_px
        # of response fields the error, and the presses from which its size is known; of lights that of the light per |n - n_flat|
        self.stated: nn.Module = nn.Identity() if self.by_lights else StatedError.from_calibration(calibration)
        light_std = light_std_by_fit(calibration) if self.by_lights else torch.zeros_like(noise_std)
        used = sum(row.get("weight", 1.0) for row in calibration.report.get("presses", []))
        presses = None if self.by_lights else used + (OF_TYPE if "prior_deg" in calibration.report else OF_SENSORS)
        self.fixed = 1.0 if calibration.measured else 0.0
        pattern = float((calibration.background + PEDESTAL).log().flatten(1).std(dim=1).square().mean().sqrt())
        self.per_uneven = pattern / (pattern**2 + FAINT_PATTERN**2)
        self.uneven_at_calibration = calibration.report.get("uneven", 0.0)
        edge_px = math.sqrt(2.0 * blur_px**2 + GRID_PX2)  # the camera's own blur is taken to be as wide as the calibration's
        self.weights = gaussian_weights(min(edge_px, MOST_BLUR_PX))
        self.reach = math.ceil(edge_px)
        self.correlation = max(1.0, 2.0 * math.sqrt(math.pi) * blur_px)  # blurred noise is as much larger in the sums
        cell = max(1, min(noise_std.shape[1:]) // WEIGHT_CELLS)
        self.cell_share = min(1.0, (self.correlation / cell) ** 2)  # of the variance of noise that means over cells have
        # TorchScript sees no numbers of the module
        self.spread = 1.0 if self.by_lights else RESPONSE_SPREAD
        self.quantile = quantile_95(presses)
        self.clipped_variance, self.per_mean = math.radians(CLIPPED_DEG) ** 2, math.radians(1.0) / SPREAD_OF_MEAN
        self.cells, self.sure, self.least_spread, self.faint_deg = WEIGHT_CELLS, WEIGHT_RISE[1], LEAST_SLOPE_SPREAD, UNSEEN_DEG
        self.useful_deg, self.around, self.steepest = USEFUL_DEG, AROUND, math.atan(MAX_SLOPE)
        self.missed_mm = 0.5 * MISSED * min(noise_std.shape[1:]) * mm_per_pixel
        self.black, self.saturated = BLACK, SATURATED
        self.usual_change = CHANGE_SCALE
        self.curl_share, self.edge_share, self.edge_depth_share = CURL_SHARE, EDGE_SHARE, EDGE_DEPTH_SHARE
        self.as_gain, self.as_tilt = (1.0, 1.0) if self.by_lights else (ALIKE, 0.5 * ALIKE)
        self.kink_variance_mm = (KINK_PX * mm_per_pixel) ** 2
        self.register_buffer("noise", noise_std.detach().clone())
        self.register_buffer("image_noise", calibration.noise_std.detach().clone())
        self.register_buffer("light_std", light_std.detach().clone())
        self.gradient = GradientFromNormal()
        self.integrate = PoissonBackground(mm_per_pixel)

    def forward(self, images: Tensor, compensated: Tensor, out: DepthOutput, light: Tensor | None = None) -> ConfidentOutput:
        """The output, and its bounds.

        Args:
            images: (B, 3, H, W), the input of the pipeline.
            compensated: the same after ``Compensate``.
            out: the output of the pipeline.
            light: (B, 3, 6), the light that ``Compensate`` has divided out, see :class:`~torchvts.core.frame.Conditions`; None for
                none. What it changes unevenly by a share u, a slope of u would change, too: a contact may be part of it. And a
                gamma that changes a pattern of light by so much changes all slopes by a share of u / pattern.
        Raises:
            ValueError: wrong shapes, or another size than the calibrated one.
        """
        self._check(images, compensated, out)
        sigma = self._noise_of(images)
        base = self.normals(compensated, None)
        again = self.normals(compensated, out.depth_mm) if self.uses_depth else base
        n_z = out.normal[:, 2:3]
        steep = n_z.square()  # an error of slope turns the normal by so much, at most along one axis
        noise, model = self._through_the_inverse(base, compensated, sigma)
        if self.by_lights:
            shadowed = self.normals.shadowed
            dark = shadowed.dark(compensated) | (compensated >= shadowed.saturated_above)
            noise = noise * self._unexplained(compensated, out.depth_mm, again, dark, sigma)
            model = model * (2.0 - 2.0 * n_z) + self.clipped_variance * dark.any(dim=1, keepdim=True).to(noise.dtype)
        else:
            model = (self.per_mean * self.stated(compensated)).square()
        unseen = torch.tan(torch.deg2rad(unseen_deg(self.gradient(base.detach()), self.cells, self.sure, self.least_spread)))
        spread = (unseen / self.sure).square() - self.cell_share * noise.flatten(1).median(dim=1).values  # which counts already
        spread = spread.clamp_min(0.0)[:, None, None, None]  # of slopes
        contrast = torch.full_like(unseen, self.uneven_at_calibration**2)
        if light is not None:
            if not torch.jit.is_scripting():
                check_tensor("light", light)
            if light.shape != (images.shape[0], 3, 6):
                raise ValueError(f"light: expected ({images.shape[0]}, 3, 6), got {light.shape}: conditions.light of these images")
            uneven = light[:, :, 1:].detach().square().sum(dim=2) / light[:, :, 0].detach().square().clamp_min(1e-6)
            contrast = contrast + uneven.mean(dim=1)
            # of lights 120 degrees apart: u where all slopes are u
            unseen = torch.sqrt(unseen.square() + uneven.sum(dim=1) / 1.5)
        unseen = torch.atan(unseen)
        of_slopes = (self.per_uneven**2 * contrast)[:, None, None, None] * out.gradient.square().sum(dim=1, keepdim=True)
        spread = (spread + of_slopes) * steep.square()
        inside = out.deformed.to(noise.dtype)
        better = self.gradient(again)
        surface = self._not_integrable(out, better, inside, noise / steep.square()) * steep.square()
        bound = self.quantile * torch.sqrt(noise + spread + model + surface + 1e-12)
        hidden = torch.sqrt(unseen.square()[:, None, None, None] + self.quantile**2 * noise)
        normal_95 = torch.rad2deg(torch.where(out.deformed, bound, hidden)).clamp_max(180.0)
        missed_mm = self.missed_mm * torch.tan(hidden.clamp_max(self.steepest))
        depth_95 = self._depth_95(out, better, inside, noise + surface, model + spread)
        depth_95 = depth_95 + missed_mm * (1.0 - inside)
        # the inverse of bound_at
        likely = 1.0 - torch.exp(math.log(0.05) * (self.useful_deg / normal_95) ** (2.0 / self.spread))
        frame = self._of_frame(likely, out, torch.rad2deg(unseen))
        parts = torch.rad2deg(torch.cat((noise, spread, model, surface), dim=1).sqrt())
        return ConfidentOutput(
            out.depth_mm, out.gradient, out.normal, out.contact, out.deformed, normal_95, depth_95, likely, frame, parts
        )

    def _of_frame(self, likely: Tensor, out: DepthOutput, unseen: Tensor) -> Tensor:
        """Mean confidence over the contact, of all of the frame without, and how sure it is that no contact was missed: (B,)."""
        contact = out.contact.to(likely.dtype)
        count = contact.sum(dim=(1, 2, 3))
        frame = torch.where(count > 0, (likely * contact).sum(dim=(1, 2, 3)) / count.clamp_min(1.0), likely.mean(dim=(1, 2, 3)))
        slope = torch.rad2deg(torch.acos(out.normal[:, 2:3].detach().clamp(-1.0, 1.0))).square() * contact  # degrees^2
        slope = torch.where(count > 0, slope.sum(dim=(1, 2, 3)) / count.clamp_min(1.0), torch.full_like(count, self.faint_deg**2))
        return frame * slope.square() / (slope.square() + unseen.square().square()).clamp_min(1e-6)

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
        """(B, 3, H, W): noise of the compensated frame, the calibrated one raised where the frame has more, or shows nothing."""
        more = (frame_noise_std(images.detach()) / self.image_noise).clamp_min(1.0).square()
        factor = torch.sqrt((more + self.fixed) / (1.0 + self.fixed))  # the background's part is what it was
        noise = self.noise[None] * factor[:, :, None, None]
        if self.by_lights:  # whose normals know where a light is blocked
            return noise
        return noise.masked_fill((images <= self.black) | (images >= self.saturated), self.usual_change)

    def _through_the_inverse(self, base: Tensor, compensated: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
        """Variances along one axis of the angle, radians^2, by noise and by the light's error."""
        noise = torch.zeros_like(base[:, 0:1])
        model = torch.zeros_like(noise)
        for k in range(3):
            step = torch.zeros_like(compensated)
            step[:, k : k + 1] = sigma[:, k : k + 1]
            turn = 0.5 * (self.normals(compensated + step, None) - base).square().sum(1, keepdim=True)
            noise = noise + turn
            model = model + turn * (self.light_std[k : k + 1] / sigma[:, k : k + 1]).square()
        return noise, model

    def _not_integrable(self, out: DepthOutput, again: Tensor, inside: Tensor, noise: Tensor) -> Tensor:
        """Variance of slopes by what the model gives with the depth found, beyond the variance of noise, and, where they are those
        of the depth, by what blur took from edges."""
        height, width = inside.shape[2], inside.shape[3]
        cell = max(1, min(height, width) // self.around)
        odd = (out.gradient - again).square().sum(1, keepdim=True)
        odd = (odd - noise) * inside  # half of white noise is the gradient of a surface
        both = nn.functional.avg_pool2d(whole_cell_means(torch.cat((odd, inside), 1), cell), 3, 1, 1)
        found = self.curl_share * cells_to_pixels(both[:, :1].clamp_min(0.0) / both[:, 1:].clamp_min(1e-6), cell, height, width)
        if self.blur_px > 0.0 and not self.by_lights:
            taken = (blur(out.gradient, self.weights) - out.gradient).square().sum(1, keepdim=True)
            found = found + self.edge_share * nn.functional.max_pool2d(taken, 2 * self.reach + 1, 1, self.reach)
        return found

    def _depth_95(self, out: DepthOutput, again: Tensor, inside: Tensor, white: Tensor, alike: Tensor) -> Tensor:
        """Bound of depth by variances of the angle along one axis that are independent from pixel to pixel, and alike all over."""
        gradient, steep = out.gradient, out.normal[:, 2:3].square()
        std = torch.sqrt(alike + 1e-14) / steep.clamp_min(0.05) * inside
        length = torch.sqrt(gradient.square().sum(1, keepdim=True) + std.square() + 1e-12)
        none = torch.zeros_like(std)
        tilts = torch.cat((torch.cat((std, none), 1), torch.cat((none, std), 1)))
        found: Tensor = self.integrate(torch.cat(((again - gradient) * inside, std * gradient / length, tilts)))
        found = found.reshape(4, std.shape[0], 1, std.shape[2], std.shape[3])
        count = inside.sum(dim=(1, 2, 3), keepdim=True).clamp_min(1.0)
        mean = (white / steep.square().clamp_min(0.01) * inside).sum(dim=(1, 2, 3), keepdim=True) / count
        growth = 0.2 + torch.log1p(torch.sqrt(count / math.pi)) / (2.0 * math.pi)
        scatter = mean * growth * (self.correlation * self.mm_per_pixel) ** 2
        kink = self.kink_variance_mm * gradient.square().sum(dim=(1, 2, 3), keepdim=True) / count
        variance = scatter + kink + self.as_gain * found[1].square() + self.as_tilt * found[2:].square().sum(0)
        if self.blur_px > 0.0:  # what blur took from edges
            taken = (blur(out.depth_mm, self.weights) - out.depth_mm).square()
            variance = variance + self.edge_depth_share * nn.functional.max_pool2d(taken, 2 * self.reach + 1, 1, self.reach)
        return found[0].abs() + 1.96 * torch.sqrt(variance)


def quantile_95(presses: float | None = None) -> float:
    """95 % quantile of the length of a two-dimensional Gaussian error, over its standard deviation along one axis, where that is
    estimated from so many presses; None where it is exact.

    Source:
        the distribution of F with 2 and n degrees of freedom; without an end of presses Rayleigh's.
    Example:
        >>> [round(quantile_95(n), 2) for n in (5, 16, None)]
        [3.4, 2.7, 2.45]
    """
    if presses is None:
        return math.sqrt(2.0 * math.log(20.0))
    presses = check_least("presses", presses, 1.0)
    return math.sqrt(presses * (20.0 ** (2.0 / presses) - 1.0))


def light_std_by_fit(calibration: Calibration) -> Tensor:
    """(3, H, W), error of the light from that of its direction and from the misfit of its fit, per unit of |n - n_flat|."""
    assert calibration.lights is not None
    none, dtype = [0.0, 0.0, 0.0], calibration.background.dtype
    direction = torch.tensor(calibration.report.get("direction_std_deg", none), dtype=dtype).nan_to_num(45.0).clamp(0.0, 45.0)
    misfit = torch.tensor(calibration.report.get("misfit", none), dtype=dtype).nan_to_num(1.0).clamp(0.0, 1.0)
    rise = calibration.lights.direction[:, 2].detach().clamp_min(0.2)
    off = torch.hypot(torch.deg2rad(direction) / rise, MISFIT_SHARE * misfit)
    return calibration.model_image.detach() * off.reshape(3, 1, 1)


class ConfidentPipeline(nn.Module):
    """A pipeline that also bounds its errors: images (B, 3, H, W) to a :class:`ConfidentOutput`.

    Args:
        pipe: the pipeline.
        confidence: of the same calibration.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> cal = Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))
        >>> pipe = ConfidentPipeline(DepthPipeline.from_calibration(cal), Confidence(cal))
        >>> pipe(cal.model_image[None])._fields[5:]
        ('normal_95_deg', 'depth_95_mm', 'confidence', 'frame_confidence', 'factors_deg')
    """

    def __init__(self, pipe: DepthPipeline, confidence: Confidence) -> None:
        super().__init__()
        check_record("pipe", pipe, DepthPipeline, "DepthPipeline.from_calibration makes one")
        check_record("confidence", confidence, Confidence, "Confidence(calibration) makes one")
        self.pipe = pipe
        self.relights = isinstance(pipe.compensate, Compensate)
        self.confidence = confidence

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
        return eval_around(cls(pipe, Confidence(calibration, pipe.normals)), normals, integrate)

    if TYPE_CHECKING:

        def __call__(self, images: Tensor) -> ConfidentOutput: ...

    def forward(self, images: Tensor) -> ConfidentOutput:
        """As :meth:`DepthPipeline.forward`."""
        out: DepthOutput = self.pipe(images)
        compensate = self.pipe.compensate
        light = compensate.light_of(images) if self.relights else None
        bounded: ConfidentOutput = self.confidence(images, compensate(images), out, light)
        return bounded


def _smooth(values: Tensor) -> Tensor:
    """Mean over 5 x 5 pixels."""
    return nn.functional.avg_pool2d(nn.functional.pad(values, [2, 2, 2, 2], mode="replicate"), 5, 1)
