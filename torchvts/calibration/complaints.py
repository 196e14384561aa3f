"""What calibration warns of: presses left out, doubtful diameters, a background with a contact or of another sensor type."""

import dataclasses
import math
import statistics
from collections.abc import Sequence

import torch

from ..model.calibration import Calibration
from ..model.sensor import Sensor
from .background import falloff, outwardness
from .contacts import ROUGH, Contact, channel_structure, differing
from .pattern import ALIKE, FAINTEST, PatternMatch

USUAL_GAIN = 1.15
"""The prior's slopes divided by those of the balls are within this factor: 0.93 to 1.00 on a GelSight Mini."""


class CalibrationWarning(UserWarning):
    """A calibration was made but should not be trusted as it is."""


def of_contacts(contacts: Sequence[Contact]) -> list[str]:
    """Presses and touches that were left out."""
    return [f"{contact.name}: left out: {contact.reason}" for contact in contacts if contact.reason]


def of_diameters_by_prior(used: Sequence[Contact]) -> list[str]:
    """Diameters that are all wrong by the same factor, which only the prior can show."""
    gain = statistics.median(contact.metrics["gain"] for contact in used)
    if abs(math.log(max(gain, 1e-3))) <= math.log(USUAL_GAIN):
        return []
    return [
        f"presses: by the sensor's prior the balls seem {1.0 / gain:.2f} times as wide as given: wrong diameter or pitch? "
        "if they are right, this unit differs from the prior's, and more presses will show it"
    ]


def of_background_with_prior(background: torch.Tensor, sensor: Sensor, match: PatternMatch) -> list[str]:
    """A background of another sensor type than the prior's, turned, swapped or cropped otherwise, or one with a contact.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: with a prior.
        match: how the background compares with the prior's.
    """
    found = []
    text = of_pattern(match, sensor)
    if text:
        found.append(f"background: {text}")
    structure = channel_structure(background)
    if structure > ROUGH and not sensor.markers:
        found.append(
            f"background: structure between the channels of {structure:.2f}, a background stays below {ROUGH}: contact in the "
            "calibration image? take it again without"
        )
    return found


def of_pattern(match: PatternMatch, sensor: Sensor) -> str:
    """In which way a background is not that of the prior's sensor type, or ""."""
    if match.fits:
        return ""
    seen = f"its pattern of light is not that of the unit on which the prior of sensor '{sensor.name}' was fitted"
    if match.named:
        alike = f"correlation {match.named_likeness:.2f}, as it is {match.likeness:.2f}"
        return f"{seen}, but looks like that pattern {match.named} ({alike}): turn, swap or crop the images as the sensor's are"
    if match.likeness >= ALIKE:
        return f"{seen}: it has {match.contrast:.2f} times its contrast, at least {FAINTEST} is usual: another sensor type"
    return (
        f"{seen}: a correlation of {match.likeness:.2f}, at least {ALIKE} is usual, and no turned, mirrored or channel-swapped one "
        "fits: another sensor type, or an LED failed"
    )


def of_background_by_lights(calibration: Calibration) -> tuple[Calibration, list[str]]:
    """A background that differs from the lights' model in places; the calibration with that in its report."""
    model = calibration.model_image
    vignetting = calibration.report.get("vignetting", 0.0)
    if vignetting != 0.0:  # of the camera: the gain removes it
        model = model * falloff(outwardness(calibration.sensor), vignetting).to(model.dtype)
    if calibration.ambient is not None:
        model = model + calibration.ambient.reshape(3, 1, 1)
    spread = (model - calibration.background).abs().flatten(1).median(dim=1).values / 0.6745
    # contact changes the light by more than 5 % and is wider than dirt: 5 sigmas of the residual and of 1 % of the model
    saturated = (calibration.background > 0.995) | (model > 0.95)
    change = (calibration.background - model).masked_fill(saturated, 0.0)
    standing_out = float(differing(change, spread.reshape(3, 1, 1) + 0.01 * model).double().mean())
    report = calibration.report.copy()
    report["residual_std"], report["standing_out"] = spread.tolist(), standing_out
    found = []
    if standing_out > 0.01:
        found.append(
            f"background: {standing_out:.1%} of the image differs from the fitted lights by more than 5 times their residual "
            f"({', '.join(f'{v:.4f}' for v in spread.tolist())}): contact in the calibration image? take it again without"
        )
    return dataclasses.replace(calibration, report=report), found
