r"""Where the skin is touched: pixels whose change stands out of the frame's own noise, holes filled, specks removed.

Fine pixels decide the rim; a grid of coarse cells decides what is a hole and what is a speck, because there it is cheap.
"""

import math

import numpy as np
import torch
from torch import Tensor, nn

from ..core import native
from ..core.checks import (
    QUANTISATION_STD,
    check_batch,
    check_field,
    check_positive,
    check_same_size,
    check_tensor,
    may_read_values,
    may_use_arrays,
)
from ..core.native import may_use_native
from ..core.noise import noise_std as frame_noise_std
from ..model.calibration import Calibration, check_calibration

CELLS = 80
"""Cells along the shorter side of the image."""

DARK_NOISES = 3.0
"""A channel below so many noises is dark, where the skin at rest is twice as bright: as in NormalFromIntensity."""

LIGHT_DRIFT = 0.008
"""Least noise, relative to the background, with a response field: the lamps of real sensors drift by 1 to 2 % of their light."""


def reconstruct(seed: Tensor, mask: Tensor) -> Tensor:
    """All of ``mask`` that is connected (over edges, not corners) to a seed inside it.

    Args:
        seed, mask: bool (B, 1, H, W).
    Returns:
        bool (B, 1, H, W).
    Source:
        Vincent, Morphological grayscale reconstruction, IEEE Trans. Image Processing 2(2), 1993.
    Example:
        >>> row = torch.tensor([[True, True, False, True]])[None, None]
        >>> reconstruct(torch.tensor([[True, False, False, False]])[None, None], row).flatten().tolist()
        [True, True, False, False]
    """
    if may_use_arrays(mask):
        return _reconstruct_by_labels(seed, mask)
    return _reconstruct_by_sweeps(seed, mask)


@torch.jit.unused
def _reconstruct_by_labels(seed: Tensor, mask: Tensor) -> Tensor:
    """:func:`reconstruct` by OpenCV's connected components; on 80 x 107 cells 0.03 ms where sweeps take 0.28."""
    import cv2

    reached = np.empty(mask.shape, np.bool_)
    for found, seeded, inside in zip(reached, seed.numpy(), mask.numpy(), strict=True):
        kind = cv2.CV_16U if inside.size < 2**17 - 8 else cv2.CV_32S  # every other pixel a label; labels of 16 bits wake no threads
        count, label = cv2.connectedComponents(inside[0].view(np.uint8), connectivity=4, ltype=kind)
        kept = np.zeros(count, np.bool_)
        kept[label[seeded[0]]] = True
        kept[0] = False  # what is not in the mask
        found[0] = kept[label]
    return torch.from_numpy(reached)


def _reconstruct_by_sweeps(seed: Tensor, mask: Tensor) -> Tensor:
    """:func:`reconstruct` by tensor operations alone, for what is scripted, exported or on another device.

    Sweeps along rows and columns both ways until nothing is gained: each sweep crosses the whole image, so blobs take a few
    rounds where a 3 x 3 dilation takes as many as the longest path has pixels.
    """
    reached = seed & mask
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_exporting():
            return _reconstruct_in_graph(reached, mask)
    grown = _dilate_cross(reached) & mask
    while bool((grown & ~reached).any()):
        reached = _sweep(_sweep(grown, mask, 2), mask, 3)
        grown = _dilate_cross(reached) & mask
    return reached


def _reconstruct_in_graph(reached: Tensor, mask: Tensor) -> Tensor:
    """The loop of :func:`reconstruct` as one operator of the graph, for torch.export."""
    from torch._higher_order_ops.while_loop import while_loop

    def gained(reached: Tensor, before: Tensor) -> Tensor:
        return (reached != before).any()

    def sweep_all(reached: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        grown = reached
        for dim in (2, 3):
            grown = _sweep(grown, mask, dim)
        return grown.contiguous(), reached.clone()

    reached = reached.contiguous()
    start = (reached, torch.zeros_like(reached))
    found: Tensor = while_loop(gained, sweep_all, start)[0]  # type: ignore[no-untyped-call]
    return found


def _sweep(reached: Tensor, mask: Tensor, dim: int) -> Tensor:
    """What can be reached along lines, both ways."""
    both = torch.cat((reached, reached.flip(dim)))
    wall = torch.cat((mask, mask.flip(dim))).logical_not_()
    # on the way from the start of a line, what came last before a pixel: a reached pixel (odd) or a wall (even)?
    place = torch.arange(2, 2 * mask.shape[dim] + 2, 2, dtype=torch.int32, device=mask.device)
    place = place[:, None] if dim == 2 else place
    last = torch.cummax((place + both) * (both | wall), dim=dim).values
    found = (last.bitwise_and_(1) == 1).logical_and_(wall.logical_not_())
    count = reached.shape[0]
    return found[:count] | found[count:].flip(dim)


def _fill(mask: Tensor) -> Tensor:
    """The mask without its holes: background that the border does not reach."""
    if may_read_values():  # a mask of one run a row, as most contacts are, has none
        starts = mask[..., 1:] & ~mask[..., :-1]
        runs = starts.to(torch.uint8).sum(dim=3, dtype=torch.int32) + mask[..., 0]
        if int(runs.amax()) <= 1:
            return mask
    border = torch.ones_like(mask)
    border[..., 1:-1, 1:-1] = False
    return ~reconstruct(border, ~mask)


def _dilate_cross(mask: Tensor) -> Tensor:
    """Dilation over edges, not corners."""
    grown = mask.clone()
    grown[..., 1:].logical_or_(mask[..., :-1])  # by method: TorchScript takes |= on a slice for a new tensor
    grown[..., :-1].logical_or_(mask[..., 1:])
    grown[..., 1:, :].logical_or_(mask[..., :-1, :])
    grown[..., :-1, :].logical_or_(mask[..., 1:, :])
    return grown


def _dilate(mask: Tensor) -> Tensor:
    """3 x 3 dilation of a bool mask; equal to kornia.morphology.dilation (a test holds them together), 30 times faster."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_exporting():  # slices of bool that are written to do not compile in Inductor (torch 2.13)
            return nn.functional.max_pool2d(mask.to(torch.float32), 3, 1, 1) > 0
    grown = mask.clone()
    grown[..., 1:].logical_or_(mask[..., :-1])
    grown[..., :-1].logical_or_(mask[..., 1:])
    result = grown.clone()
    result[..., 1:, :].logical_or_(grown[..., :-1, :])
    result[..., :-1, :].logical_or_(grown[..., 1:, :])
    return result


def _erode(mask: Tensor) -> Tensor:
    """3 x 3 erosion; what lies beyond the border counts as contact."""
    return ~_dilate(~mask)


class ContactMask(nn.Module):
    """Contact of compensated images.

    A pixel is in contact if its change over the three channels, each in units of its noise, is longer than ``sigmas``;
    a coarse cell also if its mean change is, in units of the frame's own spread of cell means (faint contact). The noise is
    the larger of the calibrated one and the frame's own. Holes are filled; components smaller than a disc of ``min_size_px`` go.
    A channel that is black in all of the frame (below 5 % of its light at rest) has lost its lamp: the other two decide.

    Args:
        flat: (3, H, W), what the compensated image is at rest.
        noise_std: (3,) or (3, H, W), noise of the compensated image at calibration.
        sigmas: threshold of a pixel; 4.5 leaves some 40 false pixels in a 640 x 480 frame, all specks.
        min_size_px: diameter of the smallest contact.
    Example:
        >>> flat = torch.full((3, 64, 64), 0.5)
        >>> image = flat.clone(); image[0, 20:40, 20:40] += 0.2
        >>> int(ContactMask(flat, torch.full((3,), 0.01))(image[None]).sum())
        400
    """

    flat: Tensor
    per_noise: Tensor
    rest: Tensor
    dead_below: Tensor
    cell_row: Tensor
    cell_column: Tensor

    def __init__(self, flat: Tensor, noise_std: Tensor, sigmas: float = 4.5, min_size_px: float = 8.0) -> None:
        super().__init__()
        check_field("flat", flat)
        check_tensor("noise_std", noise_std)
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
        self.dark_noises = DARK_NOISES
        self.register_buffer("rest", -self.flat * self.per_noise)
        self.samples = 2000  # pixels that tell a frame's own noise
        self.stride = max(1, math.ceil(math.sqrt(flat.shape[1] * flat.shape[2] / self.samples)))
        self.step = max(1, min(flat.shape[1], flat.shape[2]) // 60)
        some = self.flat[:, self.step // 2 :: self.step, self.step // 2 :: self.step]
        self.register_buffer("dead_below", 0.05 * some.mean(dim=(1, 2)))
        self.register_buffer("cell_row", torch.arange(flat.shape[1]) // self.cell)
        self.register_buffer("cell_column", torch.arange(flat.shape[2]) // self.cell)

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "ContactMask":
        """The mask of a calibrated unit's compensated images."""
        check_calibration("calibration", calibration)
        noise = calibration.compensated_noise_std
        return cls(calibration.flat, noise if calibration.response is None else noise.clamp_min(LIGHT_DRIFT))

    def forward(self, compensated: Tensor) -> Tensor:
        """bool (B, 1, H, W)."""
        self._check(compensated)
        return self._find(compensated.detach())[0]

    @torch.jit.export
    def soft(self, compensated: Tensor) -> Tensor:
        """Contact as a number in (0, 1), (B, 1, H, W), differentiable in the image: one half at the hard rim."""
        self._check(compensated)
        hard, interior = self._find(compensated.detach())
        change, squared, threshold = self._change(compensated)
        length = self.sigmas * torch.sqrt(squared / threshold + 1e-12)
        near = _dilate(_dilate(hard)).to(change.dtype)
        return near * torch.maximum(torch.sigmoid(length - self.sigmas), interior.to(change.dtype))

    @torch.jit.export
    def shaded(self, compensated: Tensor) -> Tensor:
        """Where one channel has gone dark and the two others are as they were, bool (B, 1, H, W).

        The skin may be at rest there, in the shadow of what is pressed in; or it has the one slope that looks the same.
        """
        self._check(compensated)
        change, _, threshold = self._change(compensated.detach())
        dark = (change - self.rest < self.dark_noises) & (self.rest < -2.0 * self.dark_noises)
        dark = dark | self._black(compensated).any(dim=1)[:, None, None, None]  # with a lamp dead, too little is left to tell by
        lit = change.masked_fill(dark, 0.0).square().sum(dim=1, keepdim=True) <= threshold
        return lit & (dark.to(torch.uint8).sum(dim=1, keepdim=True) == 1)

    def _check(self, compensated: Tensor) -> None:
        check_batch("compensated", compensated, 3)
        check_same_size("compensated", compensated, "the calibration", self.flat.shape[1], self.flat.shape[2])

    def _find(self, compensated: Tensor) -> tuple[Tensor, Tensor]:
        """Hard contact, and where in it cells decide, not pixels."""
        sampled = compensated.shape[2] > self.stride // 2 and compensated.shape[3] >= 3
        if sampled and may_use_native([compensated, self.rest]):
            return self._find_by_loops(compensated)
        change, squared, threshold = self._change(compensated)
        return self._clean(change, squared > threshold, threshold)

    @torch.jit.unused
    def _find_by_loops(self, compensated: Tensor) -> tuple[Tensor, Tensor]:
        cells = (self.cell, self.reach, self.sigmas, self.rounding, self.least_cells)
        return native.contact_mask(compensated, self.rest, self.per_noise, self.dead_below, self.step, self.stride, *cells)

    def _change(self, compensated: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Change in units of the calibrated noise (B, 3, H, W), its square summed over channels, and that one's threshold."""
        change = torch.addcmul(self.rest, compensated, self.per_noise)
        broken = self._black(compensated)
        if not may_read_values() or bool(broken.any()):
            broken = broken & (broken.to(torch.uint8).sum(dim=1, keepdim=True) == 1)
            change = change * (~broken)[:, :, None, None].to(change.dtype)
        r, g, b = change[:, 0:1], change[:, 1:2], change[:, 2:3]
        squared = torch.addcmul(torch.addcmul(r * r, g, g), b, b)
        noise = frame_noise_std(change.detach(), self.samples).amax(dim=1).clamp_min(1.0)  # a frame noisier than calibration
        noise = torch.sqrt(
            noise * noise + self.rounding
        )  # of smooth light, rounding to 8 bits is no white noise, and not seen there
        return change, squared, (self.sigmas * noise).square()[:, None, None, None]

    def _black(self, compensated: Tensor) -> Tensor:
        """Channels that are black in all of a frame, bool (B, 3)."""
        step = self.step
        return compensated.detach()[:, :, step // 2 :: step, step // 2 :: step].mean(dim=(2, 3)) < self.dead_below

    def _clean(self, change: Tensor, strong: Tensor, threshold: Tensor) -> tuple[Tensor, Tensor]:
        strong = _erode(_dilate(strong))  # closing: pixels lost to noise at the rim
        counted = strong.to(change.dtype)  # ONNX sums no bytes
        if may_read_values():
            counted = strong.to(torch.uint8 if self.cell < 16 else torch.int16)
        density = _cell_sums(counted, self.cell).to(change.dtype) / float(self.cell * self.cell)
        mean = _cell_sums(change, self.cell) / float(self.cell * self.cell)
        any_strong = density > 0
        step = max(1, max(mean.shape[2], mean.shape[3]) // 40)  # a median of some thousand cells is as good
        spread = mean[:, :, step // 2 :: step, step // 2 :: step].abs().flatten(2).median(dim=2).values / 0.6745
        least = torch.sqrt(threshold[:, :, 0, 0]) / (self.sigmas * self.cell)  # white noise in the mean of a cell
        faint = (mean / torch.maximum(spread, least)[..., None, None]).square().sum(1, keepdim=True) > 25.0  # 5 sigmas
        faint = faint & ~any_strong  # where single pixels stand out, as at a rim, they decide
        cells = any_strong | faint
        if may_read_values() and not bool(cells.any()):
            return strong, strong
        filled = _fill(cells)
        # a hole counts as contact; faint cells too, but it takes three that lie together, for one of ten thousand is chance
        weight = torch.where(faint, torch.full_like(density, min(1.0, 0.4 * self.least_cells)), torch.ones_like(density))
        density = torch.where(filled & ~any_strong, weight, density)
        seed = filled & (_box_sum(_box_sum(density, self.reach, 2), self.reach, 3) > self.least_cells)
        kept = reconstruct(_dilate_cross(seed) & filled, filled)
        interior = kept & (_erode(filled) | faint)
        inner = self._to_pixels(interior)
        return (strong & self._to_pixels(kept)) | inner, inner

    def _to_pixels(self, cells: Tensor) -> Tensor:
        return cells.index_select(3, self.cell_column).index_select(2, self.cell_row)


def _cell_sums(image: Tensor, cell: int) -> Tensor:
    """Sums over cells of a (B, C, H, W) image, in its own dtype; where the size is no multiple, the last cells overlap others."""
    return image if cell == 1 else _line_sums(_line_sums(image, cell).transpose(2, 3), cell).transpose(2, 3).contiguous()


def _line_sums(image: Tensor, cell: int) -> Tensor:
    """Sums of each ``cell`` rows."""
    whole = image.shape[2] // cell * cell
    sums = image[:, :, 0:whole:cell]
    for k in range(1, cell):
        sums = sums + image[:, :, k:whole:cell]
    if whole == image.shape[2]:
        return sums
    last = image[:, :, -cell : image.shape[2] - cell + 1]
    for k in range(1, cell):
        first = image.shape[2] - cell + k
        last = last + image[:, :, first : first + 1]
    return torch.cat((sums, last), dim=2)


def _box_sum(image: Tensor, reach: int, dim: int) -> Tensor:
    """Sums over ``reach`` elements either way along a dimension; beyond the border all is zero."""
    pad = [0, 0, reach, reach] if dim == 2 else [reach, reach, 0, 0]
    padded, length = nn.functional.pad(image, pad), image.shape[dim]
    total = padded.narrow(dim, 0, length)
    for k in range(1, 2 * reach + 1):
        total = total + padded.narrow(dim, k, length)
    return total
