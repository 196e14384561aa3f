"""How free skin of a unit decays and from which pressure an object touches it, from presses of balls: their circles are known."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..compensate import Compensate
from ..core.geometry import GradientFromNormal, pixel_grid_mm
from ..integration import PoissonDCT
from ..model.calibration import Calibration
from ..normals import NormalFromIntensity, NormalFromResponse
from ..skin import BLUR_MM, SHARE, ContactFromDepth, ContactMask, ZeroBackground, moved
from ..skin.weight import MOST_SPREAD
from .contacts import Contact
from .presses import Press

SHARES = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6)
"""Shares that are tried."""

TIE = 0.04
"""Overlaps that differ by less are equal; of such shares the one nearest the usual one is taken: other shapes need it."""

WIDER = 1.04
"""Contact radius that is found for a ball, over the true one: 1.07 to 1.10 on drawn sensors, 0.9 to 1 of labels on real ones."""

MOST_PRESSES = 8
"""Presses that are looked at, evenly chosen."""


def with_contact(
    calibration: Calibration, presses: Sequence[Press], contacts: Sequence[Contact]
) -> tuple[Calibration, list[float]]:
    """The calibration with L of contact, the median over located balls, and the share that gives their circles best; and how deep
    these balls are pressed in by it, mm.

    Unchanged where none was located.

    Args:
        calibration: of the unit, by any model.
        presses: of balls.
        contacts: where they were found, in the same order.
    """
    located = [(press, contact) for press, contact in zip(presses, contacts, strict=True) if not contact.reason]
    some = located[:: max(1, math.ceil(len(located) / MOST_PRESSES))]
    seen = [_depth_and_circle(calibration, press, contact) for press, contact in some]
    if not seen:
        return calibration, []
    pitch_mm = calibration.sensor.mm_per_pixel
    decay_mm = float(torch.cat([ContactFromDepth(pitch_mm).decays_mm(depth) for depth, _, _ in seen]).median())
    decay_mm = decay_mm if decay_mm > BLUR_MM else 0.0  # a rim that is only blurred
    overlap = {share: _overlap(ContactFromDepth(pitch_mm, share, decay_mm), seen) for share in SHARES}
    as_good = [share for share in SHARES if overlap[share] > max(overlap.values()) - TIE]
    share = min(as_good, key=lambda share: abs(share - SHARE))
    unit = dataclasses.replace(calibration, contact_share=share, contact_decay_mm=decay_mm)
    return unit, [float(depth[circle].max()) for depth, _, circle in seen]


def depth_of(calibration: Calibration, image: Tensor, most_spread: float = MOST_SPREAD) -> tuple[Tensor, Tensor]:
    """Depth, mm, of an image (3, H, W) by one pass, and how surely its skin has moved, (1, 1, H, W) each.

    ``most_spread``: that of undeformed skin, see :class:`~torchvts.skin.ContactMask`.
    """
    sensor = calibration.sensor
    with torch.no_grad():
        compensated = Compensate.from_calibration(calibration).float()(image.detach().cpu().float()[None])
        block = NormalFromIntensity if calibration.lights is not None else NormalFromResponse
        gradient = GradientFromNormal()(block.from_calibration(calibration).float()(compensated))
        mask = ContactMask.from_calibration(calibration).float()
        mask.most_spread = most_spread
        weight = mask(compensated, gradient)
        return ZeroBackground(sensor.mm_per_pixel)(PoissonDCT(sensor.mm_per_pixel)(gradient * weight), weight), weight


def _depth_and_circle(calibration: Calibration, press: Press, contact: Contact) -> tuple[Tensor, Tensor, Tensor]:
    """Depth of a press, where the skin has moved, and the circle of contact, (1, 1, H, W) each."""
    sensor = calibration.sensor
    depth, weight = depth_of(calibration, press.image)
    x, y = pixel_grid_mm(sensor.height, sensor.width, sensor.mm_per_pixel, torch.float64)
    away = (x - contact.center_mm[0]).square() + (y - contact.center_mm[1]).square()
    return depth, moved(weight, depth), (away < (contact.contact_radius_mm / WIDER) ** 2)[None, None]


def _overlap(block: ContactFromDepth, seen: Sequence[tuple[Tensor, Tensor, Tensor]]) -> float:
    """Median intersection over union of the contact found and the circles."""
    overlaps = []
    for depth, deformed, circle in seen:
        found = block(depth, deformed)
        overlaps.append(int((found & circle).sum()) / max(1, int((found | circle).sum())))
    return float(torch.tensor(overlaps).median())
