"""What ONNX needs of a graph: PyTorch operators that it lacks, written in those that it has, and nothing that is computed twice."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

INVERSE_STEPS = 48
"""Steps of the iteration for an inverse: each doubles the digits from where a condition of 10^7 has none."""


class InOnnxOperators(TorchFunctionMode):
    """Within it, operators that ONNX lacks are called as those that it has.

    They are so traced, and no pass over the graph is needed for them, which takes as long as to trace it.
    """

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        replacement = _REPLACEMENTS.get(func)
        return (replacement or func)(*args, **(kwargs or {}))


def median(input: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
    """``torch.median`` of all values, or along a dimension, by sorting."""
    if dim is None:
        return median(input.flatten(), 0)[0]
    ordered, index = torch.sort(input, dim=dim)
    middle = (input.shape[dim] - 1) // 2
    return _result(torch.return_types.median, ordered.narrow(dim, middle, 1), index.narrow(dim, middle, 1), dim, keepdim)


def nanmedian(input: Tensor, dim: int | None = None, keepdim: bool = False) -> Any:
    """``torch.nanmedian`` of all values, or along a dimension, by sorting."""
    if dim is None:
        return nanmedian(input.flatten(), 0)[0]
    known = ~torch.isnan(input)
    ordered, index = torch.sort(torch.where(known, input, torch.inf), dim=dim)
    middle = ((known.to(torch.int64).sum(dim, keepdim=True) - 1) // 2).clamp_min(0)
    ordered, index = ordered.gather(dim, middle), index.gather(dim, middle)
    ordered = torch.where(known.any(dim, keepdim=True), ordered, torch.nan)
    return _result(torch.return_types.nanmedian, ordered, index, dim, keepdim)


def solve(system: Tensor, right: Tensor) -> Tensor:
    """``torch.linalg.solve`` for symmetric positive definite systems (B, n, n), by products alone.

    Source:
        Newton's iteration for the inverse: Schulz, ZAMM 13, 1933; the start of Ben-Israel and Cohen, SIAM J. Numer. Anal. 3, 1966.
    """
    scale = system.diagonal(dim1=-2, dim2=-1).rsqrt()
    scaled = scale[..., :, None] * system * scale[..., None, :]
    largest = scaled.abs().sum(dim=-1).amax(dim=-1)[..., None, None]
    inverse = scaled / (largest * largest)
    for _ in range(INVERSE_STEPS):
        inverse = 2.0 * inverse - inverse @ (scaled @ inverse)
    return scale[..., :, None] * (inverse @ (scale[..., :, None] * right))


def _result(kind: Callable[..., Any], values: Tensor, index: Tensor, dim: int, keepdim: bool) -> Any:
    """As torch returns it, with names."""
    return kind((values, index) if keepdim else (values.squeeze(dim), index.squeeze(dim)))


_REPLACEMENTS: dict[Any, Callable[..., Any]] = {
    torch.median: median,
    torch.Tensor.median: median,
    torch.linalg.solve: solve,
    torch.nanmedian: nanmedian,
    torch.Tensor.nanmedian: nanmedian,
}


def simplify(model: Any) -> None:
    """Fold what is constant, and compute nothing twice, in an ``onnx_ir.Model``.

    The exporter's own optimiser does this and tries rules of rewriting at every operator. They take most of its time, and a
    pipeline is no faster by them in ONNX Runtime.
    """
    from onnx_ir.passes import Sequential, common
    from onnxscript import optimizer

    optimizer.inline(model)
    optimizer.fold_constants(model)
    optimizer.remove_unused_nodes(model)
    constants = common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)
    Sequential(constants, common.DeduplicateInitializersPass(), common.CommonSubexpressionEliminationPass())(model)
