"""Calibrate a unit from touches by unknown objects: the field by curl, and its scale from balls or known depths."""

import dataclasses
import statistics
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from ..model.report import CandidateRow
from ..model.response_field import ResponseField, ResponseModel
from ..model.sensor import Sensor
from .balls import guess_circle
from .by_presses import with_preprocessing
from .contacts import Contact, first_pass_depths, read_contacts, unit_without_model, used
from .presses import Press, Touch
from .touches import fit_touches, scale_by_presses, scaled, touch_blur_px


class TouchResult(NamedTuple):
    """What touches gave.

    Attributes:
        model: the response model.
        row: its row in the table of candidates.
        contacts: one per touch, with the reason of those left out.
    """

    model: ResponseModel
    row: CandidateRow
    contacts: list[Contact]


def by_touches(background: Tensor, sensor: Sensor, touches: Sequence[Touch], presses: Sequence[Press]) -> TouchResult:
    """Fit a response model to touches.

    Args:
        background: (3, H, W) in [0, 1].
        sensor: of the unit.
        touches: by unknown objects, some with a known depth.
        presses: of balls, for the scale.
    Raises:
        ValueError: no touch can be used, they do not constrain a field, or nothing gives the scale.
    """
    pitch = sensor.mm_per_pixel
    sharp = with_preprocessing(sensor, None)
    blurred = dataclasses.replace(sharp, blur_px=touch_blur_px(sensor.height, sensor.width))
    contacts = read_contacts(touches, background, blurred)
    usable = used(contacts)
    if not usable:
        raise ValueError("touches: none can be used: " + "; ".join(f"{c.name}: {c.reason}" for c in contacts))
    fit = fit_touches(usable, unit_without_model(background, blurred).background, 0.5 * sensor.width * pitch, pitch)
    known = [(touch.depth_mm, c) for touch, c in zip(touches, contacts) if touch.depth_mm is not None and not c.reason]
    scale, reference = _scale(fit.field, _balls(presses, background, sharp), known, pitch)
    field = scaled(fit.field, scale)
    parameters = fit.family.size()
    row: CandidateRow = {
        "model": "touches",
        "family": fit.family.label(),
        "parameters": parameters,
        "score_deg": None,
        "passes": 1,
        "tried": fit.tried,
        "note": f"{len(usable)} touches constrain {parameters} parameters (eigenvalue gap {fit.gap:.1f}), the scale by {reference}",
    }
    return TouchResult(ResponseModel(field, None, sharp.exponent, sharp.blur_px), row, contacts)


def _balls(presses: Sequence[Press], background: Tensor, sensor: Sensor) -> list[Contact]:
    """The presses that can be used, with a first guess of where the balls are."""
    balls = used(read_contacts(presses, background, sensor))
    for ball in balls:
        if not ball.known:
            guess_circle(ball, sensor)
    return used(balls)


def _scale(field: ResponseField, balls: list[Contact], known: list[tuple[float, Contact]], pitch_mm: float) -> tuple[float, str]:
    """The scale of a field by balls, or by contacts of known depth, and which of them gave it."""
    if balls:
        scale, reference = scale_by_presses(field, balls), f"{len(balls)} presses"
    elif known:
        deepest = [float(depth.max()) for depth in first_pass_depths([contact for _, contact in known], field, pitch_mm)]
        scale = statistics.median(depth / max(found, 1e-9) for (depth, _), found in zip(known, deepest))
        reference = f"{len(known)} known depths"
    else:
        raise ValueError(
            "touches: expected something that gives their scale, got only touches: add a press of a ball of known diameter, "
            "Touch(image, depth_mm), or a sensor with a prior"
        )
    if not scale > 0:
        raise ValueError(
            f"touches: the scale by {reference} came out as {scale:.3g}: the presses are no clean balls, or not of this unit"
        )
    return scale, reference
