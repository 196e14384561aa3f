"""What calibration is given, presses of balls and touches by anything, and what is seen of each in its image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..contact import ContactMask
from ..core.blur import blur, gaussian_weights
from ..core.checks import check_numbers, check_positive
from ..core.geometry import gradient_from_normal, gradient_of_depth, pixel_grid_mm
from ..integration import poisson_background
from ..model.calibration import PEDESTAL
from ..model.gs_sdk import read_calibration_folder, read_labels
from ..model.response_field import ResponseField
from ..model.sensor import Sensor
from ..normals import NormalFromResponse

INSIDE = 0.85
"""Part of the contact radius within which the skin is taken to lie on the ball; beyond it begins to leave."""

LEAST_INSIDE = 10
"""Sampled pixels inside a contact below which nothing can be said of it."""

ROUGH = 0.13
"""Structure between the channels of an image at rest from which it is taken for a contact: :func:`channel_structure`."""

MAX_SAMPLES = 2000
"""Pixels of a press that enter the fit: more are as alike as neighbours are."""


@dataclass(frozen=True, eq=False)
class Press:
    """An image of a ball pressed into the skin.

    Args:
        image: (3, H, W) in [0, 1], R, G, B, of the unit to calibrate.
        ball_diameter_mm: diameter of the ball, mm.
        name: used in messages.
        center_px: (x, y) of the ball's center in the image, if it is known; else it is found.
        contact_radius_px: of the contact, if known.
    Example:
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


@dataclass(frozen=True, eq=False)
class Touch:
    """An image of any object pressed into the skin.

    Args:
        image: (3, H, W) in [0, 1], R, G, B, of the unit to calibrate.
        depth_mm: deepest indentation, mm, if it is known, as from a stage; else None.
        name: used in messages.
    Example:
        >>> Touch(torch.zeros(3, 240, 320)).depth_mm is None
        True
    """

    image: Tensor
    depth_mm: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.depth_mm is not None:
            check_positive("depth_mm", self.depth_mm, 100.0)


def read_presses(folder: str | Path) -> tuple[Tensor, list[Press]]:
    """Background and presses of a folder in gs_sdk's layout, with the centers of ``label.npz`` or ``labels.csv`` if there.

    Raises:
        FileNotFoundError, ValueError: as :func:`read_calibration_folder` and :func:`read_labels`.
    """
    read = read_calibration_folder(folder)
    labels = read_labels(folder) if (Path(folder) / "labels.csv").is_file() else {}
    presses = []
    for item in read.presses:
        center, radius = item.center_px, item.radius_px
        if center is None and item.name in labels:
            x, y, radius = labels[item.name]
            center = (x, y)
        presses.append(Press(item.image(), item.ball_diameter_mm, item.name, center, radius))
    return read.background, presses


@dataclass(eq=False)
class Contact:
    """One image's change, the pixels of it that a fit uses, and, for a press, where the ball is.

    Attributes:
        name: for messages. change: (3, H, W) float64, image / background - 1. mask: (H, W) bool.
        index: (N,) flat indices of the sampled pixels; their four neighbours lie in the image too.
        x, y: (N,), mm. radius_mm: of the ball; 0 for an unknown object.
        center_mm: (2,), contact_radius_mm: where the ball is, as far as known.
        deep: (3, H, W), the depth, mm, that the field without depth led to, and its slopes; empty before.
        known, radius_known: the center, the contact radius was given and is not to be sought.
        reason: why it is left out; empty if it is not. figures: what the report tells of it.
    """

    name: str
    change: Tensor
    mask: Tensor
    index: Tensor
    x: Tensor
    y: Tensor
    radius_mm: float
    center_mm: Tensor = field(default_factory=lambda: torch.zeros(2, dtype=torch.float64))
    contact_radius_mm: float = 0.0
    deep: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
    known: bool = False
    radius_known: bool = False
    reason: str = ""
    figures: dict[str, Any] = field(default_factory=dict)

    def polar(self) -> tuple[Tensor, Tensor, Tensor]:
        """Sampled pixels seen from the center: x, y and distance, mm, (N,) each."""
        dx, dy = self.x - self.center_mm[0], self.y - self.center_mm[1]
        return dx, dy, torch.sqrt(dx * dx + dy * dy)

    def inside(self) -> Tensor:
        """(N,) bool: sampled pixels where the skin lies on the ball."""
        return self.polar()[2] < INSIDE * self.contact_radius_mm

    def down(self) -> Tensor:
        """(N,) mm: from the sampled pixels down to the ball's equator; beyond 0.95 of its radius what it is at 0.95."""
        return (self.radius_mm**2 - self.polar()[2].square()).clamp_min((0.3 * self.radius_mm) ** 2).sqrt()

    def ball_slope(self) -> Tensor:
        """(2, N): slope of the ball's surface at the sampled pixels."""
        dx, dy, _ = self.polar()
        return -torch.stack((dx, dy)) / self.down()


def read_contacts(
    given: Sequence[Press | Touch], background: Tensor, compensate: torch.nn.Module, contact: ContactMask, sensor: Sensor
) -> list[Contact]:
    """Contacts of presses and touches; those that show none carry a reason.

    Args:
        given: as said. background: (3, H, W) in [0, 1], image at rest.
        compensate: gives image / background. contact: its mask.
    """
    return [_read(item, background, compensate, contact, sensor) for item in given]


def _read(given: Press | Touch, background: Tensor, compensate: torch.nn.Module, contact: ContactMask, sensor: Sensor) -> Contact:
    ratio = compensate(given.image.detach().cpu().double()[None])
    mask = contact(ratio)[0, 0]
    # one pixel of margin, for the neighbours that derivatives take
    core = torch.zeros_like(mask)
    core[1:-1, 1:-1] = mask[1:-1, 1:-1]
    rows, columns = torch.nonzero(core, as_tuple=True)
    stride = max(1, math.ceil(math.sqrt(len(rows) / MAX_SAMPLES)))
    kept = (rows % stride == 0) & (columns % stride == 0)
    rows, columns = rows[kept], columns[kept]
    x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, torch.float64)
    radius_mm = 0.5 * given.ball_diameter_mm if isinstance(given, Press) else 0.0
    item = Contact(given.name, ratio[0] - 1.0, mask, rows * sensor.width + columns, x[0, columns], y[rows, 0], radius_mm)
    item.reason = _unusable(given.image, background, mask)
    if isinstance(given, Press) and given.center_px is not None:
        item.known = True
        item.center_mm = (torch.tensor(given.center_px, dtype=torch.float64) - middle_px(sensor)) * sensor.mm_per_pixel
        item.radius_known = given.contact_radius_px is not None
        radius_px = given.contact_radius_px or math.sqrt(float(mask.sum()) / math.pi) * 0.6
        item.contact_radius_mm = min(radius_px * sensor.mm_per_pixel, 0.9 * radius_mm)
        if not item.reason and int(item.inside().sum()) < LEAST_INSIDE:
            item.reason = "no contact is seen at the given center and contact radius: a slip in the label?"
    return item


def _unusable(image: Tensor, background: Tensor, mask: Tensor) -> str:
    share = float(mask.double().mean())
    border = torch.cat((mask[0], mask[-1], mask[:, 0], mask[:, -1])).double().mean()
    if share < 0.002:
        return (
            f"no contact: only {share:.2%} of the image differs from the background; is it the background itself, or a faint press?"
        )
    full = ((image > 0.995).any(dim=0) & (background < 0.995).all(dim=0) & mask.cpu()).double().sum() / mask.double().sum()
    if float(full) > 0.2:
        return f"{float(full):.0%} of the contact is saturated: lower the exposure"
    if share > 0.8 and float(border) > 0.6:
        return f"{share:.0%} of the image differs from the background: another unit, other exposure, or the light has changed"
    return ""


def middle_px(sensor: Sensor) -> Tensor:
    """(x, y) of the image's middle, where positions in mm start, float64."""
    return torch.tensor([(sensor.width - 1) / 2, (sensor.height - 1) / 2], dtype=torch.float64)


def channel_structure(image: Tensor) -> float:
    """Structure between the channels of an image (3, H, W), within a few millimetres, relative to the light.

    A lamp's fall-off is smooth and a spot is dark in all channels alike; a contact is bright in one channel where it is dark in
    another. The 99th percentile of the channels' log ratios, band-passed (Gaussians of 1/40 and 1/16 of the height): 0.01 to
    0.03 on most sensors at rest, 0.10 on a Wedge, whose lamps stand in the picture; 0.06 to 0.36 under clear contact.
    """
    stride = max(1, min(image.shape[1], image.shape[2]) // 120)
    log = (torch.nn.functional.avg_pool2d(image[None].float(), stride) + PEDESTAL).log()
    log = log - log.mean(1, keepdim=True)
    height = log.shape[2]
    band = blur(log, gaussian_weights(height / 40.0)) - blur(log, gaussian_weights(height / 16.0))
    margin = round(0.14 * height)
    inner = band[0, :, margin : height - margin, margin : log.shape[3] - margin]
    return float(inner.square().sum(0).sqrt().flatten().quantile(0.99))


def depths(contacts: Sequence[Contact], fast: ResponseField, pitch_mm: float) -> list[Tensor]:
    """(H, W) depth, mm, that a field without depth leads to in each contact, as the pipeline would."""
    if not contacts:
        return []
    height, width = contacts[0].mask.shape
    normals = NormalFromResponse(fast, None, height, width, pitch_mm, dtype=torch.float64)
    gradients = (gradient_from_normal(normals(1.0 + contact.change[None])) * contact.mask for contact in contacts)
    return [poisson_background(gradient, pitch_mm)[0, 0] for gradient in gradients]


def go_deeper(contacts: Sequence[Contact], fast: ResponseField, pitch_mm: float) -> None:
    """Keep with each contact what a second pass sees of the first one's depth: itself and its slopes."""
    for contact, depth in zip(contacts, depths(contacts, fast, pitch_mm)):
        contact.deep = torch.cat((depth[None], gradient_of_depth(depth[None, None], pitch_mm)[0]))
