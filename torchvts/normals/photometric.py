"""Normals by photometric stereo with near lights."""

import math

import torch
from torch import Tensor, nn

from ..core import native
from ..core.checks import (
    QUANTISATION_STD,
    check_batch,
    check_camera_height,
    check_integer,
    check_record,
    check_same_count,
    check_same_size,
    check_shape,
    check_size,
    check_window,
    may_read_values,
)
from ..core.geometry import MAX_SLOPE, gradient_from_normal, normal_from_gradient
from ..core.native import may_use_native
from ..model.calibration import Calibration, check_calibration
from ..model.lights import PointLights, flat_image, gloss_lobe, inverse_light_matrix, light_matrix, normal_at_depth, seen_at

LEFT_OUT = -1.0
"""Intensity of a channel that says nothing at a pixel, because something keeps its light off: relight.c knows it too. No camera
gives half of it."""

CLIFF_SLOPE = 2.0
"""Difference of neighbouring slopes from which depth is taken for a cliff."""


PRIOR_STD = 0.25
"""How far slopes spread about what is known of them beforehand."""

STEPS = 3
"""Of Gauss-Newton where a light is blocked."""

BRIGHTNESS_NOISES = 1.5
"""Brightness counts to so many noises where a light is blocked. Trusted fully, a ball at a noise of 0.01 keeps a quarter of the
plain inverse's error instead of a fifth; to 2 % at any noise, walls of slope 4 at a noise of 0.002 are twice as wrong."""


def slope_by_lit_lights(
    start: Tensor,
    compensated: Tensor,
    rows: Tensor,
    full: Tensor,
    noise_std: float,
    prior_std: float = PRIOR_STD,
    brightness_std: float = 0.01,
    steps: int = STEPS,
) -> Tensor:
    """Slopes of pixels where a light is blocked or a channel is full: each pixel against the clamped model max(0, L n).

    n is of unit length. A blocked channel says no more than that it is dark, a full one that it is at least so bright, which
    leaves two numbers for two slopes and, near |n| = 1, a direction that is badly pinned. A weak prior (``prior_std``) towards
    ``start`` holds that direction; when ``start`` comes from a depth map, its neighbours speak through it. The brightness that
    all channels share counts no more than to ``brightness_std``: a depth 0.1 mm off changes it by a hundredth, and near the plane
    of two lights, where |n| = 1 bends away from it, noise in it would push the slope. Gauss-Newton in closed form, steps of at
    most 0.5.

    Args:
        start: (N, 2), slopes (dz/dx, dz/dy). compensated: (N, 3). rows: (N, 3, 3), light matrix.
        full: (N, 3) bool, channels that are saturated; one that is broken is a full one of intensity 0.
        noise_std: of the compensated image, against which the prior is weighed.
        prior_std: of the slope about ``start``. brightness_std: relative. steps: of Gauss-Newton.
    Returns:
        (N, 2).
    Source:
        the shadowed pixels of Barsky and Petrou, TPAMI 25(10), 2003, as a maximum a posteriori estimate.
    """
    weight = (noise_std / prior_std) ** 2
    slope = start
    for _ in range(steps):
        p, q = slope[:, 0:1], slope[:, 1:2]
        n_z = torch.rsqrt(1.0 + p * p + q * q)
        normal = torch.cat((-p * n_z, -q * n_z, n_z), dim=1)
        light = (rows * normal[:, None]).sum(2)  # (N, 3)
        # 0.1 sigma above zero, because a black channel starts exactly on the terminator
        lit = ((light > 0.1 * noise_std) & ~(full & (light >= compensated))).to(light.dtype)
        # d normal / d slope is -n_z (e - n (n.e)) along x and y: the part of the light row across the normal
        across = -n_z[:, :, None] * (rows - light[:, :, None] * normal[:, None])[:, :, 0:2] * lit[:, :, None]
        seen = light * lit
        residual = compensated * lit - seen
        # whitened by the covariance noise^2 1 + brightness^2 seen seen^T
        energy = (seen * seen).sum(1, keepdim=True)
        common = (1.0 - torch.rsqrt(1.0 + (brightness_std / noise_std) ** 2 * energy)) / energy.clamp_min(1e-12)
        along = common * seen
        residual = residual - along * (seen * residual).sum(1, keepdim=True)
        across = across - along[:, :, None] * (seen[:, :, None] * across).sum(1, keepdim=True)
        a = (across[:, :, 0] ** 2).sum(1) + weight
        b = (across[:, :, 0] * across[:, :, 1]).sum(1)
        c = (across[:, :, 1] ** 2).sum(1) + weight
        right = (across * residual[:, :, None]).sum(1) + weight * (start - slope)
        step = torch.stack((c * right[:, 0] - b * right[:, 1], a * right[:, 1] - b * right[:, 0]), dim=1)
        p_q = torch.linalg.cross(across[:, :, 0], across[:, :, 1], dim=1)
        # a c - b^2 without cancellation (Cauchy-Binet): one lit channel leaves a determinant of the prior's size
        determinant = (p_q * p_q).sum(1) + weight * (a + c - weight)
        step = step / determinant[:, None]
        length = torch.sqrt((step * step).sum(1, keepdim=True) + 1e-18)
        slope = slope + step * (0.5 / length).clamp_max(1.0)
    return slope


def extrapolated_slope(slope: Tensor, sure: Tensor, cell: int, top: int = 0, left: int = 0) -> Tensor:
    """Slopes of all pixels as those that are sure foretell them: planes through them, the nearer the more they count.

    Moving least squares over cells of pixels, with weights that fall with the fourth power of the distance: free of any scale,
    so that a plane spans a gap of any width by what is as wide around it.

    Args:
        slope: (B, 2, H, W). sure: (B, 1, H, W) bool. cell: side of a cell, pixels. top, left: the first pixel's place in the
            image, so that parts of an image have the same cells.
    Returns:
        (B, 2, H, W); zero in frames without a sure pixel.
    Source:
        Lancaster and Salkauskas, Surfaces generated by moving least squares methods, Math. Comp. 37, 1981.
    Example:
        >>> x = torch.linspace(0, 1, 32).expand(1, 1, 32, 32)
        >>> plane = torch.cat((x, 1 - x), dim=1)
        >>> found = extrapolated_slope(plane, x < 0.5, 2)
        >>> bool((found - plane).abs().max() < 0.02)
        True
    """
    count, height, width = slope.shape[0], slope.shape[2], slope.shape[3]
    before, above = left % cell, top % cell
    rows, columns = (above + height + cell - 1) // cell, (before + width + cell - 1) // cell
    y = (torch.arange(height, dtype=slope.dtype, device=slope.device) + (above + 0.5)) / cell
    x = (torch.arange(width, dtype=slope.dtype, device=slope.device) + (before + 0.5)) / cell
    known = sure.to(slope.dtype)
    here = torch.stack((x.expand(height, width), y[:, None].expand(height, width)))[None]
    beyond = [before, columns * cell - before - width, above, rows * cell - above - height]
    sums = nn.functional.avg_pool2d(nn.functional.pad(torch.cat((known, known * here, known * slope), dim=1), beyond), cell)
    sums = sums.flatten(2).transpose(1, 2)  # (B, cells, 5)
    mass = sums[:, :, 0:1]
    mean = sums[:, :, 1:] / mass.clamp_min(1e-12)
    y = torch.arange(rows, dtype=slope.dtype, device=slope.device).repeat_interleave(columns) + 0.5
    x = torch.arange(columns, dtype=slope.dtype, device=slope.device).repeat(rows) + 0.5
    apart = (x[None, :, None] - mean[:, None, :, 0]).square() + (y[None, :, None] - mean[:, None, :, 1]).square()
    weight = mass.transpose(1, 2) / (apart + 0.03).square()  # (B, cell, cell that tells)
    weight = weight / weight.sum(2, keepdim=True).clamp_min(1e-12)
    products = mean[:, :, 0:2, None] * mean[:, :, None, :]  # (B, cells, 2, 4)
    center = weight @ mean
    spread = (weight @ products.flatten(2)).reshape(count, -1, 2, 4) - center[:, :, 0:2, None] * center[:, :, None, :]
    # of a cell's size at least: cells on one line tell nothing across it
    xx, xy, yy = spread[:, :, 0, 0:1] + 0.03, spread[:, :, 0, 1:2], spread[:, :, 1, 1:2] + 0.03
    along_x, along_y = spread[:, :, 0, 2:4], spread[:, :, 1, 2:4]
    determinant = xx * yy - xy * xy
    turn_x, turn_y = (yy * along_x - xy * along_y) / determinant, (xx * along_y - xy * along_x) / determinant
    planes = torch.cat((center[:, :, 2:4] - turn_x * center[:, :, 0:1] - turn_y * center[:, :, 1:2], turn_x, turn_y), dim=2)
    grid = planes.transpose(1, 2).reshape(count, 6, rows, columns)
    grid = grid.repeat_interleave(cell, dim=2).repeat_interleave(cell, dim=3)
    grid = grid[:, :, above : above + height, before : before + width]
    return grid[:, 0:2] + grid[:, 2:4] * here[:, 0:1] + grid[:, 4:6] * here[:, 1:2]


class NormalFromIntensity(nn.Module):
    """Unit normals of a compensated image.

    Without depth, the stored inverse of the light matrix at rest (eq. 9); with depth, the inverse at that depth (eq. 10).
    Where a light is blocked (its channel below three times its noise) or a channel is full, :func:`slope_by_lit_lights` decides;
    also where the lights nearly lie in one plane, so that the inverse makes more of the noise than ``PRIOR_STD``, what is known of
    slopes beforehand: |n| = 1 and that prior then damp it, which the plain inverse does not know. Elsewhere nothing changes.
    While gradients are recorded for the lights (``requires_grad_(True)``), the matrix is built from them at every call. Given
    ``window`` (top, left), the image is the part of the calibrated one whose first pixel is there. ``expected`` (B, 2, H, W) are
    slopes to begin with where a light is blocked, in place of the plain inverse's; a depth counts before them.

    Args:
        lights: the three lights. height, width: pixels. mm_per_pixel: pixel pitch, mm.
        noise_std: (3,), noise of the compensated image; None takes that of 8-bit rounding.
        inverse: (3, 3, H, W), the stored inverse; None computes it.
        full_above: (3, H, W), compensated intensity from which a channel counts as saturated; None for never.
        camera_height_mm: of a pinhole camera above the image centre, which sees deep points nearer to its axis; infinite for an
            orthographic camera. (:class:`PerspectiveIntegration` is its partner.)
    Source:
        eq. 3, 8, 9, 10 of the paper.
    Example:
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> NormalFromIntensity(lights, 8, 8, 0.1)(torch.rand(2, 3, 8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    uses_depth: bool = True
    takes_window: bool = True
    inverse: Tensor
    dark_below: Tensor
    dark_where: Tensor
    full_above: Tensor
    weak: Tensor

    def __init__(
        self,
        lights: PointLights,
        height: int,
        width: int,
        mm_per_pixel: float,
        noise_std: Tensor | None = None,
        inverse: Tensor | None = None,
        full_above: Tensor | None = None,
        camera_height_mm: float = math.inf,
    ) -> None:
        super().__init__()
        check_record("lights", lights, PointLights, "PointLights(position_mm, albedo) makes them")
        check_size(height, width, mm_per_pixel)
        self.mm_per_pixel = mm_per_pixel
        self.camera_height_mm = check_camera_height(camera_height_mm)
        position, albedo = lights.position_mm.detach(), lights.albedo.detach()
        if inverse is None:
            inverse = inverse_light_matrix(position.new_zeros(1, 1, height, width), position, albedo, mm_per_pixel)[0]
        check_shape("inverse", inverse, (3, 3, height, width))
        self.lights = PointLights(position, albedo, lights.gloss).requires_grad_(False)
        noise = torch.full((3,), QUANTISATION_STD) if noise_std is None else noise_std
        check_shape("noise_std", noise, (3,))
        if not bool((noise >= 0).all()):
            raise ValueError(f"noise_std: expected values of at least 0, got {noise.tolist()}")
        self.left_out = LEFT_OUT
        self.noise_std = max(float(noise.square().mean().sqrt()), 1e-6)
        self.brightness_std = max(0.005, BRIGHTNESS_NOISES * self.noise_std)
        self.register_buffer("inverse", inverse.detach().clone())
        self.register_buffer("dark_below", 3.0 * noise.detach().to(inverse.dtype))
        # where the noise of the inverse exceeds what is known of slopes beforehand, lights that nearly lie in one plane
        spread = self.noise_std * inverse.detach().square().sum(dim=(0, 1)).sqrt()
        weak = ~(spread <= PRIOR_STD)  # infinite ones too
        self.ill = bool(weak.any())
        self.register_buffer("weak", weak)
        # a channel can only be called dark where its light shines on the flat skin
        flat = flat_image(self.lights, height, width, mm_per_pixel).to(inverse.dtype)
        below = self.dark_below.reshape(3, 1, 1)
        self.register_buffer("dark_where", torch.where(flat > 2.0 * below, below, -torch.inf))
        if full_above is not None:
            check_shape("full_above", full_above, flat.shape)
        full = torch.full_like(flat, torch.inf) if full_above is None else full_above.detach().to(inverse.dtype)
        self.register_buffer("full_above", full)

    @classmethod
    def from_calibration(cls, calibration: Calibration, camera_height_mm: float = math.inf) -> "NormalFromIntensity":
        """The block of a unit calibrated by lights."""
        check_calibration("calibration", calibration)
        if calibration.lights is None:
            raise ValueError("calibration: expected one by lights, got one by response fields: use NormalFromResponse")
        sensor = calibration.sensor
        return cls(
            calibration.lights,
            sensor.height,
            sensor.width,
            sensor.mm_per_pixel,
            noise_std=calibration.compensated_noise_std.flatten(1).median(dim=1).values,
            inverse=calibration.inverse,
            full_above=calibration.saturated_above,
            camera_height_mm=camera_height_mm,
        )

    def forward(
        self,
        compensated: Tensor,
        depth_mm: Tensor | None = None,
        window: tuple[int, int] | None = None,
        expected: Tensor | None = None,
    ) -> Tensor:
        check_batch("compensated", compensated, 3)
        if expected is not None:
            check_batch("expected", expected, 2)
            check_same_size("expected", expected, "compensated", compensated.shape[2], compensated.shape[3])
            check_same_count("expected", expected, "compensated", compensated.shape[0])
            expected = expected.expand(compensated.shape[0], 2, compensated.shape[2], compensated.shape[3])
        height, width = self.inverse.shape[2], self.inverse.shape[3]
        top, left = check_window("compensated", compensated, (height, width), window)
        bottom, right = top + compensated.shape[2], left + compensated.shape[3]
        if depth_mm is not None:
            check_batch("depth_mm", depth_mm, 1)
            check_same_size("depth_mm", depth_mm, "compensated", compensated.shape[2], compensated.shape[3])
            check_same_count("depth_mm", depth_mm, "compensated", compensated.shape[0])
        if compensated.shape[0] == 0:
            return compensated
        position: Tensor = self.lights.position_mm
        albedo = self.lights.albedo
        whole = bottom - top == height and right - left == width
        # the lights as seen from the window's middle
        x = 0.0 if whole else 0.5 * (left + right - width) * self.mm_per_pixel
        y = 0.0 if whole else 0.5 * (top + bottom - height) * self.mm_per_pixel
        axis = (-x, -y)
        normal = compensated  # TorchScript asks for a value on every way
        tensors = [compensated, position, albedo, self.inverse]
        if depth_mm is not None:
            tensors.append(depth_mm)
        if expected is not None:
            tensors.append(expected)
        by_loops = not self.lights.glossy and may_use_native(tensors)
        if by_loops:
            normal, sound = self._by_loops(compensated, depth_mm, (top, left), axis)
            if sound and not (self.ill and bool(self.weak[top:bottom, left:right].any())):
                return normal
        if not whole:
            position = torch.cat((position[:, 0:1] - x, position[:, 1:2] - y, position[:, 2:3]), dim=1)
        if self.lights.glossy:
            compensated = self._matt(compensated, depth_mm, position, axis)
        if by_loops:
            self._relight_by_loops(normal, compensated, depth_mm, (top, left), position, axis, expected)
            return normal
        normal = self._by_operators(compensated, depth_mm, position, axis, (top, left))
        dark = self.dark_where[:, top:bottom, left:right]
        full = self.full_above[:, top:bottom, left:right]
        weak = self.weak[top:bottom, left:right]
        return self._relight(normal, compensated, depth_mm, position, albedo, dark, full, weak, axis, expected)

    def _by_operators(
        self, compensated: Tensor, depth_mm: Tensor | None, position: Tensor, axis: tuple[float, float], window: tuple[int, int]
    ) -> Tensor:
        albedo = self.lights.albedo
        if depth_mm is not None:
            return normal_at_depth(compensated, depth_mm, position, albedo, self.mm_per_pixel, self.camera_height_mm, axis)
        height, width = compensated.shape[2], compensated.shape[3]
        if torch.is_grad_enabled() and (position.requires_grad or albedo.requires_grad):
            rest = compensated.new_zeros(1, 1, height, width)
            return normal_at_depth(compensated, rest, position, albedo, self.mm_per_pixel)
        top, left = window
        inverse = self.inverse[None, :, :, top : top + height, left : left + width]
        normal = torch.addcmul(inverse[:, :, 0] * compensated[:, 0:1], inverse[:, :, 1], compensated[:, 1:2])
        normal = torch.addcmul(normal, inverse[:, :, 2], compensated[:, 2:3])
        n_x, n_y, n_z = normal[:, 0:1], normal[:, 1:2], normal[:, 2:3]
        return normal * torch.rsqrt(torch.addcmul(torch.addcmul(n_x * n_x, n_y, n_y), n_z, n_z) + 1e-24)

    @torch.jit.unused
    def _by_loops(
        self, compensated: Tensor, depth_mm: Tensor | None, window: tuple[int, int], axis: tuple[float, float]
    ) -> tuple[Tensor, bool]:
        tables = (self.dark_where, self.full_above, self.inverse, window)
        lights = (self.lights.position_mm, self.lights.albedo, self.mm_per_pixel, self.camera_height_mm)
        return native.normals(compensated, *tables, depth_mm, *lights, axis)

    @torch.jit.unused
    def _relight_by_loops(
        self,
        normal: Tensor,
        compensated: Tensor,
        depth_mm: Tensor | None,
        window: tuple[int, int],
        position: Tensor,
        axis: tuple[float, float],
        expected: Tensor | None,
    ) -> None:
        weight, brightness = (self.noise_std / PRIOR_STD) ** 2, (self.brightness_std / self.noise_std) ** 2
        numbers = [self.noise_std, weight, brightness, STEPS, self.mm_per_pixel, 1.0 / self.camera_height_mm, *axis]
        tables = (self.dark_where, self.full_above, self.weak, window)
        lights = (position, self.lights.albedo, [*numbers, CLIFF_SLOPE, MAX_SLOPE])
        native.relight(normal, compensated, *tables, depth_mm, expected, *lights)

    def _matt(self, compensated: Tensor, depth_mm: Tensor | None, position: Tensor, axis: tuple[float, float]) -> Tensor:
        """What a matt skin would show: the specular lobe divided out, at the slope of the depth so far."""
        depth = compensated.new_zeros(1, 1, compensated.shape[2], compensated.shape[3]) if depth_mm is None else depth_mm
        normal = normal_from_gradient(slope_of_depth(depth, self.mm_per_pixel))
        matrix = light_matrix(depth, position, self.lights.albedo, self.mm_per_pixel, self.camera_height_mm, axis)
        matt = compensated / (1.0 + self.lights.gloss.reshape(1, 3, 1, 1) * gloss_lobe(matrix, normal))
        return torch.where(compensated < 0.0, compensated, matt)  # channels left out stay so

    @torch.jit.export
    def blocked(self, compensated: Tensor, window: tuple[int, int] | None = None) -> Tensor:
        """Where one or two of the lights that shine on the flat skin have gone dark, (B, 1, H, W); nowhere for a dead lamp."""
        check_batch("compensated", compensated, 3)
        top, left = check_window("compensated", compensated, (self.inverse.shape[2], self.inverse.shape[3]), window)
        bottom, right = top + compensated.shape[2], left + compensated.shape[3]
        below = self.dark_where[:, top:bottom, left:right]
        if may_read_values() and bool((compensated.detach() - below).amin() >= 0.0):
            return torch.zeros_like(compensated[:, 0:1], dtype=torch.bool)
        dark = compensated < below
        return (dark & ~_dead(dark)[:, :, None, None]).any(dim=1, keepdim=True)

    @torch.jit.export
    def without_dark(self, compensated: Tensor, window: tuple[int, int] | None = None) -> Tensor:
        """The image (B, 3, h, w) with dark channels left out, as where something else than the skin's slope keeps light off."""
        check_batch("compensated", compensated, 3)
        top, left = check_window("compensated", compensated, (self.inverse.shape[2], self.inverse.shape[3]), window)
        bottom, right = top + compensated.shape[2], left + compensated.shape[3]
        return compensated.masked_fill(compensated < self.dark_where[:, top:bottom, left:right], self.left_out)

    @torch.jit.export
    def beyond(self, gradient: Tensor, compensated: Tensor, depth_mm: Tensor, window: tuple[int, int] | None = None) -> Tensor:
        """Slopes that fit as well where one light is blocked, but lie beyond the plane of the other two, away from it.

        Two lights and |n| = 1 leave a normal and its mirror image. Of walls the one beyond the plane is right, and no start near a
        depth that is still too low finds it.

        Args:
            gradient: (B, 2, h, w), slopes so far. compensated: (B, 3, h, w). depth_mm: (B, 1, h, w). window: as :meth:`forward`.
        Returns:
            (B, 2, h, w); as they are elsewhere.
        """
        check_batch("compensated", compensated, 3)
        check_batch("gradient", gradient, 2)
        check_same_size("gradient", gradient, "compensated", compensated.shape[2], compensated.shape[3])
        check_same_count("gradient", gradient, "compensated", compensated.shape[0])
        check_batch("depth_mm", depth_mm, 1)
        check_same_size("depth_mm", depth_mm, "compensated", compensated.shape[2], compensated.shape[3])
        check_same_count("depth_mm", depth_mm, "compensated", compensated.shape[0])
        height, width = self.inverse.shape[2], self.inverse.shape[3]
        top, left = check_window("compensated", compensated, (height, width), window)
        bottom, right = top + compensated.shape[2], left + compensated.shape[3]
        x, y = 0.5 * (left + right - width) * self.mm_per_pixel, 0.5 * (top + bottom - height) * self.mm_per_pixel
        rest = self.lights.position_mm
        place = torch.cat((rest[:, 0:1] - x, rest[:, 1:2] - y, rest[:, 2:3]), dim=1)
        matrix = light_matrix(depth_mm, place, self.lights.albedo, self.mm_per_pixel, self.camera_height_mm, (-x, -y))
        dark = compensated < self.dark_where[:, top:bottom, left:right]
        dark = dark & ~_dead(dark)[:, :, None, None]
        one = dark.to(torch.uint8).sum(dim=1, keepdim=True) == 1
        normal = normal_from_gradient(gradient)
        result = normal
        for light in range(3):
            plane = torch.linalg.cross(matrix[:, (light + 1) % 3], matrix[:, (light + 2) % 3], dim=1)
            along = (normal * plane).sum(dim=1, keepdim=True)
            towards = along * (plane * matrix[:, light]).sum(dim=1, keepdim=True) > 0.0
            mirrored = normal - plane * (2.0 * along / plane.square().sum(dim=1, keepdim=True).clamp_min(1e-30))
            result = torch.where(one & towards & dark[:, light : light + 1], mirrored, result)
        return gradient_from_normal(result)

    def coarse(self, stride: int) -> "NormalFromIntensity":
        """The same for an image of every ``stride``-th pixel."""
        check_integer("stride", stride, 1)
        height, width = self.inverse.shape[2], self.inverse.shape[3]
        rows, columns = len(range(stride // 2, height, stride)), len(range(stride // 2, width, stride))
        coarse = NormalFromIntensity(
            self.lights,
            rows,
            columns,
            self.mm_per_pixel * stride,
            self.dark_below / 3.0,
            full_above=self.full_above[:, stride // 2 :: stride, stride // 2 :: stride],
            camera_height_mm=self.camera_height_mm,
        )
        coarse.lights = self.lights  # one set of parameters
        return coarse

    def _relight(
        self,
        normal: Tensor,
        compensated: Tensor,
        depth_mm: Tensor | None,
        position: Tensor,
        albedo: Tensor,
        dark_where: Tensor,
        full_above: Tensor,
        weak: Tensor,
        axis: tuple[float, float],
        expected: Tensor | None,
    ) -> Tensor:
        """Replace the normals of pixels where a light that shines on the flat skin has gone dark, a channel is full, or L is weak.

        Of a lamp that is dead altogether the other two and |n| = 1 are left: all pixels go this way, and from the flat skin.
        """
        if may_read_values():  # asked by subtraction, which is three times as fast as comparison
            seen = compensated.detach()
            sound = float((seen - dark_where).amin()) >= 0.0 and float((seen - full_above).amax()) < 0.0
            if sound and not (self.ill and bool(weak.any())):
                return normal
        dark = compensated < dark_where
        broken = _dead(dark)
        clipped = dark | (compensated >= full_above) | broken[:, :, None, None]
        b, row, column = torch.where(clipped.any(dim=1) | weak)
        height, width = compensated.shape[2], compensated.shape[3]
        x = (column.to(normal.dtype) - 0.5 * (width - 1)) * self.mm_per_pixel
        y = (row.to(normal.dtype) - 0.5 * (height - 1)) * self.mm_per_pixel
        z = torch.zeros_like(x)
        start = gradient_from_normal(normal[b, :, row, column][:, :, None, None])[:, :, 0, 0]
        if expected is not None:
            start = expected[b, :, row, column]
        start = torch.where((broken.any(dim=1)[b] | weak[row, column])[:, None], torch.zeros_like(start), start)
        if depth_mm is not None:  # its neighbours speak through it
            depth = depth_mm[:, 0].expand(compensated.shape[0], height, width)
            z = depth[b, row, column]
            left, right = depth[b, row, (column - 1).clamp_min(0)], depth[b, row, (column + 1).clamp_max(width - 1)]
            above, below = depth[b, (row - 1).clamp_min(0), column], depth[b, (row + 1).clamp_max(height - 1), column]
            pitch = self.mm_per_pixel
            p = _beside_cliffs((z - left) / pitch, (right - z) / pitch)
            q = _beside_cliffs((z - above) / pitch, (below - z) / pitch)
            start = torch.stack((p, q), dim=1)
            x, y = seen_at(x, z, self.camera_height_mm, axis[0]), seen_at(y, z, self.camera_height_mm, axis[1])
        to_light = position - torch.stack((x, y, z), dim=1)[:, None]  # (N, light, axis)
        squared = (to_light * to_light).sum(2, keepdim=True)
        rows = albedo[None, :, None] * to_light * (squared.rsqrt() / squared)
        intensity, dead = compensated[b, :, row, column], broken[b]
        full = (intensity >= full_above[:, row, column].t()) | dead | (intensity <= 0.5 * self.left_out)
        slope = slope_by_lit_lights(
            start, intensity * (~dead).to(intensity.dtype), rows, full, self.noise_std, brightness_std=self.brightness_std
        )
        solution = normal_from_gradient(slope[:, :, None, None])[:, :, 0, 0]
        return normal.permute(0, 2, 3, 1).index_put((b, row, column), solution).permute(0, 3, 1, 2)


def _dead(dark: Tensor) -> Tensor:
    """Lamps that are dead, (B, 3): black nearly everywhere, for no shadow is so large."""
    return dark.to(torch.float32).mean(dim=(2, 3)) > 0.98


def slope_of_depth(depth_mm: Tensor, mm_per_pixel: float) -> Tensor:
    """Central differences, (B, 2, H, W); one-sided halves at the border, and beside a cliff the difference on its other side."""
    padded = nn.functional.pad(depth_mm, [1, 1, 1, 1], mode="replicate") / mm_per_pixel
    along_x, along_y = padded[..., 1:-1, 1:] - padded[..., 1:-1, :-1], padded[..., 1:, 1:-1] - padded[..., :-1, 1:-1]
    p = _beside_cliffs(along_x[..., :-1], along_x[..., 1:])
    q = _beside_cliffs(along_y[..., :-1, :], along_y[..., 1:, :])
    return torch.cat((p, q), dim=1)


def _beside_cliffs(one: Tensor, other: Tensor, apart: float = CLIFF_SLOPE) -> Tensor:
    """The mean of two slopes, or the smaller where they are so far apart that a cliff must lie on one side."""
    smaller = torch.where(one.abs() < other.abs(), one, other)
    return torch.where((one - other).abs() < apart, 0.5 * (one + other), smaller)
