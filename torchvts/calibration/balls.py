"""Where a ball lies in a contact: by its outline, by how fast the skin's slope falls off, by known slopes."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..model.sensor import Sensor
from .contacts import LEAST_INSIDE, Contact, middle_px

EDGE_SLOPE_RATIO = 0.6
"""The contact ends where the skin's slope has fallen to this part of the ball's: about half way down from ball to skirt."""


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
    longest = max(outlines, key=len)
    hull = cv2.convexHull(longest)
    # a ball's outline is convex: where the border cuts it, that of the faint middle opens to the outside
    convex = [abs(cv2.pointPolygonTest(hull, (float(x), float(y)), True)) < 2.0 for x, y in longest[:, 0]]
    outline = torch.from_numpy(longest[:, 0][convex].astype(np.float64))
    free = (outline > 1).all(1) & (outline[:, 0] < sensor.width - 2) & (outline[:, 1] < sensor.height - 2)
    if int(free.sum()) < 12:
        contact.reason = "the contact has no outline within the image: press nearer to the middle"
        return
    center_px, radius_px = _circle(outline[free])
    contact.center_mm = (center_px - middle_px(sensor)) * sensor.mm_per_pixel
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
        weighted = columns * weight[:, None] ** 2
        solution = torch.linalg.solve(weighted.t() @ columns, weighted.t() @ xy.square().sum(1))
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
            contact.reason = (
                f"no ball of {2 * contact.radius_mm:g} mm fits the contact: wrong diameter, too faint a press, or not round"
            )
            return
        down = contact.down()[inside]
        # slope = -(x - center) / down, weighted so that a pixel counts by its normal rather than by its slope
        weight = down**2
        miss = slope[:, inside] - contact.ball_slope()[:, inside]
        step = (weight / down * miss).sum(1) / (weight / down**2).sum()
        contact.center_mm = contact.center_mm + step.clamp(-limit, limit)
        update_radius(contact, slope, pitch_mm)
