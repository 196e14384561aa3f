r"""Where the skin is touched: pixels whose change stands out of the frame's own noise, holes filled, specks removed.

Fine pixels decide the rim; a grid of coarse cells decides what is a hole and what is a speck, because there it is cheap.
"""

import math

import torch
from torch import Tensor, nn

from .core.checks import QUANTISATION_STD, check_batch, check_positive, check_same_size
from .core.noise import noise_std as frame_noise_std
from .record import Calibration

LIGHT_DRIFT = 0.008
"""Least noise, relative to the background, with a response field: the lamps of real sensors drift by 1 to 2 % of their light."""


def reconstruct(seed: Tensor, mask: Tensor) -> Tensor:
    """All of ``mask`` that is connected (over edges, not corners) to a seed inside it.

    Sweeps along rows and columns both ways until nothing is gained: each sweep crosses the whole image, so blobs take a few
    rounds where a 3 x 3 dilation takes as many as the longest path has pixels.

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
    reached = seed & mask
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_exporting():
            return _reconstruct_in_graph(reached, mask)
    before = 0
    count = int(reached.sum())
    while count > before:
        for dim in (2, 3):
            reached = _sweep(_sweep(reached, mask, dim).flip(dim), mask.flip(dim), dim).flip(dim)
        before, count = count, int(reached.sum())
    return reached


def _reconstruct_in_graph(reached: Tensor, mask: Tensor) -> Tensor:
    """The loop of :func:`reconstruct` as one operator of the graph, for torch.export."""
    from torch._higher_order_ops.while_loop import while_loop

    def gained(reached: Tensor, before: Tensor) -> Tensor:
        return (reached != before).any()

    def sweep_all(reached: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        grown = reached
        for dim in (2, 3):
            grown = _sweep(_sweep(grown, mask, dim).flip(dim), mask.flip(dim), dim).flip(dim)
        return grown.contiguous(), reached.clone()

    start = (reached.contiguous(), torch.zeros_like(reached))
    found: Tensor = while_loop(gained, sweep_all, start)[0]  # type: ignore[no-untyped-call]
    return found


def _sweep(reached: Tensor, mask: Tensor, dim: int) -> Tensor:
    # on the way from the start of a line, what came last before a pixel: a reached pixel or a barrier?
    place = 2 * torch.arange(1, mask.shape[dim] + 1, dtype=torch.int32, device=mask.device)
    place = place[:, None] if dim == 2 else place
    code = (place + reached.to(torch.int32)) * (reached | ~mask).to(torch.int32)
    return mask & (torch.cummax(code, dim=dim).values % 2 == 1)


def _dilate(mask: Tensor) -> Tensor:
    """3 x 3 dilation of a bool mask; equal to kornia.morphology.dilation (a test holds them together), 30 times faster."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_exporting():  # slices of bool that are written to do not compile in Inductor (torch 2.13)
            return nn.functional.max_pool2d(mask.to(torch.float32), 3, 1, 1) > 0
    grown = mask.clone()
    grown[..., 1:].logical_or_(mask[..., :-1])  # by method: TorchScript takes |= on a slice for a new tensor
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

    Args:
        flat: (3, H, W), what the compensated image is at rest.
        noise_std: (3,) or (3, H, W), noise of the compensated image at calibration.
        sigmas: threshold; 5 leaves 5 false pixels in a 640 x 480 frame, all specks.
        min_size_px: diameter of the smallest contact.
    Example:
        >>> flat = torch.full((3, 64, 64), 0.5)
        >>> image = flat.clone(); image[0, 20:40, 20:40] += 0.2
        >>> int(ContactMask(flat, torch.full((3,), 0.01))(image[None]).sum())
        400
    """

    flat: Tensor
    per_noise: Tensor

    def __init__(self, flat: Tensor, noise_std: Tensor, sigmas: float = 5.0, min_size_px: float = 8.0) -> None:
        super().__init__()
        if flat.dim() != 3 or flat.shape[0] != 3:
            raise ValueError(f"flat: expected (3, H, W), got {tuple(flat.shape)}")
        self.sigmas = check_positive("sigmas", sigmas)
        self.min_size_px = check_positive("min_size_px", min_size_px)
        self.cell = max(1, min(flat.shape[1], flat.shape[2]) // 96)
        self.reach = max(1, math.ceil(0.5 * min_size_px / self.cell))  # cells around one that a smallest contact may touch
        self.least_cells = 0.6 * (min_size_px / self.cell) ** 2  # nearly the area of a disc of that size
        noise = noise_std.reshape(3, 1, 1) if noise_std.dim() == 1 else noise_std
        self.register_buffer("flat", flat.detach().clone())
        self.register_buffer("per_noise", 1.0 / noise.detach().clamp_min(QUANTISATION_STD).to(flat.dtype))

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "ContactMask":
        """The mask of a calibrated unit's compensated images."""
        noise = calibration.compensated_noise_std
        return cls(calibration.flat, noise if calibration.response is None else noise.clamp_min(LIGHT_DRIFT))

    def forward(self, compensated: Tensor) -> Tensor:
        """bool (B, 1, H, W)."""
        change, squared, threshold = self._change(compensated)
        return self._clean(change, squared > threshold, threshold)[0]

    @torch.jit.export
    def soft(self, compensated: Tensor) -> Tensor:
        """Contact as a number in (0, 1), (B, 1, H, W), differentiable in the image: one half at the hard rim."""
        change, squared, threshold = self._change(compensated)
        hard, interior = self._clean(change.detach(), squared > threshold, threshold)
        length = self.sigmas * torch.sqrt(squared / threshold + 1e-12)
        near = _dilate(_dilate(hard)).to(change.dtype)
        return near * torch.maximum(torch.sigmoid(length - self.sigmas), interior.to(change.dtype))

    def _change(self, compensated: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Change in units of the calibrated noise (B, 3, H, W), its square summed over channels, and that one's threshold."""
        check_batch("compensated", compensated, 3)
        check_same_size("compensated", compensated, "the calibration", self.flat.shape[1], self.flat.shape[2])
        change = (compensated - self.flat) * self.per_noise
        r, g, b = change[:, 0:1], change[:, 1:2], change[:, 2:3]
        squared = torch.addcmul(torch.addcmul(r * r, g, g), b, b)
        noise = frame_noise_std(change.detach()).amax(dim=1).clamp_min(1.0)  # a frame noisier than calibration
        return change, squared, (self.sigmas * noise).square()[:, None, None, None]

    def _clean(self, change: Tensor, strong: Tensor, threshold: Tensor) -> tuple[Tensor, Tensor]:
        height, width, cell = change.shape[2], change.shape[3], self.cell
        strong = ~_dilate(~_dilate(strong))  # closing: pixels lost to noise at the rim
        pad = [0, -width % cell, 0, -height % cell]
        counted = strong.to(change.dtype)
        if pad[1] > 0 or pad[3] > 0:  # padding by nothing would copy
            counted, change = nn.functional.pad(counted, pad), nn.functional.pad(change, pad, mode="replicate")
        density = nn.functional.avg_pool2d(counted, cell)
        any_strong = density > 0
        mean = nn.functional.avg_pool2d(change, cell)
        spread = mean.abs().flatten(2).median(dim=2).values / 0.6745
        least = torch.sqrt(threshold[:, :, 0, 0]) / (self.sigmas * cell)  # white noise in the mean of a cell
        faint = (mean / torch.maximum(spread, least)[..., None, None]).square().sum(1, keepdim=True) > self.sigmas * self.sigmas
        faint = faint & ~any_strong  # where single pixels stand out, as at a rim, they decide
        cells = any_strong | faint
        border = torch.ones_like(cells)
        border[..., 1:-1, 1:-1] = False
        filled = ~reconstruct(border, ~cells)
        density = torch.where(filled & ~any_strong, torch.ones_like(density), density)
        around = 2 * self.reach + 1
        area = nn.functional.avg_pool2d(density, around, 1, self.reach) * float(around * around)
        kept = reconstruct(filled & (area > self.least_cells), filled)
        interior = self._to_pixels(kept & (_erode(filled) | faint), height, width)
        return (strong & self._to_pixels(kept, height, width)) | interior, interior

    def _to_pixels(self, cells: Tensor, height: int, width: int) -> Tensor:
        rows, columns, cell = cells.shape[2], cells.shape[3], self.cell
        blocks = cells[:, :, :, None, :, None].expand(-1, -1, rows, cell, columns, cell)
        return blocks.reshape(-1, 1, rows * cell, columns * cell)[..., :height, :width]
