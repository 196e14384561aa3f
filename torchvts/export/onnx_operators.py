"""What ONNX needs of a graph: PyTorch operators that it lacks, written in those that it has, and nothing that is computed twice."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def decompositions() -> dict[Any, Callable[..., Any]]:
    """The replacements by operator, for ``ExportedProgram.run_decompositions``."""
    aten = torch.ops.aten
    return {aten.median.dim: median, aten.nanmedian.dim: nanmedian}


def median(values: Tensor, dim: int, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    """``torch.median`` along a dimension, by sorting."""
    ordered, index = torch.sort(values, dim=dim)
    middle = (values.shape[dim] - 1) // 2
    ordered, index = ordered.narrow(dim, middle, 1), index.narrow(dim, middle, 1)
    return (ordered, index) if keepdim else (ordered.squeeze(dim), index.squeeze(dim))


def nanmedian(values: Tensor, dim: int, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    """``torch.nanmedian`` along a dimension, by sorting."""
    known = ~torch.isnan(values)
    ordered, index = torch.sort(torch.where(known, values, torch.inf), dim=dim)
    middle = ((known.to(torch.int64).sum(dim, keepdim=True) - 1) // 2).clamp_min(0)
    ordered, index = ordered.gather(dim, middle), index.gather(dim, middle)
    ordered = torch.where(known.any(dim, keepdim=True), ordered, torch.nan)
    return (ordered, index) if keepdim else (ordered.squeeze(dim), index.squeeze(dim))


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
