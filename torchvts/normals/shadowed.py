"""Normals of pixels where a light is blocked, a channel is saturated, or the light matrix is ill-conditioned."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..core.checks import check_shape, may_read, may_read_values
from ..core.geometry import gradient_from_normal, normal_from_gradient, slope_of_depth
from ..core.noise import dark_below
from ..model.lights import glossy_light, light_matrix, seen_at

LEFT_OUT = -1.0
"""Intensity of a channel that is left out at a pixel because something else than the skin's slope blocks its light. No camera gives
half of it."""

PRIOR_STD = 0.25
"""Spread of slopes about what is known of them beforehand."""

SLOPE_STEPS = 3
"""Gauss-Newton steps where a light is blocked."""

BRIGHTNESS_NOISES = 1.5
"""Standard deviation of the common brightness, in units of noise, where a light is blocked."""

LEAST_BRIGHTNESS = 0.005
"""It is so large at least."""

FAILED_SHARE = 0.98
"""A channel that is dark on a larger part of the image has lost its LED, for no shadow is so large."""


UNCHANGED_NOISES = 4.5
"""Change of light, in units of the noise, up to which it is none."""


class LightView(NamedTuple):
    """Lights and camera.

    Attributes:
        position_mm: (3, 3), of the lights.
        albedo: (3,).
        mm_per_pixel: pixel pitch, mm.
        camera_height_mm: infinite for an orthographic camera.
        gloss: (3,), of the lights; None for a matt skin.
    """

    position_mm: Tensor
    albedo: Tensor
    mm_per_pixel: float
    camera_height_mm: float
    gloss: Tensor | None = None


def matrix_in_view(depth_mm: Tensor, view: LightView) -> Tensor:
    """The light matrix at a depth (B, 1, H, W): (B, 3, 3, H, W)."""
    return light_matrix(depth_mm, view.position_mm, view.albedo, view.mm_per_pixel, view.camera_height_mm)


class DarkPixels(NamedTuple):
    """N pixels to solve by themselves.

    Attributes:
        start: (N, 2), slopes (dz/dx, dz/dy) to start from.
        intensity: (N, 3), compensated.
        rows: (N, 3, 3), light matrix.
        saturated: (N, 3) bool, channels that are saturated; one that is left out is a saturated one of intensity 0.
        noise_std: (N,), noise of the compensated image, against which the prior is weighed.
        brightness_std: (N,), of the common brightness, relative.
        gloss: (3,), of the lights; None for a matt skin.
    """

    start: Tensor
    intensity: Tensor
    rows: Tensor
    saturated: Tensor
    noise_std: Tensor
    brightness_std: Tensor
    gloss: Tensor | None = None


def slope_by_lit_lights(pixels: DarkPixels, prior_std: float = PRIOR_STD, steps: int = SLOPE_STEPS) -> Tensor:
    """Slopes of pixels where a light is blocked or a channel is saturated: each pixel against the clamped model max(0, L n).

    On a glossy skin the lobe is part of the model: two lights leave a direction in which the slope answers to small differences of
    intensity, and a lobe divided out at the last slope would carry it away from pass to pass.

    n is of unit length. A blocked channel says no more than that it is dark, a saturated one that it is at least so bright. That
    leaves two intensities for two slopes and, near |n| = 1, a direction that is poorly constrained. A weak prior of standard
    deviation ``prior_std`` about ``start`` holds that direction; where ``start`` comes from a depth map, the neighbours enter
    through it. The brightness that all channels share counts only to ``brightness_std``: a depth 0.1 mm off changes it by a
    hundredth, and near the plane of two lights, where |n| = 1 bends away from it, noise in it would push the slope. Gauss-Newton
    in closed form, steps of at most 0.5.

    Args:
        pixels: the pixels.
        prior_std: of the slope about ``start``.
        steps: of Gauss-Newton.
    Returns:
        (N, 2).
    Source:
        the shadowed pixels of Barsky and Petrou, TPAMI 25(10), 2003, as a maximum a posteriori estimate.
    """
    start, compensated, rows, gloss = pixels.start, pixels.intensity, pixels.rows, pixels.gloss
    weight = (pixels.noise_std / prior_std).square()
    least_light = 0.1 * pixels.noise_std[:, None]  # above zero, because a black channel starts exactly on the terminator
    trust = (pixels.brightness_std / pixels.noise_std).square()[:, None]
    slope = start
    for _ in range(steps):
        p, q = slope[:, 0:1], slope[:, 1:2]
        n_z = torch.rsqrt(1.0 + p * p + q * q)
        normal = torch.cat((-p * n_z, -q * n_z, n_z), dim=1)
        light, change = (rows * normal[:, None]).sum(2), rows  # (N, 3), (N, light, axis)
        if gloss is not None:
            light, change = glossy_light(rows, normal, gloss)
        lit = ((light > least_light) & ~(pixels.saturated & (light >= compensated))).to(light.dtype)
        # d normal / d slope is -n_z (e - n (n.e)) along x and y: the part of the light row across the normal
        change = change - (change * normal[:, None]).sum(2, keepdim=True) * normal[:, None]
        across = -n_z[:, :, None] * change[:, :, 0:2] * lit[:, :, None]
        model = light * lit
        residual = compensated * lit - model
        # whitened by the covariance noise^2 1 + brightness^2 model model^T
        energy = (model * model).sum(1, keepdim=True)
        common = (1.0 - torch.rsqrt(1.0 + trust * energy)) / energy.clamp_min(1e-12)
        along = common * model
        residual = residual - along * (model * residual).sum(1, keepdim=True)
        across = across - along[:, :, None] * (model[:, :, None] * across).sum(1, keepdim=True)
        a = (across[:, :, 0] ** 2).sum(1) + weight
        b = (across[:, :, 0] * across[:, :, 1]).sum(1)
        c = (across[:, :, 1] ** 2).sum(1) + weight
        right = (across * residual[:, :, None]).sum(1) + weight[:, None] * (start - slope)
        step = torch.stack((c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]), dim=1)
        p_q = torch.linalg.cross(across[:, :, 0], across[:, :, 1], dim=1)
        # a c - b^2 without cancellation (Cauchy-Binet): one lit channel leaves a determinant of the prior's size
        determinant = (p_q * p_q).sum(1) + weight * (a + c - weight)
        step = step / determinant[:, None]
        length = torch.sqrt((step * step).sum(1, keepdim=True) + 1e-18)
        slope = slope + step * (0.5 / length).clamp_max(1.0)
    return slope


def failed_leds(dark: Tensor, share: float = FAILED_SHARE) -> Tensor:
    """Channels whose LED has failed, bool (B, 3): dark (B, 3, H, W) on more than that share of the image."""
    return dark.to(torch.float32).mean(dim=(2, 3)) > share


class ShadowedPixels(nn.Module):
    """Replaces normals where the plain inverse does not hold; the others stay as they are.

    That is where a light that shines on the flat skin is dark, where a channel is saturated, and where the matrix is so
    ill-conditioned that its inverse makes more of the noise than slopes vary (``PRIOR_STD``). Where an LED has failed, the other
    two and |n| = 1 are left, so all pixels go this way, starting from the flat skin.

    Args:
        flat: (3, H, W), what the lights give on the flat skin.
        noise_std: (3,), noise of the compensated image at calibration.
        inverse: (3, 3, H, W), the inverse light matrix at the flat skin.
        saturated_above: (3, H, W), intensity from which a channel counts as saturated; None for never.
    """

    noise_std: Tensor
    flat: Tensor
    saturated_above: Tensor
    ill_conditioned: Tensor

    def __init__(self, flat: Tensor, noise_std: Tensor, inverse: Tensor, saturated_above: Tensor | None) -> None:
        super().__init__()
        self.left_out, self.brightness_noises, self.unchanged_noises = LEFT_OUT, BRIGHTNESS_NOISES, UNCHANGED_NOISES
        self.least_brightness = LEAST_BRIGHTNESS
        self.register_buffer("noise_std", noise_std.detach().to(flat.dtype))
        self.follow(flat, inverse)
        if saturated_above is not None:
            check_shape("saturated_above", saturated_above, flat.shape)
        above = (
            torch.full_like(flat, torch.inf) if saturated_above is None else saturated_above.detach().to(flat.dtype).contiguous()
        )
        self.register_buffer("saturated_above", above)

    def follow(self, flat: Tensor, inverse: Tensor) -> None:
        """Take over what depends on the lights: where the flat skin is lit, and where the matrix is ill-conditioned."""
        noise = float(self.of_all_channels())
        ill_conditioned = ~(noise * inverse.square().sum(dim=(0, 1)).sqrt() <= PRIOR_STD)  # infinite ones too
        self.any_ill_conditioned = bool(ill_conditioned.any())
        self.register_buffer("ill_conditioned", ill_conditioned)
        self.register_buffer("flat", flat.detach().clone())

    def of_all_channels(self) -> Tensor:
        """Root mean square of the channels' noise, a scalar."""
        return self.noise_std.square().mean().sqrt().clamp_min(1e-6)

    def brightness_std(self, noise: Tensor) -> Tensor:
        """Relative standard deviation of the brightness that all channels share, where their noise is so large."""
        return (self.brightness_noises * noise).clamp_min(self.least_brightness)

    def nowhere_dark(self, image: Tensor) -> bool:
        """Whether no channel of an image (B, 3, H, W) is below three times its noise; where it is, ``dark`` says more."""
        return bool((image.detach().amin(dim=(2, 3)) >= 3.0 * self.noise_std).all())

    def dark(self, image: Tensor) -> Tensor:
        """Channels whose light is blocked, bool (B, 3, H, W); see :func:`~torchvts.core.noise.dark_below`."""
        return image < dark_below(self.flat, 3.0 * self.noise_std[:, None, None])

    def all_valid(self, image: Tensor) -> bool:
        """Whether no pixel of the image needs this module."""
        image = image.detach()
        if self.any_ill_conditioned:
            return False
        if float((image - self.saturated_above).amax()) >= 0.0:  # by subtraction, three times as fast as comparison
            return False
        return self.nowhere_dark(image) or not bool(self.dark(image).any())

    def forward(self, normal: Tensor, image: Tensor, depth_mm: Tensor | None, view: LightView, expected: Tensor | None) -> Tensor:
        """Normals (B, 3, H, W) with those replaced that the plain inverse got wrong.

        Args:
            normal: (B, 3, H, W), by the plain inverse.
            image: (B, 3, H, W), compensated.
            depth_mm: (B or 1, 1, H, W), the depth so far; its slopes are the start.
            view: lights and camera.
            expected: (B, 2, H, W), slopes to start from where there is no depth; None for those of ``normal``.
        """
        if may_read(image) and self.all_valid(image):
            return normal
        dark = self.dark(image)
        failed = failed_leds(dark)
        invalid = dark | (image >= self.saturated_above) | failed[:, :, None, None]
        wanted = invalid.any(dim=1) | self.ill_conditioned
        b, row, column = _places(wanted)
        start = gradient_from_normal(normal[b, :, row, column][:, :, None, None])[:, :, 0, 0]
        if expected is not None:
            start = expected[b, :, row, column]
        start = torch.where((failed.any(dim=1)[b] | self.ill_conditioned[row, column])[:, None], torch.zeros_like(start), start)
        z = torch.zeros_like(start[:, 0])
        if depth_mm is not None:  # its neighbours enter through it
            depth = depth_mm.expand(image.shape[0], 1, image.shape[2], image.shape[3])
            z = depth[b, 0, row, column]
            start = slope_of_depth(depth, view.mm_per_pixel)[b, :, row, column]
        x = (column.to(normal.dtype) - 0.5 * (image.shape[3] - 1)) * view.mm_per_pixel
        y = (row.to(normal.dtype) - 0.5 * (image.shape[2] - 1)) * view.mm_per_pixel
        if depth_mm is not None:
            x, y = seen_at(x, z, view.camera_height_mm), seen_at(y, z, view.camera_height_mm)
        to_light = view.position_mm - torch.stack((x, y, z), dim=1)[:, None]  # (N, light, axis)
        squared = (to_light * to_light).sum(2, keepdim=True)
        rows = view.albedo[None, :, None] * to_light * (squared.rsqrt() / squared)
        intensity, lost = image[b, :, row, column], failed[b]
        saturated = (intensity >= self.saturated_above[:, row, column].t()) | lost | (intensity <= 0.5 * self.left_out)
        std = self.of_all_channels().expand(start.shape[0])
        pixels = DarkPixels(
            start, intensity * (~lost).to(intensity.dtype), rows, saturated, std, self.brightness_std(std), view.gloss
        )
        slope = slope_by_lit_lights(pixels)
        solution = normal_from_gradient(slope[:, :, None, None])[:, :, 0, 0]
        solution = torch.where(wanted[b, row, column][:, None], solution, normal[b, :, row, column])
        return normal.permute(0, 2, 3, 1).index_put((b, row, column), solution).permute(0, 3, 1, 2)

    @torch.jit.export
    def blocked(self, image: Tensor) -> Tensor:
        """Where one or two of the lights that shine on the flat skin are dark, (B, 1, H, W) bool; a failed LED is not counted."""
        if may_read(image) and self.nowhere_dark(image):
            return torch.zeros_like(image[:, 0:1], dtype=torch.bool)
        dark = self.dark(image)
        return (dark & ~failed_leds(dark)[:, :, None, None]).any(dim=1, keepdim=True)

    @torch.jit.export
    def undeformed_in_shadow(self, image: Tensor) -> Tensor:
        """Where one channel is dark and the two others are unchanged, bool (B, 1, H, W).

        The skin may be undeformed there, in a shadow of the object; or it has the one slope that looks the same.
        """
        dark = self.dark(image)
        return ~self.changed(image) & (dark.to(torch.uint8).sum(dim=1, keepdim=True) == 1)

    @torch.jit.export
    def changed(self, image: Tensor) -> Tensor:
        """Where channels that are not dark differ from the undeformed skin's by more than their noise, bool (B, 1, H, W)."""
        change = ((image - self.flat) / self.noise_std[:, None, None]).masked_fill(self.dark(image), 0.0)
        return change.square().sum(dim=1, keepdim=True) > self.unchanged_noises**2

    @torch.jit.export
    def without_dark(self, image: Tensor) -> Tensor:
        """The image (B, 3, H, W) with dark channels left out, as where something else than the skin's slope blocks the light."""
        return image.masked_fill(self.dark(image), self.left_out)

    @torch.jit.export
    def mirrored(self, gradient: Tensor, image: Tensor, depth_mm: Tensor, view: LightView) -> Tensor:
        """Slopes that fit as well where one light is blocked, but lie beyond the plane of the other two.

        Two lights and |n| = 1 leave a normal and its mirror image. On walls the one beyond the plane is right, and no start near a
        depth that is still too low finds it.

        Args:
            gradient: (B, 2, H, W), slopes so far.
            image: (B, 3, H, W), compensated.
            depth_mm: (B, 1, H, W).
            view: lights and camera.
        Returns:
            (B, 2, H, W); as they are elsewhere.
        """
        matrix = matrix_in_view(depth_mm, view)
        dark = self.dark(image)
        dark = dark & ~failed_leds(dark)[:, :, None, None]
        one = dark.to(torch.uint8).sum(dim=1, keepdim=True) == 1
        normal = normal_from_gradient(gradient)
        result = normal
        for light in range(3):
            plane = torch.linalg.cross(matrix[:, (light + 1) % 3], matrix[:, (light + 2) % 3], dim=1)
            along = (normal * plane).sum(dim=1, keepdim=True)
            towards = along * (plane * matrix[:, light]).sum(dim=1, keepdim=True) > 0.0
            reflected = normal - plane * (2.0 * along / plane.square().sum(dim=1, keepdim=True).clamp_min(1e-30))
            result = torch.where(one & towards & dark[:, light : light + 1], reflected, result)
        return gradient_from_normal(result)


def _places(wanted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Frame, row and column of the wanted pixels, (B, H, W) bool; on a GPU of all, because their number would be waited for."""
    if may_read_values() and not may_read(wanted):
        height, width = wanted.shape[1], wanted.shape[2]
        place = torch.arange(wanted.numel(), device=wanted.device)
        pixel = place % (height * width)
        return place // (height * width), pixel // width, pixel % width
    b, row, column = torch.where(wanted)
    return b, row, column
