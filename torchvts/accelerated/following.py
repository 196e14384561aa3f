"""A frame registered to a keyframe in one compiled call: csrc/follow.c, and what it is given."""

import ctypes
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor

from .kernels import loaded

INTEGER, REAL, POINTER = ctypes.c_int32, ctypes.c_double, ctypes.c_void_p

FOUND = {"pose": 16, "sums": 56, "noise": 1, "covariance": 36, "forth": 56, "back": 56, "pixels": 1, "last_step": 1}
FOUND |= {"turn_variance": 1, "shift_variance": 1, "used": 1, "variance": 1, "motions": 36, "shifts": 9, "unknown": 1, "slides": 1}
"""Numbers of each part of ``Followed`` of csrc/follow.c, all float64."""

ENDS = np.cumsum(list(FOUND.values())).tolist()
PLACES = {name: slice(end - size, end) for (name, size), end in zip(FOUND.items(), ENDS, strict=True)}


class KeyframePixels(ctypes.Structure):
    """``Pixels`` of csrc/follow.c."""

    _fields_ = (("columns", POINTER), ("stride", ctypes.c_int64), ("number", ctypes.c_int64))


class Grid(ctypes.Structure):
    """``Grid`` of csrc/follow.c."""

    _fields_ = (("field", POINTER), ("height", INTEGER), ("width", INTEGER), ("x0", REAL), ("y0", REAL), ("pitch", REAL))


class Directions(ctypes.Structure):
    """``Directions`` of csrc/track.h."""

    _fields_ = (("line", REAL * 36), ("number", INTEGER))


class KeyframeProgram(ctypes.Structure):
    """``Keyframe`` of csrc/follow.c."""

    _fields_ = (
        *((name, KeyframePixels) for name in ("coarse", "some", "many")),
        ("own", Grid),
        *((name, POINTER) for name in ("cell", "per_cell", "lines", "products")),
        *((name, INTEGER) for name in ("cells", "modes", "parts", "coarse_steps", "some_steps")),
        *(("units", REAL * 6), ("center", REAL * 3), ("held", Directions), ("bias", REAL * 36), ("shown", REAL * 36)),
        *((name, REAL) for name in ("per_height", "score_slope", "score_height", "deep", "shallow")),
        *((name, REAL) for name in ("slope_noise", "least_noise", "largest_mm", "coarse_mm", "small_mm", "least_information")),
        *(("wanted", REAL * 6), ("alike", REAL)),
        *((name, REAL) for name in ("least_slope_noise", "most_height_mm", "white_mm")),
        *((name, REAL) for name in ("shared_error", "unseen", "height_error", "offset_mm", "least_share", "unknown_variance")),
    )


class Found(NamedTuple):
    """A frame registered to a keyframe.

    Attributes:
        start: which of the starts was the best one.
        parts: (n,) float64 of each name of :data:`FOUND`.
    """

    start: int
    parts: dict[str, npt.NDArray[Any]]


def pixels_of(columns: Tensor) -> KeyframePixels:
    """The pixels (23, N) of a keyframe, for its program; the tensor must stay."""
    return KeyframePixels(columns.data_ptr(), columns.stride(0), columns.shape[1])


def grid_of(channels: Tensor, x0: float, y0: float, pitch: float) -> Grid:
    """A field of channels (H, W, 4), for a program; the tensor must stay."""
    return Grid(channels.data_ptr(), *channels.shape[:2], x0, y0, pitch)


def directions_of(columns: npt.NDArray[Any]) -> Directions:
    """Orthonormal columns (6, k), for a program."""
    number = columns.shape[1]
    return Directions((REAL * 36)(*columns.T.ravel()), number)


def follow_frame(program: KeyframeProgram, fine: Grid, coarse: Grid, starts: npt.NDArray[Any], last: npt.NDArray[Any]) -> Found:
    """Register a frame from the best of the poses (number, 4, 4) float64; what is unknown keeps its value in the last pose."""
    found = np.empty(ENDS[-1])
    number = loaded().follow_frame(
        *(ctypes.byref(program), ctypes.byref(fine), ctypes.byref(coarse)),
        *(starts.ctypes.data, len(starts), last.ctypes.data, found.ctypes.data),
    )
    if number < 0:
        raise MemoryError("torchvts: no memory is left for the cells of a contact")
    return Found(number, {name: found[place] for name, place in PLACES.items()})
