"""Presses to learn from: without their labels, located by calibration, as pixels of known slope, and for gs_sdk's network."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from ..calibration import RESPONSE_BLUR_PX, CalibrationWarning, Press, calibrate
from ..calibration.presses import check_presses
from ..compensate import Compensate
from ..core.checks import check_image
from ..model import Calibration, Sensor
from ..training import MlpFit, fit_mlp
from .balls import ball_truth


def found_by(calibration: Calibration, presses: Sequence[Press]) -> list[Press | None]:
    """Presses with the centres and contact radii that their calibration found; None where it left one out."""
    return [
        dataclasses.replace(press, center_px=tuple(row["center_px"]), contact_radius_px=row["contact_radius_px"])
        if row["weight"] > 0.5
        else None
        for press, row in zip(presses, calibration.report["presses"], strict=True)
    ]


class TrainingPixels(NamedTuple):
    """Pixels on balls.

    Attributes:
        intensity: (N, 3), compensated R, G, B.
        xy: (N, 2), column and row, of the same dtype.
        slope: (N, 2), mm per mm.
        press: (N,), index of the press.
    """

    intensity: Tensor
    xy: Tensor
    slope: Tensor
    press: Tensor


def without_labels(press: Press) -> Press:
    """The press without centre and contact radius."""
    return dataclasses.replace(press, center_px=None, contact_radius_px=None)


def quiet_calibrate(background: Tensor, sensor: Sensor, presses: Sequence[Press] = ()) -> Calibration:
    """``calibrate`` without its warnings: an evaluation reports the errors themselves."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return calibrate(background, sensor, presses)


def training_pixels(compensate: nn.Module, presses: Sequence[Press], mm_per_pixel: float) -> TrainingPixels:
    """Pixels on balls, :data:`torchvts.training.balls.RIM_PX` inside their contact radius, and the slope there.

    Args:
        compensate: ``Compensate.from_calibration(calibration)``, as the pipeline's.
        presses: presses with centres and contact radii.
        mm_per_pixel: pixel pitch, mm.
    Raises:
        ValueError: no presses, or one without centre or contact radius.
    """
    if not presses:
        raise ValueError("presses: expected one or more with center and contact radius, got none: label some, or press deeper")
    parts: list[TrainingPixels] = []
    for index, press in enumerate(presses):
        height, width = press.image.shape[1:]
        truth = ball_truth(press, height, width, mm_per_pixel)
        rows, columns = torch.nonzero(truth.region[0, 0], as_tuple=True)
        with torch.inference_mode():
            value = compensate(press.image[None])[0][:, rows, columns].T
        slope = truth.gradient[0][:, rows, columns].T.to(value.dtype)
        xy = torch.stack((columns, rows), 1).to(value.dtype)
        parts.append(TrainingPixels(value.clone(), xy, slope, torch.full_like(rows, index)))
    return TrainingPixels(*(torch.cat(column) for column in zip(*parts)))


def train_network(
    background: Tensor,
    presses: Sequence[Press],
    sensor: Sensor,
    blur_px: float = RESPONSE_BLUR_PX,
    seed: int = 0,
    max_epochs: int = 60,
    progress: bool = False,
) -> MlpFit:
    """Train gs_sdk's RGBXY network on presses, on raw images behind ``Compensate(blur_px=blur_px)``.

    Args:
        background: (3, H, W) in [0, 1], image without contact.
        presses: at least two; where a contact radius is missing, ``calibrate`` without the prior finds centre and radius.
        sensor: the sensor.
        blur_px: blur of the images, pixels.
        seed: seed of weights, order and held-out presses.
        max_epochs: largest number of epochs.
        progress: show a bar.
    Raises:
        ValueError, TypeError: see :func:`torchvts.calibrate` and :func:`torchvts.training.fit_mlp`.
    """
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    named = check_presses(presses, sensor)
    labelled = [press.center_px is not None and press.contact_radius_px is not None for press in named]
    bare = [without_labels(press) for press in named]
    found = named if all(labelled) else found_by(quiet_calibrate(background, sensor.without_prior(), bare), bare)
    known = [given if there else here for given, here, there in zip(named, found, labelled)]
    kept = [press for press in known if press is not None]
    if lost := len(named) - len(kept):
        text = f"presses: {lost} of {len(named)} left out: no clean ball is found in them: torchvts calibrate says why"
        warnings.warn(text, CalibrationWarning, stacklevel=2)
    compensate = Compensate(blur_px=blur_px)
    pixels = training_pixels(compensate, kept, sensor.mm_per_pixel)
    flat = compensate(background[None])[0].clamp(0, 1)
    intensity, xy, slope, group = pixels
    options: dict[str, Any] = {"seed": seed, "max_epochs": max_epochs, "progress": progress, "blur_px": blur_px}
    return fit_mlp(intensity.clamp(0, 1), xy, slope, flat, groups=group, **options)
