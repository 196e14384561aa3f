"""Where a ball was pressed: center, contact radius and usable pixels of each press, without labels."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..contact import ContactMask
from ..core.checks import check_image, check_numbers, check_positive
from ..core.geometry import gradient_from_normal, pixel_grid_mm
from ..core.response import ResponseField
from ..core.sensor import Sensor
from ..integration import poisson_rest
from ..normals import NormalFromResponse

EDGE_SLOPE_RATIO = 0.6
"""The contact ends where the skin's slope has fallen to this part of the ball's: about half way down from ball to skirt."""

INSIDE = 0.85
"""Part of the contact radius within which the skin is taken to lie on the ball; beyond it begins to leave."""

LEAST_INSIDE = 10
"""Sampled pixels inside a contact below which nothing can be said of it."""

MAX_SAMPLES = 3000
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


@dataclass(eq=False)
class Contact:
    """One image's change, the pixels of it that a fit uses, and, for a press, where the ball is.

    Attributes:
        name: for messages. change: (3, H, W) float64, image / background - 1. mask: (H, W) bool.
        index: (N,) flat indices of the sampled pixels; their four neighbours lie in the image too.
        x, y: (N,), mm. radius_mm: of the ball; 0 for an unknown object.
        center_mm: (2,), contact_radius_mm: where the ball is, as far as known.
        depth_mm: (H, W), what the field without depth led to; empty before.
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
    depth_mm: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.float64))
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

    def ball_slope(self) -> Tensor:
        """(2, N): slope of the ball's surface at the sampled pixels; beyond 0.95 of its radius that at 0.95."""
        dx, dy, r = self.polar()
        down = (self.radius_mm**2 - r * r).clamp_min((0.3 * self.radius_mm) ** 2).sqrt()
        return -torch.stack((dx, dy)) / down


def read_contacts(
    images: Sequence[Press | Tensor], background: Tensor, compensate: torch.nn.Module, contact: ContactMask, sensor: Sensor
) -> list[Contact]:
    """Contacts of presses, or of touches by unknown objects (3, H, W); those that show none carry a reason.

    Args:
        images: as said. background: (3, H, W) in [0, 1], image at rest.
        compensate: gives image / background. contact: its mask.
    Raises:
        ValueError, TypeError: an image of another shape or range.
    """
    contacts = []
    middle = torch.tensor([(sensor.width - 1) / 2, (sensor.height - 1) / 2], dtype=torch.float64)
    for k, given in enumerate(images):
        press = given if isinstance(given, Press) else Press(given, 1.0, f"touches[{k}]")
        image, name = press.image, press.name or f"presses[{k}]"
        check_image(f"{name}: image", image, sensor.height, sensor.width, sensor.name)
        ratio = compensate(image.detach().cpu().double()[None])
        mask = contact(ratio)[0, 0]
        # one pixel of margin, for the neighbours that derivatives take
        core = torch.zeros_like(mask)
        core[1:-1, 1:-1] = mask[1:-1, 1:-1]
        rows, columns = torch.nonzero(core, as_tuple=True)
        stride = max(1, math.ceil(math.sqrt(len(rows) / MAX_SAMPLES)))
        kept = (rows % stride == 0) & (columns % stride == 0)
        rows, columns = rows[kept], columns[kept]
        x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, torch.float64)
        radius_mm = 0.5 * press.ball_diameter_mm if isinstance(given, Press) else 0.0
        item = Contact(name, ratio[0] - 1.0, mask, rows * sensor.width + columns, x[0, columns], y[rows, 0], radius_mm)
        if press.center_px is not None:
            item.known = True
            item.center_mm = (torch.tensor(press.center_px, dtype=torch.float64) - middle) * sensor.mm_per_pixel
            item.radius_known = press.contact_radius_px is not None
            radius_px = press.contact_radius_px or math.sqrt(float(mask.sum()) / math.pi) * 0.6
            item.contact_radius_mm = min(radius_px * sensor.mm_per_pixel, 0.9 * radius_mm)
        item.reason = _unusable(image, background, mask)
        if item.known and not item.reason and int(item.inside().sum()) < LEAST_INSIDE:
            item.reason = "no contact is seen at the given center and contact radius: a slip in the label?"
        contacts.append(item)
    return contacts


def _unusable(image: Tensor, background: Tensor, mask: Tensor) -> str:
    share = float(mask.double().mean())
    border = torch.cat((mask[0], mask[-1], mask[:, 0], mask[:, -1])).double().mean()
    if share < 0.002:
        return (
            f"no contact: only {share:.2%} of the image differs from the background; is it the background itself, or a faint press?"
        )
    if share > 0.6 and float(border) > 0.6:
        return f"{share:.0%} of the image differs from the background: another unit, other exposure, or the light has changed"
    full = ((image > 0.995).any(dim=0) & (background < 0.995).all(dim=0) & mask.cpu()).double().sum() / mask.double().sum()
    if float(full) > 0.2:
        return f"{float(full):.0%} of the contact is saturated: lower the exposure"
    return ""


def guess_circle(contact: Contact, sensor: Sensor) -> None:
    """A first center and contact radius from the outline of what has changed most; blobs of like size are a second contact.

    The outline that runs along the image border is left out, so that a ball cut by it is found where it is.
    """
    import cv2

    length = contact.change.square().sum(0).sqrt()[None, None]
    length = torch.nn.functional.avg_pool2d(length, 7, 1, 3, count_include_pad=False)[0, 0]
    peak = 0.9 * length.max()
    apart = _blob_areas((length > 0.2 * peak) & contact.mask)[0]
    areas, labels = _blob_areas((length > 0.4 * peak) & contact.mask)
    if len(areas) == 0:
        contact.reason = "no contact: nothing stands out from the noise"
        return
    several = int((apart > 0.3 * apart.max()).sum())
    if several > 1:
        contact.reason = f"{several} contacts in one image: press one ball at a time"
        return
    blob = (labels == 1 + int(areas.argmax())).astype(np.uint8)
    outlines, _ = cv2.findContours(blob, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    outline = torch.from_numpy(max(outlines, key=len)[:, 0].astype(np.float64))
    free = (outline > 1).all(1) & (outline[:, 0] < sensor.width - 2) & (outline[:, 1] < sensor.height - 2)
    if int(free.sum()) < 12:
        contact.reason = "the contact has no outline within the image: press nearer to the middle"
        return
    center_px, radius_px = _circle(outline[free])
    middle = torch.tensor([(sensor.width - 1) / 2, (sensor.height - 1) / 2], dtype=torch.float64)
    contact.center_mm = (center_px - middle) * sensor.mm_per_pixel
    # the outline runs outside of the contact, about a fifth of its radius
    contact.contact_radius_mm = min(0.8 * radius_px * sensor.mm_per_pixel, 0.9 * contact.radius_mm)


def _blob_areas(mask: Tensor) -> tuple[Any, Any]:
    """Areas of the connected blobs of an (H, W) mask, and their labels from 1."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8))
    return stats[1:, cv2.CC_STAT_AREA], labels


def _circle(points: Tensor) -> tuple[Tensor, float]:
    """Robust circle through points (N, 2): Kasa's linear fit, re-weighted."""
    origin = points.mean(0)
    xy = points - origin
    columns = torch.cat((xy, torch.ones_like(xy[:, :1])), dim=1)
    weight = torch.ones_like(xy[:, 0])
    center, radius = torch.zeros(2, dtype=points.dtype), torch.zeros((), dtype=points.dtype)
    for _ in range(10):
        solution = torch.linalg.lstsq(columns * weight[:, None], (xy.square().sum(1) * weight)[:, None]).solution[:, 0]
        center = 0.5 * solution[:2]
        radius = (solution[2] + center.square().sum()).clamp_min(1.0).sqrt()
        residual = (xy - center).norm(dim=1) - radius
        scale = residual.abs().median() / 0.6745 + 0.3
        weight = (1.0 - (residual / (4.0 * scale)) ** 2).clamp_min(0.0)
    return center + origin, float(radius)


def update_radius(contact: Contact, slope: Tensor, pitch_mm: float, damping: float = 0.5) -> None:
    """Contact radius from slopes (2, N) at the sampled pixels: the ring where they fall below those of the ball."""
    if contact.radius_known:
        return
    dx, dy, r = contact.polar()
    ring = (r / pitch_mm).round().long()
    count = int(0.95 * contact.radius_mm / pitch_mm)
    near = (ring < count) & (ring > 0)
    outward = torch.stack((dx, dy)) / r.clamp_min(1e-9)
    measured, ball = -(slope * outward).sum(0), -(contact.ball_slope() * outward).sum(0)
    total = torch.zeros(2, count, dtype=torch.float64).index_add_(1, ring[near], torch.stack((measured, ball))[:, near])
    total = torch.nn.functional.avg_pool1d(total[None], 3, 1, 1)[0]
    ratio = total[0] / total[1].clamp_min(1e-9)
    start = max(2, int(0.5 * contact.contact_radius_mm / pitch_mm))
    for k in range(start, count - 1):
        if ratio[k] >= EDGE_SLOPE_RATIO > ratio[k + 1]:
            found = (k + float((ratio[k] - EDGE_SLOPE_RATIO) / (ratio[k] - ratio[k + 1]))) * pitch_mm
            contact.contact_radius_mm += (1.0 - damping) * (min(found, 0.9 * contact.radius_mm) - contact.contact_radius_mm)
            return


def center_by_slope(contact: Contact, slope_map: Tensor, pitch_mm: float, rounds: int = 12) -> None:
    """Center and contact radius from slopes (2, H, W) that are already known: the ball that fits them best."""
    slope = slope_map.flatten(1)[:, contact.index]
    limit = 0.25 * contact.radius_mm
    for _ in range(rounds):
        inside = contact.inside()
        if int(inside.sum()) < LEAST_INSIDE:
            contact.reason = "no ball fits the contact: too small, or not round"
            return
        r = contact.polar()[2]
        down = (contact.radius_mm**2 - r * r).clamp_min((0.3 * contact.radius_mm) ** 2).sqrt()[inside]
        # slope = -(x - center) / down, weighted so that a pixel counts by its normal rather than by its slope
        weight = down**2
        miss = slope[:, inside] - contact.ball_slope()[:, inside]
        step = (weight / down * miss).sum(1) / (weight / down**2).sum()
        contact.center_mm = contact.center_mm + step.clamp(-limit, limit)
        update_radius(contact, slope, pitch_mm)


def add_depth(contact: Contact, fast: ResponseField, pitch_mm: float) -> None:
    """Fill in the depth that a field without depth leads to, as the pipeline would."""
    height, width = contact.mask.shape
    normals = NormalFromResponse(fast, None, height, width, pitch_mm, dtype=torch.float64)
    gradient = gradient_from_normal(normals(1.0 + contact.change[None])) * contact.mask
    contact.depth_mm = poisson_rest(gradient, pitch_mm)[0, 0]
