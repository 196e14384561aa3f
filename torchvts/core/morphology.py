"""Morphology of bool masks (B, 1, H, W) by tensor operations that script and export."""

import torch
from torch import Tensor, nn


def reconstruct(seed: Tensor, mask: Tensor) -> Tensor:
    """All of ``mask`` that is connected (over edges, not corners) to a seed inside it.

    Rows and columns in turn until nothing is gained: a run of ``mask`` along a line is reached as soon as one of its pixels is, so
    blobs take a few rounds where a 3 x 3 dilation takes as many as the longest path has pixels.

    Source:
        Vincent, Morphological grayscale reconstruction, IEEE Trans. Image Processing 2(2), 1993.
    Example:
        >>> row = torch.tensor([[True, True, False, True]])[None, None]
        >>> reconstruct(torch.tensor([[True, False, False, False]])[None, None], row).flatten().tolist()
        [True, True, False, False]
    """
    reached = seed & mask
    by_row, by_column = _runs(mask, 3), _runs(mask, 2)
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_compiling():
            return _reconstruct_in_graph(reached, mask, by_row, by_column)
    reached = _sweep(reached, mask, by_column)
    across = _sweep(reached, mask, by_row)
    while not torch.equal(across, reached):
        reached = _sweep(across, mask, by_column)
        across = _sweep(reached, mask, by_row)
    return across


def _reconstruct_in_graph(reached: Tensor, mask: Tensor, by_row: Tensor, by_column: Tensor) -> Tensor:
    """The loop of :func:`reconstruct` as one operator of the graph, for torch.export."""

    def gained(reached: Tensor, before: Tensor) -> Tensor:
        return (reached != before).any()

    def sweep_all(reached: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        grown = _sweep(_sweep(reached, mask, by_column), mask, by_row)
        return grown.contiguous(), reached.clone()

    reached = reached.contiguous()
    start = (reached, torch.zeros_like(reached))
    found: Tensor = torch.while_loop(gained, sweep_all, start)[0]  # type: ignore[no-untyped-call]
    return found


def _runs(mask: Tensor, dim: int) -> Tensor:
    """Which run of ``mask`` along a dimension each pixel belongs to, counted over all frames, int64 (B * H * W,)."""
    length = mask.shape[dim]
    first = torch.arange(length, device=mask.device) == 0
    begins = ~mask | (first[:, None] if dim == 2 else first)  # a pixel outside of the mask belongs to the run behind it
    if dim == 3:
        return begins.flatten().cumsum(0)
    return begins.transpose(2, 3).flatten().cumsum(0).reshape(mask.transpose(2, 3).shape).transpose(2, 3).flatten()


def _sweep(reached: Tensor, mask: Tensor, runs: Tensor) -> Tensor:
    """All runs of ``mask`` in which a pixel is reached."""
    inside = reached.flatten().to(torch.uint8).to(torch.float32)
    counts = inside.new_zeros([inside.shape[0] + 1]).scatter_add(0, runs, inside)  # runs are counted from one
    return (counts.index_select(0, runs).reshape(mask.shape) > 0.0) & mask


def dilate(mask: Tensor, reach: int = 1) -> Tensor:
    """Dilation of a bool mask by a square of 2 reach + 1 a side; equal to kornia.morphology.dilation (a test holds them together),
    100 times faster."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_compiling():  # slices of bool that are written to do not compile in Inductor (torch 2.13)
            inside = nn.functional.max_pool2d(mask.to(torch.float32), (1, 2 * reach + 1), 1, (0, reach))
            return nn.functional.max_pool2d(inside, (2 * reach + 1, 1), 1, (reach, 0)) > 0
    return _dilate_lines(_dilate_lines(mask, reach, 3), reach, 2)


def _dilate_lines(mask: Tensor, reach: int, dim: int) -> Tensor:
    """Dilation along a dimension, by shifts that double."""
    length, done = mask.shape[dim], 0
    while done < reach:
        shift = min(done + 1, reach - done)
        grown = mask.clone()
        if shift < length:
            grown.narrow(dim, shift, length - shift).logical_or_(mask.narrow(dim, 0, length - shift))
            grown.narrow(dim, 0, length - shift).logical_or_(mask.narrow(dim, shift, length - shift))
        mask = grown
        done += shift
    return mask


def erode(mask: Tensor, reach: int = 1) -> Tensor:
    """Erosion by the same square; what lies beyond the border counts as contact."""
    return ~dilate(~mask, reach)
