"""Accelerated twins of the blocks of the online path."""

import ctypes

import numpy as np
import torch
from torch import Tensor

from .. import compensate, integration, normals
from ..compensate.drift import grid_stride
from ..core import geometry
from ..core.checks import check_batch, check_same_size
from ..core.noise import sample_stride
from ..normals.shadowed import PRIOR_STD, STEPS
from . import kernels
from .derived import pedestals, response_lines
from .gate import arrays_usable, usable
from .twin import Twin


class Drift(Twin, compensate.Drift):
    """Samples by a compiled kernel; sorts and medians by NumPy: 0.03 ms for 3 x 4,800 values, torch 0.7."""

    plain = compensate.Drift

    def samples(self, image: Tensor) -> Tensor:
        stride = grid_stride(image)
        if stride < 3 or not usable(image):
            return super().samples(image)
        return kernels.grid_means(image, stride, stride // 2 - 1)

    def ordered(self, values: Tensor) -> Tensor:
        if not arrays_usable(values):
            return super().ordered(values)
        return torch.from_numpy(np.sort(values.numpy(), axis=-1))

    def by_mode(
        self, ratio: Tensor, least: float = compensate.drift.LEAST_DRIFT, most: float = compensate.drift.MOST_DRIFT
    ) -> Tensor:
        if not usable(ratio):
            return super().by_mode(ratio, least, most)
        return kernels.levels(ratio, grid_stride(ratio), least, most)

    def divided(self, light: Tensor, level: Tensor) -> Tensor:
        if not usable(light, level):
            return super().divided(light, level)
        return light if all(value == 1.0 for value in level.flatten().tolist()) else kernels.divided(light, level)

    def median(self, values: Tensor) -> Tensor:
        if not arrays_usable(values):
            return super().median(values)
        middle = (values.shape[-1] - 1) // 2  # the lower one of two
        return torch.from_numpy(np.partition(values.numpy(), middle)[..., middle : middle + 1])


class SmoothDrift(Twin, compensate.SmoothDrift):
    """The fit and the division by compiled kernels."""

    plain = compensate.SmoothDrift

    def forward(self, ratio: Tensor) -> Tensor:
        return kernels.without_smooth_change(ratio) if usable(ratio) else super().forward(ratio)


class Compensate(Twin, compensate.Compensate):
    """One compiled kernel for all that stands between linear light and the drift, and the accelerated estimator of that."""

    plain = compensate.Compensate
    drift_block = Drift

    def cleaned(self, light: Tensor, saturated: Tensor | None) -> Tensor:
        gain, offset = self.gain.gain, self.gain.offset
        maps = [field for field in (gain, offset) if field is not None]
        if saturated is not None or not (maps or len(self.clean)) or not usable(light, *maps):
            return super().cleaned(light, saturated)
        for field in maps:
            check_same_size("image", light, "the calibration", field.shape[1], field.shape[2])
        empty = torch.empty(0, dtype=torch.int64)
        defects: tuple[Tensor, Tensor] = (empty, empty)
        weights: list[float] = []
        for block in self.clean:
            if isinstance(block, compensate.FillDefects):
                defects = (block.defect, block.neighbours)
            elif isinstance(block, compensate.Blur):
                weights = block.weights
        found = pedestals(self.gain) if gain is not None and offset is not None else None
        offsets = kernels.NO_PEDESTAL if offset is None else offset if found is None else found
        return kernels.clean(light, gain, offsets, defects, (ctypes.c_float * len(weights))(*weights))


class NormalFromIntensity(Twin, normals.NormalFromIntensity):
    """Normals, and whether all pixels are valid, in one pass; shadowed pixels in a second kernel."""

    plain = normals.NormalFromIntensity

    def frame_noise(self, compensated: Tensor) -> Tensor:
        if not usable(compensated):
            return super().frame_noise(compensated)
        return kernels.frame_noise(compensated, sample_stride(compensated.shape[2], compensated.shape[3], self.samples))

    def normals_of(self, image: Tensor, depth_mm: Tensor | None, expected: Tensor | None, noise_std: Tensor) -> Tensor:
        position, albedo = self.lights.position_mm, self.lights.albedo
        given = [tensor for tensor in (depth_mm, expected) if tensor is not None]
        if self.lights.glossy or not usable(image, position, albedo, self.inverse, noise_std, *given):
            return super().normals_of(image, depth_mm, expected, noise_std)
        view, shadowed = self.view(), self.shadowed
        limits = (shadowed.flat, shadowed.saturated_above)
        normal, valid = kernels.normals(image, limits, noise_std, self.inverse, depth_mm, view)
        if valid and not shadowed.any_ill_conditioned:
            return normal
        noise = shadowed.of_all_channels(noise_std)
        weights = torch.stack((noise, (noise / PRIOR_STD).square(), (shadowed.brightness_std(noise) / noise).square()), dim=1)
        constants = [float(STEPS), geometry.CLIFF_SLOPE, geometry.MAX_SLOPE]
        tables = (*limits, shadowed.ill_conditioned)
        kernels.solve_shadowed(normal, image, tables, (noise_std, weights), depth_mm, expected, view, constants)
        return normal


class NormalFromResponse(Twin, normals.NormalFromResponse):
    """One compiled pass, by rows of polynomials in place of maps."""

    plain = normals.NormalFromResponse

    def normals_of(self, image: Tensor, depth_mm: Tensor | None) -> Tensor:
        given = () if depth_mm is None else (depth_mm,)
        lines = response_lines(self) if usable(image, self.maps, self.per_mm, *given) else None
        if lines is None:
            return super().normals_of(image, depth_mm)
        return kernels.response_normals(image, depth_mm, lines, (self.steeper, self.reference_mm, self.max_sine))


class GradientFromNormal(Twin, geometry.GradientFromNormal):
    """One compiled pass."""

    plain = geometry.GradientFromNormal

    def forward(self, normal: Tensor) -> Tensor:
        check_batch("normal", normal, 3)
        if not usable(normal):
            return super().forward(normal)
        return kernels.slopes(normal, self.max_slope)


class PoissonDCT(Twin, integration.PoissonDCT):
    """One compiled kernel, but for heights whose cosine transform is slow."""

    plain = integration.PoissonDCT

    def integrate(self, gradient: Tensor, plan: list[Tensor]) -> Tensor:
        tables = kernels.poisson_plan(gradient.shape[2], gradient.shape[3]) if usable(gradient) else None
        if tables is None:
            return super().integrate(gradient, plan)
        return kernels.solve_poisson(gradient, self.mm_per_pixel, tables, self.zero_in_background)


class PoissonBackground(PoissonDCT, integration.PoissonBackground):
    """As :class:`PoissonDCT`."""

    plain = integration.PoissonBackground


class AdaptiveIntegration(Twin, integration.AdaptiveIntegration):
    """With the accelerated Poisson solver."""

    plain = integration.AdaptiveIntegration
    poisson = PoissonBackground


class PerspectiveIntegration(Twin, integration.PerspectiveIntegration):
    """With the accelerated Poisson solver."""

    plain = integration.PerspectiveIntegration
    poisson = PoissonBackground
