"""What a user gives to calibrate from, beside the background: presses of balls."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from ..core.checks import check_image, check_numbers, check_positive, check_sequence
from ..model.gs_sdk import read_calibration_folder, read_labels
from ..model.sensor import Sensor


@dataclass(frozen=True, eq=False)
class Press:
    """An image of a ball pressed into the skin.

    Args:
        image: (3, H, W) in [0, 1], R, G, B, of the unit to calibrate.
        ball_diameter_mm: diameter of the ball, mm.
        name: used in messages.
        center_px: (x, y) of the ball's center in the image, if it is known; else it is found.
        contact_radius_px: radius of the contact, if it is known; else it is found.
    Raises:
        ValueError, TypeError: an impossible diameter, center or radius.
    Example:
        >>> import torch
        >>> Press(torch.zeros(3, 240, 320), 6.31).ball_diameter_mm
        6.31
    """

    image: Tensor
    ball_diameter_mm: float
    name: str = ""
    center_px: tuple[float, float] | None = None
    contact_radius_px: float | None = None

    def __post_init__(self) -> None:
        check_positive("ball_diameter_mm", self.ball_diameter_mm, 1000.0)
        if self.center_px is not None:
            check_numbers("center_px", self.center_px, (2,))
        if self.contact_radius_px is not None:
            check_positive("contact_radius_px", self.contact_radius_px)


def read_presses(folder: str | Path) -> tuple[Tensor, list[Press]]:
    """Read a folder in gs_sdk's layout.

    Args:
        folder: the folder that holds ``catalog.csv``.
    Returns:
        The background (3, H, W) and the presses, with the centers of ``label.npz`` or ``labels.csv`` where they exist.
    Raises:
        FileNotFoundError, ValueError: as :func:`read_calibration_folder` and :func:`read_labels`.
    """
    background, pressed = read_calibration_folder(folder)
    labels = read_labels(folder) if (Path(folder) / "labels.csv").is_file() else {}
    presses = []
    for item in pressed:
        center, radius = item.center_px, item.radius_px
        if center is None and item.name in labels:
            x, y, radius = labels[item.name]
            center = (x, y)
        presses.append(Press(item.image, item.ball_diameter_mm, item.name, center, radius))
    return background, presses


def check_presses(presses: Sequence[Press], sensor: Sensor) -> list[Press]:
    """Check the presses, and name those without a name."""
    check_sequence("presses", presses, "Press")
    named = []
    for k, press in enumerate(presses):
        if not isinstance(press, Press):
            raise TypeError(f"presses[{k}]: expected a Press, got {type(press).__name__}: Press(image, ball_diameter_mm)")
        named.append(press if press.name else dataclasses.replace(press, name=f"presses[{k}]"))
        check_image(f"{named[k].name}: image", press.image, sensor.height, sensor.width, sensor.name)
    return named
