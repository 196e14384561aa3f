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
    tensor = torch.empty(0, dtype=dtype, device="cpu")
    size = math.prod(shape) * dtype.itemsize
    if _users is None or size > MOST_BYTES:
        return tensor.resize_(shape)
    if not _lock.acquire(blocking=False):  # another thread is at the table, and after a fork for ever
        return tensor.resize_(shape)
    try:
        some = _kept.setdefault(size, [])
        for storage in some:
            if _users(storage._cdata) == 1 and not storage.is_shared() and storage.nbytes() == size:
                return tensor.set_(storage, 0, shape)  # type: ignore[call-overload, no-any-return]
        return tensor.set_(_new(size, some, _users), 0, shape)  # type: ignore[call-overload, no-any-return]
    finally:
        _lock.release()


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
