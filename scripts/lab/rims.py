"""The circle of a ball's contact by the bright rim that some skins show there, without any model of slopes."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchvts.core.blur import blur, gaussian_weights

THIN_PX, WIDE_PX = 1.2, 3.0
"""Gaussians whose difference shows a bright line of 2 to 4 pixels."""

REACH_PX = 12.0
"""How far from the label the circle is searched; its radius to :data:`RADIUS_REACH_PX`."""

RADIUS_REACH_PX = 8.0
STEP_PX = 0.5


class Rim(NamedTuple):
    """A bright circle.

    Attributes:
        center_px: its centre (x, y), pixels.
        radius_px: its radius, pixels.
        strength: mean of the line's brightness along it, in 8-bit counts.
    """

    center_px: tuple[float, float]
    radius_px: float
    strength: float


def visible_rim(image: Tensor, background: Tensor, center_px: tuple[float, float], radius_px: float) -> Rim:
    """The circle near a label along which the image is brightest against its surroundings.

    Args:
        image: (3, H, W) in [0, 1], a ball pressed.
        background: (3, H, W), the same without contact.
        center_px: of the label, (x, y).
        radius_px: of the label.
    Example:
        >>> y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
        >>> ring = torch.exp(-0.5 * (torch.hypot(x - 41, y - 30) - 20).square()) / 20
        >>> visible_rim(0.5 + ring.expand(3, -1, -1), torch.full((3, 60, 80), 0.5), (39.0, 32.0), 21.0)[:2]
        ((41.0, 30.0), 20.0)
    """
    change = 255.0 * (image - background).double().mean(0)[None, None]
    line = blur(change, gaussian_weights(THIN_PX)) - blur(change, gaussian_weights(WIDE_PX))
    line = line.clamp(-2.0, 3.0)  # a scratch must not outweigh the circle
    steps = torch.arange(-REACH_PX, REACH_PX + 0.5 * STEP_PX, STEP_PX, dtype=torch.float64)
    radii = radius_px + torch.arange(-RADIUS_REACH_PX, RADIUS_REACH_PX + 0.5 * STEP_PX, STEP_PX, dtype=torch.float64)
    angle = torch.arange(240, dtype=torch.float64) * (2.0 * math.pi / 240)
    best = Rim(center_px, radius_px, -math.inf)
    half = torch.tensor([(line.shape[3] - 1) / 2, (line.shape[2] - 1) / 2], dtype=torch.float64)
    for radius in radii.tolist():
        circle = radius * torch.stack((torch.cos(angle), torch.sin(angle)), 1)  # (240, 2)
        centers = torch.cartesian_prod(center_px[0] + steps, center_px[1] + steps)  # (N, 2)
        place = (centers[:, None] + circle) / half - 1.0
        along = torch.nn.functional.grid_sample(line, place[None], padding_mode="border", align_corners=True)[0, 0].mean(1)
        k = int(along.argmax())
        if float(along[k]) > best.strength:
            best = Rim((float(centers[k, 0]), float(centers[k, 1])), radius, float(along[k]))
    return best
