"""The error of a unit's model that its calibration states, before any frame."""

import math

import torch
from torch import Tensor

from ..model.calibration import Calibration

UNMEASURED_DEG = 5.0
"""Mean error that is assumed where nothing has measured it: of a prior whose file does not say. Priors are 2 to 5 degrees off."""

NOT_METRIC_DEG = 20.0
"""Mean error of a model that is not this unit's: no better than to call every ball flat."""

FEW_PRESSES = 2.0
"""Variance that n presses leave where no ball was pressed, in that of a press, times n. So their error is multiplied by
sqrt(1 + 2 / n); a prior counts as so many presses. The misfit of the very presses, one or two, hides more: sqrt(1 + (2 / n)^2)."""

HELD_OUT_VARIANCE = 0.05
"""Variance of the logarithm of the error that held-out presses state, beside 1 / (2 n) of n presses."""

UNIT_VARIANCE = 0.25
"""The same of a prior, or of the misfit of the very presses: units of a type differ by a factor of 1.6 (2.6 and 4.9 degrees,
GelSight Mini)."""

FEW = 6
"""Presses from which frames may show a response field without a prior to be better than they state. The error of fewer is in part a
scale or a tilt, which every surface has, and no frame shows: of three presses on a DIGIT the 95 % bound covered 87 %, now 94."""

MISFIT_SHARE = 3.0
"""Error of the light per unit of tilt, over the part of the background that fitted lights leave unexplained."""


def expected_model_deg(calibration: Calibration) -> float:
    """Mean error of a response field to expect of an object anywhere on the skin, degrees.

    It is measured: by its presses, each by the others; where they are too few for that, by the misfit of the very presses; by the
    record of its sensor's prior. A field that starts from a prior has the errors of both, by their weights.
    """
    report = calibration.report
    if report.get("not_metric"):
        return NOT_METRIC_DEG
    by_type, held_out = report.get("prior_deg") or UNMEASURED_DEG, report.get("held_out_deg")
    used = max(1, sum(bool(row.get("used")) for row in report.get("presses", [])))
    if report.get("source") == "prior" or ("prior_deg" in report and not held_out):
        return by_type
    if "prior_deg" in report and held_out:
        return math.sqrt((used * held_out**2 + FEW_PRESSES * by_type**2) / (used + FEW_PRESSES))
    if held_out:
        return held_out * math.sqrt(1.0 + FEW_PRESSES / used)
    own = report.get("own_deg")
    return own * math.sqrt(1.0 + (FEW_PRESSES / used) ** 2) if own else UNMEASURED_DEG


def model_log_variance(calibration: Calibration) -> float:
    """Variance of the logarithm of :func:`expected_model_deg`: how uncertain that is before a frame; 0 where frames do not count.

    Held-out presses state it within a quarter; one press alone, or a prior, within a factor of 1.6.
    """
    report = calibration.report
    if report.get("not_metric"):
        return 0.0
    used = max(1, sum(bool(row.get("used")) for row in report.get("presses", [])))
    if report.get("held_out_deg"):
        return HELD_OUT_VARIANCE + 0.5 / used
    return UNIT_VARIANCE


def least_level(calibration: Calibration) -> float:
    """The least factor of the model's variance that a frame may show: 1 of less than :data:`FEW` presses without a prior, or 0."""
    report = calibration.report
    used = sum(bool(row.get("used")) for row in report.get("presses", []))
    return 1.0 if 0 < used < FEW and "prior_deg" not in report else 0.0


def light_std_by_fit(calibration: Calibration) -> Tensor:
    """(3, H, W), error of the light from that of its direction and from the misfit of its fit, per unit of |n - n_flat|."""
    assert calibration.lights is not None
    none, dtype = [0.0, 0.0, 0.0], calibration.background.dtype
    direction = torch.tensor(calibration.report.get("direction_std_deg", none), dtype=dtype).nan_to_num(45.0).clamp(0.0, 45.0)
    misfit = torch.tensor(calibration.report.get("misfit", none), dtype=dtype).nan_to_num(1.0).clamp(0.0, 1.0)
    rise = calibration.lights.direction[:, 2].detach().clamp_min(0.2)
    off = torch.hypot(torch.deg2rad(direction) / rise, MISFIT_SHARE * misfit)
    return calibration.model_image.detach() * off.reshape(3, 1, 1)
