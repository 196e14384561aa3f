"""Memory of outputs, used again once nobody holds them: pages that the system hands out anew cost half a frame's work."""

import threading
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor, UntypedStorage

MOST_BYTES = 2**27
"""No more is kept for later frames."""

_lock = threading.Lock()
_kept: dict[tuple[tuple[int, ...], torch.dtype], list["_Kept"]] = {}
_users: Callable[[int], int] | None = getattr(torch._C, "_storage_Use_Count", None)


class _Kept(NamedTuple):
    """Memory, and the tensor of which outputs are aliases: one more is made in a tenth of the time of a new tensor.

    Attributes:
        place: where the memory lies, as long as nobody has resized it or shares it with other processes.
        address: of torch's own record of the memory, which counts its users.
        idle: how many those are while nobody holds an output.
    """

    tensor: Tensor
    storage: UntypedStorage
    bytes: int
    place: int
    address: int
    idle: int


def empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """A tensor on the CPU whose values are not set.

    Its memory is that of an earlier one of this shape that nobody holds any more, neither itself nor a view of it; else new.
    """
    return empties([(shape, dtype)])[0]


def empties(wanted: list[tuple[tuple[int, ...], torch.dtype]]) -> list[Tensor]:
    """Such tensors of several shapes and types, each with memory of its own."""
    if _users is None or not _lock.acquire(blocking=False):  # another thread is at the table, and after a fork for ever
        return [torch.empty(shape, dtype=dtype, device="cpu") for shape, dtype in wanted]
    try:
        return [_tensor(kind, _users) for kind in wanted]
    finally:
        _lock.release()


def _tensor(kind: tuple[tuple[int, ...], torch.dtype], users: Callable[[int], int]) -> Tensor:
    for tensor, _, _, place, address, idle in _kept.get(kind, ()):
        if users(address) == idle and tensor.data_ptr() == place:
            return tensor.detach()
    return _new(kind, users)


def _new(kind: tuple[tuple[int, ...], torch.dtype], users: Callable[[int], int]) -> Tensor:
    """New memory, kept beside others of its kind, if need be in place of those that nobody holds.

    What another process sees, or somebody has resized, is not ours any more.
    """
    shape, dtype = kind
    with torch.inference_mode(False):
        tensor = torch.empty(shape, dtype=dtype, device="cpu")
    storage = tensor.untyped_storage()
    size, address = storage.nbytes(), storage._cdata
    if size > MOST_BYTES:
        return tensor
    alike = _kept.setdefault(kind, [])
    alike[:] = [kept for kept in alike if kept.storage.nbytes() == kept.bytes and not kept.storage.is_shared()]
    if _kept_bytes() + size > MOST_BYTES:
        for some in _kept.values():
            some[:] = [kept for kept in some if users(kept.address) > kept.idle]
        for unused in [other for other, some in _kept.items() if not some]:
            del _kept[unused]
    if _kept_bytes() + size <= MOST_BYTES:
        _kept.setdefault(kind, []).append(_Kept(tensor, storage, size, tensor.data_ptr(), address, users(address)))
    return tensor.detach()


def _kept_bytes() -> int:
    return sum(kept.bytes for some in _kept.values() for kept in some)
