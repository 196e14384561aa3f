"""A pipeline as one graph of PyTorch operators, by torch.export; for ONNX with the Poisson solver by matrix products."""

import copy
import warnings

import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_size, check_window
from ..integration import PoissonBackground, PoissonDCT, divergence
from ..integration.transforms import cosine_bases, fold, unfold
from ..pipeline.depth import DepthPipeline

MAX_BATCH = 1024
"""Largest batch that the graph formats accept."""


class PoissonBackgroundByMatrix(nn.Module):
    """:class:`PoissonBackground` for one size, by matrix products alone, because ONNX has no such FFT.

    Args:
        height: rows, pixels.
        width: columns, pixels.
        mm_per_pixel: pixel pitch, mm.
        dtype: dtype of the matrices.
        zero_background: zero on the background, as :class:`PoissonBackground`; else zero mean, as :class:`PoissonDCT`.
    Source:
        As :func:`poisson_dct`; a test compares them.
    Example:
        >>> gradient = torch.randn(2, 2, 24, 32)
        >>> bool((PoissonBackgroundByMatrix(24, 32, 0.5)(gradient) - PoissonBackground(0.5)(gradient)).abs().max() < 1e-5)
        True
    """

    takes_window: bool = True

    def __init__(
        self, height: int, width: int, mm_per_pixel: float, dtype: torch.dtype = torch.float32, zero_background: bool = True
    ) -> None:
        super().__init__()
        check_size(height, width, mm_per_pixel)
        self.size = (height, width)
        self.mm_per_pixel = mm_per_pixel
        self.zero_background = zero_background
        even_y, odd_y, value_even_y, value_odd_y = cosine_bases(height)
        even_x, odd_x, value_even_x, value_odd_x = cosine_bases(width)
        for name, basis in (("even_y", even_y), ("odd_y", odd_y), ("even_x", even_x), ("odd_x", odd_x)):
            self.register_buffer(name, basis.to(dtype))
        for y, value_y in (("even", value_even_y), ("odd", value_odd_y)):
            for x, value_x in (("even", value_even_x), ("odd", value_odd_x)):
                value = value_y[:, None] + value_x[None, :]
                inverse = torch.where(value == 0.0, torch.zeros_like(value), 1.0 / value)  # zero: the mean
                self.register_buffer(f"inverse_{y}_{x}", inverse.to(dtype))

    def forward(self, gradient: Tensor, window: tuple[int, int] = (0, 0), size: tuple[int, int] | None = None) -> Tensor:
        check_batch("gradient", gradient, 2)
        if size is not None and size != self.size:
            raise ValueError(f"gradient, window: expected size {self.size}, for which the matrices are, got {size}")
        check_window("gradient", gradient, self.size, None if size is None and window == (0, 0) else window)
        if size is not None and size != (gradient.shape[2], gradient.shape[3]):
            after = [size[k] - window[k] - gradient.shape[2 + k] for k in (0, 1)]
            gradient = nn.functional.pad(gradient, [window[1], after[1], window[0], after[0]])
        up, down = fold(divergence(gradient), -2)
        rows = []
        for y, part in (("even", up), ("odd", down)):
            basis_y = self.get_buffer(f"{y}_y")
            lines = []
            for x, block in zip(("even", "odd"), fold(part, -1)):
                basis_x, inverse = self.get_buffer(f"{x}_x"), self.get_buffer(f"inverse_{y}_{x}")
                lines.append(basis_y.t() @ ((basis_y @ block @ basis_x.t()) * inverse) @ basis_x)
            rows.append(unfold(lines[0], lines[1], -1))
        depth = self.mm_per_pixel * unfold(rows[0], rows[1], -2)
        if not self.zero_background:
            return depth
        background = ((gradient[:, 0:1] == 0) & (gradient[:, 1:2] == 0)).to(depth.dtype)
        count = background.sum(dim=(2, 3), keepdim=True)
        mean = (depth * background).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
        return depth - torch.where(count > 0, mean, depth.amin(dim=(2, 3), keepdim=True))


class _PlainOutput(nn.Module):
    """A pipeline that returns a plain tuple: a file with a NamedTuple of torchvts would need torchvts to be read."""

    def __init__(self, pipe: DepthPipeline) -> None:
        super().__init__()
        self.pipe = pipe

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.pipe(images))


def size_and_dtype(pipe: DepthPipeline) -> tuple[int, int, torch.dtype]:
    """Height, width and dtype for which the pipeline was calibrated.

    Raises:
        ValueError: no block knows them.
    """
    for tensor in (*pipe.contact.buffers(), *pipe.compensate.buffers()):
        if tensor.dim() == 3 and tensor.shape[0] == 3 and tensor.is_floating_point():
            return tensor.shape[1], tensor.shape[2], tensor.dtype
    raise ValueError("pipe: expected blocks that know the size of the calibration, as from_calibration makes them, got none")


def trace(pipe: DepthPipeline, by_matrix: bool) -> torch.export.ExportedProgram:
    """Trace a copy of a pipeline for any batch; ``by_matrix`` replaces its Poisson solvers by matrix products."""
    height, width, dtype = size_and_dtype(pipe)
    pipe = copy.deepcopy(pipe).eval().requires_grad_(False)
    if by_matrix and isinstance(pipe.integrate, PoissonDCT):
        pipe.integrate = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype, pipe.integrate.levelled)
    if by_matrix and isinstance(pipe.coarse_integrate, PoissonBackground):
        rows, columns = (len(range(pipe.stride // 2, n, pipe.stride)) for n in (height, width))
        pipe.coarse_integrate = PoissonBackgroundByMatrix(rows, columns, pipe.stride * pipe.mm_per_pixel, dtype)
    if by_matrix and isinstance(pipe.judge, PoissonBackground):
        pipe.judge = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype)
    images = torch.full((2, 3, height, width), 0.5, dtype=dtype)
    batch = torch.export.Dim("batch", min=1, max=MAX_BATCH)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pipe(images)  # integrators make their tables, which then are constants of the graph
        if pipe.expects:
            pipe.judge(images[:, :2], (0, 0), (height, width))
        return torch.export.export(_PlainOutput(pipe), (images,), dynamic_shapes=({0: batch},), strict=False)
