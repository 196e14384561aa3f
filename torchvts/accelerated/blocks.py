"""Accelerated twins of the blocks of the online path."""

import ctypes

import numpy as np
import torch
from torch import Tensor

from .. import compensate, contact, integration, normals
from ..compensate.drift import grid_stride
from ..core import frame as frames
from ..core import geometry
from ..core.checks import check_batch, check_same_size
from ..core.noise import sample_stride
from ..integration import background
from ..normals.shadowed import PRIOR_STD, STEPS, LightView
from . import kernels
from .derived import flat_is_one, pedestals, response_lines
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
        return _median(values) if arrays_usable(values) else super().median(values)


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


class ContactMask(Twin, contact.ContactMask):
    """One compiled kernel for the whole mask; else medians by NumPy and connected components by OpenCV: 0.03 ms for 80 x 107 cells
    where sweeps of tensors take 0.28."""

    plain = contact.ContactMask

    def divided(self, compensated: Tensor) -> Tensor:
        if not self.smooth_light or not usable(compensated):
            return super().divided(compensated)
        return kernels.without_smooth_change(compensated)

    def find(self, compensated: Tensor, image: Tensor) -> contact.Moved:
        if not usable(compensated, image, self.offset):
            return super().find(compensated, image)
        bridge = (self.bridge_cells, self.bridge_sigmas, self.tail_sigmas, self.least_spread)
        sides = (self.step, self.stride, self.cell, self.reach)
        grid = kernels.ContactGrid(*sides, self.sigmas, self.rounding, self.least_cells, *bridge, self.least_colour)
        offset = None if flat_is_one(self) else self.offset
        limits = (self.failed_below, self.most_far_field)
        try:
            return contact.Moved(*kernels.contact_mask(compensated, image, offset, self.per_noise, limits, grid))
        except kernels.NotFinite:
            return super().find(compensated, image)

    def median(self, values: Tensor) -> Tensor:
        return _median(values) if arrays_usable(values) else super().median(values)

    def quarter(self, some: Tensor) -> Tensor:
        if not arrays_usable(some):
            return super().quarter(some)
        place = some.shape[-1] // 4
        return torch.from_numpy(np.partition(some.numpy(), place)[..., place : place + 1])

    def reconstruct(self, seed: Tensor, mask: Tensor) -> Tensor:
        if not arrays_usable(seed, mask):
            return super().reconstruct(seed, mask)
        import cv2

        reached = np.empty(mask.shape, np.bool_)
        for found, seeded, inside in zip(reached, seed.numpy(), mask.numpy(), strict=True):
            # every other pixel a label; labels of 16 bits wake no threads
            kind = cv2.CV_16U if inside.size < 2**17 - 8 else cv2.CV_32S
            count, label = cv2.connectedComponents(inside[0].view(np.uint8), connectivity=4, ltype=kind)
            kept = np.zeros(count, np.bool_)
            kept[label[seeded[0]]] = True
            kept[0] = False  # what is not in the mask
            found[0] = kept[label]
        return torch.from_numpy(reached)


class ContactFromDepth(Twin, contact.ContactFromDepth):
    """One compiled kernel."""

    plain = contact.ContactFromDepth

    def find(self, depth_mm: Tensor, gradient: Tensor, deformed: Tensor) -> Tensor:
        if not usable(depth_mm, gradient):
            return super().find(depth_mm, gradient, deformed)
        return kernels.contact_from_depth(
            depth_mm, gradient, deformed, (self.cell, self.reach), (ctypes.c_float * 13)(*self.numbers())
        )

    def numbers(self) -> tuple[float, ...]:
        """The settings that the kernel takes."""
        rest = (self.most_unexplained, self.noise_depth_mm, self.free_share, self.fall, float(self.inner))
        return (self.cell * self.mm_per_pixel, self.share, *self.decay, *self.tail, *self.least_free, *rest)


class Crop(Twin, frames.Crop):
    """The box by a compiled kernel."""

    plain = frames.Crop

    def box(self, deformed: Tensor) -> tuple[int, int, int, int]:
        if not usable() or not arrays_usable(deformed):
            return super().box(deformed)
        return kernels.box_of(deformed)


class NormalFromIntensity(Twin, normals.NormalFromIntensity):
    """Normals, and whether all pixels are valid, in one pass; shadowed pixels in a second kernel."""

    plain = normals.NormalFromIntensity

    def frame_noise(self, compensated: Tensor) -> Tensor:
        if not usable(compensated):
            return super().frame_noise(compensated)
        return kernels.frame_noise(compensated, sample_stride(compensated.shape[2], compensated.shape[3], self.samples))

    def normals_of(
        self, image: Tensor, depth_mm: Tensor | None, window: tuple[int, int], expected: Tensor | None, noise_std: Tensor
    ) -> Tensor:
        position, albedo = self.lights.position_mm, self.lights.albedo
        given = [tensor for tensor in (depth_mm, expected) if tensor is not None]
        if self.lights.glossy or not usable(image, position, albedo, self.inverse, noise_std, *given):
            return super().normals_of(image, depth_mm, window, expected, noise_std)
        x, y = self.middle_mm(image, window)
        whole = LightView(position, albedo, self.mm_per_pixel, self.camera_height_mm, (-x, -y), window)
        shadowed = self.shadowed
        limits = normals.shadowed.Limits(shadowed.flat, shadowed.saturated_above, shadowed.ill_conditioned)
        normal, valid = kernels.normals(image, limits, noise_std, self.inverse, depth_mm, whole)
        ill_conditioned = shadowed.any_ill_conditioned and bool(shadowed.limits(image, window).ill_conditioned.any())
        if valid and not ill_conditioned:
            return normal
        noise = shadowed.of_all_channels(noise_std)
        weights = torch.stack((noise, (noise / PRIOR_STD).square(), (shadowed.brightness_std(noise) / noise).square()), dim=1)
        constants = [float(STEPS), geometry.CLIFF_SLOPE, geometry.MAX_SLOPE]
        noises = (noise_std, weights)
        kernels.solve_shadowed(normal, image, limits, noises, depth_mm, expected, self.view(image, window), constants)
        return normal


class NormalFromResponse(Twin, normals.NormalFromResponse):
    """One compiled pass, by rows of polynomials in place of maps."""

    plain = normals.NormalFromResponse

    def normals_of(self, image: Tensor, depth_mm: Tensor | None, window: tuple[int, int]) -> Tensor:
        given = () if depth_mm is None else (depth_mm,)
        lines = response_lines(self) if usable(image, self.maps, self.per_mm, *given) else None
        if lines is None:
            return super().normals_of(image, depth_mm, window)
        settings = (self.steeper, self.reference_mm, self.max_sine)
        return kernels.response_normals(image, depth_mm, lines, window, settings)


class Masked(Twin, frames.Masked):
    """One compiled pass."""

    plain = frames.Masked

    def forward(self, gradient: Tensor, mask: Tensor) -> Tensor:
        return kernels.masked(gradient, mask) if usable(gradient) else super().forward(gradient, mask)


class MaskedGradient(Twin, frames.MaskedGradient):
    """One compiled pass."""

    plain = frames.MaskedGradient

    def forward(self, depth_mm: Tensor, mask: Tensor) -> Tensor:
        if not usable(depth_mm):
            return super().forward(depth_mm, mask)
        return kernels.depth_slopes(depth_mm, mask, self.mm_per_pixel)


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

    def integrate(self, gradient: Tensor, plan: list[Tensor], top: int, left: int) -> Tensor:
        size = (int(plan[5].shape[0]), int(plan[6].shape[0]))
        tables = kernels.poisson_plan(*size) if usable(gradient) else None
        if tables is None:
            return super().integrate(gradient, plan, top, left)
        return kernels.solve_poisson(gradient, self.mm_per_pixel, tables, (top, left), size, self.zero_in_background)


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


class ZeroBackground(Twin, background.ZeroBackground):
    """All grids in one compiled kernel."""

    plain = background.ZeroBackground

    def forward(self, depth_mm: Tensor, deformed: Tensor) -> Tensor:
        if depth_mm.shape != deformed.shape or not usable(depth_mm):
            return super().forward(depth_mm, deformed)
        return kernels.zero_background(depth_mm, deformed, self.stiff, self.tolerance, self.sweeps)


class LargestChange(Twin, frames.LargestChange):
    """One compiled pass."""

    plain = frames.LargestChange

    def forward(self, one: Tensor, other: Tensor) -> Tensor:
        return kernels.largest_change(one, other) if usable(one, other) else super().forward(one, other)


class Uncrop(Twin, frames.Uncrop):
    """Gradient and normals of the whole image in one compiled pass."""

    plain = frames.Uncrop

    def forward(self, frame: frames.Frame, solution: frames.Solution, contact: Tensor) -> frames.DepthOutput:
        if not usable(solution.gradient):
            return super().forward(frame, solution, contact)
        gradient, normal, contact = kernels.uncrop(solution.gradient, contact, frame.window, frame.size)
        return frames.DepthOutput(solution.depth_mm, gradient, normal, contact, frame.deformed)


def _median(values: Tensor) -> Tensor:
    """Of the last dimension, the lower one of two; 0.02 ms for 3 x 2,000 values, torch 0.07."""
    middle = (values.shape[-1] - 1) // 2
    return torch.from_numpy(np.partition(values.numpy(), middle)[..., middle : middle + 1])
