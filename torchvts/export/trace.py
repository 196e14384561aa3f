"""A pipeline as one graph of PyTorch operators, by torch.export; for ONNX with the Poisson solver by matrix products."""

import copy
import warnings

import torch
from torch import Tensor, nn

from ..compensate import Rectify
from ..core.checks import check_batch, check_dtype, check_same_size, check_size, check_switch
from ..integration import Integrator, PoissonDCT, divergence
from ..integration.transforms import cosine_bases, fold, unfold
from ..pipeline import DepthOutput, DepthPipeline, Shadows

MAX_BATCH = 1024
"""Largest batch that the graph formats accept."""


class PoissonBackgroundByMatrix(Integrator):
    """:class:`PoissonBackground` for one size, by matrix products alone, because ONNX has no such FFT.

    Args:
        height: rows, pixels.
        width: columns, pixels.
        mm_per_pixel: pixel pitch, mm.
        dtype: dtype of the matrices.
        zero_in_background: zero where the gradient is zero, as :class:`PoissonBackground`; else zero mean, as :class:`PoissonDCT`.
    Source:
        As :func:`poisson_dct`; a test compares them.
    Example:
        >>> from torchvts import PoissonBackground
        >>> gradient = torch.randn(2, 2, 24, 32)
        >>> bool((PoissonBackgroundByMatrix(24, 32, 0.5)(gradient) - PoissonBackground(0.5)(gradient)).abs().max() < 1e-5)
        True
    """

    def __init__(
        self, height: int, width: int, mm_per_pixel: float, dtype: torch.dtype = torch.float32, zero_in_background: bool = True
    ) -> None:
        super().__init__()
        check_size(height, width, mm_per_pixel)
        check_dtype("dtype", dtype)
        check_switch("zero_in_background", zero_in_background)
        self.size = (height, width)
        self.mm_per_pixel = mm_per_pixel
        self.zero_in_background = zero_in_background
        even_y, odd_y, value_even_y, value_odd_y = cosine_bases(height)
        even_x, odd_x, value_even_x, value_odd_x = cosine_bases(width)
        for name, basis in (("even_y", even_y), ("odd_y", odd_y), ("even_x", even_x), ("odd_x", odd_x)):
            self.register_buffer(name, basis.to(dtype))
        for y, value_y in (("even", value_even_y), ("odd", value_odd_y)):
            for x, value_x in (("even", value_even_x), ("odd", value_odd_x)):
                value = value_y[:, None] + value_x[None, :]
                inverse = torch.where(value == 0.0, torch.zeros_like(value), 1.0 / value)  # zero: the mean
                self.register_buffer(f"inverse_{y}_{x}", inverse.to(dtype))

    def forward(self, gradient: Tensor) -> Tensor:
        check_batch("gradient", gradient, 2)
        check_same_size("gradient", gradient, "the matrices", self.size[0], self.size[1])
        if gradient.dtype != self.get_buffer("even_y").dtype:
            raise TypeError(f"gradient: expected {self.get_buffer('even_y').dtype} like the matrices, got {gradient.dtype}")
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
        if not self.zero_in_background:
            return depth
        background = ((gradient[:, 0:1] == 0) & (gradient[:, 1:2] == 0)).to(depth.dtype)
        count = background.sum(dim=(2, 3), keepdim=True)
        mean = (depth * background).sum(dim=(2, 3), keepdim=True) / count.clamp_min(1.0)
        return depth - torch.where(count > 0, mean, depth.amin(dim=(2, 3), keepdim=True))


class FromRaw(nn.Module):
    """Raw frames of the camera to the outputs of a pipeline."""

    def __init__(self, rectify: Rectify, pipe: DepthPipeline) -> None:
        super().__init__()
        self.rectify = rectify
        self.pipe = pipe

    def forward(self, images: Tensor) -> DepthOutput:
        return self.pipe(self.rectify(images))


class _PlainOutput(nn.Module):
    """A pipeline that returns a plain tuple: a file with a NamedTuple of torchvts would need torchvts to be read."""

    def __init__(self, pipe: nn.Module) -> None:
        super().__init__()
        self.pipe = pipe

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.pipe(images))


def size_and_dtype(pipe: DepthPipeline) -> tuple[int, int, torch.dtype]:
    """Height, width and dtype for which the pipeline was calibrated.

    Raises:
        ValueError: no block knows them.
    """
    assert isinstance(pipe.mask, nn.Module) and isinstance(pipe.compensate, nn.Module)
    for tensor in (*pipe.mask.buffers(), *pipe.compensate.buffers()):
        if tensor.dim() == 3 and tensor.shape[0] == 3 and tensor.shape[1] > 1 and tensor.is_floating_point():
            return tensor.shape[1], tensor.shape[2], tensor.dtype
    raise ValueError("pipe: expected blocks that know the size of the calibration, as from_calibration makes them, got none")


def trace(pipe: DepthPipeline, by_matrix: bool, rectify: Rectify | None = None) -> torch.export.ExportedProgram:
    """Trace a copy of a pipeline, with ``rectify`` from raw frames, for any batch; ``by_matrix``: no FFT, but matrix products."""
    height, width, dtype = size_and_dtype(pipe)
    pipe = copy.deepcopy(pipe).eval().requires_grad_(False)
    if by_matrix:
        _use_matrices(pipe, height, width, dtype)
    images = torch.full((2, 3, height, width), 0.5, dtype=dtype)
    _make_tables(pipe, images)
    whole: nn.Module = pipe
    if rectify is not None:
        whole, images = FromRaw(copy.deepcopy(rectify), pipe), torch.full((2, 3, *_raw_size(rectify)), 0.5, dtype=dtype)
    shapes = ({0: torch.export.Dim("batch", min=1, max=MAX_BATCH)},)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return torch.export.export(_PlainOutput(whole), (images,), dynamic_shapes=shapes, strict=False)


def _raw_size(rectify: Rectify) -> tuple[int, int]:
    sizes = rectify.view.raw_sizes
    if len(sizes) != 1:
        raise ValueError(
            f"rectify: expected a sensor of one raw size, got {sizes}: a graph takes frames of one size; "
            "dataclasses.replace(sensor, raw_size_px=((height, width),)) states it"
        )
    return sizes[0]


def _use_matrices(pipe: DepthPipeline, height: int, width: int, dtype: torch.dtype) -> None:
    """Replace the FFT solvers of a pipeline by matrix products."""
    solve, refine = pipe.solve, pipe.refine
    if isinstance(solve.integrate, PoissonDCT):
        zero = solve.integrate.zero_in_background
        solve.integrate = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype, zero)
    if isinstance(refine, Shadows):
        refine.residual_integrator = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype)


@torch.no_grad()
def _make_tables(pipe: DepthPipeline, images: Tensor) -> None:
    """Let each integrator make the tables of its size, which then are constants of the graph."""
    pipe(images)
    if isinstance(pipe.refine, Shadows):
        pipe.refine.residual_integrator(images[:, :2])
