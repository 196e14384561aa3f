"""Normals by a response field."""

import torch
from torch import Tensor

from ..core.checks import check_batch, check_dtype, check_record, check_same_size, check_size
from ..model.calibration import Calibration, check_calibration
from ..model.response_field import CHANGE_SCALE, MAX_SINE, DepthBrightness, ResponseField
from .base import NormalModel


class NormalFromResponse(NormalModel):
    """Unit normals of a compensated image, which for a response field is image / background.

    The field's sines are the parts of the normal in the plane of the undeformed skin. In a second pass, what the depth of the
    first does to brightness is taken out before: what flat skin changes is subtracted, and the rest divided by what slopes gain.
    The normals of a pipeline are then those of the depth.

    Args:
        field: sine by brightness.
        by_depth: what depth does to brightness, or None: then there is no second pass.
        height: pixels.
        width: pixels.
        mm_per_pixel: pixel pitch, mm.
        dtype: of the coefficients.
    Example:
        >>> field = ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
        >>> NormalFromResponse(field, None, 8, 8, 0.1)(torch.ones(2, 3, 8, 8))[0, :, 0, 0] + 0.0
        tensor([0., 0., 1.])
    """

    passes: int = 2
    normals_from_depth: bool = True
    calibrated: bool = True
    input_domain: str | None = "ratio"
    maps: Tensor
    per_mm: Tensor

    def __init__(
        self,
        field: ResponseField,
        by_depth: DepthBrightness | None,
        height: int,
        width: int,
        mm_per_pixel: float,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        check_record("field", field, ResponseField)
        check_size(height, width, mm_per_pixel)
        check_dtype("dtype", dtype)
        if by_depth is not None:
            check_record("by_depth", by_depth, DepthBrightness)
        self.uses_depth = by_depth is not None
        self.max_sine = MAX_SINE
        self.steeper = 0.0 if by_depth is None else by_depth.steeper
        self.reference_mm = 0.0 if by_depth is None else by_depth.reference_mm
        self.terms = [list(term) for term in field.terms()]
        scale = torch.tensor([CHANGE_SCALE ** -len(term) for term in self.terms], dtype=torch.float64)
        self.register_buffer("maps", (field.maps(height, width, mm_per_pixel) * scale[:, None, None, None]).to(dtype))
        per_mm = torch.zeros(0, height, width) if by_depth is None else by_depth.maps(height, width, mm_per_pixel)
        self.register_buffer("per_mm", per_mm.to(dtype))

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "NormalFromResponse":
        """The block of a unit calibrated by response fields."""
        check_calibration("calibration", calibration)
        response, sensor = calibration.response, calibration.sensor
        if response is None:
            raise ValueError("calibration: expected one by response fields, got one by lights: use NormalFromIntensity")
        size = (sensor.height, sensor.width, sensor.mm_per_pixel)
        return cls(response.field, response.by_depth, *size, dtype=calibration.background.dtype)

    def forward(self, image: Tensor, depth_mm: Tensor | None = None) -> Tensor:
        check_batch("compensated", image, 3)
        check_same_size("compensated", image, "the calibration", self.maps.shape[2], self.maps.shape[3])
        if depth_mm is not None:
            if not self.uses_depth:
                raise ValueError("depth_mm: expected None, because this response does not say what depth does to brightness")
            check_batch("depth_mm", depth_mm, 1)
            check_same_size("depth_mm", depth_mm, "compensated", image.shape[2], image.shape[3])
        change = image - 1.0
        if depth_mm is not None:
            depth = depth_mm.to(change.dtype)
            change = change - self.per_mm * depth
            if self.steeper > 0.0:
                change = change / (self.steeper * (depth - self.reference_mm).clamp_min(0.0) + 1.0)
        sine = self.maps[0] * change[:, 0:1]  # (B, 2, H, W), of the first term
        for place in range(1, len(self.terms)):
            term = self.terms[place]
            product = change[:, term[0] : term[0] + 1]
            for k in term[1:]:
                product = product * change[:, k : k + 1]
            sine = torch.addcmul(sine, self.maps[place], product)
        squared = torch.addcmul(sine[:, 0:1] * sine[:, 0:1], sine[:, 1:2], sine[:, 1:2])
        kept = (self.max_sine / torch.sqrt(squared + 1e-12)).clamp_max(1.0)
        up = torch.sqrt(1.0 - squared * (kept * kept))
        return torch.cat((-kept * sine, up), dim=1)
