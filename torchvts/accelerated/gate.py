"""The one gate: whether compiled kernels, or NumPy and OpenCV, may stand in for PyTorch on given tensors."""

import contextlib
import contextvars
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

from . import kernels

HALF = (torch.float16, torch.bfloat16)
"""Of these NumPy knows one, and sums it otherwise."""

_refused = contextvars.ContextVar("refused", default=False)


@contextlib.contextmanager
def reference_only() -> Iterator[None]:
    """Within it, no compiled kernel runs: PyTorch does all the work, as in exported programs and on a GPU.

    Example:
        >>> from torchvts import PoissonBackground
        >>> solver, gradient = PoissonBackground(0.1), torch.randn(1, 2, 48, 64)
        >>> with reference_only():
        ...     depth = solver(gradient)
        >>> bool((solver(gradient) - depth).abs().max() < 1e-5)
        True
    """
    before = _refused.set(True)
    try:
        yield
    finally:
        _refused.reset(before)


def arrays_usable(*tensors: Tensor) -> bool:
    """Whether NumPy and OpenCV may read these tensors: plain ones on a CPU, in eager mode, with no derivative recorded."""
    return not torch.compiler.is_compiling() and _plain(tensors)


def usable(*tensors: Tensor) -> bool:
    """Whether compiled kernels may work on these tensors: as :func:`arrays_usable`, and float32, and the kernels are there."""
    if torch.compiler.is_compiling() or _refused.get() or kernels.library() is None:
        return False
    for tensor in tensors:
        if tensor.dtype is not torch.float32:
            return False
    return _plain(tensors)


def _plain(tensors: tuple[Tensor, ...]) -> bool:
    if torch._C._get_tracing_state() is not None:
        return False
    if forward_ad._current_level >= 0 or torch._C._len_torch_dispatch_stack() > 0:  # tangents and traces would be lost
        return False
    recorded = torch.is_grad_enabled()
    for tensor in tensors:  # a loop, because it runs some ten times a frame
        if type(tensor) is not Tensor and type(tensor) is not nn.Parameter:
            return False
        if not tensor.is_cpu or tensor.layout is not torch.strided or tensor.dtype in HALF or (recorded and tensor.requires_grad):
            return False
        if torch._C._functorch.is_functorch_wrapped_tensor(tensor):
            return False
        if tensor.is_neg() or tensor._is_zerotensor():  # its memory holds other values, or there is none
            return False
    return True
