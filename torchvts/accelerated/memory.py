"""Memory of outputs, used again once nobody holds them: pages that the system hands out anew cost half a frame's work."""

import math
import threading
from collections.abc import Callable

import torch
from torch import Tensor, UntypedStorage

MOST_BYTES = 2**27
"""No more is kept for later frames."""

_lock = threading.Lock()
_kept: dict[int, list[UntypedStorage]] = {}
_users: Callable[[int], int] | None = getattr(torch._C, "_storage_Use_Count", None)


def empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """A tensor on the CPU whose values are not set.

    Its memory is that of an earlier one of as many bytes that nobody holds any more, neither itself nor a view of it; else new.
    """
    return empties([(shape, dtype)])[0]


def empties(wanted: list[tuple[tuple[int, ...], torch.dtype]]) -> list[Tensor]:
    """Such tensors of several shapes and types, each with memory of its own."""
    if _users is None or not _lock.acquire(blocking=False):  # another thread is at the table, and after a fork for ever
        return [torch.empty(shape, dtype=dtype, device="cpu") for shape, dtype in wanted]
    try:
        return [_tensor(shape, dtype, _users) for shape, dtype in wanted]
    finally:
        _lock.release()


def _tensor(shape: tuple[int, ...], dtype: torch.dtype, users: Callable[[int], int]) -> Tensor:
    size = math.prod(shape) * dtype.itemsize
    tensor = torch.empty(0, dtype=dtype, device="cpu")
    if size > MOST_BYTES:
        return tensor.resize_(shape)
    some = _kept.setdefault(size, [])
    for storage in some:
        if users(storage._cdata) == 1 and not storage.is_shared() and storage.nbytes() == size:
            break
    else:
        storage = _new(size, some, users)
    return tensor.set_(storage, 0, shape)  # type: ignore[call-overload, no-any-return]


def _new(size: int, alike: list[UntypedStorage], users: Callable[[int], int]) -> UntypedStorage:
    """New memory, kept beside others of its size, if need be in place of those that nobody holds.

    What another process sees, or somebody has resized, is not ours any more.
    """
    alike[:] = [storage for storage in alike if storage.nbytes() == size and not storage.is_shared()]
    if _kept_bytes() + size > MOST_BYTES:
        for some in _kept.values():
            some[:] = [other for other in some if users(other._cdata) > 1]
    storage = UntypedStorage(size)
    if _kept_bytes() + size <= MOST_BYTES:
        alike.append(storage)
    return storage


def _kept_bytes() -> int:
    return sum(size * len(some) for size, some in _kept.items())
