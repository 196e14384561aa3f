"""Normals by a response field."""

import copy

import torch
from torch import Tensor

from ..core.checks import check_batch, check_integer, check_positive, check_record, check_same_size, check_size, check_window
from ..core.geometry import gradient_of_depth, normal_from_gradient
from ..model.calibration import Calibration, check_calibration
from ..model.response_field import CHANGE_SCALE, ResponseField
from .base import NormalModel


class NormalFromResponse(NormalModel):
    """Unit normals of a compensated image, which for a response field is image / background.

    Without depth by the field ``fast``; with the depth of that pass by the field ``precise``, which was fitted on such depths and
    their slopes. A second pass is all there is to gain.

    Args:
        fast: field without depth.
        precise: field with depth, or None.
        height: pixels.
        width: pixels.
        mm_per_pixel: pixel pitch, mm.
        max_slope: largest steepness, mm per mm: polynomials run away outside of what they were fitted on.
        dtype: of the coefficients.
    Example:
        >>> field = ResponseField(0, -1, False, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
        >>> NormalFromResponse(field, None, 8, 8, 0.1)(torch.ones(2, 3, 8, 8))[0, :, 0, 0] + 0.0
        tensor([0., 0., 1.])
    """

    max_passes: int = 2
    takes_window: bool = True
    input_domain: str | None = "ratio"
    fast_maps: Tensor
    precise_maps: Tensor

    def __init__(
        self,
        fast: ResponseField,
        precise: ResponseField | None,
        height: int,
        width: int,
        mm_per_pixel: float,
        max_slope: float = 3.0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        check_record("fast", fast, ResponseField)
        check_size(height, width, mm_per_pixel)
        if precise is not None:
            check_record("precise", precise, ResponseField)
        for name, field, uses in (("fast", fast, False), ("precise", precise, True)):
            if field is not None and field.uses_depth != uses:
                raise ValueError(f"{name}: expected a field with uses_depth={uses}, got uses_depth={field.uses_depth}")
        self.max_slope = check_positive("max_slope", max_slope)
        self.mm_per_pixel = mm_per_pixel
        self.uses_depth = precise is not None
        self.register_buffer("fast_maps", _maps(fast, height, width, mm_per_pixel).to(dtype))
        deep = torch.zeros(0, 2, height, width) if precise is None else _maps(precise, height, width, mm_per_pixel)
        self.register_buffer("precise_maps", deep.to(dtype))

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "NormalFromResponse":
        """The block of a unit calibrated by response fields."""
        check_calibration("calibration", calibration)
        response, sensor = calibration.response, calibration.sensor
        if response is None:
            raise ValueError("calibration: expected one by response fields, got one by lights: use NormalFromIntensity")
        size = (sensor.height, sensor.width, sensor.mm_per_pixel)
        return cls(response.fast, response.precise, *size, dtype=calibration.background.dtype)

    def forward(self, image: Tensor, depth_mm: Tensor | None = None, window: tuple[int, int] | None = None) -> Tensor:
        check_batch("compensated", image, 3)
        size = (self.fast_maps.shape[2], self.fast_maps.shape[3])
        top, left = check_window("compensated", image, size, window)
        change = image - 1.0
        inputs = [change[:, 0:1], change[:, 1:2], change[:, 2:3]]
        maps = self.fast_maps
        if depth_mm is not None:
            if not self.uses_depth:
                raise ValueError("depth_mm: expected None, because this response has no field with depth: use mode 'fast'")
            check_batch("depth_mm", depth_mm, 1)
            check_same_size("depth_mm", depth_mm, "compensated", image.shape[2], image.shape[3])
            depth = depth_mm.to(change.dtype).expand_as(inputs[0])
            slope = gradient_of_depth(depth, self.mm_per_pixel)
            inputs += [depth, slope[:, 0:1], slope[:, 1:2]]
            maps = self.precise_maps
        maps = maps[:, :, top : top + image.shape[2], left : left + image.shape[3]]
        gradient = maps[0] * inputs[0]  # (B, 2, H, W)
        for k in range(1, len(inputs)):
            gradient = torch.addcmul(gradient, maps[k], inputs[k])
        place = len(inputs)
        if maps.shape[0] > place:
            for i in range(3):  # products of changes and depth, but for depth squared
                for k in range(i, min(len(inputs), 4)):
                    gradient = torch.addcmul(gradient, maps[place], inputs[i] * inputs[k])
                    place += 1
        p, q = gradient[:, 0:1], gradient[:, 1:2]
        steepness = torch.sqrt(torch.addcmul(p * p, q, q) + 1e-12)
        return normal_from_gradient(gradient * (self.max_slope / steepness).clamp_max(1.0))

    def coarse(self, stride: int) -> "NormalFromResponse":
        """The same for an image of every ``stride``-th pixel."""
        check_integer("stride", stride, 1)
        other = copy.deepcopy(self)
        for name in ("fast_maps", "precise_maps"):
            setattr(other, name, getattr(other, name)[..., stride // 2 :: stride, stride // 2 :: stride].clone())
        other.mm_per_pixel = stride * self.mm_per_pixel
        return other


def _maps(field: ResponseField, height: int, width: int, mm_per_pixel: float) -> Tensor:
    """The field's maps for inputs in plain units: relative change and mm."""
    scale = [CHANGE_SCALE ** -sum(k < 3 for k in term) for term in field.terms()]
    return field.maps(height, width, mm_per_pixel) * torch.tensor(scale, dtype=torch.float64)[:, None, None, None]
