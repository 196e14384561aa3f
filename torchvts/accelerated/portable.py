"""A frame's program as plain tensors, for a file that holds the compiled kernels itself: torchvts/export/kernels_in_file.py."""

import ctypes
import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from .frame import POINTER, Blocks, Program, program_of
from .kernels import SmoothLight, SmoothTables


def portable_program(pipe: nn.Module, parts: Callable[[], Blocks | None]) -> list[Tensor] | None:
    """The program of a pipeline and all that it points to; None where there is none, or blocks take over from it in some frames.

    Args:
        pipe: the pipeline.
        parts: gives its blocks.
    Returns:
        uint8 tensors. The first holds int64: the number of structures, then for each address in them three: which structure, at
        which byte, of which piece. The structures follow, :class:`Program` first, then the tables; pieces are counted from there.
    """
    found = program_of(pipe, parts)
    if found is None:
        return None
    program, memory = found
    if program.inverse or (program.drifts and math.isfinite(program.believed_drift)):
        return None
    tensors, _, weights, tables, smooth = memory
    structures: list[ctypes.Structure] = [program]
    held = {tensor.data_ptr(): _bytes_of(tensor) for tensor in (*tensors.values(), tables)}
    held[ctypes.addressof(weights)] = _bytes_in(weights)
    if isinstance(smooth, SmoothTables):
        structures.append(smooth.structure)
        held.update({tensor.data_ptr(): _bytes_of(tensor) for tensor in smooth.memory})
    order = {ctypes.addressof(structure): k for k, structure in enumerate(structures)}
    pieces = [_bytes_in(structure) for structure in structures]
    places = [len(structures)]
    for k, structure in enumerate(structures):
        for field in (Program if k == 0 else SmoothLight)._fields_:
            name = field[0]
            address = getattr(structure, name) if field[1] is POINTER else None
            if not address:
                continue
            if address not in order:
                order[address] = len(pieces)
                pieces.append(held[address])
            places += [k, getattr(type(structure), name).offset, order[address]]
    return [torch.tensor(places, dtype=torch.int64).view(torch.uint8), *pieces]


def _bytes_of(tensor: Tensor) -> Tensor:
    return tensor.detach().contiguous().flatten().view(torch.uint8).clone()


def _bytes_in(value: ctypes.Structure | ctypes.Array) -> Tensor:  # type: ignore[type-arg]
    return torch.frombuffer(bytearray(bytes(value)), dtype=torch.uint8)
