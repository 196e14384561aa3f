"""Depth that is zero where the skin is undeformed: errors that slopes add up to beside a contact are taken out."""

import torch
from torch import Tensor, nn

from ..core.cells import cell_means, mean_around
from ..core.checks import check_batch, check_same_size, may_read
from ..core.morphology import dilate

STIFF = 30.0
"""How much less the deepest skin bends to the continuation than undeformed skin: slopes are calibrated in contact only."""

TOLERANCE = 0.01
"""Depth below zero that is left, as a share of the largest depth; from twice that none is."""

LEAST_LOW = 0.02
"""Share of the skin without change below which its lower part is a pocket of errors, and no undeformed skin around a face."""

SWEEPS = 4
"""Relaxations on each grid."""


class ZeroBackground(nn.Module):
    """Set depth to zero where the skin is undeformed, and take a continuation of what was there out of the deformed skin.

    Slopes that are off by a few per cent do not sum to zero over a contact. Integrated, they leave a pit on one side of it and a
    rise on the other, which go on as a harmonic function over the undeformed skin. That function is known there, since
    depth is zero; its harmonic continuation into the deformed area is subtracted. Deep skin is stiff against it: slopes are
    right within contacts, from which they are calibrated, and least known around them.
    Skin is pressed in and never pulled out: where depth would be below zero, as beside a contact that the image border
    cuts, it is held at zero as undeformed skin is, and the continuation is found again.
    A flat face that no rim encloses shows no change: there depth stays as it is (:func:`below_faces`).

    Source:
        successive grids for the continuation: Gortler, Grzeszczuk, Szeliski and Cohen, The Lumigraph, SIGGRAPH 1996; the rest is
        this project's.
    Example:
        >>> import torch
        >>> deformed = torch.zeros(1, 1, 48, 64, dtype=torch.bool)
        >>> deformed[..., 12:36, 16:48] = True
        >>> tilt = torch.linspace(-0.1, 0.1, 64).expand(1, 1, 48, 64)
        >>> bool(ZeroBackground()(tilt + deformed.float(), deformed)[..., :10, :].any())
        False
    """

    def __init__(self) -> None:
        super().__init__()
        self.stiff, self.tolerance = STIFF, TOLERANCE
        self.sweeps, self.least_low = SWEEPS, LEAST_LOW

    def forward(self, depth_mm: Tensor, deformed: Tensor) -> Tensor:
        """Depth (B, 1, H, W), and where the skin has moved, bool (B, 1, H, W), to depth.

        Raises:
            ValueError: shapes that differ.
        """
        check_batch("depth_mm", depth_mm, 1)
        height, width = depth_mm.shape[2], depth_mm.shape[3]
        check_same_size("deformed", deformed, "depth_mm", height, width)
        free, (low, high) = _beside(deformed), _range(depth_mm)
        flat = below_faces(free, free & (depth_mm < 0.5 * (low + high)), self.least_low)
        known, raised = _as(flat, depth_mm), _as(free & ~flat, depth_mm)  # a face of the object: only the frame's mean is taken out
        values = depth_mm * known
        level = values.sum(dim=(2, 3), keepdim=True) / known.sum(dim=(2, 3), keepdim=True).clamp_min(1.0)
        range_mm = (high - level).clamp_min(1e-9)
        above = ((depth_mm - level) / range_mm).clamp_min(0.0)
        cell = max(1, min(height, width) // 60)
        weights = _pyramid(cell_means(1.0 + self.stiff * above * above, cell))
        around = [mean_around(weight) for weight in weights]
        cells = torch.cat((cell_means(known + raised, cell), cell_means(torch.addcmul(values, raised, level), cell)), dim=1)
        offset = _pixels(self.continued(cells, weights, around, cell), cell, height, width)
        # depth below zero is an error too: beyond a tolerance pixels begin to be known, up to a quarter, so that none decides alone
        below = 0.25 * ((offset - depth_mm) / (self.tolerance * range_mm) - 1.0).clamp(0.0, 1.0).masked_fill(free, 0.0)
        if may_read(below) and not bool(below.any()):
            return (depth_mm - offset) * (1.0 - known)
        cells = cells + torch.cat((cell_means(below, cell), cell_means(depth_mm * below, cell)), dim=1)
        offset = _pixels(self.continued(cells, weights, around, cell), cell, height, width)
        return (depth_mm - offset) * (1.0 - known)

    def continued(self, known: Tensor, weights: list[Tensor], around: list[Tensor], cell: int) -> Tensor:
        """Values continued to all cells, (B, 1, h, w).

        Args:
            known: (B, 2, h, w): the share of a cell on which the value is known, and the mean of the value, 0 where it is unknown.
            weights: (B, 1, h, w) and coarser: the weight of a cell, whose square is the stiffness against the continuation.
            around: the mean of these weights over 3 x 3 cells.
            cell: pixels a side of a cell. Cells in which less than a pixel is known are known in part.
        """
        grids = _pyramid(known)
        mean = grids[-1][:, 1:2].sum(dim=(2, 3), keepdim=True) / grids[-1][:, 0:1].sum(dim=(2, 3), keepdim=True).clamp_min(1e-9)
        found = mean.expand_as(weights[-1])
        for k in range(len(grids) - 1, -1, -1):
            share, weight = grids[k][:, 0:1], weights[k]
            if k < len(grids) - 1:
                found = _pixels(found, 2, share.shape[2], share.shape[3])
            sure = (share * float((cell << k) ** 2)).clamp_max(1.0)
            free = weight * (1.0 - sure)
            # of the products weight * value: those that are known, and the part of the mean around that others take
            held, taken = weight * (sure * (grids[k][:, 1:2] / share.clamp_min(1e-9))), free / around[k]
            product = torch.addcmul(held, free, found)
            for _ in range(self.sweeps):
                product = torch.addcmul(held, taken, mean_around(product))
            found = product / weight
        return found


def with_faces(depth_mm: Tensor, deformed: Tensor) -> Tensor:
    """The deformed area, bool (B, 1, H, W), with the flat faces of the object that it leaves open.

    A flat face changes no light. Its rim encloses it, and holes are filled, unless the image border cuts the rim, or the light
    hardly changes along a part of it: then unchanged skin lies on the object and on undeformed skin alike. Depth shows which is
    which: :func:`below_faces`. Where no rim reaches the image border, less of a face lies along it than deformed skin surrounds.

    Args:
        depth_mm: (B, 1, H, W), as integrated.
        deformed: (B, 1, H, W) bool, where light has changed.
    Example:
        >>> import torch
        >>> depth, rim = torch.zeros(1, 1, 48, 64), torch.zeros(1, 1, 48, 64, dtype=torch.bool)
        >>> depth[..., :20] = 0.5
        >>> rim[..., 18:22] = True
        >>> int(with_faces(depth, rim).sum()) == 48 * 22
        True
    """
    low, high = _range(depth_mm)
    above = depth_mm >= 0.5 * (low + high)
    if may_read(deformed) and not _any(above & ~deformed):
        return deformed
    free = _beside(deformed)
    flat = below_faces(free, free & ~above)
    face = free & ~flat
    # along an image border that no rim reaches, little of it can be a face
    apart = (_on_border(deformed) > 0.0) | (_on_border(face) < _count(dilate(face) & ~free))
    found = apart & (_count(face) > 0.0) & (_count(flat) > 0.0)
    return deformed | (found & above)


def below_faces(free: Tensor, low: Tensor, least_low: float = LEAST_LOW) -> Tensor:
    """Undeformed skin, bool (B, 1, H, W): the lower part of what shows no change, or all if the rest is no face of the object.

    The rest is one if deformed skin is most of what surrounds it. Where the lower part is empty, depth is upside down, as of a
    module in training, and stays so: held at zero, it would not learn.

    Args:
        free: bool (B, 1, H, W), where skin shows no change.
        low: the same of its part below half of the frame's depth.
        least_low: share of ``free`` below which ``low`` is a pocket of errors.
    """
    high = free & ~low
    if may_read(high) and not _any(high):
        return free
    rim = dilate(high) & ~high
    count = _count(low)
    pocket = (count > 0.0) & (count < least_low * _count(free))
    return low | (free & ~((_count(rim & ~free) > _count(rim & low)) & ~pocket))


class DepthAsIs(nn.Module):
    """Depth (B, 1, H, W) as it was integrated."""

    def forward(self, depth_mm: Tensor, deformed: Tensor) -> Tensor:
        return depth_mm


def _as(mask: Tensor, like: Tensor) -> Tensor:
    return mask.to(torch.uint8).to(like.dtype)


def _beside(deformed: Tensor) -> Tensor:
    """Where no skin within two pixels is deformed, bool: a steep rim may be two pixels wider than the mask."""
    return ~dilate(deformed, 2)


def _count(mask: Tensor) -> Tensor:
    """Pixels of each frame in a mask, (B, 1, 1, 1)."""
    return mask.to(torch.uint8).to(torch.float32).sum(dim=(2, 3), keepdim=True)  # a quarter of the time of a sum of bools


def _any(mask: Tensor) -> bool:
    """Whether a mask holds any pixel: a third of the time of ``any``."""
    return bool(mask.to(torch.uint8).sum() > 0)


def _range(depth_mm: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest depth of each frame, (B, 1, 1, 1)."""
    return depth_mm.amin(dim=(2, 3), keepdim=True), depth_mm.amax(dim=(2, 3), keepdim=True)


def _on_border(mask: Tensor) -> Tensor:
    """Pixels of each frame in a mask along the four sides of the image, (B, 1, 1, 1)."""
    return _count(torch.cat((mask[..., 0, :], mask[..., -1, :], mask[..., :, 0], mask[..., :, -1]), dim=2)[..., None])


def _pyramid(fields: Tensor) -> list[Tensor]:
    """Fields, and their means over cells of 2, 4, ... a side, down to two cells along the shorter side."""
    grids = [fields]
    while min(grids[-1].shape[2], grids[-1].shape[3]) > 2:
        grids.append(cell_means(grids[-1], 2))
    return grids


def _pixels(cells: Tensor, cell: int, height: int, width: int) -> Tensor:
    """Values of cells at pixels, interpolated."""
    if cell > 1:
        cells = nn.functional.interpolate(cells, scale_factor=float(cell), mode="bilinear", align_corners=False)
    return cells[:, :, :height, :width]
