"""Depth that is zero where the skin is undeformed: errors that slopes add up to beside a contact are taken out."""

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_same_size, may_read

STIFF = 30.0
"""How much less the deepest skin bends to the continuation than undeformed skin: slopes are calibrated in contact only."""

TOLERANCE = 0.01
"""Depth below zero that is left, as a share of the largest depth."""

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
    A flat face that the image border cuts shows no change: there depth stays as it is (:func:`below_faces`).

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
        free, high = _beside(deformed, depth_mm), depth_mm.amax(dim=(2, 3), keepdim=True)
        flat = below_faces(free, free * _as(depth_mm < _middle(depth_mm), depth_mm), self.least_low)
        count = flat.sum(dim=(2, 3), keepdim=True)
        level = (depth_mm * flat).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
        raised = free - flat  # a face of the object: only the frame's mean is taken out
        range_mm = (high - level).clamp_min(1e-9)
        weight = 1.0 + self.stiff * ((depth_mm - level) / range_mm).clamp_min(0.0).square()
        fields = torch.cat((free, depth_mm * flat + level * raised, weight), dim=1)
        offset = self.continued(fields)
        below = (1.0 - free) * _as(depth_mm < offset - self.tolerance * range_mm, depth_mm)  # that too is an error
        offset = self.continued(fields + torch.cat((below, depth_mm * below, torch.zeros_like(below)), dim=1))
        return (depth_mm - offset) * (1.0 - flat)

    def continued(self, fields: Tensor) -> Tensor:
        """Values continued to all pixels, (B, 1, H, W).

        Args:
            fields: (B, 3, H, W): the share of a pixel on which the value is known, 0 or 1; the value, 0 where it is unknown; the
                weight of the pixel, whose square is the stiffness against the continuation.
        """
        height, width = fields.shape[2], fields.shape[3]
        cell = max(1, min(height, width) // 60)
        fields = _coarser(fields, cell)
        grids = [fields]
        while min(grids[-1].shape[2], grids[-1].shape[3]) > 2:
            grids.append(_coarser(grids[-1], 2))
        share, values = grids[-1][:, 0:1], grids[-1][:, 1:2]
        mean = values.sum(dim=(2, 3), keepdim=True) / share.sum(dim=(2, 3), keepdim=True).clamp_min(1e-9)
        found = mean.expand_as(values)
        for k in range(len(grids)):
            grid = grids[len(grids) - 1 - k]
            share, values, weight = grid[:, 0:1], grid[:, 1:2], grid[:, 2:3]
            if k > 0:
                found = nn.functional.interpolate(found, scale_factor=2.0, mode="bilinear", align_corners=False)
                found = found[:, :, : share.shape[2], : share.shape[3]]
            known, values = share > 0.0, values / share.clamp_min(1e-9)
            found = torch.where(known, values, found)
            total = nn.functional.avg_pool2d(weight, 3, 1, 1).clamp_min(1e-9)
            for _ in range(self.sweeps):
                around = nn.functional.avg_pool2d(weight * found, 3, 1, 1) / total
                found = torch.where(known, values, around)
        if cell > 1:
            found = nn.functional.interpolate(found, scale_factor=float(cell), mode="bilinear", align_corners=False)
        return found[:, :, :height, :width]


def with_cut_faces(depth_mm: Tensor, deformed: Tensor) -> Tensor:
    """The deformed area, bool (B, 1, H, W), with the faces of the object that the image border cuts.

    A flat face changes no light. Within the image its rim encloses it, and holes are filled; where the image border cuts the rim,
    unchanged skin lies on the object and on undeformed skin alike. Depth shows which is which: :func:`below_faces`.

    Args:
        depth_mm: (B, 1, H, W), as integrated.
        deformed: (B, 1, H, W) bool, where light has changed.
    Example:
        >>> import torch
        >>> depth, rim = torch.zeros(1, 1, 48, 64), torch.zeros(1, 1, 48, 64, dtype=torch.bool)
        >>> depth[..., :20] = 0.5
        >>> rim[..., 18:22] = True
        >>> int(with_cut_faces(depth, rim).sum()) == 48 * 22
        True
    """
    cut = _on_border(deformed)
    if may_read(deformed) and not bool(cut.any()):
        return deformed
    free, above = _beside(deformed, depth_mm), depth_mm >= _middle(depth_mm)
    flat = below_faces(free, free * _as(~above, depth_mm))
    found = cut & _on_border(free - flat > 0.0) & (flat.amax(dim=(2, 3), keepdim=True) > 0.0)
    return deformed | (found & above)


def below_faces(free: Tensor, low: Tensor, least_low: float = LEAST_LOW) -> Tensor:
    """Undeformed skin, (B, 1, H, W): the lower part of what shows no change, or all of it if the rest is no face of the object.

    The rest is one if deformed skin is most of what surrounds it. Where the lower part is empty, depth is upside down, as of a
    module in training, and stays so: held at zero, it would not learn.

    Args:
        free: (B, 1, H, W), 1 where skin shows no change, else 0.
        low: the same of its part below half of the frame's depth.
        least_low: share of ``free`` below which ``low`` is a pocket of errors.
    """
    high = free - low
    rim = nn.functional.max_pool2d(high, 3, 1, 1) - high
    by_low, by_deformed = (rim * low).sum(dim=(2, 3), keepdim=True), (rim * (1.0 - free)).sum(dim=(2, 3), keepdim=True)
    count, of = low.sum(dim=(2, 3), keepdim=True), free.sum(dim=(2, 3), keepdim=True)
    pocket = (count > 0.0) & (count < least_low * of)
    return torch.where((by_deformed > by_low) & ~pocket, low, free)


class DepthAsIs(nn.Module):
    """Depth (B, 1, H, W) as it was integrated."""

    def forward(self, depth_mm: Tensor, deformed: Tensor) -> Tensor:
        return depth_mm


def _as(mask: Tensor, like: Tensor) -> Tensor:
    return mask.to(torch.uint8).to(like.dtype)


def _beside(deformed: Tensor, like: Tensor) -> Tensor:
    """1 where no skin within two pixels is deformed, else 0: a steep rim may be two pixels wider than the mask."""
    return 1.0 - nn.functional.max_pool2d(_as(deformed, like), 5, 1, 2)


def _middle(depth_mm: Tensor) -> Tensor:
    """Half of each frame's depth, (B, 1, 1, 1)."""
    return 0.5 * (depth_mm.amin(dim=(2, 3), keepdim=True) + depth_mm.amax(dim=(2, 3), keepdim=True))


def _on_border(mask: Tensor) -> Tensor:
    """Whether any pixel of a mask lies on the image border, bool (B, 1, 1, 1)."""
    across = torch.cat((mask[..., 0, :], mask[..., -1, :], mask[..., :, 0], mask[..., :, -1]), dim=2)
    return across.any(dim=2)[..., None, None]


def _coarser(fields: Tensor, cell: int) -> Tensor:
    """Means over cells; beyond the border nothing is known."""
    if cell == 1:
        return fields
    height, width = fields.shape[2], fields.shape[3]
    return nn.functional.avg_pool2d(nn.functional.pad(fields, [0, -width % cell, 0, -height % cell]), cell)
