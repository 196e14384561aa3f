"""Python's side of the compiled kernels in csrc/: one function for each of them.

They give the results of the PyTorch blocks beside which they stand, up to rounding, in a half to a tenth of the time: a frame
passes through memory once instead of once per operator. (Where a problem is ill-posed, as with a failed LED, rounding shows: depth
differs by 0.01 to 0.04 mm between the two, and as much from float64.) They know no derivatives, no other devices and no other
types: :func:`torchvts.accelerated.gate.usable` must be asked first.
"""

import ctypes
import functools
import warnings
import zlib
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..normals.shadowed import LightView, Limits

LIBRARY = Path(__file__).parent / "csrc" / "libtorchvts.so"


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernels; None where no C compiler was at hand when this package was installed, and PyTorch does their work."""
    try:
        loaded = ctypes.CDLL(str(LIBRARY))
        built_from = int(loaded.sources())
    except (OSError, AttributeError):
        return None
    if built_from & 0xFFFFFFFF != zlib.crc32(b"".join(source.read_bytes() for source in sorted(LIBRARY.parent.glob("*.[ch]")))):
        warnings.warn(f"{LIBRARY}: built from other sources than lie beside it, so it is not used: install again", stacklevel=2)
        return None
    pointer, whole, real, step = ctypes.c_void_p, ctypes.c_int, ctypes.c_float, ctypes.c_int64
    loaded.contact_mask.argtypes = [*[pointer] * 5, *[whole] * 7, *[real] * 3, whole, real, pointer, pointer]
    loaded.normals.argtypes = [
        pointer,
        *[step] * 3,
        *[pointer] * 3,
        step,
        *[whole] * 4,
        pointer,
        *[step] * 2,
        *[pointer] * 2,
        *[real] * 4,
        pointer,
    ]
    loaded.solve_shadowed.argtypes = [
        pointer,
        *[step] * 3,
        *[pointer] * 3,
        step,
        *[whole] * 4,
        pointer,
        *[step] * 2,
        *[pointer] * 5,
    ]
    loaded.zero_background.argtypes = [pointer, pointer, *[whole] * 3, *[real] * 2, whole, pointer]
    loaded.grid_means.argtypes = [pointer, *[whole] * 7, pointer]
    loaded.slopes.argtypes = [pointer, whole, whole, real, pointer]
    loaded.divergence_lines.argtypes = [pointer, real, *[whole] * 9, pointer]
    loaded.to_columns.argtypes = [pointer, pointer, *[whole] * 4, pointer]
    loaded.divide.argtypes = [*[pointer] * 4, *[whole] * 3]
    loaded.finish_depth.argtypes = [*[pointer] * 3, *[whole] * 7, pointer]
    loaded.largest_change.argtypes = [pointer, pointer, whole, step, pointer]
    loaded.uncrop.argtypes = [pointer, *[whole] * 7, pointer, pointer]
    for name in ("grid_means", "solve_shadowed", "slopes", "to_columns", "finish_depth", "largest_change", "uncrop"):
        getattr(loaded, name).restype = None
    return loaded


class ContactGrid(NamedTuple):
    """The settings of the contact kernel: attributes of :class:`~torchvts.contact.ContactMask`."""

    step: int
    stride: int
    cell: int
    reach: int
    sigmas: float
    rounding: float
    least_cells: float
    bridge_cells: int
    bridge_sigmas: float


def _loaded() -> ctypes.CDLL:
    loaded = library()
    assert loaded is not None, "called without usable()"
    return loaded


def _check(short_of_memory: int) -> None:
    if short_of_memory:
        raise MemoryError("torchvts: no memory is left for a few rows of the image")


def _with_whole_rows(tensor: Tensor) -> Tensor:
    """The tensor with each row contiguous; frames, channels and rows may lie anywhere."""
    return tensor if tensor.stride(3) == 1 else tensor.contiguous()


def _depth_arguments(depth_mm: Tensor | None) -> tuple[int | None, int, int]:
    """Address of a depth, and the distance of its frames and rows; one frame serves all. The caller keeps the tensor alive."""
    if depth_mm is None:
        return None, 0, 0
    return depth_mm.data_ptr(), 0 if depth_mm.shape[0] == 1 else depth_mm.stride(0), depth_mm.stride(2)


def grid_means(image: Tensor, stride: int, first: int) -> Tensor:
    """Means of 3 x 3 pixels on a grid, (B, C, h, w): from (first, first) on, every ``stride`` pixels that fit whole."""
    image = image.contiguous()
    count, channels, height, width = image.shape
    rows, columns = (len(range(first, length // stride * stride, stride)) for length in (height, width))
    means = image.new_empty(count, channels, rows, columns)
    _loaded().grid_means(image.data_ptr(), count * channels, height, width, stride, first, rows, columns, means.data_ptr())
    return means


def contact_mask(
    compensated: Tensor, offset: Tensor, per_noise: Tensor, limits: tuple[Tensor, Tensor], grid: ContactGrid
) -> tuple[Tensor, Tensor]:
    """Deformed area and its interior, bool (B, 1, H, W): see :class:`~torchvts.contact.ContactMask`, whose attributes these are.

    ``limits``: ``failed_below`` and ``most_far_field``.
    """
    compensated, offset, per_noise = compensated.contiguous(), offset.contiguous(), per_noise.contiguous()
    count, _, height, width = compensated.shape
    mask = compensated.new_empty(count, 1, height, width, dtype=torch.bool)
    interior = torch.empty_like(mask)
    inputs = (compensated.data_ptr(), offset.data_ptr(), per_noise.data_ptr(), limits[0].data_ptr(), limits[1].data_ptr())
    _check(_loaded().contact_mask(*inputs, count, height, width, *grid, mask.data_ptr(), interior.data_ptr()))
    return mask, interior


def normals(compensated: Tensor, limits: Limits, inverse: Tensor, depth_mm: Tensor | None, view: LightView) -> tuple[Tensor, bool]:
    """Unit normals (B, 3, h, w) of a window, and whether every channel of it is valid.

    By the stored inverse (3, 3, H, W), or with a depth by the lights; see :class:`~torchvts.normals.NormalFromIntensity`. Limits
    and inverse are those of the whole image, and the position of the lights is as seen from its middle.
    """
    dark, saturated, inverse = limits.dark_below.contiguous(), limits.saturated_above.contiguous(), inverse.contiguous()
    compensated = _with_whole_rows(compensated)
    position_mm, albedo = view.position_mm.contiguous(), view.albedo.contiguous()
    count, _, rows, columns = compensated.shape
    height, width = inverse.shape[2], inverse.shape[3]
    at = 4 * (view.window[0] * width + view.window[1])
    normal = compensated.new_empty(count, 3, rows, columns)
    depth_mm = None if depth_mm is None else _with_whole_rows(depth_mm)
    invalid = _loaded().normals(
        compensated.data_ptr(),
        *compensated.stride()[:3],
        dark.data_ptr() + at,
        saturated.data_ptr() + at,
        inverse.data_ptr() + at,
        height * width,
        width,
        count,
        rows,
        columns,
        *_depth_arguments(depth_mm),
        position_mm.data_ptr(),
        albedo.data_ptr(),
        view.mm_per_pixel,
        1.0 / view.camera_height_mm,
        *view.axis_mm,
        normal.data_ptr(),
    )
    return normal, not invalid


def solve_shadowed(
    normal: Tensor,
    compensated: Tensor,
    limits: Limits,
    depth_mm: Tensor | None,
    expected: Tensor | None,
    view: LightView,
    constants: list[float],
) -> None:
    """Replace normals, in place, where a light is blocked, a channel is saturated, or the matrix is ill-conditioned.

    See :class:`~torchvts.normals.shadowed.ShadowedPixels`. The position of the lights is as seen from the window's middle.
    ``constants``: noise, weight of the prior, weight of the brightness, steps; then behind pitch, camera and axis, which are taken
    from ``view``, the largest difference of slopes beside a cliff and the largest slope.
    """
    dark, saturated, ill = (table.contiguous() for table in limits)
    compensated = _with_whole_rows(compensated)
    position_mm, albedo = view.position_mm.contiguous(), view.albedo.contiguous()
    camera = [view.mm_per_pixel, 1.0 / view.camera_height_mm, *view.axis_mm]
    model = albedo.new_tensor([*constants[:4], *camera, *constants[4:]])
    count, _, rows, columns = compensated.shape
    height, width = dark.shape[1], dark.shape[2]
    place = view.window[0] * width + view.window[1]
    depth_mm = None if depth_mm is None else _with_whole_rows(depth_mm)
    expected = None if expected is None else expected.contiguous()
    _loaded().solve_shadowed(
        compensated.data_ptr(),
        *compensated.stride()[:3],
        dark.data_ptr() + 4 * place,
        saturated.data_ptr() + 4 * place,
        ill.data_ptr() + place,
        height * width,
        width,
        count,
        rows,
        columns,
        *_depth_arguments(depth_mm),
        None if expected is None else expected.data_ptr(),
        position_mm.data_ptr(),
        albedo.data_ptr(),
        model.data_ptr(),
        normal.data_ptr(),
    )


def slopes(normal: Tensor, max_slope: float) -> Tensor:
    """Gradients (B, 2, H, W): see :func:`~torchvts.core.geometry.gradient_from_normal`."""
    normal = normal.contiguous()
    count, _, height, width = normal.shape
    gradient = normal.new_empty(count, 2, height, width)
    _loaded().slopes(normal.data_ptr(), count, height * width, 1.0 / max_slope, gradient.data_ptr())
    return gradient


def solve_poisson(gradient: Tensor, mm_per_pixel: float, plan: list[Tensor], window: tuple[int, int], zeroed: bool) -> Tensor:
    """Depth (B, 1, H, W) of a window's gradient, by the seven tables of a plan for the FFT.

    See :mod:`torchvts.integration.poisson`. ``zeroed``: zero on average where the gradient is zero, not over all of the image.
    """
    gradient = gradient.contiguous()
    turns, of_sum, of_difference, order = plan[0], plan[2], plan[3], plan[5]
    height, width = int(plan[5].shape[0]), int(plan[6].shape[0])
    count, _, rows, columns = gradient.shape
    part = (rows, columns, *window)
    first, last = max(0, window[0] - 1), min(height, window[0] + rows + 1)
    loaded = _loaded()
    lines = gradient.new_empty(count, last - first, width)
    _check(
        loaded.divergence_lines(
            gradient.data_ptr(), mm_per_pixel, count, *part, height, width, first, last - first, lines.data_ptr()
        )
    )
    spectrum = torch.fft.rfft(lines).contiguous()
    turned = spectrum.new_empty(count, spectrum.shape[2], height)
    places = order.data_ptr() + first * order.element_size()
    loaded.to_columns(spectrum.data_ptr(), places, count, last - first, spectrum.shape[2], height, turned.data_ptr())
    spectrum = torch.fft.fft(turned).contiguous()
    tables = (turns.data_ptr(), of_sum.data_ptr(), of_difference.data_ptr())
    _check(loaded.divide(spectrum.data_ptr(), *tables, count, spectrum.shape[1], height))
    lines = torch.fft.irfft(torch.fft.ifft(spectrum), n=width, dim=1).transpose(1, 2).contiguous()
    depth = gradient.new_empty(count, 1, height, width)
    zeroed_by = gradient.data_ptr() if zeroed else None
    loaded.finish_depth(lines.data_ptr(), order.data_ptr(), zeroed_by, count, *part, height, width, depth.data_ptr())
    return depth


def largest_change(one: Tensor, other: Tensor) -> Tensor:
    """Largest difference of two batches of depths, per frame, (B,)."""
    one, other = one.contiguous(), other.contiguous()
    change = one.new_empty(one.shape[0])
    _loaded().largest_change(one.data_ptr(), other.data_ptr(), one.shape[0], one[0].numel(), change.data_ptr())
    return change


def uncrop(gradient: Tensor, window: tuple[int, int], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The gradient of a window embedded in the whole image (B, 2, H, W), zero elsewhere, and its normals (B, 3, H, W)."""
    gradient = gradient.contiguous()
    count, _, rows, columns = gradient.shape
    whole, normal = gradient.new_empty(count, 2, *size), gradient.new_empty(count, 3, *size)
    _loaded().uncrop(gradient.data_ptr(), count, rows, columns, *window, *size, whole.data_ptr(), normal.data_ptr())
    return whole, normal


def zero_background(depth_mm: Tensor, deformed: Tensor, stiff: float, tolerance: float, sweeps: int) -> Tensor:
    """:class:`torchvts.integration.background.ZeroBackground` of depth (B, 1, H, W) and deformed skin, bool (B, 1, H, W)."""
    depth_mm, deformed = depth_mm.contiguous(), deformed.contiguous()
    count, _, height, width = depth_mm.shape
    out = torch.empty_like(depth_mm)
    numbers = (count, height, width, stiff, tolerance, sweeps)
    if _loaded().zero_background(depth_mm.data_ptr(), deformed.data_ptr(), *numbers, out.data_ptr()):
        raise MemoryError(f"depth_mm: no memory for grids of {height} x {width} pixels")
    return out
