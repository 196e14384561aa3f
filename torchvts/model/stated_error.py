"""The error of normals that the covariance of a response field states, from the calibration alone, and where to press next."""

import math

import torch
from torch import Tensor, nn

from ..core.cells import cells_to_pixels, whole_cell_means
from ..core.checks import check_batch, check_positive, check_record, check_same_size
from ..core.geometry import pixel_grid_mm
from .calibration import Calibration, check_calibration
from .response_field import CHANGE_SCALE, ResponseField, position_basis

NOT_LEARNED = 0.15
"""Share of the squared error on the own presses by which each unit of phi' C phi adds."""

BESIDE_DEG = 1.5
"""Error that is there whatever the presses say, degrees: found centers, skin that hangs off the ball."""

UNKNOWN_DEG = 5.0
"""Mean error of a field without a covariance, degrees: one that was given, or a file that does not say."""

NOT_METRIC_DEG = 20.0
"""Mean error of a field whose scale is in doubt, degrees: no better than to call every ball flat."""

ERROR_CELLS = 60
"""Cells along the shorter side of the image on which the error is stated."""

PRESSED_SINE = 0.25
"""Sine of the slopes whose error tells where to press next: root mean square over the contact of a ball, usually."""


def variance_of(factors: Tensor, covariance: Tensor) -> Tensor:
    """phi' C phi for N phi, (K, N), and C, (K, K): variance of a sine, up to the noise of a press."""
    variance: Tensor = (factors * (covariance @ factors)).sum(0)
    return variance


def stated_deg(own_deg: float, variance: Tensor, not_learned: float = NOT_LEARNED, beside_deg: float = BESIDE_DEG) -> Tensor:
    """Mean error of normals to expect, degrees: sqrt(own^2 (1 + 0.15 phi' C phi) + 1.5^2).

    The two numbers are the same for all sensors. They were chosen on the 16 sensors on which it lies within a factor of 1.5 of the
    error on presses that were not learned in 85 % without a prior (too good by more in 6 %) and in 98 % with one (1 %): on others
    it may be less right.

    Args:
        own_deg: mean error of the field on its own presses, degrees.
        variance: phi' C phi, any shape.
        not_learned: :data:`NOT_LEARNED`; an argument, as TorchScript takes no global number.
        beside_deg: :data:`BESIDE_DEG`.
    Example:
        >>> round(float(stated_deg(2.0, torch.tensor(0.0))), 2), round(float(stated_deg(2.0, torch.tensor(30.0))), 2)
        (2.5, 4.92)
    """
    return torch.sqrt(own_deg**2 * (1.0 + not_learned * variance) + beside_deg**2)


class StatedError(nn.Module):
    """Mean error of normals that a calibration states: compensated images (B, 3, H, W) to degrees (B, 1, H, W), at most 90.

    phi' C phi is a polynomial in the changes of light whose coefficients vary over the skin. They are computed once, on cells.

    Args:
        own_deg: mean error of the field on its own presses, degrees.
        covariance: (K, K), of its coefficients, up to the noise of a press; None for an error of ``own_deg`` everywhere.
        field: the response field.
        height: pixels.
        width: pixels.
        mm_per_pixel: pixel pitch, mm.
    Example:
        >>> field = ResponseField(0, -1, 10.0, ((0.3, 0, 0), (0, 0.3, 0)))
        >>> error = StatedError(2.0, torch.eye(3), field, 48, 64, 0.1)
        >>> [round(float(error(torch.full((1, 3, 48, 64), light)).mean()), 2) for light in (1.0, 1.3, 1.9)]
        [2.5, 2.84, 4.74]
    """

    inputs: Tensor
    first: Tensor
    second: Tensor
    maps: Tensor

    def __init__(
        self, own_deg: float, covariance: Tensor | None, field: ResponseField, height: int, width: int, mm_per_pixel: float
    ) -> None:
        super().__init__()
        self.own_deg = check_positive("own_deg", own_deg)
        check_record("field", field, ResponseField, "a calibration by a response field has one")
        self.states = covariance is not None
        self.cell = max(1, min(height, width) // ERROR_CELLS)
        self.scale = CHANGE_SCALE
        terms = field.terms()
        first, second = torch.triu_indices(len(terms), len(terms))
        # of every term three inputs, the fourth of which is one
        self.register_buffer("inputs", torch.tensor([[*term, 3, 3][:3] for term in terms]))
        self.register_buffer("first", first)
        self.register_buffer("second", second)
        maps = torch.zeros(1, 0, 1, 1)
        if covariance is not None:
            x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
            maps = self._maps(covariance, field, torch.stack((x.expand(height, width), y.expand(height, width))))
        self.register_buffer("maps", maps)

    def _maps(self, covariance: Tensor, field: ResponseField, place_mm: Tensor) -> Tensor:
        """The coefficient of the product of each pair of terms at every cell, (1, P, h, w) float32."""
        x, y = whole_cell_means(place_mm[None], self.cell)[0]
        bases = [position_basis(x, y, field.half_mm, degree) for degree in field.degrees().values()]
        blocks = torch.split(covariance.double(), [len(basis) for basis in bases])
        rows = [torch.split(block, [len(basis) for basis in bases], 1) for block in blocks]
        pairs = [
            (1.0 if i == k else 2.0) * (bases[i] * torch.tensordot(rows[i][k], bases[k], 1)).sum(0)
            for i, k in zip(self.first.tolist(), self.second.tolist(), strict=True)
        ]
        return torch.stack(pairs)[None].float()

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "StatedError":
        """The error of a unit by a response field.

        It is :data:`NOT_METRIC_DEG` where the scale is in doubt, and :data:`UNKNOWN_DEG` where there is no covariance.

        Raises:
            ValueError: a calibration by lights.
        """
        check_calibration("calibration", calibration)
        sensor, response = calibration.sensor, calibration.response
        if response is None:
            raise ValueError("calibration: expected one by response fields, got one by lights: their error is that of their fit")
        stated = _stated_by_covariance(calibration) if calibration.metric else None
        if stated is not None:
            return stated
        expected_deg = UNKNOWN_DEG if calibration.metric else NOT_METRIC_DEG
        return cls(expected_deg, None, response.field, sensor.height, sensor.width, sensor.mm_per_pixel)

    def forward(self, compensated: Tensor) -> Tensor:
        height, width = compensated.shape[2], compensated.shape[3]
        if not self.states:
            return torch.full_like(compensated[:, :1], self.own_deg)
        error = self.of_products(self.products(whole_cell_means(compensated, self.cell) - 1.0))
        return cells_to_pixels(error, self.cell, height, width)

    def products(self, change: Tensor) -> Tensor:
        """The product of each pair of terms, (B, P, h, w), of relative changes of light (B, 3, h, w)."""
        inputs = torch.cat((change / self.scale, torch.ones_like(change[:, :1])), dim=1)
        terms = inputs[:, self.inputs[:, 0]] * inputs[:, self.inputs[:, 1]] * inputs[:, self.inputs[:, 2]]
        return terms[:, self.first] * terms[:, self.second]

    def of_products(self, products: Tensor) -> Tensor:
        """Mean error at every cell, (B, 1, h, w) degrees, for products (B, P, h, w) or (B, P, 1, 1)."""
        variance = (products * self.maps.to(products.dtype)).sum(dim=1, keepdim=True).clamp_min(0.0)
        return stated_deg(self.own_deg, variance).clamp_max(90.0)

    def anywhere(self, change: Tensor) -> float:
        """Mean error of relative changes of light (3, N), each of which is as likely at every cell, degrees."""
        products = self.products(change[None, :, None]).mean(dim=3)  # (1, P, 1)
        return float(stated_deg(self.own_deg, (products * self.maps.to(products.dtype).flatten(2)).sum(dim=1).mean()))


def stated_error_deg(calibration: Calibration, compensated: Tensor) -> Tensor:
    """Mean error of the normals at each pixel that the calibration states, degrees: :class:`StatedError` of its covariance.

    Args:
        calibration: by a response field that was fitted to presses, or by a prior.
        compensated: (B, 3, H, W), image / background.
    Returns:
        (B, 1, H, W), of the dtype of ``compensated``.
    Raises:
        ValueError: a calibration without a covariance, or images of another size.
    """
    check_calibration("calibration", calibration)
    check_batch("compensated", compensated, 3)
    check_same_size("compensated", compensated, "the calibration", calibration.sensor.height, calibration.sensor.width)
    block = _stated_by_covariance(calibration)
    if block is None:
        raise ValueError(
            "calibration: expected one whose field has a covariance, got one without: by presses or a prior calibrate makes one"
        )
    found: Tensor = block.to(compensated.device)(compensated)
    return found


def press_next(calibration: Calibration) -> tuple[tuple[int, int], float] | None:
    """(x, y), pixels, of the place where slopes like the presses' are known least, and the mean error there, degrees.

    The changes of light are those that slopes of :data:`PRESSED_SINE` make in the middle of each press. A circle of contact around
    the place lies in the image. None where no press was used, or nothing is stated.

    Args:
        calibration: of the unit.
    Example:
        >>> from torchvts import PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> press_next(Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))) is None
        True
    """
    found = error_over_skin(calibration)
    if found is None:
        return None
    error, cell, radius_px = found
    margin = round(radius_px / cell)
    down, across = (min(margin, (size - 1) // 2) for size in error.shape)
    inner = error[down : error.shape[0] - down, across : error.shape[1] - across]
    place = int(inner.argmax())
    cells = (place % inner.shape[1] + across, place // inner.shape[1] + down)
    column, row = (cell * k + cell // 2 for k in cells)
    return (column, row), float(inner.max())


def error_over_skin(calibration: Calibration) -> tuple[Tensor, int, float] | None:
    """The error to expect of slopes like the presses' on cells (h, w), degrees, pixels of a cell, and of a contact's median radius.

    None as :func:`press_next`.
    """
    check_calibration("calibration", calibration)
    block, sensor, response = _stated_by_covariance(calibration), calibration.sensor, calibration.response
    rows = [row for row in calibration.report.get("presses", []) if row["used"] and "center_px" in row]
    if block is None or response is None or not rows:
        return None
    x, y, radius = torch.tensor([(*row["center_px"], row["contact_radius_px"]) for row in rows], dtype=torch.float64).t()
    x, y = x.round().long().clamp(0, sensor.width - 1), y.round().long().clamp(0, sensor.height - 1)
    per_change = response.field.maps(sensor.height, sensor.width, sensor.mm_per_pixel)[:3, :, y, x].permute(2, 1, 0)  # (N, 2, 3)
    angle = torch.arange(8, dtype=torch.float64) * (math.pi / 4.0)
    change = CHANGE_SCALE * PRESSED_SINE * torch.linalg.pinv(per_change) @ torch.stack((angle.cos(), angle.sin()))  # (N, 3, 8)
    products = block.products(change[..., None]).mean(dim=(2, 3), keepdim=True)  # (N, P, 1, 1)
    error = torch.cat([block.of_products(one[None])[0] for one in products]).median(dim=0).values  # a press may lie in the dark
    return error, block.cell, float(radius.median())


def _stated_by_covariance(calibration: Calibration) -> StatedError | None:
    """None where the calibration has no covariance."""
    own_deg, response, sensor = calibration.report.get("own_deg"), calibration.response, calibration.sensor
    if calibration.covariance is None or response is None or own_deg is None:
        return None
    return StatedError(own_deg, calibration.covariance, response.field, sensor.height, sensor.width, sensor.mm_per_pixel)
