"""How surely the skin has moved: a weight from slopes and colour."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights
from ..core.cells import cells_to_pixels, whole_cell_means
from ..core.checks import check_batch, check_field, check_least, check_record, check_same_count, check_same_size, check_switch
from ..core.morphology import reconstruct
from ..model.calibration import Calibration, check_calibration
from ..model.lights import PointLights
from .settings import ContactSettings

WEIGHT_CELLS = 60
"""Cells along the shorter side of the image."""

WEIGHT_RISE = (1.2, 3.0)
"""Evidence at which the weight leaves 0 and reaches 1. From 0.8 and 2.5 on relief is 1 % worse, all else equal."""

LEAST_SLOPE_SPREAD = 0.002
"""Least spread of slopes and of relative changes of light: half a count of 8 bits."""

MOST_SPREAD = 0.012
"""The same at most, beside noise: skin that hangs far around a contact is undeformed nowhere, and its slopes are smooth."""

HANGING = 0.1
"""Spread beyond which it is no skin that hangs, but another light or unit: the frame then reads as undeformed, and is in doubt."""

ROUGH = 1.57
"""Most spread that is noise, over the median difference of neighbouring cells: one and a half times that of white noise."""

WITHIN = 2.5
"""Standard deviations within which undeformed skin lies."""

SQUARE_WITHIN = 0.9112565
"""Mean of x^2 of a standard Gaussian x within them."""

FEWEST = 0.02
"""Share of the cells that is undeformed skin at least: where a contact leaves less, the frame reads as undeformed."""

GREY_SHARE = 0.2
"""Colour that a grey change may have, as a share of it: shade and dirt are not exactly grey."""

BLUR_CELLS = 0.8
"""Blur of evidence, cells: what moves is larger than a cell, noise is not."""

LEAST_COLOUR = 0.3
"""Colour of slopes (:func:`colour_of_slopes`) from which it counts:
of lights 120 degrees apart it is 1.2, 60 degrees 0.4, 15 degrees 0.03."""

FAILED = 0.05
"""Mean light of a channel in all of a frame, as a share of the background's, below which its LED has failed: it says nothing."""

LEAST_DEPTH = 0.01
"""Depth of moved skin, as a share of the deepest, at least."""

FAILED_LIGHT = 0.05
"""Light of a channel, as a share of its median, below which its relative change counts as if it were that bright."""


class ContactMask(nn.Module):
    """Weight in [0, 1], how surely the skin has moved: 0 on undeformed skin, 1 in the contact and on the skin that hangs around it.

    Moved skin has a slope and has changed its colour. The evidence of a cell is the length of its mean slope, each component
    divided by its own spread in the least changed skin of the frame; likewise of the mean change of colour (the relative change of
    R, G, B less their mean). The smaller of the two counts: specks, dots, shade and dirt change no colour, compression and a light
    that drifts give no slope. The weight rises from 0 to 1 between evidences of 1.2 and 3, in connected parts in which two
    neighbouring cells exceed ``sigmas``. Where light is weak, spreads are larger as the noise is. Differentiable.

    Args:
        flat: (3, H, W), the compensated image of the undeformed skin; None for 1, as behind a response field.
        light: (3, H, W), the part of it that the lights give, to which changes are relative; None for all.
        noise_std: (3, H, W), noise of the compensated image; only where it is larger than usual counts. None for even noise.
        sigmas: evidence that a contact has somewhere. Higher finds less dirt, and fewer faint presses.
        by_colour: whether slopes change the colour. Of lights that stand at one side they do not: there slopes alone decide.
    Example:
        >>> flat = torch.full((3, 64, 64), 0.5)
        >>> image = flat.clone(); image[0, 20:40, 20:40] += 0.2
        >>> weight = ContactMask(flat)(image[None])
        >>> float(weight[0, 0, 30, 30]), float(weight[0, 0, 5, 5])
        (1.0, 0.0)
    """

    flat: Tensor
    per_light: Tensor
    per_noise: Tensor

    def __init__(
        self,
        flat: Tensor | None = None,
        light: Tensor | None = None,
        noise_std: Tensor | None = None,
        sigmas: float = 4.5,
        by_colour: bool = True,
    ) -> None:
        super().__init__()
        self.sigmas, self.by_colour = check_least("sigmas", sigmas, 1.0, 1000.0), check_switch("by_colour", by_colour)
        self.cells, self.rise, self.grey_share, self.failed = WEIGHT_CELLS, WEIGHT_RISE, GREY_SHARE, FAILED
        self.weights, self.least_spread = gaussian_weights(BLUR_CELLS), LEAST_SLOPE_SPREAD
        self.most_spread, self.hanging, self.rough = MOST_SPREAD, HANGING, ROUGH
        flat = torch.ones(3, 1, 1) if flat is None else flat
        check_field("flat", flat)
        self.register_buffer("flat", flat.detach().clone())
        light = flat if light is None else light
        check_field("light", light)
        check_same_size("light", light, "flat", flat.shape[1], flat.shape[2])
        typical = light.detach().flatten(1).median(dim=1).values[:, None, None]
        self.register_buffer("per_light", 1.0 / light.detach().maximum(FAILED_LIGHT * typical).clamp_min(1e-6))
        per_noise = torch.ones_like(flat[:1])
        if noise_std is not None:
            check_field("noise_std", noise_std)
            check_same_size("noise_std", noise_std, "flat", flat.shape[1], flat.shape[2])
            noise = (noise_std.detach() * self.per_light).square().mean(dim=0, keepdim=True).sqrt()
            per_noise = (noise.median() / noise).clamp_max(1.0).nan_to_num(1.0)
        self.register_buffer("per_noise", per_noise)

    @classmethod
    def from_calibration(cls, calibration: Calibration, settings: ContactSettings | None = None) -> "ContactMask":
        """The mask of a calibrated unit's compensated images."""
        check_calibration("calibration", calibration)
        settings = ContactSettings() if settings is None else settings
        check_record("settings", settings, ContactSettings, "ContactSettings() makes one")
        offset = calibration.offset if calibration.response is not None else None
        light = calibration.flat if offset is None else calibration.flat - offset
        by_colour = calibration.lights is None or colour_of_slopes(calibration.lights) > LEAST_COLOUR
        return cls(calibration.flat, light, calibration.compensated_noise_std, settings.sigmas, by_colour)

    if TYPE_CHECKING:

        def __call__(self, compensated: Tensor, gradient: Tensor | None = None) -> Tensor: ...

    def forward(self, compensated: Tensor, gradient: Tensor | None = None) -> Tensor:
        """The weight of compensated images (B, 3, H, W), (B, 1, H, W).

        ``gradient``: (B, 2, H, W), their slopes by any model of normals; None where there are none: then colour alone decides.
        """
        check_batch("compensated", compensated, 3)
        height, width = compensated.shape[2], compensated.shape[3]
        if self.flat.shape[1] > 1 or self.flat.shape[2] > 1:
            check_same_size("compensated", compensated, "the calibration", self.flat.shape[1], self.flat.shape[2])
        cell = max(1, min(height, width) // self.cells)
        change = self.change(compensated, cell)
        grey = change.mean(dim=1, keepdim=True)
        evidence = self.lengths(change - grey, self.grey_share * grey)
        if gradient is not None:
            check_batch("gradient", gradient, 2)
            check_same_count("gradient", gradient, "compensated", compensated.shape[0])
            check_same_size("gradient", gradient, "compensated", height, width)
            by_slopes = self.lengths(whole_cell_means(gradient, cell), torch.zeros_like(grey))
            evidence = torch.minimum(evidence, by_slopes) if self.by_colour else by_slopes
        per_noise = whole_cell_means(self.per_noise[None], cell) if self.per_noise.shape[1] > 1 else self.per_noise[None]
        evidence = evidence * per_noise
        return cells_to_pixels(self.weight(blur(evidence, self.weights)), cell, height, width)

    @torch.jit.unused
    def unseen_deg(self, gradient: Tensor) -> Tensor:
        """Slope that the frame's undeformed skin hides, degrees, (B,), of the slopes (B, 2, H, W) that it seems to have."""
        return unseen_deg(gradient, self.cells, self.rise[1], self.least_spread)

    def change(self, compensated: Tensor, cell: int) -> Tensor:
        """Relative change of light of cells, (B, 3, h, w); zero in channels whose LED has failed."""
        change = whole_cell_means((compensated - self.flat) * self.per_light, cell)
        lit = change.detach().mean(dim=(2, 3), keepdim=True) > self.failed - 1.0
        return change * lit.to(change.dtype)

    def lengths(self, means: Tensor, beside: Tensor) -> Tensor:
        """Length (B, 1, h, w) of vectors (B, C, h, w), each component in units of its spread in the frame's least changed cells.

        Root mean square over the two dimensions that slopes have, and changes of colour (three components of zero sum). ``beside``:
        (B, 1, h, w), a spread of its own that each cell has beside that of the frame.
        """
        spread = spread_of(means.abs().flatten(2) + 1e-6, self.least_spread)  # so that the root has a slope at zero
        steps = (means[..., 1:] - means[..., :-1]).detach().abs().flatten(2).sort(dim=2).values
        most = (self.rough * steps[:, :, steps.shape[2] // 2]).clamp_min(max(self.most_spread, self.least_spread))
        spread = torch.where(spread < self.hanging, torch.minimum(spread, most[..., None]), spread)[..., None]
        squared = (means.square() / (spread.square() + beside.square())).sum(dim=1, keepdim=True)
        return torch.sqrt(0.5 * squared + 1e-12)

    def weight(self, evidence: Tensor) -> Tensor:
        """Weight of cells by their evidence, both (B, 1, h, w)."""
        weight = ((evidence - self.rise[0]) / (self.rise[1] - self.rise[0])).clamp(0.0, 1.0)
        sure = (evidence.detach() > self.sigmas).to(evidence.dtype)
        pair = (sure > 0.0) & (nn.functional.avg_pool2d(sure, 3, 1, 1) * 9.0 > 1.5)
        kept = reconstruct(pair, weight.detach() > 0.0)
        return nn.functional.max_pool2d(weight * kept.to(weight.dtype), 3, 1, 1)


def colour_of_slopes(lights: PointLights) -> float:
    """Least change of colour that a slope in any direction makes in the middle of the image, over the largest change of a light."""
    position = lights.position_mm.detach().double()
    change = position[:, :2] / position[:, 2:]  # of each light, relative, by a unit slope along x and y
    colour = torch.linalg.svdvals(change - change.mean(dim=0))
    return float(colour.amin() / change.norm(dim=1).amax())


def spread_of(
    values: Tensor, least: float, within: float = WITHIN, square: float = SQUARE_WITHIN, fewest: float = FEWEST
) -> Tensor:
    """Standard deviation (B, C, 1) of the undeformed skin's part of absolute values (B, C, N), whatever its share.

    Values are added, the smallest first, until the next one lies beyond ``within`` of their standard deviations.
    """
    count = values.shape[2]
    ordered = values.sort(dim=2).values
    number = torch.arange(1, count + 1, dtype=values.dtype, device=values.device)
    spread = torch.sqrt(ordered.square().cumsum(dim=2) / (square * number)).clamp_min(least)
    last = (ordered[:, :, 1:] > within * spread[:, :, :-1]) & (number[:-1] >= fewest * float(count))
    end = torch.cat((last, torch.ones_like(ordered[:, :, :1]) > 0.0), dim=2).to(torch.uint8).argmax(dim=2, keepdim=True)
    return spread.gather(2, end)


def unseen_deg(
    gradient: Tensor, cells: int = WEIGHT_CELLS, sure: float = WEIGHT_RISE[1], least: float = LEAST_SLOPE_SPREAD
) -> Tensor:
    """Slope below which moved skin is not surely told from undeformed skin, degrees, (B,).

    Args:
        gradient: (B, 2, H, W), slopes of frames before they are weighted.
        cells: along the shorter side.
        sure: evidence from which skin has surely moved.
        least: least spread of slopes.
    """
    means = whole_cell_means(gradient, max(1, min(gradient.shape[2], gradient.shape[3]) // cells))
    return torch.rad2deg(torch.atan(sure * spread_of(means.abs().flatten(2) + 1e-6, least).amax(dim=(1, 2))))


def moved(weight: Tensor, depth_mm: Tensor, least: float = LEAST_DEPTH) -> Tensor:
    """Where the skin has moved, bool (B, 1, H, W): more likely than not and to another depth, or to half of the frame's deepest.

    A flat face changes neither slope nor colour; its depth says that it is no undeformed skin.
    """
    deepest = depth_mm.abs().amax(dim=(2, 3), keepdim=True).clamp_min(1e-9)
    return ((weight > 0.5) & (depth_mm.abs() > least * deepest)) | (depth_mm > 0.5 * deepest)
