"""Whether a background shows the skin at rest: beside presses, or read as a frame by the prior of the sensor's type."""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..core.blur import band_of_ratios, blur, gaussian_weights
from ..core.levels import BLACK, SATURATED
from ..core.morphology import dilate
from ..core.robust import TUKEY, tukey_weight
from ..model.calibration import PEDESTAL, Calibration
from ..model.response_field import image_basis
from ..skin.weight import WEIGHT_CELLS
from .presses import Press
from .touching import depth_of

CONTACT = 0.2
"""A background holds a contact if its structure exceeds that of the presses, in a place, by this part of what theirs exceeds
its own."""

LEAST_STRUCTURE = 0.01
"""Smallest such excess: less is noise. A press has 0.02 to 0.7."""

DEGREE = 4
"""Degree in position of the logarithm of smooth light: that of a prior's pattern."""

RESTING_ROUNDS = 20
"""Rounds of reweighting: a contact over a tenth of the skin is left out after ten."""

LEAST_MM = 0.1
"""Depth that a background may read beside its own smooth light, mm."""


def beside_presses(background: Tensor, presses: Sequence[Press]) -> str:
    """Why a background holds a contact: structure between the channels, somewhere, that the presses lack there; or "".

    What is saturated or black in one of them is left out, as its edge moves with the exposure.

    Args:
        background: (3, H, W) in [0, 1].
        presses: that show the same skin.
    """
    if not presses:
        return ""
    own, theirs = _structure(background), torch.stack([_structure(press.image) for press in presses])
    usual = theirs.median(dim=0).values if len(presses) > 2 else theirs.amax(dim=0)
    seen = ~(_clipped(background) | torch.stack([_clipped(press.image) for press in presses]).any(dim=0))
    if not bool(seen.any()):
        return ""
    excess = ((own - usual) * seen).flatten()
    most, contact = float(excess.max()), float(((theirs - own) * seen).flatten(1).amax(dim=1).median())
    if most < LEAST_STRUCTURE or most < CONTACT * contact:
        return ""
    cell = _cell(background)
    row, column = divmod(int(excess.argmax()), own.shape[1])
    place = [round((k + _margin(own) + 0.5) * cell) for k in (column, row)]
    return (
        "background: was a press given as the background? take it again without contact; what is said of presses may come from "
        f"it. Around pixel ({place[0]}, {place[1]}) its channels differ by {most:.2f} within millimetres, and those of the presses "
        f"do not (in their contacts {contact:.2f})"
    )


def read_as_frame(unit: Calibration) -> str:
    """Why the background of a unit holds a contact: read as a frame, beside its own smooth light, it has a depth; "" where it does
    not.

    Args:
        unit: by the prior of its type, which has seen nothing of this background.
    """
    smooth = dataclasses.replace(unit, background=_smooth(unit))
    depth, weight = depth_of(smooth, unit.background_value.float(), math.inf)  # what a polynomial leaves is smooth, too
    depth = depth * (weight > 0)
    deepest = float(depth.max())
    if deepest < LEAST_MM:
        return ""
    row, column = divmod(int(depth.flatten().argmax()), depth.shape[-1])
    return (
        f"background: read as a frame it shows skin that is {deepest:.1f} mm deep around pixel ({column}, {row}): contact in the "
        "calibration image? take it again without contact"
    )


def _smooth(unit: Calibration) -> Tensor:
    """(3, H, W): the smooth light of the unit's background that most of the skin shows: its logarithm is a polynomial."""
    light, pitch_mm = unit.background, unit.sensor.mm_per_pixel
    cell = _cell(light)
    log = torch.nn.functional.avg_pool2d(light[None].double(), cell)[0].clamp_min(1e-3).log()
    height, width = light.shape[1:]
    half_mm = 0.5 * width * pitch_mm
    basis = image_basis(log.shape[1], log.shape[2], cell * pitch_mm, half_mm, DEGREE).flatten(1).t()
    values, weight = log.flatten(1).t(), torch.ones(basis.shape[0], 1, dtype=torch.float64)
    for _ in range(RESTING_ROUNDS):
        solution = torch.linalg.solve(basis.t() @ (weight * basis), basis.t() @ (weight * values))
        left = values - basis @ solution
        scale = left.abs().median(dim=0).values / 0.6745 + 1e-3
        weight = tukey_weight((left / (TUKEY * scale)).square().mean(dim=1, keepdim=True).sqrt())
    whole = image_basis(height, width, pitch_mm, half_mm, DEGREE).flatten(1)
    smooth: Tensor = (solution.t() @ whole).exp().reshape(3, height, width).to(light.dtype)
    return smooth


def _cell(image: Tensor) -> int:
    return max(1, min(image.shape[1:]) // WEIGHT_CELLS)


def _margin(structure: Tensor) -> int:
    """Cells that were cut from each side of what is now (h, w)."""
    return round(0.1 / 0.8 * min(structure.shape))


def _inner(cells: Tensor) -> Tensor:
    """(..., h, w) without a tenth of the shorter side on each side, where the blurs meet the border."""
    margin = round(0.1 * min(cells.shape[-2:]))
    return cells[..., margin : cells.shape[-2] - margin, margin : cells.shape[-1] - margin]


def _structure(image: Tensor) -> Tensor:
    """Structure between the channels of an image (3, H, W) around each cell less a margin, RMS, (h, w)."""
    cell = _cell(image)
    light = torch.nn.functional.avg_pool2d(image.detach().cpu().float()[None], cell)
    band = band_of_ratios(light, float(min(image.shape[1:]) // cell), PEDESTAL)
    around = blur(band.square().sum(dim=1, keepdim=True), gaussian_weights(min(band.shape[2:]) / 20.0))
    return _inner(around[0, 0].sqrt())


def _clipped(image: Tensor) -> Tensor:
    """Cells of :func:`_structure` that saturated pixels reach, or cells that are mostly black in a channel, bool (h, w)."""
    cell, image = _cell(image), image.detach().cpu()
    full = torch.nn.functional.max_pool2d((image > SATURATED).any(dim=0).float()[None, None], cell) > 0
    black = torch.nn.functional.avg_pool2d((image <= BLACK).float()[None], cell).amax(dim=1, keepdim=True) > 0.5
    return _inner(dilate(full | black, round(min(full.shape[2:]) / 8.0))[0, 0])
