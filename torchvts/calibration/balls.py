"""Locate the ball in each press: by its outline, by slopes that are known, or jointly with response fields of rising size."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from ..core.geometry import gradient_from_normal
from ..core.robust import tukey_weight
from ..model.response_field import MAX_SINE, ResponseModel
from ..model.sensor import Sensor
from ..normals import NormalFromResponse
from .closure import PENALTY, close_loops
from .contacts import LEAST_SAMPLES, Contact, first_pass_depths, middle_px, used
from .field import ContactForms, Family, solve_with_centers
from .regions import one_ball, strong_blobs

EDGE_SLOPE_RATIO = 0.6
"""The contact ends where the skin's slope has fallen to this part of the ball's: about the middle of the fall."""

JOINT_STAGES = ((0, -1, 3), (1, -1, 3), (2, -1, 6), (3, 2, 4))
"""Families and rounds in which balls are located jointly. Linear fields come first: with products the field can imitate a shift of
all centers, so that stage only refines, each center regularised to the linear result by a third of a press."""


def locate(contacts: list[Contact], sensor: Sensor, prior: ResponseModel | None, half_mm: float) -> None:
    """Find center and contact radius of every usable contact, in place. Contacts that no ball fits get a reason.

    Args:
        contacts: of presses.
        sensor: of the unit.
        prior: gives the slopes; without one balls and fields are found jointly.
        half_mm: scale of positions of these fields, mm.
    """
    pitch_mm = sensor.mm_per_pixel
    for contact in contacts:
        if not contact.reason and 0.0 < contact.radius_mm < 2.0 * pitch_mm:
            contact.reason = f"a ball of {2 * contact.radius_mm:g} mm is smaller than four pixels: is its diameter in mm?"
        if not contact.reason and contact.known:
            contact.reason = wrong_label(contact, sensor)
        elif not contact.reason:
            guess_circle(contact, sensor)
    usable = used(contacts)
    if prior is not None:
        for contact, slopes in zip(usable, _slope_maps(usable, prior, pitch_mm)):
            if not contact.known:
                center_by_slope(contact, slopes, pitch_mm)
            for _ in range(6):
                update_radius(contact, slopes.flatten(1)[:, contact.index], pitch_mm)
    elif not all(contact.known and contact.radius_known for contact in usable):
        _locate_jointly(usable, pitch_mm, half_mm)
        close_loops(usable, half_mm)
    for contact in usable:
        if not contact.reason and int(contact.inside().sum()) < LEAST_SAMPLES:
            contact.reason = "no ball of this diameter fits the contact: wrong diameter, or a contact of too few pixels"


def wrong_label(contact: Contact, sensor: Sensor) -> str:
    """That a label lies outside of the contact that its outline shows, or that nothing is seen there; or ""."""
    outline = dataclasses.replace(contact)
    guess_circle(outline, sensor)
    off_mm = float((contact.center_mm - outline.center_mm).norm())
    if not outline.reason and off_mm > outline.contact_radius_mm:
        return f"label is {off_mm / sensor.mm_per_pixel:.0f} px from the contact: correct it, or leave it out"
    if int(contact.inside().sum()) < LEAST_SAMPLES:
        return "no contact is seen at the given center and contact radius: a mistake in the label?"
    return ""


def _locate_jointly(contacts: list[Contact], pitch_mm: float, half_mm: float) -> None:
    most = 1 if len(contacts) < 4 else 2 if len(contacts) < 10 else 3
    anchors = None
    for degree, products, rounds in [stage for stage in JOINT_STAGES if stage[0] <= most]:
        family = Family(degree, products, half_mm)
        if products >= 0 and anchors is None:
            anchors = [contact.center_mm.clone() for contact in contacts]
        forms = [ContactForms(family, contact) for contact in contacts]
        coefficient = torch.zeros(2, family.size(), dtype=torch.float64)
        for _ in range(rounds):
            coefficient = solve_with_centers(forms, PENALTY * family.penalty(), anchors, 0.3)
            for item in forms:
                update_radius(item.contact, item.slope(coefficient), pitch_mm)


def _slope_maps(contacts: list[Contact], model: ResponseModel, pitch_mm: float) -> list[Tensor]:
    """(2, H, W) each: slopes by the model's last pass."""
    if not contacts:
        return []
    height, width = contacts[0].mask.shape
    normals = NormalFromResponse(model.field, model.by_depth, height, width, pitch_mm)
    images = [1.0 + contact.change[None].float() for contact in contacts]
    if model.by_depth is None:
        return [gradient_from_normal(normals(image))[0].double() for image in images]
    first = first_pass_depths(contacts, model.field, pitch_mm)
    return [gradient_from_normal(normals(image, depth[None, None].float()))[0].double() for image, depth in zip(images, first)]


def guess_circle(contact: Contact, sensor: Sensor) -> None:
    """Set a first center and contact radius from the outline of the largest change. Two blobs of similar size are an error.

    The outline along the image border is left out, so that a ball cut by the border is found where it is.
    """
    import cv2

    length = contact.change.square().sum(0).sqrt()[None, None]
    length = torch.nn.functional.avg_pool2d(length, 7, 1, 3, count_include_pad=False)[0, 0]
    peak = 0.9 * (length * contact.mask).max()  # a spot beside the contact may have changed more
    ball_px = contact.radius_mm / sensor.mm_per_pixel
    wide = strong_blobs((length > 0.2 * peak) & contact.mask, torch.ones_like(length))
    if not wide:
        contact.reason = "no contact: nothing is above the noise"
        return
    if not one_ball(wide, ball_px):
        contact.reason = f"{len(wide)} contacts in one image: press one ball at a time"
        return
    blobs = strong_blobs((length > 0.4 * peak) & contact.mask, torch.ones_like(length), 0.1)
    lobes = np.maximum.reduce([blob.mask for blob in blobs if one_ball([blobs[0], blob], ball_px)])
    outlines, _ = cv2.findContours(lobes, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate(outlines)
    hull = cv2.convexHull(points)
    # a ball's outline is convex; where the border cuts the ball, the outline of its faint middle opens to the border
    convex = [abs(cv2.pointPolygonTest(hull, (float(x), float(y)), True)) < 2.0 for x, y in points[:, 0]]
    outline = torch.from_numpy(points[:, 0][convex].astype(np.float64))
    free = (outline > 1).all(1) & (outline[:, 0] < sensor.width - 2) & (outline[:, 1] < sensor.height - 2)
    if int(free.sum()) < 12:
        contact.reason = "the contact has no outline within the image: press nearer to the middle"
        return
    center_px, radius_px = _circle(outline[free])
    contact.center_mm = (center_px - middle_px(sensor)) * sensor.mm_per_pixel
    # the outline lies outside of the contact, by about a fifth of its radius
    contact.contact_radius_mm = min(0.8 * radius_px * sensor.mm_per_pixel, MAX_SINE * contact.radius_mm)


def _circle(points: Tensor) -> tuple[Tensor, float]:
    """Robust circle through points (N, 2): Kasa's linear fit, iteratively reweighted."""
    origin = points.mean(0)
    xy = points - origin
    columns = torch.cat((xy, torch.ones_like(xy[:, :1])), dim=1)
    weight = torch.ones_like(xy[:, 0])
    center, radius = torch.zeros(2, dtype=points.dtype), torch.zeros((), dtype=points.dtype)
    for _ in range(10):
        weighted = columns * weight[:, None]
        solution = torch.linalg.solve(weighted.t() @ columns, weighted.t() @ xy.square().sum(1))
        center = 0.5 * solution[:2]
        radius = (solution[2] + center.square().sum()).clamp_min(1.0).sqrt()
        residual = (xy - center).norm(dim=1) - radius
        scale = residual.abs().median() / 0.6745 + 0.3
        weight = tukey_weight(residual / (4.0 * scale))
    return center + origin, float(radius)


def update_radius(contact: Contact, slope: Tensor, pitch_mm: float, damping: float = 0.5) -> None:
    """Contact radius from slopes (2, N) at the sampled pixels: the ring where they fall below those of the ball."""
    if contact.radius_known:
        return
    dx, dy, r = contact.polar()
    ring = (r / pitch_mm).round().long()
    count = int(MAX_SINE * contact.radius_mm / pitch_mm)
    near = (ring < count) & (ring > 0) & ~contact.saturated
    outward = torch.stack((dx, dy)) / r.clamp_min(1e-9)
    measured, ball = -(slope * outward).sum(0), -(contact.ball_slope() * outward).sum(0)
    total = torch.zeros(2, count, dtype=torch.float64).index_add_(1, ring[near], torch.stack((measured, ball))[:, near])
    total = torch.nn.functional.avg_pool1d(total[None], 3, 1, 1)[0]
    ratio = total[0] / total[1].clamp_min(1e-9)
    start = max(2, int(0.5 * contact.contact_radius_mm / pitch_mm))
    for k in range(start, count - 1):
        if ratio[k] >= EDGE_SLOPE_RATIO > ratio[k + 1]:
            found = (k + float((ratio[k] - EDGE_SLOPE_RATIO) / (ratio[k] - ratio[k + 1]))) * pitch_mm
            contact.contact_radius_mm += (1.0 - damping) * (min(found, MAX_SINE * contact.radius_mm) - contact.contact_radius_mm)
            return


def center_by_slope(contact: Contact, slope_map: Tensor, pitch_mm: float, rounds: int = 12) -> None:
    """Center and contact radius from known slopes (2, H, W): the ball that fits them best."""
    slope = slope_map.flatten(1)[:, contact.index]
    limit = 0.25 * contact.radius_mm
    for _ in range(rounds):
        inside = contact.inside()
        if int(inside.sum()) < LEAST_SAMPLES:
            contact.reason = (
                f"no ball of {2 * contact.radius_mm:g} mm fits the contact: wrong diameter, too faint a press, or not round"
            )
            return
        height = contact.height_above_equator()[inside]
        # slope = -(x - center) / height; the weight makes a pixel count by its normal rather than by its slope
        weight = height**2
        residual = slope[:, inside] - contact.ball_slope()[:, inside]
        step = (weight / height * residual).sum(1) / (weight / height**2).sum()
        contact.center_mm = contact.center_mm + step.clamp(-limit, limit)
        update_radius(contact, slope, pitch_mm)
