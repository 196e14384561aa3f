"""The deformed area: pixels whose change stands out of the frame's noise, with holes filled and specks removed.

Fine pixels decide the rim; a grid of coarse cells decides what is a hole and what is a speck, because there it is cheap.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from ..core.cells import cell_sums
from ..core.checks import (
    QUANTISATION_STD,
    check_batch,
    check_field,
    check_float_tensor,
    check_least,
    check_mask,
    check_noise,
    check_positive,
    check_record,
    check_same_count,
    check_same_size,
    check_switch,
    may_read,
    may_read_values,
)
from ..core.morphology import dilate, dilate_cross, erode, reconstruct
from ..core.noise import (
    clipped_std,
    dark_below,
    least_quarter,
    noise_from,
    sample_stride,
    second_differences_of_rows,
    std_of_median,
    std_of_quarter,
)
from ..core.smooth import without_smooth_change
from ..model.calibration import Calibration, check_calibration
from .settings import ContactSettings

CELLS = 80
"""Cells along the shorter side of the image."""

DARK_NOISES = 3.0
"""A channel below so many noises, or half of the undeformed skin's light, is dark: as in NormalFromIntensity."""

MOST_FAR_FIELD = 0.06
"""Largest change, relative to the background, that a press elsewhere is believed to make in a channel of undeformed skin."""

BRIDGE = 4
"""Gaps of up to twice so many cells between moved skin are bridged where light scatters: where the slope turns from one LED to
another, the change passes by zero, and two lobes of one contact would have undeformed skin between them."""

BRIDGE_SHARE = 0.5
"""Part of ``sigmas`` that the mean change of a cell has in a gap that is bridged."""

TAIL_SHARE = 2.0 / 3.0
"""Part of ``sigmas``, in units of the spread of the cells' own mean changes, that a cell has in which moved skin goes on."""

LEAST_SPREAD = 0.1
"""Least spread of such means, in units of the noise of a pixel over the side of a cell: white noise alone has 1."""

COLOUR_SHARE = 0.5
"""Part of the colour that slopes give to a change of light, below which a change is a shadow or a stain, not moved skin."""

STAND_IN_NOISE = 0.02
"""Least noise under a stand-in model, relative to the background and to its median: a press scatters light that no calibration has
measured, as much of it to dark pixels as to bright ones."""


class Moved(NamedTuple):
    """Where the skin has moved, each bool (B, 1, H, W).

    Attributes:
        mask: all of it.
        interior: where cells decide, not pixels.
        tail: where it goes on below the threshold.
    """

    mask: Tensor
    interior: Tensor
    tail: Tensor


class Change(NamedTuple):
    """The change of frames.

    Attributes:
        change: (B, 3, H, W), in units of the noise.
        squared: (B, 1, H, W), summed over channels.
        threshold: of squared.
        scale: (B, 3), calibrated noise of a channel over that of the frame; 0 where its LED has failed.
    """

    change: Tensor
    squared: Tensor
    threshold: float
    scale: Tensor


class ContactMask(nn.Module):
    """Where the skin has moved, from compensated images: the contact and the skin around it that hangs free.

    A pixel has moved if its change over the three channels, each in units of its noise, is longer than ``sigmas``; a coarse
    cell also if its mean change is, in units of the frame's own spread of cell means (faint contact). The noise of a channel is
    the largest of the calibrated one, the frame's own, and the frame's spread of change far from the contact. Holes are filled;
    components smaller than a disc of ``min_size_px`` are removed. Where light scatters, the threshold is high, and the skin that
    hangs free below it would be missing from the depth of all it surrounds: moved skin goes on over the cells connected to it
    whose mean change stands out of the spread of such means in the least changed skin. A channel that is black in all of the frame
    (below 5 % of its background) has lost its LED: the other two decide. A shadow or a stain changes all channels alike, where
    slopes change the colour: of a frame whose changes all together have too little colour, only parts that have it have moved.
    With ``smooth_light`` a smooth change of the light is divided out first, unless the caller has done so; the noise is the
    frame's before that, since what a press makes of undeformed skin is smooth only roughly.

    Args:
        flat: (3, H, W), the compensated image of the undeformed skin.
        noise_std: (3,) or (3, H, W), noise of the compensated image at calibration.
        sigmas: threshold of a pixel; 4.5 leaves some 40 false pixels in a 640 x 480 frame, all specks.
        min_size_px: diameter of the smallest contact.
        far_field: largest change, relative to the light, that a press makes in undeformed skin; up to it, the spread of the least
            changed skin of a frame counts as noise. 0 for rigs in which light does not scatter.
        smooth_light: whether the light may have changed smoothly over the image since calibration; ``flat`` is 1 then.
        least_colour: change of colour over change of light, each relative and RMS, that moved skin has at least: 0 where all
            three channels may change alike, 1.4 for channels that change independently of one another.
    Example:
        >>> flat = torch.full((3, 64, 64), 0.5)
        >>> image = flat.clone(); image[0, 20:40, 20:40] += 0.2
        >>> int(ContactMask(flat, torch.full((3,), 0.01))(image[None]).sum())
        400
    """

    flat: Tensor
    per_noise: Tensor
    offset: Tensor
    failed_below: Tensor
    most_far_field: Tensor
    cell_row: Tensor
    cell_column: Tensor
    middle_row: Tensor
    middle_column: Tensor

    def __init__(
        self,
        flat: Tensor,
        noise_std: Tensor,
        sigmas: float = 4.5,
        min_size_px: float = 8.0,
        far_field: float = 0.0,
        smooth_light: bool = False,
        least_colour: float = 0.0,
    ) -> None:
        super().__init__()
        check_field("flat", flat)
        self.smooth_light = check_switch("smooth_light", smooth_light)
        if smooth_light and not bool((flat == 1.0).all()):
            raise ValueError("smooth_light: expected False, because flat is not 1: a smooth change is found in image / background")
        if flat.shape[2] < 3:
            raise ValueError(f"flat: expected at least 3 columns, for the noise of a frame, got {flat.shape[2]}")
        far_field = check_least("far_field", far_field)
        self.least_colour = check_least("least_colour", least_colour)
        check_float_tensor("noise_std", noise_std)
        if tuple(noise_std.shape) not in ((3,), tuple(flat.shape)) or not bool(torch.isfinite(noise_std).all()):
            raise ValueError(f"noise_std: expected (3,) or {tuple(flat.shape)} finite values, got {tuple(noise_std.shape)}")
        self.sigmas = check_positive("sigmas", sigmas)
        self.min_size_px = check_positive("min_size_px", min_size_px)
        self.cell = max(1, min(flat.shape[1], flat.shape[2]) // CELLS)
        # cells around one that a smallest contact may touch; none is farther away than the longer side
        self.reach = min(max(1, math.ceil(0.5 * min_size_px / self.cell)), max(flat.shape[1], flat.shape[2]))
        self.least_cells = 0.6 * (min_size_px / self.cell) ** 2  # nearly the area of a disc of that size
        noise = noise_std.reshape(3, 1, 1) if noise_std.dim() == 1 else noise_std
        self.register_buffer("flat", flat.detach().clone())
        per_noise = 1.0 / noise.detach().clamp_min(QUANTISATION_STD).to(flat.dtype)
        self.register_buffer("per_noise", per_noise.expand_as(flat).clone())
        self.rounding = float((QUANTISATION_STD * self.per_noise).square().mean())
        self.register_buffer("most_far_field", far_field * (self.flat * self.per_noise).mean(dim=(1, 2)))
        self.dark_noises = DARK_NOISES
        self.bridges, self.bridge_sigmas = far_field > 0.0, BRIDGE_SHARE * sigmas
        self.bridge_cells = BRIDGE if self.bridges else 0
        self.tail_sigmas, self.least_spread = TAIL_SHARE * sigmas, LEAST_SPREAD / self.cell
        self.register_buffer("offset", -self.flat * self.per_noise)
        self.samples = 2000  # pixels from which a frame's own noise is estimated
        self.stride = sample_stride(flat.shape[1], flat.shape[2], self.samples)
        self.step = max(1, min(flat.shape[1], flat.shape[2]) // 60)
        some = self.flat[:, self.step // 2 :: self.step, self.step // 2 :: self.step]
        self.register_buffer("failed_below", 0.05 * some.mean(dim=(1, 2)))
        self.register_buffer("cell_row", torch.arange(flat.shape[1]) // self.cell)
        self.register_buffer("cell_column", torch.arange(flat.shape[2]) // self.cell)
        for name, length in (("middle_row", flat.shape[1]), ("middle_column", flat.shape[2])):  # the pixel in the middle of a cell
            middle = torch.arange(0, length, self.cell).clamp_max(length - self.cell) + self.cell // 2
            self.register_buffer(name, middle, persistent=False)

    @classmethod
    def from_calibration(cls, calibration: Calibration, settings: ContactSettings | None = None) -> "ContactMask":
        """The mask of a calibrated unit's compensated images."""
        check_calibration("calibration", calibration)
        settings = ContactSettings() if settings is None else settings
        check_record("settings", settings, ContactSettings, "ContactSettings() makes one")
        noise = calibration.compensated_noise_std
        if _stand_in(calibration):
            light = calibration.background
            typical = light.flatten(1).median(dim=1).values[:, None, None]
            noise = noise.maximum(STAND_IN_NOISE * (typical / light.clamp_min(1e-3 * typical)).clamp_min(1.0))
        smooth = calibration.response is not None
        scattered, colour = most_far_field(calibration), least_colour(calibration)
        return cls(calibration.flat, noise, settings.sigmas, settings.min_size_px, scattered, smooth, colour)

    if TYPE_CHECKING:

        def __call__(self, compensated: Tensor, image: Tensor | None = None, tail: Tensor | None = None) -> Tensor: ...

    def forward(self, compensated: Tensor, image: Tensor | None = None, tail: Tensor | None = None) -> Tensor:
        """Where the skin has moved in compensated images (B, 3, H, W), bool (B, 1, H, W).

        ``image``: the same without their smooth change of the light, where that is known; None to find it here. ``tail``: takes
        the part of the result where moved skin goes on below the threshold, bool (B, 1, H, W).
        """
        self._check("compensated", compensated)
        if image is not None:
            self._check("image", image)
            check_same_count("image", image, "compensated", compensated.shape[0])
        if tail is not None:
            check_mask("tail", tail)
            count, height, width = compensated.shape[0], compensated.shape[2], compensated.shape[3]
            if tail.dim() != 4 or list(tail.shape) != [count, 1, height, width]:
                raise ValueError(
                    f"tail: expected [{count}, 1, {height}, {width}] like compensated, got {list(tail.shape)}: it takes a result"
                )
            if 0 in tail.stride():
                raise ValueError("tail: expected memory of its own for each pixel, got an expanded tensor: use .clone()")
        image = self.divided(compensated) if image is None else image
        found = self.find(compensated.detach(), image.detach())
        if tail is not None:
            tail.copy_(found.tail)
        return found.mask

    @torch.jit.export
    def soft(self, compensated: Tensor) -> Tensor:
        """The same as a number in (0, 1), (B, 1, H, W), differentiable in the image: one half at the hard rim."""
        self._check("compensated", compensated)
        image = self.divided(compensated)
        moved = self.find(compensated.detach(), image.detach())
        found = self.change(compensated, image)
        length = self.sigmas * torch.sqrt(found.squared / found.threshold + 1e-12)
        near = dilate(dilate(moved.mask)).to(length.dtype)
        return near * torch.maximum(torch.sigmoid(length - self.sigmas), moved.interior.to(length.dtype))

    @torch.jit.export
    def shadowed(self, compensated: Tensor, noise_std: Tensor | None = None) -> Tensor:
        """Where one channel is dark and the two others are unchanged, bool (B, 1, H, W).

        The skin may be undeformed there, in a shadow of the object; or it has the one slope that looks the same. ``noise_std``:
        (B, 3), noise of each frame; None for the calibrated one.
        """
        self._check("compensated", compensated)
        found = self.change(compensated.detach(), self.divided(compensated.detach()))
        three_noises = self.dark_noises / self.per_noise[None]
        if noise_std is not None:
            check_noise("noise_std", noise_std, compensated.shape[0])
            three_noises = self.dark_noises * noise_std[:, :, None, None]
        dark = compensated.detach() < dark_below(self.flat, three_noises)
        dark = dark | self.black(compensated).any(dim=1)[:, None, None, None]  # with a failed LED, too little is left to decide
        lit = found.change.masked_fill(dark, 0.0).square().sum(dim=1, keepdim=True) <= found.threshold
        return lit & (dark.to(torch.uint8).sum(dim=1, keepdim=True) == 1)

    def _check(self, name: str, image: Tensor) -> None:
        check_batch(name, image, 3)
        check_same_size(name, image, "the calibration", self.flat.shape[1], self.flat.shape[2])

    def divided(self, compensated: Tensor) -> Tensor:
        """Compensated images without a smooth change of the light; themselves where none is looked for."""
        return without_smooth_change(compensated) if self.smooth_light else compensated

    def find(self, compensated: Tensor, image: Tensor) -> Moved:
        """The deformed area; compiled kernels replace this method."""
        found = self.change(compensated, image)
        return self.clean(found.change, found.squared > found.threshold, found.scale)

    def change(self, compensated: Tensor, image: Tensor) -> Change:
        """The change of an image, in units of the calibrated noise; ``compensated`` is the same before it was :meth:`divided`."""
        change = image * self.per_noise + self.offset  # each rounded, as compiled kernels do: a fused operator rounds once
        first, stride = self.stride // 2, self.stride
        offset, per_noise = self.offset[:, first::stride], self.per_noise[:, first::stride]
        rows = compensated.detach()[:, :, first::stride] * per_noise + offset
        noise = torch.maximum(self.noise(rows), self.far_field(rows)).clamp_min(1.0)
        # rounding to 8 bits of smooth light is no white noise, and second differences miss it
        scale = torch.rsqrt(noise * noise + self.rounding)
        failed = self.black(compensated)
        if not may_read(failed) or bool(failed.any()):
            failed = failed & (failed.to(torch.uint8).sum(dim=1, keepdim=True) == 1)
            scale = scale * (~failed).to(change.dtype)
        change = change * scale[:, :, None, None]
        r, g, b = change[:, 0:1], change[:, 1:2], change[:, 2:3]
        squared = r * r + g * g + b * b
        return Change(change, squared, self.sigmas**2, scale)

    def noise(self, rows: Tensor) -> Tensor:
        """Noise of the frame itself, (B, 3), from every ``stride``-th row of its change."""
        second = second_differences_of_rows(rows, self.stride)
        return noise_from(second, std_of_median(self.median(second)))

    def far_field(self, rows: Tensor) -> Tensor:
        """Spread of the change of undeformed skin, (B, 3), which a press changes everywhere on a real sensor.

        From the least changed quarter of all pixels, then from all within three standard deviations: an object may press on
        about two thirds of the skin before it counts. What exceeds ``most_far_field`` is the object, and the more it does, the
        less of it is believed.
        """
        some = rows[..., self.stride // 2 :: self.stride].abs().flatten(2)
        spread = clipped_std(some, std_of_quarter(self.quarter(some)))[:, :, 0]
        return torch.minimum(spread, self.most_far_field.square() / spread.clamp_min(1e-9))

    def median(self, values: Tensor) -> Tensor:
        """The median of (B, 3, N), the lower one of two, (B, 3, 1)."""
        return values.median(dim=2, keepdim=True).values

    def quarter(self, some: Tensor) -> Tensor:
        """The value below which a quarter of (B, 3, N) lies, (B, 3, 1)."""
        return least_quarter(some)

    def black(self, compensated: Tensor) -> Tensor:
        """Channels that are black in all of a frame, bool (B, 3)."""
        step = self.step
        return compensated.detach()[:, :, step // 2 :: step, step // 2 :: step].mean(dim=(2, 3)) < self.failed_below

    def clean(self, change: Tensor, strong: Tensor, scale: Tensor) -> Moved:
        """The same from pixels that stand out: gaps closed, holes filled, specks removed, faint cells added."""
        strong = erode(dilate(strong))  # closing: pixels lost to noise at the rim
        counted = strong.to(change.dtype)  # ONNX sums no bytes
        if may_read_values():
            counted = strong.to(torch.uint8 if self.cell < 16 else torch.int16)
        density = cell_sums(counted, self.cell).to(change.dtype) / float(self.cell * self.cell)
        any_strong = density > 0
        mean = cell_sums(change, self.cell) / float(self.cell * self.cell)
        faint = self.faint(mean) & ~any_strong  # where single pixels stand out, as at a rim, they decide
        cells = any_strong | faint
        if may_read(cells) and not bool(cells.any()):
            return Moved(strong, strong, strong)
        filled = self.filled(cells)
        # a hole counts as contact; faint cells too, but it takes three that lie together, for one of ten thousand is chance
        weight = torch.where(faint, torch.full_like(density, min(1.0, 0.4 * self.least_cells)), torch.ones_like(density))
        density = torch.where(filled & ~any_strong, weight, density)
        seed = filled & (_box_sum(_box_sum(density, self.reach, 2), self.reach, 3) > self.least_cells)
        kept = self.reconstruct(dilate_cross(seed) & filled, filled)
        added = self.gaps(mean, kept) if self.bridges else torch.zeros_like(kept)
        tail = self.tail(mean, kept | added) if self.bridges else torch.zeros_like(kept)
        added = added | tail
        whole = kept | added
        inside = erode(filled | whole) | faint | added
        if self.least_colour > 0.0:
            whole = self.coloured(mean, whole, scale)
            tail = tail & whole
        interior = self._to_pixels(whole & inside)
        return Moved((strong & self._to_pixels(whole)) | interior, interior, self._to_pixels(tail))

    def coloured(self, mean: Tensor, whole: Tensor, scale: Tensor) -> Tensor:
        """Cells that have moved whose changes have the colour of slopes, bool; all of them if their changes all together have.

        Else there is a shadow or a stain, and beside it maybe a contact: cells that have the colour themselves stay where nearly a
        disc of the least size of them lies together, with what lies between them, unless all these together lack it again. Where
        an LED has failed, two channels are too few to say.
        """
        per_noise = self.per_noise.index_select(1, self.middle_row).index_select(2, self.middle_column)
        change = mean / (per_noise * scale.clamp_min(1e-9)[:, :, None, None])
        r, g, b = change[:, 0:1], change[:, 1:2], change[:, 2:3]
        light = (r * r + g * g + b * b) / 3.0 * self.least_colour**2
        colour = ((r - g) ** 2 + (b - g) ** 2) / 2.0
        enough = self.more(colour, light, whole) | (scale <= 0.0).any(dim=1)[:, None, None, None]
        if may_read(enough) and bool(enough.all()):
            return whole
        own = whole & (colour >= light)
        together = _box_sum(_box_sum(own.to(mean.dtype), self.reach, 2), self.reach, 3) > self.least_cells
        kept = self.reconstruct(own & together, own)
        kept = self.filled(kept | (erode(dilate(kept, self.bridge_cells), self.bridge_cells) & whole)) & whole
        return whole & (enough | (kept & self.more(colour, light, kept)))

    def more(self, colour: Tensor, light: Tensor, cells: Tensor) -> Tensor:
        """Whether the sum of ``colour`` over cells is at least that of ``light``, bool (B, 1, 1, 1)."""
        counted = cells.to(colour.dtype)
        return (colour * counted).sum(dim=(2, 3), keepdim=True) >= (light * counted).sum(dim=(2, 3), keepdim=True)

    def gaps(self, mean: Tensor, kept: Tensor) -> Tensor:
        """Cells between kept ones that have moved too, and what they enclose, bool; ``mean`` is the change of each cell."""
        weak = mean.square().sum(1, keepdim=True) > self.bridge_sigmas**2
        closed = erode(dilate(kept, self.bridge_cells), self.bridge_cells)
        return self.filled(kept | (closed & weak)) & ~kept

    def tail(self, mean: Tensor, kept: Tensor) -> Tensor:
        """Cells in which the skin of kept ones goes on, and what they enclose, bool; ``mean`` is the change of each cell."""
        some = self.some_cells(mean)
        spread = clipped_std(some, std_of_quarter(self.quarter(some))).clamp_min(self.least_spread)
        weak = (mean / spread[..., None]).square().sum(1, keepdim=True) > self.tail_sigmas**2
        return self.filled(self.reconstruct(kept, weak | kept)) & ~kept

    def some_cells(self, mean: Tensor) -> Tensor:
        """Some thousand of the cells' mean changes (B, 3, h, w), without their sign, (B, 3, N)."""
        rows, columns = mean.shape[2], mean.shape[3]
        step = max(1, min(max(rows, columns) // 40, rows, columns))
        return mean[:, :, step // 2 :: step, step // 2 :: step].abs().flatten(2)

    def faint(self, mean: Tensor) -> Tensor:
        """Cells whose mean change stands out of the spread of all cells by 5 sigmas, bool."""
        spread = std_of_median(self.median(self.some_cells(mean)))
        return (mean / spread.clamp_min(1.0 / self.cell)[..., None]).square().sum(1, keepdim=True) > 25.0

    def filled(self, mask: Tensor) -> Tensor:
        """The mask without its holes: background that the border does not reach."""
        if may_read(mask):  # a mask of one run a row, as most contacts are, has none
            starts = mask[..., 1:] & ~mask[..., :-1]
            runs = starts.to(torch.uint8).sum(dim=3, dtype=torch.int32) + mask[..., 0]
            if int(runs.amax()) <= 1:
                return mask
        border = torch.ones_like(mask)
        border[..., 1:-1, 1:-1] = False
        return ~self.reconstruct(border, ~mask)

    def reconstruct(self, seed: Tensor, mask: Tensor) -> Tensor:
        """:func:`~torchvts.core.morphology.reconstruct`."""
        return reconstruct(seed, mask)

    def _to_pixels(self, cells: Tensor) -> Tensor:
        return cells.index_select(3, self.cell_column).index_select(2, self.cell_row)


def most_far_field(calibration: Calibration) -> float:
    """``far_field`` of a unit's mask: a rig that lights explain scatters none, and under a stand-in its least noise covers it."""
    return 0.0 if calibration.response is None or _stand_in(calibration) else MOST_FAR_FIELD


def least_colour(calibration: Calibration) -> float:
    """``least_colour`` of a unit's mask: a share of what its response field says of slopes; 0 without a field of its own."""
    if calibration.response is None or _stand_in(calibration):
        return 0.0
    return COLOUR_SHARE * calibration.response.field.colour()


def _stand_in(calibration: Calibration) -> bool:
    return calibration.report.get("source") == "stand_in"


def _box_sum(image: Tensor, reach: int, dim: int) -> Tensor:
    """Sums over ``reach`` elements either way along a dimension; beyond the border all is zero."""
    pad = [0, 0, reach, reach] if dim == 2 else [reach, reach, 0, 0]
    padded, length = nn.functional.pad(image, pad), image.shape[dim]
    total = padded.narrow(dim, 0, length)
    for k in range(1, 2 * reach + 1):
        total = total + padded.narrow(dim, k, length)
    return total
