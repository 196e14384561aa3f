"""A plan: what a frame needs, as one file that C, robots and pages read too. docs/plan.md states its layout."""

import ctypes
import functools
import json
import struct
import weakref
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from .binding import check_memory, loaded

Values = dict[str, Any]

VERSION = 3
"""Of the file; csrc/load.h has it too."""

LINE = 64
"""Bytes: the head, each record and each table begin at a multiple of it."""

DTYPES = {"float": torch.float32, "double": torch.float64, "int64_t": torch.int64, "uint8_t": torch.bool}
"""Of tables, by their type in C."""

LETTERS = {"float": b"f", "double": b"d", "int64_t": b"i", "uint8_t": b"b", "i": b"i", "d": b"d"}
"""What a record says of its values."""

FLOAT_PLANES = 2
"""VTS_FLOAT of csrc/torchvts.h."""

DONE, NO_MEMORY, BAD_ARGUMENT, BAD_VALUES = range(4)
"""What vts_depth() returns."""


class PlanError(ValueError):
    """Bytes that the library refuses, with its reason."""


class PlanFacts(ctypes.Structure):
    """vts_facts of csrc/torchvts.h."""

    _fields_ = (
        ("mm_per_pixel", ctypes.c_double),
        ("height", ctypes.c_int32),
        ("width", ctypes.c_int32),
        ("metric", ctypes.c_int32),
        ("about_size", ctypes.c_int32),
        ("about", ctypes.c_void_p),
        ("bytes", ctypes.c_void_p),
        ("size", ctypes.c_size_t),
    )


@functools.cache
def fields() -> dict[str, tuple[str, str]]:
    """Of each field of a plan, by name, in order: its kind ("i", "d", or the type of a table), and how many values it has."""
    lines = loaded().plan_fields().decode().split("\n")[:-1]
    return {name: (kind, size) for kind, name, size in (line.split(" ", 2) for line in lines)}


def plan_bytes(values: Mapping[str, Any], about: Mapping[str, object]) -> bytes:
    """The file of a plan.

    Args:
        values: of every field; None for no table.
        about: who made it and of what, for JSON.
    Raises:
        TypeError: a table of another dtype. KeyError, ValueError: fields that are missing, or too many.
    """
    unknown = values.keys() - fields().keys()
    if unknown:
        raise ValueError(f"values: expected fields of a plan, got {', '.join(sorted(unknown))}")
    text = json.dumps(about, sort_keys=True, allow_nan=False).encode() + b"\0"
    parts = [_whole_lines(text)]
    for name, (kind, _) in fields().items():
        content, count = _content(name, kind, values[name])
        parts += [struct.pack("<32sc7xQ16x", name.encode(), LETTERS[kind], count), _whole_lines(content)]
    size = LINE + sum(map(len, parts))
    rest = b"".join([struct.pack("<QII32x", size, len(fields()), len(text)), *parts])
    return struct.pack("<8sII", b"VTSPLAN\n", VERSION, zlib.crc32(rest)) + rest


def _content(name: str, kind: str, value: Any) -> tuple[bytes, int]:
    if kind in ("i", "d"):
        return (struct.pack("<q", int(value)) if kind == "i" else struct.pack("<d", float(value))), 1
    if value is None:
        return b"", 0
    if not isinstance(value, Tensor) or value.dtype != DTYPES[kind] or not value.is_cpu:
        raise TypeError(f"{name}: expected a tensor of {DTYPES[kind]} on the CPU, got {value!r:.100}")
    return value.detach().contiguous().numpy().tobytes(), value.numel()


def _whole_lines(content: bytes) -> bytes:
    return content + bytes(-len(content) % LINE)


class Plan:
    """A plan in the memory of the library, which read and checked it. Nothing changes it.

    Args:
        content: bytes of the file, which the library copies.
    Attributes:
        about: who made it and of what, as the file says.
        size: of its images, pixels.
        mm_per_pixel: pixel pitch.
        metric: whether lengths are mm.
    Raises:
        PlanError: what is wrong with it, and what to do.
    """

    def __init__(self, content: bytes) -> None:
        self._hold(lambda reason: loaded().vts_load(content, len(content), reason))

    def _hold(self, made: Callable[[Any], int | None]) -> None:
        """Hold the plan that a function of the library makes, or raise with the reason that it writes."""
        reason = ctypes.create_string_buffer(256)
        self._handle = made(reason)
        if not self._handle:
            raise PlanError(reason.value.decode())
        weakref.finalize(self, loaded().vts_free, self._handle)
        facts = self._facts()
        self.size, self.mm_per_pixel, self.metric = (facts.height, facts.width), facts.mm_per_pixel, bool(facts.metric)
        try:
            about = json.loads(ctypes.string_at(facts.about, facts.about_size))
        except (ValueError, RecursionError) as error:
            raise PlanError(f"about: expected JSON, got {error}") from error
        if not isinstance(about, dict):
            raise PlanError(f"about: expected an object in JSON, got {about!r:.60}")
        self.about: dict[str, object] = about

    def _facts(self) -> PlanFacts:
        facts = PlanFacts()
        loaded().vts_info(self._handle, ctypes.addressof(facts))
        return facts

    def with_background(self, image: Tensor) -> "Plan":
        """The plan of the same unit with another image without contact, (3, H, W) contiguous float32.

        Raises:
            PlanError: the library's reason.
        """
        made = Plan.__new__(Plan)
        made._hold(lambda reason: loaded().vts_background(self._handle, image.data_ptr(), FLOAT_PLANES, reason))
        return made

    def content(self) -> bytes:
        """The bytes of the file."""
        facts = self._facts()
        return ctypes.string_at(facts.bytes, facts.size)

    def reconstruct(self, image: Tensor, conditions: Tensor, output: tuple[Tensor, ...]) -> bool:
        """Reconstruct a frame; False if its values are not finite and in [0, 1].

        Args:
            image: (3, H, W), contiguous float32 as all tensors here but for masks.
            conditions: (22,), gets the light (3, 6), what is lost (3), and the slope that could not be seen.
            output: depth (1, H, W), gradient (2, H, W), normal (3, H, W), contact and deformed (1, H, W), which get the result.
        Raises:
            MemoryError: memory is short.
        """
        depth, gradient, normal, contact, deformed = (part.data_ptr() for part in output)
        wanted = (ctypes.c_void_p * 6)(depth, normal, contact, deformed, gradient, conditions.data_ptr())  # vts_output
        code = int(loaded().vts_depth(self._handle, image.data_ptr(), FLOAT_PLANES, wanted))
        check_memory(code == NO_MEMORY)
        return code == DONE
