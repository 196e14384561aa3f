"""The error of normals that the covariance of a response field states, from the calibration alone."""

import torch
from torch import Tensor

from ..core.checks import check_batch, check_same_size
from ..core.geometry import pixel_grid_mm
from .calibration import Calibration, check_calibration
from .response_field import term_values

NOT_LEARNED = 0.1
"""Share of the squared error on the own presses by which each unit of phi' C phi adds."""

BESIDE_DEG = 1.5
"""Error that is there whatever the presses say, degrees: found centers, skin that hangs off the ball."""


def variance_of(factors: Tensor, covariance: Tensor) -> Tensor:
    """phi' C phi: variance of a sine, up to the noise of a press.

    Args:
        factors: phi, (K, N).
        covariance: C, (K, K).
    Returns:
        (N,).
    """
    variance: Tensor = (factors * (covariance @ factors)).sum(0)
    return variance


def stated_deg(own_deg: float, variance: Tensor) -> Tensor:
    """Mean error of normals to expect, degrees: sqrt(own^2 (1 + 0.1 phi' C phi) + 1.5^2).

    The two numbers are the same for all sensors. They were chosen on the 18 sensors on which it lies within a factor of 1.5 of the
    error on presses that were not learned in 85 %, and is too good by more in 5 %: on others it may be less right.

    Args:
        own_deg: mean error of the field on its own presses, degrees.
        variance: phi' C phi, any shape.
    Example:
        >>> round(float(stated_deg(2.0, torch.tensor(0.0))), 2), round(float(stated_deg(2.0, torch.tensor(30.0))), 2)
        (2.5, 4.27)
    """
    return (own_deg**2 * (1.0 + NOT_LEARNED * variance) + BESIDE_DEG**2).sqrt()


def stated_error_deg(calibration: Calibration, compensated: Tensor) -> Tensor:
    """Mean error of the normals at each pixel that the calibration states, degrees.

    Args:
        calibration: by a response field that was fitted to presses, or by a prior.
        compensated: (B, 3, H, W), image / background.
    Returns:
        (B, 1, H, W), of the dtype of ``compensated``.
    Raises:
        ValueError: a calibration without a covariance, or images of another size.
    """
    check_calibration("calibration", calibration)
    if calibration.covariance is None or calibration.response is None or "own_deg" not in calibration.report:
        raise ValueError(
            "calibration: expected one whose field has a covariance, got one without: by presses or a prior calibrate makes one"
        )
    check_batch("compensated", compensated, 3)
    sensor, field = calibration.sensor, calibration.response.field
    check_same_size("compensated", compensated, "the calibration", sensor.height, sensor.width)
    x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, compensated.dtype)
    x, y = (axis.expand(sensor.height, sensor.width).flatten().to(compensated.device) for axis in (x, y))
    covariance = calibration.covariance.to(compensated)
    variances = [
        variance_of(term_values(one.flatten(1) - 1.0, x, y, field.half_mm, field.degrees()), covariance) for one in compensated
    ]
    variance = torch.stack(variances).reshape(-1, 1, sensor.height, sensor.width)
    return stated_deg(calibration.report["own_deg"], variance)
