"""Morphology of bool masks (B, 1, H, W) by tensor operations that script and export."""

import torch
from torch import Tensor, nn


def reconstruct(seed: Tensor, mask: Tensor) -> Tensor:
    """All of ``mask`` that is connected (over edges, not corners) to a seed inside it.

    Sweeps along rows and columns both ways until nothing is gained: each sweep crosses the whole image, so blobs take a few
    rounds where a 3 x 3 dilation takes as many as the longest path has pixels.

    Args:
        seed: bool (B, 1, H, W).
        mask: bool (B, 1, H, W).
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
        if torch.compiler.is_compiling():
            return _reconstruct_in_graph(reached, mask)
    grown = dilate_cross(reached) & mask
    while bool((grown & ~reached).any()):
        reached = _sweep(_sweep(grown, mask, 2), mask, 3)
        grown = dilate_cross(reached) & mask
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


def dilate_cross(mask: Tensor) -> Tensor:
    """Dilation over edges, not corners."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_compiling():
            inside = mask.to(torch.float32)
            beside = nn.functional.max_pool2d(inside, (1, 3), 1, (0, 1))
            return (nn.functional.max_pool2d(inside, (3, 1), 1, (1, 0)) + beside) > 0
    grown = mask.clone()
    grown[..., 1:].logical_or_(mask[..., :-1])  # by method: TorchScript takes |= on a slice for a new tensor
    grown[..., :-1].logical_or_(mask[..., 1:])
    grown[..., 1:, :].logical_or_(mask[..., :-1, :])
    grown[..., :-1, :].logical_or_(mask[..., 1:, :])
    return grown


def dilate(mask: Tensor) -> Tensor:
    """3 x 3 dilation of a bool mask; equal to kornia.morphology.dilation (a test holds them together), 30 times faster."""
    if not torch.jit.is_scripting():  # noqa: SIM102
        if torch.compiler.is_compiling():  # slices of bool that are written to do not compile in Inductor (torch 2.13)
            return nn.functional.max_pool2d(mask.to(torch.float32), 3, 1, 1) > 0
    grown = mask.clone()
    grown[..., 1:].logical_or_(mask[..., :-1])
    grown[..., :-1].logical_or_(mask[..., 1:])
    result = grown.clone()
    result[..., 1:, :].logical_or_(grown[..., :-1, :])
    result[..., :-1, :].logical_or_(grown[..., 1:, :])
    return result


def erode(mask: Tensor) -> Tensor:
    """3 x 3 erosion; what lies beyond the border counts as contact."""
    return ~dilate(~mask)
