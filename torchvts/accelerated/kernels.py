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
from ..normals.shadowed import LightView
from .threads import by_frames

LIBRARY = Path(__file__).parent / "csrc" / "libtorchvts.so"

NO_PEDESTAL = (ctypes.c_float * 3)()


SIGNATURES = {
    "normals": ("i", "ppppp iii ppp ff p"),
    "solve_shadowed": ("v", "ppppp iii ppppppp"),
    "frame_noise": ("i", "p iiii p"),
    "clean": ("i", "pppppp l p iiii p"),
    "levels": ("i", "p iiiii ff p"),
    "smooth_change": ("i", "pp i p"),
    "over_smooth": ("v", "ppp i p"),
    "divide_planes": ("v", "pp i l p"),
    "over_tilted": ("v", "pppp ii p"),
    "response_normals": ("v", "ppp ii pp fff iii p"),
    "grid_means": ("v", "p iiiiiii p"),
    "slopes": ("v", "p ii f p"),
    "poisson_plan_size": ("l", "i"),
    "make_poisson_plan": ("v", "ii p"),
    "solve_poisson": ("i", "pp f iiii p"),
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


def loaded() -> ctypes.CDLL:
    """The compiled kernels, after :func:`~torchvts.accelerated.gate.usable` said that they may work."""
    loaded = library()
    assert loaded is not None, "called without usable()"
    return loaded


def _check(code: int) -> None:
    if code:
        raise MemoryError("torchvts: no memory is left for a few rows of the image")


def _at(tensor: Tensor | None, frame: int) -> int | None:
    """Address of a frame of a batch; of the only one, where one serves all."""
    if tensor is None:
        return None
    return tensor.data_ptr() + (0 if tensor.shape[0] == 1 else frame * tensor.stride(0) * tensor.element_size())


def _of_each(tensor: Tensor | None, count: int) -> Tensor | None:
    """So many frames, contiguous; where one serves all, it is repeated."""
    return None if tensor is None else tensor.expand(count, -1, -1, -1).contiguous()


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
    settings, kernel = (*maps, pedestal, *filled, weights, len(weights)), loaded().clean
    _check(
        by_frames(
            count,
            height * width,
            lambda first, many: kernel(_at(light, first), *settings, many, height, width, _at(out, first)),
        )
    )
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
    """``SmoothLight`` of csrc/smooth.c."""

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
    compensated: Tensor, depth_mm: Tensor | None, lines: ResponseLines, settings: tuple[float, float, float]
) -> Tensor:
    """Unit normals (B, 3, H, W): see :class:`~torchvts.normals.NormalFromResponse`.

    Its steeper, reference_mm and max_sine are the settings.
    """
    compensated, weight = compensated.contiguous(), lines.weight
    count, _, height, width = compensated.shape
    depth_mm, per_mm = _of_each(depth_mm, count), lines.per_mm
    normal = torch.empty_like(compensated)
    field = (lines.place.data_ptr(), weight.data_ptr(), weight.shape[1] - 1, weight.shape[3])
    by_depth = (None if per_mm is None else per_mm.data_ptr(), *settings)
    kernel = loaded().response_normals
    by_frames(
        count,
        height * width,
        lambda first, many: kernel(
            *(_at(compensated, first), *field, _at(depth_mm, first), *by_depth, many, height, width, _at(normal, first)),
        ),
    )
    return normal


def normals(
    compensated: Tensor,
    limits: tuple[Tensor, Tensor],
    noise_std: Tensor,
    inverse: Tensor,
    depth_mm: Tensor | None,
    view: LightView,
) -> tuple[Tensor, bool]:
    """Unit normals (B, 3, H, W), and whether every channel of the images is valid.

    By the stored inverse (3, 3, H, W), or with a depth by the lights; see :class:`~torchvts.normals.NormalFromIntensity`.
    ``limits``: what the lights give on the flat skin, and from where on a channel is saturated, (3, H, W). ``noise_std``: (B, 3).
    """
    (flat, saturated), inverse = (table.contiguous() for table in limits), inverse.contiguous()
    compensated, three_noises = compensated.contiguous(), (3.0 * noise_std).contiguous()
    position_mm, albedo = view.position_mm.contiguous(), view.albedo.contiguous()
    count, _, height, width = compensated.shape
    depth_mm = _of_each(depth_mm, count)
    normal = torch.empty_like(compensated)
    fields = (flat.data_ptr(), saturated.data_ptr(), inverse.data_ptr())
    lights = (position_mm.data_ptr(), albedo.data_ptr(), view.mm_per_pixel, 1.0 / view.camera_height_mm)
    kernel = loaded().normals
    invalid = by_frames(
        count,
        height * width,
        lambda first, many: kernel(
            *(_at(compensated, first), three_noises[first:].data_ptr(), *fields, many, height, width),
            *(_at(depth_mm, first), *lights, _at(normal, first)),
        ),
    )
    return normal, not invalid


def solve_shadowed(
    normal: Tensor,
    compensated: Tensor,
    tables: tuple[Tensor, Tensor, Tensor],
    noises: tuple[Tensor, Tensor],
    depth_mm: Tensor | None,
    expected: Tensor | None,
    view: LightView,
    constants: list[float],
) -> None:
    """Replace normals, in place, where a light is blocked, a channel is saturated, or the matrix is ill-conditioned.

    See :class:`~torchvts.normals.shadowed.ShadowedPixels`, whose flat, saturated_above and ill_conditioned the tables are.
    ``noises``: of the channels of each frame, (B, 3), and of each frame the noise, the weight of the prior and that of the
    brightness, (B, 3). ``constants``: steps; then behind pitch and camera, which are taken from ``view``, the largest
    difference of slopes beside a cliff and the largest slope.
    """
    flat, saturated, ill = (table.contiguous() for table in tables)
    three_noises, weights = (3.0 * noises[0]).contiguous(), noises[1].contiguous()
    compensated = compensated.contiguous()
    position_mm, albedo = view.position_mm.contiguous(), view.albedo.contiguous()
    model = albedo.new_tensor([constants[0], view.mm_per_pixel, 1.0 / view.camera_height_mm, *constants[1:]])
    count, _, height, width = compensated.shape
    depth_mm, expected = _of_each(depth_mm, count), _of_each(expected, count)
    inputs = (compensated, three_noises, flat, saturated, ill)
    loaded().solve_shadowed(
        *(tensor.data_ptr() for tensor in inputs),
        *(count, height, width),
        *(None if tensor is None else tensor.data_ptr() for tensor in (depth_mm, expected)),
        *(tensor.data_ptr() for tensor in (position_mm, albedo, model, weights, normal)),
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


def solve_poisson(gradient: Tensor, mm_per_pixel: float, tables: Tensor, zeroed: bool) -> Tensor:
    """Depth (B, 1, H, W) from a gradient (B, 2, H, W), by the tables of :func:`poisson_plan`.

    See :mod:`torchvts.integration.poisson`. ``zeroed``: zero on average where the gradient is zero, not over all of the image.
    """
    gradient = gradient.contiguous()
    count, _, height, width = gradient.shape
    depth = gradient.new_empty(count, 1, height, width)
    settings, kernel = (height, width, zeroed), loaded().solve_poisson
    _check(
        by_frames(
            count,
            height * width,
            lambda first, many: kernel(_at(gradient, first), tables.data_ptr(), mm_per_pixel, many, *settings, _at(depth, first)),
        )
    )
    return depth


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
