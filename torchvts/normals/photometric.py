"""Normals by photometric stereo with near lights: eq. 9 and 10 of the paper."""

import math

import torch
from torch import Tensor

from ..core.checks import (
    QUANTISATION_STD,
    check_batch,
    check_camera_height,
    check_float_tensor,
    check_positive,
    check_record,
    check_same_count,
    check_same_size,
    check_shape,
    check_size,
    may_read_values,
    reads_freely,
)
from ..core.geometry import normal_from_gradient, slope_of_depth
from ..model.calibration import Calibration, check_calibration
from ..model.lights import PointLights, flat_image, gloss_lobe, inverse_light_matrix, normal_at_depth
from .base import NormalModel
from .shadowed import LightView, ShadowedPixels, matrix_in_view

GLOSS_STEPS = 3
"""Times that a first pass divides the lobe out, each at the slope of the last."""


class NormalFromIntensity(NormalModel):
    """Unit normals of a compensated image.

    Without depth, by the stored inverse of the light matrix at the undeformed skin (eq. 9); with depth, by the inverse at that
    depth (eq. 10). Where a light is blocked (its channel below three times its noise and below half of the flat skin's light), a
    channel is saturated or the light matrix is ill-conditioned, :class:`~torchvts.normals.shadowed.ShadowedPixels` replaces that
    normal; elsewhere nothing changes. While gradients are recorded for the lights (``requires_grad_(True)``), the matrix is
    built from them at every call. The stored inverse follows the lights: it is computed again where they are no longer those
    that it was made of.

    Args:
        lights: the three lights.
        height: pixels.
        width: pixels.
        mm_per_pixel: pixel pitch, mm.
        noise_std: (3,), noise of the compensated image; None takes that of 8-bit rounding.
        inverse: (3, 3, H, W), the stored inverse; None computes it.
        saturated_above: (3, H, W), compensated intensity from which a channel counts as saturated; None for never.
        camera_height_mm: of a pinhole camera above the image centre, which sees deep points nearer to its axis; infinite for an
            orthographic camera. (:class:`~torchvts.integration.PerspectiveIntegration` is its partner.)
    Source:
        eq. 3, 8, 9, 10 of the paper.
    Example:
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> NormalFromIntensity(lights, 8, 8, 0.1)(torch.rand(2, 3, 8, 8)).shape
        torch.Size([2, 3, 8, 8])
    """

    uses_depth: bool = True
    calibrated: bool = True
    input_domain: str | None = "light"
    inverse: Tensor
    stored_position_mm: Tensor
    stored_albedo: Tensor

    def __init__(
        self,
        lights: PointLights,
        height: int,
        width: int,
        mm_per_pixel: float,
        noise_std: Tensor | None = None,
        inverse: Tensor | None = None,
        saturated_above: Tensor | None = None,
        camera_height_mm: float = math.inf,
    ) -> None:
        super().__init__()
        self.gloss_steps = GLOSS_STEPS
        check_record("lights", lights, PointLights, "PointLights(position_mm, albedo) makes them")
        check_size(height, width, mm_per_pixel)
        self.mm_per_pixel = mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.camera_height_mm = check_camera_height(camera_height_mm)
        self.lights = PointLights(lights.position_mm.detach(), lights.albedo.detach(), lights.gloss).requires_grad_(False)
        if inverse is None:
            inverse = self._inverse_of_lights(height, width)
        check_float_tensor("inverse", inverse)
        check_shape("inverse", inverse, (3, 3, height, width))
        noise = torch.full((3,), QUANTISATION_STD) if noise_std is None else noise_std
        check_float_tensor("noise_std", noise)
        check_shape("noise_std", noise, (3,))
        if not bool((noise >= 0).all()):
            raise ValueError(f"noise_std: expected values of at least 0, got {noise.tolist()}")
        self.register_buffer("inverse", inverse.detach().clone())
        self.register_buffer("stored_position_mm", self.lights.position_mm.detach().clone(), persistent=False)
        self.register_buffer("stored_albedo", self.lights.albedo.detach().clone(), persistent=False)
        flat = flat_image(self.lights, height, width, mm_per_pixel).to(inverse.dtype)
        if saturated_above is not None:
            check_float_tensor("saturated_above", saturated_above)
        self.shadowed = ShadowedPixels(flat, noise, self.inverse, saturated_above)

    @classmethod
    def from_calibration(cls, calibration: Calibration, camera_height_mm: float = math.inf) -> "NormalFromIntensity":
        """The block of a unit calibrated by lights.

        Raises:
            ValueError: a unit calibrated by response fields.
        """
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
            saturated_above=calibration.saturated_above,
            camera_height_mm=camera_height_mm,
        )

    def forward(self, image: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        return self.solve(image, depth_mm, None)

    @torch.jit.export
    def solve(self, image: Tensor, depth_mm: Tensor | None, expected: Tensor | None) -> Tensor:
        """As ``forward``, but shadowed pixels start from the slopes ``expected`` (B, 2, H, W); a depth takes precedence."""
        check_batch("compensated", image, 3)
        if expected is not None:
            check_batch("expected", expected, 2)
            check_same_size("expected", expected, "compensated", image.shape[2], image.shape[3])
            check_same_count("expected", expected, "compensated", image.shape[0])
            expected = expected.expand(image.shape[0], 2, image.shape[2], image.shape[3])
        if not torch.jit.is_scripting():
            self.follow_lights()
        check_same_size("compensated", image, "the calibration", self.inverse.shape[2], self.inverse.shape[3])
        if depth_mm is not None:
            check_batch("depth_mm", depth_mm, 1)
            check_same_size("depth_mm", depth_mm, "compensated", image.shape[2], image.shape[3])
            check_same_count("depth_mm", depth_mm, "compensated", image.shape[0])
        if image.shape[0] == 0:
            return image
        view = self.view()
        plain = self.inverted_glossy(image, depth_mm, view) if self.lights.glossy else self.inverted(image, depth_mm, view)
        normal: Tensor = self.shadowed(plain, image, depth_mm, view, expected)
        return normal

    def follow_lights(self) -> None:
        """Compute what is stored of the lights again if they have changed since, as by an optimiser.

        In eager mode on a CPU, where reading twelve parameters costs nothing; elsewhere nothing that is stored is used.
        """
        position, albedo = self.lights.position_mm, self.lights.albedo
        if not reads_freely(position) or (
            torch.equal(position, self.stored_position_mm) and torch.equal(albedo, self.stored_albedo)
        ):
            return
        with torch.inference_mode(False), torch.no_grad():
            height, width = self.inverse.shape[2], self.inverse.shape[3]
            self.inverse = self._inverse_of_lights(height, width).to(self.inverse.dtype)
            flat = flat_image(self.lights, height, width, self.mm_per_pixel).detach().to(self.inverse.dtype)
            self.shadowed.follow(flat, self.inverse)
            self.stored_position_mm, self.stored_albedo = position.detach().clone(), albedo.detach().clone()

    def __prepare_scriptable__(self) -> "NormalFromIntensity":
        self.follow_lights()  # a graph cannot
        return self

    def _inverse_of_lights(self, height: int, width: int) -> Tensor:
        """(3, 3, H, W): the inverse light matrix at the undeformed skin."""
        position, albedo = self.lights.position_mm.detach(), self.lights.albedo.detach()
        return inverse_light_matrix(position.new_zeros(1, 1, height, width), position, albedo, self.mm_per_pixel)[0]

    def inverted(self, image: Tensor, depth_mm: Tensor | None, view: LightView) -> Tensor:
        """The plain inverse at every pixel: eq. 9 without depth, eq. 10 with depth."""
        position, albedo, pitch = view.position_mm, view.albedo, view.mm_per_pixel
        if depth_mm is not None:
            return normal_at_depth(image, depth_mm, position, albedo, pitch, view.camera_height_mm)
        if self.built_from_lights():
            return normal_at_depth(image, image.new_zeros(1, 1, image.shape[2], image.shape[3]), position, albedo, pitch)
        inverse = self.inverse[None]
        normal = torch.addcmul(inverse[:, :, 0] * image[:, 0:1], inverse[:, :, 1], image[:, 1:2])
        normal = torch.addcmul(normal, inverse[:, :, 2], image[:, 2:3])
        n_x, n_y, n_z = normal[:, 0:1], normal[:, 1:2], normal[:, 2:3]
        return normal * torch.rsqrt(torch.addcmul(torch.addcmul(n_x * n_x, n_y, n_y), n_z, n_z) + 1e-24)

    def built_from_lights(self) -> bool:
        """Whether the matrix is built at this call: gradients are recorded, or the stored one may not follow the lights."""
        lights = self.lights
        if torch.is_grad_enabled() and (lights.position_mm.requires_grad or lights.albedo.requires_grad):
            return True
        if torch.jit.is_scripting():
            return False
        else:  # noqa: RET505, TorchScript needs the else to skip this branch
            return may_read_values() and not reads_freely(lights.position_mm)

    def inverted_glossy(self, image: Tensor, depth_mm: Tensor | None, view: LightView) -> Tensor:
        """The plain inverse of what a matt skin would show: the specular lobe divided out.

        At the slope of the depth so far, which the next pass corrects; without depth at the flat skin's, then at that found.
        """
        depth = image.new_zeros(1, 1, image.shape[2], image.shape[3]) if depth_mm is None else depth_mm
        normal = normal_from_gradient(slope_of_depth(depth, self.mm_per_pixel))
        matrix, gloss = matrix_in_view(depth, view), self.lights.gloss.reshape(1, 3, 1, 1)
        for _ in range(self.gloss_steps if depth_mm is None else 1):
            matt = image / (1.0 + gloss * gloss_lobe(matrix, normal))
            normal = self.inverted(torch.where(image < 0.0, image, matt), depth_mm, view)  # channels left out stay so
        return normal

    def view(self) -> LightView:
        """Lights and camera."""
        gloss = self.lights.gloss if self.lights.glossy else None
        return LightView(self.lights.position_mm, self.lights.albedo, self.mm_per_pixel, self.camera_height_mm, gloss)
