"""A pipeline as one graph of PyTorch operators, by torch.export; for ONNX with the Poisson solver by matrix products."""

import copy
import warnings

import torch
from torch import Tensor, nn

from ..compensate import Rectify
from ..core.checks import check_batch, check_same_size
from ..integration import Integrator, PoissonDCT, divergence
from ..integration.poisson import zeroed_in_background
from ..integration.transforms import cosine_basis, matrices, solve_by_matrices
from ..pipeline import DepthPipeline, Shadows

MAX_BATCH = 1024
"""Largest batch that the graph formats accept."""


class PoissonBackgroundByMatrix(Integrator):
    """:class:`PoissonBackground` for one size, by matrix products alone, because ONNX has no such FFT.

    Zero where the gradient is zero, as :class:`PoissonBackground`, or of zero mean, as :class:`PoissonDCT`; a test compares them.
    """

    def __init__(
        self, height: int, width: int, mm_per_pixel: float, dtype: torch.dtype = torch.float32, zero_in_background: bool = True
    ) -> None:
        super().__init__()
        self.size = (height, width)
        self.mm_per_pixel = mm_per_pixel
        self.zero_in_background = zero_in_background
        for name, table in zip(("basis_y", "basis_x", "inverse"), matrices(cosine_basis(height), cosine_basis(width))):
            self.register_buffer(name, table.to(dtype))

    def forward(self, gradient: Tensor) -> Tensor:
        check_batch("gradient", gradient, 2)
        check_same_size("gradient", gradient, "the matrices", self.size[0], self.size[1])
        plan = [self.get_buffer(name) for name in ("basis_y", "basis_x", "inverse")]
        depth = self.mm_per_pixel * solve_by_matrices(divergence(gradient), plan)
        return zeroed_in_background(depth, gradient) if self.zero_in_background else depth


class _PlainOutput(nn.Module):
    """A pipeline that returns a plain tuple: a file with a NamedTuple of torchvts would need torchvts to be read."""

    def __init__(self, pipe: nn.Module) -> None:
        super().__init__()
        self.pipe = pipe

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.pipe(images))


def size_and_dtype(pipe: DepthPipeline) -> tuple[int, int, torch.dtype]:
    """Height, width and dtype for which the pipeline was calibrated; ValueError where no block knows them."""
    assert isinstance(pipe.mask, nn.Module) and isinstance(pipe.compensate, nn.Module)
    for tensor in (*pipe.mask.buffers(), *pipe.compensate.buffers()):
        if tensor.dim() == 3 and tensor.shape[0] == 3 and tensor.shape[1] > 1 and tensor.is_floating_point():
            return tensor.shape[1], tensor.shape[2], tensor.dtype
    raise ValueError("pipe: expected blocks that know the size of the calibration, as from_calibration makes them, got none")


def trace(pipe: DepthPipeline, by_matrix: bool, rectify: Rectify | None = None) -> torch.export.ExportedProgram:
    """Trace a copy of a pipeline, with ``rectify`` from raw frames, for any batch; ``by_matrix``: no FFT, but matrix products."""
    height, width, dtype = size_and_dtype(pipe)
    sizes = ((height, width),) if rectify is None else rectify.view.raw_sizes
    if len(sizes) != 1:
        raise ValueError(
            f"rectify: expected a sensor of one raw size, got {sizes}: a graph takes frames of one size; "
            "dataclasses.replace(sensor, raw_size_px=((height, width),)) states it"
        )
    pipe = copy.deepcopy(pipe).eval().requires_grad_(False)
    shadows = pipe.refine if isinstance(pipe.refine, Shadows) else None
    if by_matrix and isinstance(pipe.solve.integrate, PoissonDCT):
        zero = pipe.solve.integrate.zero_in_background
        pipe.solve.integrate = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype, zero)
    if by_matrix and shadows is not None:
        shadows.residual_integrator = PoissonBackgroundByMatrix(height, width, pipe.mm_per_pixel, dtype)
    whole = pipe if rectify is None else nn.Sequential(copy.deepcopy(rectify), pipe)
    images, raw = (torch.full((2, 3, *size), 0.5, dtype=dtype) for size in ((height, width), sizes[0]))
    shapes = ({0: torch.export.Dim("batch", min=1, max=MAX_BATCH)},)
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pipe(images)  # each integrator makes the tables of its size, which then are constants of the graph
        if shadows is not None:
            shadows.residual_integrator(images[:, :2])
        return torch.export.export(_PlainOutput(whole), (raw,), dynamic_shapes=shapes, strict=False)
