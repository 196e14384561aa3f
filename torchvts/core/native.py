"""Python's side of the compiled loops in torchvts/native: one function for each of theirs, and whether they may be used.

They give the numbers of the tensor operators beside which they stand, but for rounding, in a half to a tenth of the time: a frame
passes through memory once instead of once per operator. (Where a problem is ill posed, as with a dead lamp, rounding shows: depth
by either differs by 0.01 to 0.04 mm, and as much from float64's.) They know neither gradients nor other devices nor other types.
"""

import contextlib
import contextvars
import ctypes
import functools
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad

LIBRARY = Path(__file__).parents[1] / "native" / "libtorchvts.so"


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled loops; None where no C compiler was at hand when this package was installed, and operators do their work."""
    try:
        loaded = ctypes.CDLL(str(LIBRARY))
        built_from = int(loaded.sources())
    except (OSError, AttributeError):
        return None
    if built_from & 0xFFFFFFFF != zlib.crc32(b"".join(source.read_bytes() for source in sorted(LIBRARY.parent.glob("*.[ch]")))):
        warnings.warn(f"{LIBRARY}: built from other sources than lie beside it, so it is not used: install again", stacklevel=2)
        return None
    pointer, whole, real, step = ctypes.c_void_p, ctypes.c_int, ctypes.c_float, ctypes.c_int64
    loaded.contact_mask.argtypes = [*[pointer] * 4, *[whole] * 7, *[real] * 3, pointer, pointer]
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
    loaded.relight.argtypes = [
        pointer,
        *[step] * 3,
        *[pointer] * 3,
        step,
        *[whole] * 4,
        pointer,
        *[step] * 2,
        *[pointer] * 5,
    ]
    loaded.some_means.argtypes = [pointer, *[whole] * 7, pointer]
    loaded.slopes.argtypes = [pointer, whole, whole, real, pointer]
    loaded.divergence_lines.argtypes = [pointer, real, *[whole] * 9, pointer]
    loaded.to_columns.argtypes = [pointer, pointer, *[whole] * 4, pointer]
    loaded.divide.argtypes = [*[pointer] * 4, *[whole] * 3]
    loaded.settle.argtypes = [*[pointer] * 3, *[whole] * 7, pointer]
    loaded.largest_change.argtypes = [pointer, pointer, whole, step, pointer]
    loaded.widen.argtypes = [pointer, *[whole] * 7, pointer, pointer]
    for name in ("some_means", "relight", "slopes", "to_columns", "settle", "largest_change", "widen"):
        getattr(loaded, name).restype = None
    return loaded


_refused = contextvars.ContextVar("refused", default=False)


@contextlib.contextmanager
def reference_only() -> Iterator[None]:
    """Within it, tensor operators do all the work, as they do in exported programs, while gradients are recorded, and on a GPU.

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


def may_use_native(tensors: list[Tensor]) -> bool:
    """Whether compiled loops may work on these: float32, on a CPU, run by Python, no gradient recorded. Scripts."""
    if torch.jit.is_scripting():
        return False
    else:  # noqa: RET505, TorchScript leaves out the other branch only so
        if torch.compiler.is_compiling() or torch.jit.is_tracing() or _refused.get() or library() is None:
            return False
        if forward_ad._current_level >= 0 or torch._C._len_torch_dispatch_stack() > 0:  # tangents and traces would be lost
            return False
        recorded = torch.is_grad_enabled()
        return all(
            type(tensor) in (Tensor, nn.Parameter)
            and tensor.dtype == torch.float32
            and tensor.device.type == "cpu"
            and not (recorded and tensor.requires_grad)
            and not torch._C._functorch.is_functorch_wrapped_tensor(tensor)
            for tensor in tensors
        )


def _loops() -> ctypes.CDLL:
    loaded = library()
    assert loaded is not None, "asked without may_use_native"
    return loaded


def _check(short_of_memory: int) -> None:
    if short_of_memory:
        raise MemoryError("torchvts: no memory is left for a few rows of the image")


def _of_whole_rows(tensor: Tensor) -> Tensor:
    """The tensor, its rows in one piece; frames, channels and rows may lie anywhere."""
    return tensor if tensor.stride(3) == 1 else tensor.contiguous()


def _depth_arguments(depth_mm: Tensor | None) -> tuple[int | None, int, int]:
    """Where a depth begins, and how far its frames and rows are apart; one frame serves all. The caller keeps the tensor."""
    if depth_mm is None:
        return None, 0, 0
    return depth_mm.data_ptr(), 0 if depth_mm.shape[0] == 1 else depth_mm.stride(0), depth_mm.stride(2)


def some_means(image: Tensor, stride: int, first: int) -> Tensor:
    """Means of 3 x 3 pixels on a grid, (B, C, h, w): from (first, first) on every ``stride`` that is whole."""
    image = image.contiguous()
    count, channels, height, width = image.shape
    rows, columns = (len(range(first, length // stride * stride, stride)) for length in (height, width))
    means = image.new_empty(count, channels, rows, columns)
    _loops().some_means(image.data_ptr(), count * channels, height, width, stride, first, rows, columns, means.data_ptr())
    return means


def contact_mask(
    compensated: Tensor,
    rest: Tensor,
    per_noise: Tensor,
    dead_below: Tensor,
    step: int,
    stride: int,
    cell: int,
    reach: int,
    sigmas: float,
    rounding: float,
    least_cells: float,
) -> tuple[Tensor, Tensor]:
    """Hard and inner contact, bool (B, 1, H, W): see :class:`~torchvts.contact.masks.ContactMask`, whose attributes these are."""
    compensated, rest, per_noise = compensated.contiguous(), rest.contiguous(), per_noise.contiguous()
    count, _, height, width = compensated.shape
    mask = compensated.new_empty(count, 1, height, width, dtype=torch.bool)
    inner = torch.empty_like(mask)
    inputs = (compensated.data_ptr(), rest.data_ptr(), per_noise.data_ptr(), dead_below.data_ptr())
    grid = (count, height, width, step, stride, cell, reach, sigmas, rounding, least_cells)
    _check(_loops().contact_mask(*inputs, *grid, mask.data_ptr(), inner.data_ptr()))
    return mask, inner


def normals(
    compensated: Tensor,
    dark: Tensor,
    full: Tensor,
    inverse: Tensor,
    window: tuple[int, int],
    depth_mm: Tensor | None,
    position_mm: Tensor,
    albedo: Tensor,
    mm_per_pixel: float,
    camera_height_mm: float,
    axis_mm: tuple[float, float],
) -> tuple[Tensor, bool]:
    """Unit normals (B, 3, h, w) of a window, and whether no light is blocked there and no channel full.

    See :class:`~torchvts.normals.NormalFromIntensity`: by the stored inverse, or at a depth by the lights. ``axis_mm`` is where the
    middle of the image lies as seen from that of the window. ``dark``, ``full`` (3, H, W) and ``inverse`` (3, 3, H, W) are those
    of the whole image.
    """
    dark, full, inverse = dark.contiguous(), full.contiguous(), inverse.contiguous()
    compensated = _of_whole_rows(compensated)
    position_mm, albedo = position_mm.contiguous(), albedo.contiguous()
    count, _, rows, columns = compensated.shape
    height, width = inverse.shape[2], inverse.shape[3]
    at = 4 * (window[0] * width + window[1])
    normal = compensated.new_empty(count, 3, rows, columns)
    depth_mm = None if depth_mm is None else _of_whole_rows(depth_mm)
    unsound = _loops().normals(
        compensated.data_ptr(),
        *compensated.stride()[:3],
        dark.data_ptr() + at,
        full.data_ptr() + at,
        inverse.data_ptr() + at,
        height * width,
        width,
        count,
        rows,
        columns,
        *_depth_arguments(depth_mm),
        position_mm.data_ptr(),
        albedo.data_ptr(),
        mm_per_pixel,
        1.0 / camera_height_mm,
        *axis_mm,
        normal.data_ptr(),
    )
    return normal, not unsound


def relight(
    normal: Tensor,
    compensated: Tensor,
    dark: Tensor,
    full: Tensor,
    weak: Tensor,
    window: tuple[int, int],
    depth_mm: Tensor | None,
    expected: Tensor | None,
    position_mm: Tensor,
    albedo: Tensor,
    numbers: list[float],
) -> None:
    """Replaces normals, in place, where a light is blocked, a channel full or ``weak`` (H, W) true.

    See :class:`~torchvts.normals.NormalFromIntensity`. ``position_mm`` is as seen from the window's middle. ``numbers``: noise,
    weight of the prior, how much more brightness counts than noise, steps, pixel pitch, 1 / camera height, axis, cliff and largest
    slope.
    """
    dark, full, weak = dark.contiguous(), full.contiguous(), weak.contiguous()
    compensated = _of_whole_rows(compensated)
    position_mm, albedo, model = position_mm.contiguous(), albedo.contiguous(), albedo.new_tensor(numbers)
    count, _, rows, columns = compensated.shape
    height, width = dark.shape[1], dark.shape[2]
    place = window[0] * width + window[1]
    depth_mm = None if depth_mm is None else _of_whole_rows(depth_mm)
    expected = None if expected is None else expected.contiguous()
    _loops().relight(
        compensated.data_ptr(),
        *compensated.stride()[:3],
        dark.data_ptr() + 4 * place,
        full.data_ptr() + 4 * place,
        weak.data_ptr() + place,
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
    _loops().slopes(normal.data_ptr(), count, height * width, 1.0 / max_slope, gradient.data_ptr())
    return gradient


def solve_poisson(gradient: Tensor, mm_per_pixel: float, plan: list[Tensor], window: tuple[int, int], levelled: bool) -> Tensor:
    """Depth (B, 1, H, W) of a window's gradient, by the seven tables of a plan for the FFT.

    See :mod:`torchvts.integration.poisson`. ``levelled``: zero on average where the gradient is zero, not over all of the image.
    """
    gradient = gradient.contiguous()
    turns, of_sum, of_difference, order = plan[0], plan[2], plan[3], plan[5]
    height, width = int(plan[5].shape[0]), int(plan[6].shape[0])
    count, _, rows, columns = gradient.shape
    part = (rows, columns, *window)
    first, last = max(0, window[0] - 1), min(height, window[0] + rows + 1)
    loops = _loops()
    lines = gradient.new_empty(count, last - first, width)
    _check(
        loops.divergence_lines(
            gradient.data_ptr(), mm_per_pixel, count, *part, height, width, first, last - first, lines.data_ptr()
        )
    )
    spectrum = torch.fft.rfft(lines).contiguous()
    turned = spectrum.new_empty(count, spectrum.shape[2], height)
    places = order.data_ptr() + first * order.element_size()
    loops.to_columns(spectrum.data_ptr(), places, count, last - first, spectrum.shape[2], height, turned.data_ptr())
    spectrum = torch.fft.fft(turned).contiguous()
    tables = (turns.data_ptr(), of_sum.data_ptr(), of_difference.data_ptr())
    _check(loops.divide(spectrum.data_ptr(), *tables, count, spectrum.shape[1], height))
    lines = torch.fft.irfft(torch.fft.ifft(spectrum), n=width, dim=1).transpose(1, 2).contiguous()
    depth = gradient.new_empty(count, 1, height, width)
    slopes = gradient.data_ptr() if levelled else None
    loops.settle(lines.data_ptr(), order.data_ptr(), slopes, count, *part, height, width, depth.data_ptr())
    return depth


def largest_change(one: Tensor, other: Tensor) -> Tensor:
    """Largest difference of two batches of depths, per frame, (B,)."""
    one, other = one.contiguous(), other.contiguous()
    change = one.new_empty(one.shape[0])
    _loops().largest_change(one.data_ptr(), other.data_ptr(), one.shape[0], one[0].numel(), change.data_ptr())
    return change


def widen(gradient: Tensor, window: tuple[int, int], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """A window's gradient in the whole image (B, 2, H, W), zero elsewhere, and the normals (B, 3, H, W)."""
    gradient = gradient.contiguous()
    count, _, rows, columns = gradient.shape
    whole, normal = gradient.new_empty(count, 2, *size), gradient.new_empty(count, 3, *size)
    _loops().widen(gradient.data_ptr(), count, rows, columns, *window, *size, whole.data_ptr(), normal.data_ptr())
    return whole, normal
