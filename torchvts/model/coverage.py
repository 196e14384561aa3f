"""Which part of the skin the presses of a calibration cover, and where to press next."""

import torch
from torch import Tensor

from .calibration import Calibration, check_calibration

COVERED = 1.5
"""Distance from the middle of a press, in radii of its contact, up to which it shows the response of the skin."""

MARGIN = 1.0
"""Distance of the next press from the image border, in contact radii of the usual press: its circle must be seen."""


def distance_to_presses(calibration: Calibration) -> Tensor | None:
    """(H, W), distance of each pixel from the nearest press that was used, in radii of its contact.

    None where the model does not come from presses alone: a prior, or lights, hold beyond them.

    Args:
        calibration: of the unit.
    Example:
        >>> from torchvts import Calibration, PointLights, Sensor
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> distance_to_presses(Calibration.from_lights(lights, Sensor("rig", 48, 64, 0.5))) is None
        True
    """
    check_calibration("calibration", calibration)
    report, sensor = calibration.report, calibration.sensor
    circles = [
        (*row["center_px"], row["contact_radius_px"]) for row in report.get("presses", []) if row["used"] and "center_px" in row
    ]
    if report["model"] != "response" or report["source"] != "presses" or "prior_deg" in report or not circles:
        return None
    x, y, radius = torch.tensor(circles, dtype=torch.float64).t()[:, :, None, None]
    across = torch.arange(sensor.width, dtype=torch.float64)[None, None, :] - x
    down = torch.arange(sensor.height, dtype=torch.float64)[None, :, None] - y
    distance: Tensor = (torch.hypot(across, down) / radius.clamp_min(1.0)).amin(dim=0)
    return distance


def press_next(calibration: Calibration) -> tuple[float, tuple[int, int] | None]:
    """Share of the skin that presses cover, and (x, y), pixels, of the place furthest from all; None where all is covered.

    Args:
        calibration: of the unit. One whose model does not come from presses alone counts as covered.
    """
    distance = distance_to_presses(calibration)
    if distance is None:
        return 1.0, None
    share = float((distance <= COVERED).double().mean())
    radii = sorted(row["contact_radius_px"] for row in calibration.report["presses"] if row["used"])
    height, width = distance.shape
    margin = min(round(MARGIN * radii[len(radii) // 2]), (min(height, width) - 1) // 2)
    inner = distance[margin : height - margin, margin : width - margin]
    place = int(inner.argmax())
    if float(inner.max()) <= COVERED:
        return share, None
    return share, (place % inner.shape[1] + margin, place // inner.shape[1] + margin)
