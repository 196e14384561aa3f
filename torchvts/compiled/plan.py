"""A plan: the numbers and tables that the compiled stages of a frame read, in the structure that the library says."""

import ctypes
import functools
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from .binding import check_memory, loaded

Values = dict[str, Any]

DTYPES = {"float": torch.float32, "double": torch.float64, "int64_t": torch.int64, "uint8_t": torch.bool}
"""Of tables, by their type in C."""

DONE, NO_MEMORY = 0, 1
"""What the compiled frame returns: see csrc/plan.h."""


@functools.cache
def fields() -> dict[str, str]:
    """Kind of each field of a plan, by name, in order: "i", "d", or the type of a table."""
    lines = loaded().plan_fields().decode().split("\n")[:-1]
    return {name: kind for kind, name in (line.rsplit(" ", 1) for line in lines)}


@functools.cache
def _structure() -> type[ctypes.Structure]:
    kinds = {"i": ctypes.c_int64, "d": ctypes.c_double}
    members = [(name, kinds.get(kind, ctypes.c_void_p)) for name, kind in fields().items()]
    made = type("Plan", (ctypes.Structure,), {"_fields_": members})
    assert ctypes.sizeof(made) == loaded().plan_size(), "the library has another layout than it says"
    return made


class Plan:
    """A plan in memory, with the tables that it points to. Nothing changes it.

    Args:
        values: of every field; None for no table.
    Raises:
        TypeError: a table of another dtype. KeyError, ValueError: fields that are missing, or too many.
    """

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._kept: list[object] = []
        unknown = values.keys() - fields().keys()
        if unknown:
            raise ValueError(f"values: expected fields of a plan, got {', '.join(sorted(unknown))}")
        given = {name: self._given(name, kind, values[name]) for name, kind in fields().items()}
        self._memory = _structure()(**given)
        self.address = ctypes.addressof(self._memory)

    def _given(self, name: str, kind: str, value: Any) -> Any:
        if kind in ("i", "d"):
            return int(value) if kind == "i" else float(value)
        if value is None:
            return None
        if not isinstance(value, Tensor) or value.dtype != DTYPES[kind] or not value.is_cpu:
            raise TypeError(f"{name}: expected a tensor of {DTYPES[kind]} on the CPU, got {value!r:.100}")
        table = value.detach().contiguous().clone()
        self._kept.append(table)
        return table.data_ptr()

    def reconstruct(self, image: Tensor, conditions: Tensor, output: tuple[Tensor, ...]) -> None:
        """Reconstruct a frame.

        Args:
            image: (3, H, W), its markers filled, contiguous float32 as all tensors here but for masks.
            conditions: (22,), gets the light (3, 6), what is lost (3), and the slope that could not be seen.
            output: depth (1, H, W), gradient (2, H, W), normal (3, H, W), contact and deformed (1, H, W), which get the result.
        Raises:
            MemoryError: memory is short.
        """
        parts = [part.data_ptr() for part in output]
        code = int(loaded().reconstruct(self.address, image.data_ptr(), conditions.data_ptr(), *parts))
        check_memory(code == NO_MEMORY)


def ends(values: Tensor) -> tuple[float, float]:
    """Smallest and largest of some contiguous values of float32; NaN where any is no number or infinite."""
    found = (ctypes.c_float * 2)()
    loaded().range(values.data_ptr(), values.numel(), found)
    return found[0], found[1]


def poisson_tables(height: int, width: int) -> Tensor | None:
    """Tables of csrc/poisson.c for a size; None where the height has a prime factor that is too large."""
    size = loaded().poisson_plan_size(height)
    if not size or width < 2:
        return None
    tables = torch.empty(-(-size // 8), dtype=torch.float64, device="cpu")
    loaded().make_poisson_plan(height, width, tables.data_ptr())
    return tables
