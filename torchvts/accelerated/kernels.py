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
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from ..core import smooth
from ..core.robust import HALVINGS
from ..normals.shadowed import LightView, Limits
from .threads import by_frames

LIBRARY = Path(__file__).parent / "csrc" / "libtorchvts.so"

NO_PEDESTAL = (ctypes.c_float * 3)()


SIGNATURES = {
    "contact_mask": ("i", "pppppp iiiiiii fff i ffff pp ppp"),
    "normals": ("i", "p lll pppp l iiii p ll pp ffff p"),
    "solve_shadowed": ("v", "p lll pppp l iiii p ll pppppp"),
    "frame_noise": ("i", "p iiii p"),
    "zero_background": ("i", "pp iii ff i p"),
    "contact_from_depth": ("i", "p ll pp ll iiiii pp"),
    "clean": ("i", "pppppp l p iiii ppp"),
    "levels": ("i", "p iiiii ff p"),
    "smooth_change": ("i", "pp i p"),
    "over_smooth": ("v", "ppp i p"),
    "box_of": ("v", "p iii p"),
    "divide_planes": ("v", "pp i l p"),
    "over_tilted": ("v", "pppp ii p"),
    "response_normals": ("v", "p lll pp ii p ll p fff iii p"),
    "mask_values": ("v", "pp ll iiii p"),
    "depth_slopes": ("v", "p ll p ll f iii p"),
    "grid_means": ("v", "p iiiiiii p"),
    "slopes": ("v", "p ii f p"),
    "begin_frame": ("v", "pp i"),
    "forget_frame": ("v", ""),
    "exchange_ns": ("d", ""),
    "solve_frames": ("i", "pp ii ppppp"),
    "poisson_plan_size": ("l", "i"),
    "make_poisson_plan": ("v", "ii p"),
    "solve_poisson": ("i", "pp f iiiiiiii p"),
    "largest_change": ("v", "pp i l p"),
    "uncrop": ("v", "pp iiiiiii ppp"),
    "alignment_sums": ("v", "p ii p l ii pp"),
    "part_sums": ("v", "p ii p l ii pp"),
    "refine_pose": ("v", "p ii p l ii pp i pp"),
    "height_sums": ("i", "p ii p l i p pppp ii dd p"),
    "track_grids": ("i", "ppp ii f ii pp"),
    "contact_pixels": ("i", "ppp l"),
    "object_pixels": ("i", "p ii ddd l p"),
    "follow_frame": ("i", "pppp i pp"),
}
"""What each kernel returns and takes, a letter each: a pointer, int, float, double, int64 (l), or nothing (v)."""

_TYPES: dict[str, Any] = {
    "p": ctypes.c_void_p,
    "i": ctypes.c_int,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "l": ctypes.c_int64,
    "v": None,
}


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
    for name, (result, arguments) in SIGNATURES.items():
        kernel = getattr(loaded, name)
        kernel.restype, kernel.argtypes = _TYPES[result], [_TYPES[letter] for letter in arguments.replace(" ", "")]
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
    tail_sigmas: float
    least_spread: float
    least_colour: float


def loaded() -> ctypes.CDLL:
    """The compiled kernels, after :func:`~torchvts.accelerated.gate.usable` said that they may work."""
    loaded = library()
    assert loaded is not None, "called without usable()"
    return loaded


class NotFinite(ArithmeticError):
    """A value is NaN or infinite; the PyTorch reference says what then happens."""


def _check(code: int) -> None:
    if code == 2:
        raise NotFinite
    if code:
        raise MemoryError("torchvts: no memory is left for a few rows of the image")


def _at(tensor: Tensor | None, frame: int) -> int | None:
    """Address of a frame of a batch; of the only one, where one serves all."""
    if tensor is None:
        return None
    return tensor.data_ptr() + (0 if tensor.shape[0] == 1 else frame * tensor.stride(0) * tensor.element_size())


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
    loaded().grid_means(image.data_ptr(), count * channels, height, width, stride, first, rows, columns, means.data_ptr())
    return means


def clean(
    light: Tensor,
    gain: Tensor | None,
    offset: "Tensor | ctypes.Array[ctypes.c_float]",
    defects: tuple[Tensor, Tensor],
    weights: "ctypes.Array[ctypes.c_float]",
) -> Tensor:
    """light * gain + offset, (B, 3, H, W), its defects filled, blurred by an odd number of weights: see
    :class:`~torchvts.compensate.Compensate`.

    ``offset``: of every pixel, (3, H, W); or three pedestals, and the offset is pedestal * gain. ``defects``: their indices (N,)
    and those of their neighbours (N, 4).
    """
    light = light.contiguous()
    count, _, height, width = light.shape
    gain = None if gain is None else gain.contiguous()
    by_pixel = offset.contiguous() if isinstance(offset, Tensor) else None
    out = torch.empty_like(light)
    maps = (None if gain is None else gain.data_ptr(), None if by_pixel is None else by_pixel.data_ptr())
    pedestal = NO_PEDESTAL if isinstance(offset, Tensor) else offset
    filled = (*[index.data_ptr() for index in defects], defects[0].shape[0])
    kernel = loaded().clean
    no_levels = (None, None)

    def some(first: int, many: int) -> int:
        at, to = _at(light, first), _at(out, first)
        code = int(kernel(at, *maps, pedestal, *filled, weights, len(weights), many, height, width, to, *no_levels))
        return 1 & code  # values outside of [0, 1] may be here

    _check(by_frames(count, height * width, some))
    return out


def levels(image: Tensor, stride: int, least: float, most: float, halvings: int = HALVINGS) -> Tensor:
    """Brightness of each channel, (B, 3, 1, 1): see :meth:`~torchvts.compensate.Drift.by_mode`."""
    image = image.contiguous()
    count, _, height, width = image.shape
    found = image.new_empty(count, 3, 1, 1)
    size, limits, kernel = (height, width, stride, halvings), (least, most), loaded().levels
    _check(by_frames(count, height * width, lambda first, many: kernel(_at(image, first), many, *size, *limits, _at(found, first))))
    return found


class SmoothLight(ctypes.Structure):
    """``SmoothLight`` of csrc/kernels.h."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("height", "width", "stride", "rows", "columns", "samples", "steps")),
        ("most", ctypes.c_double),
        *((name, ctypes.c_void_p) for name in ("place", "along_x", "along_y", "per_square", "peaks")),
    )


class SmoothTables(NamedTuple):
    """How a smooth change of light is found in images of a size.

    Attributes:
        structure: what the kernels take.
        memory: what it points to.
    """

    structure: SmoothLight
    memory: tuple[Tensor, ...]


@functools.lru_cache(maxsize=8)
def smooth_tables(height: int, width: int) -> SmoothTables | None:
    """The tables of a size; None where none is looked for."""
    if min(height, width) < smooth.SAMPLES:
        return None
    with torch.inference_mode(False):
        stride = smooth.smooth_stride(height, width)
        place = smooth.smooth_basis(height, width, stride)
        rows, columns = place.shape[1], place.shape[2]
        place = torch.nn.functional.pad(place.flatten(1), [0, -rows * columns % 16]).contiguous()
        along_x, along_y = (smooth.legendre(length, 1)[1:].float().contiguous() for length in (width, height))
        scales = torch.tensor([smooth.per_square(step) for step in range(smooth.STEPS)], dtype=torch.float64)
        memory = (place, along_x, along_y, scales, smooth.peaks())
    pointers = (tensor.data_ptr() for tensor in memory)
    return SmoothTables(
        SmoothLight(height, width, stride, rows, columns, place.shape[1], smooth.STEPS, smooth.MOST, *pointers), memory
    )


def without_smooth_change(ratio: Tensor) -> Tensor:
    """Images / background (B, 3, H, W) without their smooth change of light: see :class:`~torchvts.compensate.SmoothDrift`."""
    tables = smooth_tables(ratio.shape[2], ratio.shape[3])
    if tables is None:
        return ratio
    ratio = ratio.contiguous()
    count, _, height, width = ratio.shape
    of, found, result = ctypes.byref(tables.structure), ratio.new_empty(count, 3, 6), torch.empty_like(ratio)
    change, over = loaded().smooth_change, loaded().over_smooth

    def some(first: int, many: int) -> int:
        code = int(change(of, _at(ratio, first), many, _at(found, first)))
        over(of, _at(ratio, first), _at(found, first), many, _at(result, first))
        return code

    _check(by_frames(count, height * width, some))
    return result


def box_of(mask: Tensor) -> tuple[int, int, int, int]:
    """(top, bottom, left, right) of the smallest box that holds all of a bool (B, 1, H, W); zeros without any."""
    mask = mask.contiguous()
    box = (ctypes.c_int * 4)()
    loaded().box_of(mask.data_ptr(), mask.shape[0], mask.shape[2], mask.shape[3], box)
    return box[0], box[1], box[2], box[3]


def divided(image: Tensor, level: Tensor) -> Tensor:
    """Images (B, C, H, W) over levels (B, C, 1, 1)."""
    image, level = image.contiguous(), level.contiguous()
    level, out = level.expand(image.shape[0], -1, -1, -1).contiguous(), torch.empty_like(image)
    count, planes, pixels, kernel = image.shape[0], image.shape[1], image.shape[2] * image.shape[3], loaded().divide_planes
    by_frames(
        count,
        pixels,
        lambda first, many: kernel(_at(image, first), _at(level, first), many * planes, pixels, _at(out, first)),
    )
    return out


def contact_mask(
    compensated: Tensor,
    image: Tensor,
    offset: Tensor | None,
    per_noise: Tensor,
    limits: tuple[Tensor, Tensor],
    grid: ContactGrid,
) -> tuple[Tensor, Tensor, Tensor]:
    """Deformed area, interior and tail, bool (B, 1, H, W): see :class:`~torchvts.contact.ContactMask`, whose attributes these are.

    ``image``: where pixels stand out; ``compensated``: what the noise is of. ``offset``: None where it is ``-per_noise``, as the
    undeformed skin is 1. ``limits``: ``failed_below`` and ``most_far_field``.
    """
    compensated, image, per_noise = compensated.contiguous(), image.contiguous(), per_noise.contiguous()
    offset = None if offset is None else offset.contiguous()
    offsets = None if offset is None else offset.data_ptr()
    count, _, height, width = compensated.shape
    mask = compensated.new_empty(count, 1, height, width, dtype=torch.bool)
    interior, tail = torch.empty_like(mask), torch.empty_like(mask)
    fields = (offsets, per_noise.data_ptr(), limits[0].data_ptr(), limits[1].data_ptr())
    kernel = loaded().contact_mask
    _check(
        by_frames(
            count,
            height * width,
            lambda first, many: kernel(
                *(_at(compensated, first), _at(image, first), *fields, many, height, width, *grid),
                *(None, None, _at(mask, first), _at(interior, first), _at(tail, first)),
            ),
        )
    )
    return mask, interior, tail


def frame_noise(image: Tensor, stride: int) -> Tensor:
    """Noise of each channel, (B, 3): see :func:`~torchvts.core.noise.noise_of_spotted`, whose stride this is."""
    image = image.contiguous()
    count, _, height, width = image.shape
    noise, kernel = image.new_empty(count, 3), loaded().frame_noise
    _check(
        by_frames(
            count, height * width, lambda first, many: kernel(_at(image, first), many, height, width, stride, _at(noise, first))
        )
    )
    return noise


def contact_from_depth(
    depth_mm: Tensor, gradient: Tensor, deformed: Tensor, cells: tuple[int, int], model: "ctypes.Array[ctypes.c_float]"
) -> Tensor:
    """Contact, bool (B, 1, h, w), of a window: see :class:`~torchvts.contact.ContactFromDepth`.

    ``cells``: side and reach; ``model``: its settings in the order of ``Model`` in touching.c.
    """
    depth_mm, deformed, gradient = _with_whole_rows(depth_mm), _with_whole_rows(deformed), gradient.contiguous()
    count, _, rows, columns = depth_mm.shape
    contact = depth_mm.new_empty(count, 1, rows, columns, dtype=torch.bool)
    strides = (depth_mm.stride(0), depth_mm.stride(2)), (deformed.stride(0), deformed.stride(2))
    kernel = loaded().contact_from_depth
    _check(
        by_frames(
            count,
            rows * columns,
            lambda first, many: kernel(
                *(_at(depth_mm, first), *strides[0], _at(gradient, first), _at(deformed, first), *strides[1]),
                *(many, rows, columns, *cells, model, _at(contact, first)),
            ),
        )
    )
    return contact


class ResponseLines(NamedTuple):
    """A response field whose coefficients are polynomials along each row of the image.

    Attributes:
        place: (W,), of each column, from -1 to 1.
        weight: (H, degree + 1, 2, terms), the lowest power first; degree 2, 4 or 6.
        per_mm: (H, 3, 3), what depth does to R, G and B, degree 2; None if that is not known.
    """

    place: Tensor
    weight: Tensor
    per_mm: Tensor | None


def response_normals(
    compensated: Tensor,
    depth_mm: Tensor | None,
    lines: ResponseLines,
    window: tuple[int, int],
    settings: tuple[float, float, float],
) -> Tensor:
    """Unit normals (B, 3, h, w) of a window: see :class:`~torchvts.normals.NormalFromResponse`.

    Its steeper, reference_mm and max_sine are the settings.
    """
    compensated = _with_whole_rows(compensated)
    depth_mm = None if depth_mm is None else _with_whole_rows(depth_mm)
    (top, left), (count, _, rows, columns) = window, compensated.shape
    weight, per_mm = lines.weight, None if depth_mm is None else lines.per_mm
    normal = compensated.new_empty(count, 3, rows, columns)
    field = (
        lines.place.data_ptr() + 4 * left,
        weight.data_ptr() + 4 * top * weight.stride(0),
        weight.shape[1] - 1,
        weight.shape[3],
    )
    by_depth = (None if per_mm is None else per_mm.data_ptr() + 36 * top, *settings)
    steps = (0, 0) if depth_mm is None else (0 if depth_mm.shape[0] == 1 else depth_mm.stride(0), depth_mm.stride(2))
    kernel, strides = loaded().response_normals, compensated.stride()[:3]
    by_frames(
        count,
        rows * columns,
        lambda first, many: kernel(
            *(_at(compensated, first), *strides, *field, _at(depth_mm, first), *steps, *by_depth),
            *(many, rows, columns, _at(normal, first)),
        ),
    )
    return normal


def masked(gradient: Tensor, mask: Tensor) -> Tensor:
    """A gradient (B, 2, h, w), zero outside of a mask, bool (B, 1, h, w)."""
    gradient, mask = gradient.contiguous(), _with_whole_rows(mask)
    out = torch.empty_like(gradient)
    loaded().mask_values(gradient.data_ptr(), mask.data_ptr(), mask.stride(0), mask.stride(2), *gradient.shape, out.data_ptr())
    return out


def depth_slopes(depth_mm: Tensor, mask: Tensor, mm_per_pixel: float) -> Tensor:
    """The gradient of depth (B, 1, h, w), (B, 2, h, w), zero outside of a mask, bool (B, 1, h, w)."""
    depth_mm, mask = _with_whole_rows(depth_mm), _with_whole_rows(mask)
    count, _, rows, columns = depth_mm.shape
    gradient = depth_mm.new_empty(count, 2, rows, columns)
    strides = (depth_mm.stride(0), depth_mm.stride(2)), (mask.stride(0), mask.stride(2))
    settings, kernel = (0.5 / mm_per_pixel,), loaded().depth_slopes
    by_frames(
        count,
        rows * columns,
        lambda first, many: kernel(
            *(_at(depth_mm, first), *strides[0], _at(mask, first), *strides[1], *settings),
            *(many, rows, columns, _at(gradient, first)),
        ),
    )
    return gradient


def normals(
    compensated: Tensor, limits: Limits, noise_std: Tensor, inverse: Tensor, depth_mm: Tensor | None, view: LightView
) -> tuple[Tensor, bool]:
    """Unit normals (B, 3, h, w) of a window, and whether every channel of it is valid.

    By the stored inverse (3, 3, H, W), or with a depth by the lights; see :class:`~torchvts.normals.NormalFromIntensity`. Limits
    and inverse are those of the whole image, and the position of the lights is as seen from its middle. ``noise_std``: (B, 3).
    """
    flat, saturated, inverse = limits.flat.contiguous(), limits.saturated_above.contiguous(), inverse.contiguous()
    three_noises = (3.0 * noise_std).contiguous()
    compensated = _with_whole_rows(compensated)
    position_mm, albedo = view.position_mm.contiguous(), view.albedo.contiguous()
    count, _, rows, columns = compensated.shape
    height, width = inverse.shape[2], inverse.shape[3]
    at = 4 * (view.window[0] * width + view.window[1])
    normal = compensated.new_empty(count, 3, rows, columns)
    depth_mm = None if depth_mm is None else _with_whole_rows(depth_mm)
    fields = (flat.data_ptr() + at, saturated.data_ptr() + at, inverse.data_ptr() + at, height * width, width)
    lights = (position_mm.data_ptr(), albedo.data_ptr(), view.mm_per_pixel, 1.0 / view.camera_height_mm, *view.axis_mm)
    kernel, strides, steps = loaded().normals, compensated.stride()[:3], _depth_arguments(depth_mm)[1:]
    invalid = by_frames(
        count,
        rows * columns,
        lambda first, many: kernel(
            *(_at(compensated, first), *strides, three_noises[first:].data_ptr(), *fields, many, rows, columns),
            *(_at(depth_mm, first), *steps, *lights, _at(normal, first)),
        ),
    )
    return normal, not invalid


def solve_shadowed(
    normal: Tensor,
    compensated: Tensor,
    limits: Limits,
    noises: tuple[Tensor, Tensor],
    depth_mm: Tensor | None,
    expected: Tensor | None,
    view: LightView,
    constants: list[float],
) -> None:
    """Replace normals, in place, where a light is blocked, a channel is saturated, or the matrix is ill-conditioned.

    See :class:`~torchvts.normals.shadowed.ShadowedPixels`. The position of the lights is as seen from the window's middle.
    ``noises``: of the channels of each frame, (B, 3), and of each frame the noise, the weight of the prior and that of the
    brightness, (B, 3). ``constants``: steps; then behind pitch, camera and axis, which are taken from ``view``, the largest
    difference of slopes beside a cliff and the largest slope.
    """
    flat, saturated, ill = (table.contiguous() for table in limits)
    three_noises, weights = (3.0 * noises[0]).contiguous(), noises[1].contiguous()
    compensated = _with_whole_rows(compensated)
    position_mm, albedo = view.position_mm.contiguous(), view.albedo.contiguous()
    camera = [view.mm_per_pixel, 1.0 / view.camera_height_mm, *view.axis_mm]
    model = albedo.new_tensor([constants[0], *camera, *constants[1:]])
    count, _, rows, columns = compensated.shape
    height, width = flat.shape[1], flat.shape[2]
    place = view.window[0] * width + view.window[1]
    depth_mm = None if depth_mm is None else _with_whole_rows(depth_mm)
    expected = None if expected is None else expected.contiguous()
    loaded().solve_shadowed(
        compensated.data_ptr(),
        *compensated.stride()[:3],
        three_noises.data_ptr(),
        flat.data_ptr() + 4 * place,
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
        weights.data_ptr(),
        normal.data_ptr(),
    )


def slopes(normal: Tensor, max_slope: float) -> Tensor:
    """Gradients (B, 2, H, W): see :func:`~torchvts.core.geometry.gradient_from_normal`."""
    normal = normal.contiguous()
    count, _, height, width = normal.shape
    gradient = normal.new_empty(count, 2, height, width)
    loaded().slopes(normal.data_ptr(), count, height * width, 1.0 / max_slope, gradient.data_ptr())
    return gradient


def over_tilted(image: Tensor, plane: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """An image (1, 3, H, W) in the background's light: see :mod:`torchvts.stream.follow_light`.

    Args:
        image: in the light of now.
        plane: (3, 3), level and tilts of each channel.
        x: (W,), where the tilt along x is -1 to 1; y, (H,), the same.
    """
    image, plane = image.contiguous(), plane.contiguous()
    result = torch.empty_like(image)
    inputs = (image.data_ptr(), plane.data_ptr(), x.data_ptr(), y.data_ptr())
    loaded().over_tilted(*inputs, *image.shape[-2:], result.data_ptr())
    return result


@functools.lru_cache(maxsize=8)
def poisson_plan(height: int, width: int) -> Tensor | None:
    """The tables of csrc/poisson.c for a size; None where the height has a prime factor above 64."""
    size = loaded().poisson_plan_size(height)
    if not size:
        return None
    with torch.inference_mode(False):
        tables = torch.empty(size, dtype=torch.uint8, device="cpu")
    loaded().make_poisson_plan(height, width, tables.data_ptr())
    return tables


def solve_poisson(
    gradient: Tensor, mm_per_pixel: float, tables: Tensor, window: tuple[int, int], size: tuple[int, int], zeroed: bool
) -> Tensor:
    """Depth (B, 1, H, W) of the given size from a window's gradient, by the tables of :func:`poisson_plan`.

    See :mod:`torchvts.integration.poisson`. ``zeroed``: zero on average where the gradient is zero, not over all of the image.
    """
    gradient = gradient.contiguous()
    count, _, rows, columns = gradient.shape
    depth = gradient.new_empty(count, 1, *size)
    settings, kernel = (rows, columns, *window, *size, zeroed), loaded().solve_poisson
    _check(
        by_frames(
            count,
            size[0] * size[1],
            lambda first, many: kernel(_at(gradient, first), tables.data_ptr(), mm_per_pixel, many, *settings, _at(depth, first)),
        )
    )
    return depth


def largest_change(one: Tensor, other: Tensor) -> Tensor:
    """Largest difference of two batches of depths, per frame, (B,)."""
    one, other = one.contiguous(), other.contiguous()
    change = one.new_empty(one.shape[0])
    loaded().largest_change(one.data_ptr(), other.data_ptr(), one.shape[0], one[0].numel(), change.data_ptr())
    return change


def uncrop(gradient: Tensor, contact: Tensor, window: tuple[int, int], size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """The gradient of a window embedded in the whole image (B, 2, H, W), zero elsewhere, its normals (B, 3, H, W), the contact."""
    gradient, contact = gradient.contiguous(), contact.contiguous()
    count, _, rows, columns = gradient.shape
    whole, normal = gradient.new_empty(count, 2, *size), gradient.new_empty(count, 3, *size)
    touching = contact.new_empty(count, 1, *size)
    part, kernel = (rows, columns, *window, *size), loaded().uncrop
    by_frames(
        count,
        size[0] * size[1],
        lambda first, many: kernel(
            *(_at(gradient, first), _at(contact, first), many, *part),
            *(_at(whole, first), _at(normal, first), _at(touching, first)),
        ),
    )
    return whole, normal, touching


def zero_background(depth_mm: Tensor, deformed: Tensor, stiff: float, tolerance: float, sweeps: int) -> Tensor:
    """:class:`torchvts.integration.background.ZeroBackground` of depth (B, 1, H, W) and deformed skin, bool (B, 1, H, W)."""
    depth_mm, deformed = depth_mm.contiguous(), deformed.contiguous()
    count, _, height, width = depth_mm.shape
    out = torch.empty_like(depth_mm)
    kernel, settings = loaded().zero_background, (height, width, stiff, tolerance, sweeps)
    _check(
        by_frames(
            count,
            height * width,
            lambda first, many: kernel(_at(depth_mm, first), _at(deformed, first), many, *settings, _at(out, first)),
        )
    )
    return out


def alignment_sums(field: Tensor, columns: Tensor, limits: npt.NDArray[Any], score_only: bool = False) -> npt.NDArray[Any]:
    """Sums (56,) float64 of one Gauss-Newton step: see :mod:`torchvts.pose.inverse`, whose tensors these are."""
    sums = np.empty(56)
    inputs = (field.data_ptr(), *field.shape[:2], columns.data_ptr(), columns.stride(0), columns.shape[1], score_only)
    loaded().alignment_sums(*inputs, limits.ctypes.data, sums.ctypes.data)
    return sums


def part_sums(field: Tensor, columns: Tensor, parts: int, limits: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Sums (parts, 56) float64 of as many runs of pixels, as of :func:`alignment_sums`."""
    sums = np.empty((parts, 56))
    inputs = (field.data_ptr(), *field.shape[:2], columns.data_ptr(), columns.stride(0), columns.shape[1], parts)
    loaded().part_sums(*inputs, limits.ctypes.data, sums.ctypes.data)
    return sums


def refine_pose(
    field: Tensor, columns: Tensor, steps: int, settings: npt.NDArray[Any], held: npt.NDArray[Any], limits: npt.NDArray[Any]
) -> npt.NDArray[Any]:
    """Gauss-Newton steps; moves the pose in ``limits``. Returns the sums (56,) of the last step, and the noise of its weights."""
    sums, held = np.empty(57), np.ascontiguousarray(held)
    inputs = (field.data_ptr(), *field.shape[:2], columns.data_ptr(), columns.stride(0), columns.shape[1], steps)
    loaded().refine_pose(*inputs, settings.ctypes.data, held.ctypes.data, held.shape[1], limits.ctypes.data, sums.ctypes.data)
    return sums


def height_sums(
    field: Tensor, columns: Tensor, limits: npt.NDArray[Any], cells: tuple[npt.NDArray[Any], ...], most_mm: float, white_mm: float
) -> npt.NDArray[Any]:
    """Products (7, 7) of six twists and the residual of heights: see :mod:`torchvts.pose.height_errors`.

    Args:
        field: of the frame.
        columns: of the keyframe's pixels.
        limits: as of :func:`alignment_sums`.
        cells: the cell of each pixel, int64, the number of pixels of each cell, what its height changes by, and products of that.
        most_mm: height residuals of more than this are left out.
        white_mm: unit of the residuals of cells.
    """
    cell, number, lines, products = cells
    left = np.empty((7, 7))
    inputs = (field.data_ptr(), *field.shape[:2], columns.data_ptr(), columns.stride(0), columns.shape[1], limits.ctypes.data)
    arrays = (cell.ctypes.data, number.ctypes.data, lines.ctypes.data, products.ctypes.data)
    _check(loaded().height_sums(*inputs, *arrays, len(number), lines.shape[1] - 6, most_mm, white_mm, left.ctypes.data))
    return left


def track_grids(
    depth: Tensor, slopes: Tensor, contact: Tensor, least_mm: float, times: tuple[int, int]
) -> tuple[Tensor, Tensor, int]:
    """Fine and coarse channels (H, W, 4) of a frame, and how many fine pixels lie on it: see :mod:`torchvts.pose.keyframe`.

    Args:
        depth: (1, 1, H, W), contiguous as the others.
        slopes: (1, 2, H, W), y down.
        contact: (1, 1, H, W) bool.
        least_mm: depth from which skin surely lies on the object.
        times: pixels a side of the cells of both grids.
    """
    height, width = depth.shape[-2:]
    fine, coarse = (torch.empty(height // n, width // n, 4, dtype=torch.float32) for n in times)
    inputs = (depth.data_ptr(), slopes.data_ptr(), contact.data_ptr(), height, width, least_mm, *times)
    touching = loaded().track_grids(*inputs, fine.data_ptr(), coarse.data_ptr())
    _check(touching < 0)
    return fine, coarse, int(touching)


def contact_pixels(depth: Tensor, slopes: Tensor, contact: Tensor) -> int:
    """How many pixels touch, -1 where values are not finite or beyond 1e6; the tensors are those of :func:`track_grids`."""
    return int(loaded().contact_pixels(depth.data_ptr(), slopes.data_ptr(), contact.data_ptr(), depth.numel()))


def object_pixels(field: Tensor, x0: float, y0: float, pitch: float) -> Tensor:
    """Columns (5, N) x, y, z, p and q of the cells of a field that lie on the object: see :mod:`torchvts.pose.follow`."""
    height, width = field.shape[:2]
    columns = torch.empty(5, height * width, dtype=torch.float32)
    number = loaded().object_pixels(field.data_ptr(), height, width, x0, y0, pitch, height * width, columns.data_ptr())
    return columns[:, :number]
