"""The compiled library: loaded once, its functions with their types. csrc/torchvts.h explains those that others call too."""

import ctypes
import functools
import warnings
import zlib
from pathlib import Path
from typing import Any

LIBRARY = Path(__file__).parent / "csrc" / "libtorchvts.so"

SIGNATURES = {
    "plan_fields": "s",
    "vts_load": "p p l p",
    "vts_info": "v p p",
    "vts_depth": "i p p i p",
    "vts_background": "p p p i p",
    "vts_free": "v p",
    "alignment_sums": "v p i i p l i i p p",
    "height_sums": "i p i i p l i p p p p p i i d d p",
    "track_grids": "i p p p i i f i i p p",
}
"""What each function returns, then what it takes: a pointer, int, float, double, int64 (l), text (s), or nothing (v)."""

_TYPES: dict[str, Any] = {
    "p": ctypes.c_void_p,
    "i": ctypes.c_int,
    "f": ctypes.c_float,
    "d": ctypes.c_double,
    "l": ctypes.c_int64,
    "s": ctypes.c_char_p,
    "v": None,
}

AGAIN = "install again (in a checkout: make setup)"
"""What makes a library that fits its sources."""


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled library; None where there is none for this machine (:func:`why_no_library`): then PyTorch does its work."""
    try:
        loaded = ctypes.CDLL(str(LIBRARY))
        built_from = int(loaded.sources())
    except (OSError, AttributeError):
        return None
    if built_from & 0xFFFFFFFF != zlib.crc32(b"".join(source.read_bytes() for source in sorted(LIBRARY.parent.glob("*.[ch]")))):
        warnings.warn(f"{LIBRARY}: built from other sources than lie beside it, so it is not used: {AGAIN}", stacklevel=2)
        return None
    for name, types in SIGNATURES.items():
        result, *arguments = types.split()
        function = getattr(loaded, name)
        function.restype, function.argtypes = _TYPES[result], [_TYPES[letter] for letter in arguments]
    return loaded


def why_no_library() -> str:
    """Why :func:`library` gave none."""
    if not LIBRARY.exists():
        return "no C compiler was at hand when torchvts was installed"
    return f"{LIBRARY} cannot be loaded on this machine, or was built from other sources: {AGAIN}"


def loaded() -> ctypes.CDLL:
    """The compiled library, after :func:`library` gave one."""
    found = library()
    assert found is not None, "called without a library"
    return found


def check_memory(short: int) -> None:
    """Raise if a function said that memory was short."""
    if short:
        raise MemoryError("torchvts: no memory is left for the tables of a frame")
