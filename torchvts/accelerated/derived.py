"""What kernels need of a block's buffers in another form, worked out once and kept until a buffer changes."""

import ctypes
from collections.abc import Callable
from typing import TypeVar, cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from ..compensate.compensate import Gain
from ..normals import NormalFromResponse
from .kernels import ResponseLines

_Value = TypeVar("_Value")

DEGREES = (2, 4, 6)
"""Degrees for which response.c has loops."""

TERMS = (3, 9, 13, 19)
"""Terms for which it has: three changes, their six products of two, their ten of three."""

_notes: WeakKeyDictionary[nn.Module, dict[str, tuple[tuple[Tensor, ...], list[int], object]]] = WeakKeyDictionary()


def kept(module: nn.Module, name: str, buffers: tuple[Tensor, ...], make: Callable[[], _Value]) -> _Value | None:
    """What ``make`` gives, kept beside a module as long as it holds these very buffers and nobody has written to them.

    None for tensors made under inference mode, of which torch does not say whether they were written to.
    """
    if any(buffer.is_inference() for buffer in buffers):
        return None
    versions = [buffer._version for buffer in buffers]
    notes = _notes.setdefault(module, {})
    note = notes.get(name)
    if note is None or note[1] != versions or any(a is not b for a, b in zip(note[0], buffers, strict=True)):
        with torch.inference_mode(False), torch.no_grad():
            note = (buffers, versions, make())
        notes[name] = note
    return cast(_Value, note[2])


def pedestals(block: Gain) -> "ctypes.Array[ctypes.c_float] | None":
    """What the offset is of the gain, where it is exactly one number a channel; else None."""
    gain, offset = block.gain, block.offset
    if gain is None or offset is None:
        return None
    return kept(block, "pedestals", (gain, offset), lambda: _pedestals(gain, offset))


def _pedestals(gain: Tensor, offset: Tensor) -> "ctypes.Array[ctypes.c_float] | None":
    found = (offset.double() / gain.double()).flatten(1).mean(dim=1).to(gain.dtype)
    if not torch.equal(found[:, None, None] * gain, offset):
        return None
    return (ctypes.c_float * 3)(*found.tolist())


def response_lines(block: NormalFromResponse) -> ResponseLines | None:
    """The coefficients of a response field as polynomials along rows; None where its maps are none."""
    return kept(block, "lines", (block.maps, block.per_mm), lambda: _lines(block.maps, block.per_mm))


def _lines(maps: Tensor, per_mm: Tensor) -> ResponseLines | None:
    place = torch.linspace(-1.0, 1.0, maps.shape[3], dtype=torch.float64)
    weight = next((found for degree in DEGREES if (found := _polynomials(maps, place, degree)) is not None), None)
    by_depth = _polynomials(per_mm, place, 2)
    if weight is None or by_depth is None or maps.shape[0] not in TERMS:
        return None
    return ResponseLines(
        place.float(), weight.permute(2, 3, 1, 0).float().contiguous(), by_depth.transpose(0, 1).float().contiguous()
    )


def _polynomials(maps: Tensor, place: Tensor, degree: int) -> Tensor | None:
    """Coefficients (..., H, degree + 1) of maps (..., H, W) along their rows; None where they are no such polynomials."""
    powers = place[:, None] ** torch.arange(degree + 1, dtype=torch.float64)
    found: Tensor = maps.double() @ torch.linalg.pinv(powers).t()
    if maps.numel() and float((found @ powers.t() - maps).abs().max()) > 3e-7 * float(maps.abs().max()):
        return None
    return found
