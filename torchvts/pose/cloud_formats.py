"""Readers of PCD and PLY files that trust nothing: every number of a header is checked against the size of the file.

(Open3D's own readers crash on damaged files, and allocate whatever memory a header asks for.)
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np

from ..core.checks import parse_number

Columns = dict[str, "np.ndarray[Any, Any]"]

MOST_BYTES = 2**31
"""Largest file that is read."""

HEAD_BYTES = 2**16
"""Largest header."""

PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


def read_columns(path: Path) -> Columns:
    """Read the columns of a .pcd or .ply file's points by name, float64, all of one length.

    PCD: text, binary, compressed. PLY: text, binary of both byte orders; points come first and are plain numbers.

    Raises:
        ValueError: the file is too large, damaged or no point cloud, or a coordinate is not finite.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"expected at most {MOST_BYTES} bytes, got {size}")
    data = path.read_bytes()
    try:
        columns = _read_pcd(data) if path.suffix.lower() == ".pcd" else _read_ply(data)
    except (struct.error, LookupError, OverflowError, TypeError) as error:
        raise ValueError(f"its header is damaged: {error!r}") from error
    found = {name: column.astype(np.float64) for name, column in columns.items()}
    for name in {"x", "y", "z"} & found.keys():
        if not np.isfinite(found[name]).all():
            raise ValueError(f"column {name}: expected finite numbers, got NaN or infinite ones: leave such points out")
    return found


def _read_pcd(data: bytes) -> Columns:
    head: dict[str, list[str]] = {}
    place = 0
    while "DATA" not in head:
        end = data.find(b"\n", place, HEAD_BYTES)
        if end < 0:
            raise ValueError("not a point cloud, or cut short in its header")
        words = data[place:end].decode("ascii", "replace").split()
        place = end + 1
        if words and not words[0].startswith("#"):
            head[words[0]] = words[1:]
    names, kinds = head["FIELDS"], head["TYPE"]
    counts = [_count(n) for n in head.get("COUNT", ["1"] * len(names))]
    sizes = [_count(n) for n in head["SIZE"]]
    if not len(names) == len(kinds) == len(sizes) == len(counts) or len(set(names)) < len(names) or min(counts, default=0) < 1:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT do not match")
    types = [np.dtype(f"<{ {'F': 'f', 'I': 'i', 'U': 'u'}[kind] }{size}") for kind, size in zip(kinds, sizes)]
    points = _count(head["POINTS"][0] if "POINTS" in head else head["WIDTH"][0])
    width = sum(t.itemsize * n for t, n in zip(types, counts))
    way, body = head["DATA"][0], data[place:]
    if way == "ascii":
        return _text_columns(body, points, names, counts)
    if way == "binary_compressed":
        packed, size = struct.unpack("<II", body[:8])
        _check_count(points, width, size)
        if packed > len(body) - 8 or size > 256 * packed:  # LZF expands a byte by less
            raise ValueError(f"cut short: {packed} bytes are announced, {len(body) - 8} are there")
        body = _unpack_lzf(body[8 : 8 + packed], size)
        columns, place = {}, 0
        for name, kind, count in zip(names, types, counts):  # field after field
            columns[name] = np.frombuffer(body, kind, points * count, place).reshape(points, count)[:, 0]
            place += points * count * kind.itemsize
        return columns
    if way != "binary":
        raise ValueError(f"DATA is {way!r}, expected ascii, binary or binary_compressed")
    _check_count(points, width, len(body))
    row = np.dtype([(name, kind, (count,)) for name, kind, count in zip(names, types, counts)])
    table = np.frombuffer(body, row, points)
    return {name: table[name][:, 0] for name in names}


def _read_ply(data: bytes) -> Columns:
    end = data.find(b"end_header", 0, HEAD_BYTES)
    if not data.startswith(b"ply") or end < 0:
        raise ValueError("not a point cloud, or cut short in its header")
    start = data.find(b"\n", end) + 1
    way, element, points = "", "", 0
    names: list[str] = []
    types: list[str] = []
    for line in data[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            way = words[1]
        elif words[:1] == ["element"]:
            if not element and words[1] != "vertex":
                raise ValueError(f"its first element is {words[1]!r}, expected vertex")
            points = points if element else _count(words[2])
            element = element or "vertex"
            if words[1] != "vertex":
                break  # elements after the points are not read
        elif words[:1] == ["property"]:
            names.append(words[2])
            types.append(PLY_TYPES[words[1]])
    if not names or len(set(names)) < len(names) or start == 0:
        raise ValueError("its points have no properties")
    if way == "ascii":
        return _text_columns(data[start:], points, names, [1] * len(names))
    row = np.dtype(
        [(name, {"binary_little_endian": "<", "binary_big_endian": ">"}[way] + kind) for name, kind in zip(names, types)]
    )
    _check_count(points, row.itemsize, len(data) - start)
    table = np.frombuffer(data, row, points, start)
    return {name: table[name] for name in names}


def _text_columns(body: bytes, points: int, names: list[str], counts: list[int]) -> Columns:
    width = sum(counts)
    _check_count(points, 2 * width - 1, len(body) + 1)  # a digit and a space each
    words = body.split(maxsplit=points * width)[: points * width]
    if len(words) < points * width:
        raise ValueError(f"cut short: {points * width} numbers are announced, {len(words)} are there")
    table = np.array([parse_number(word.decode("ascii", "replace")) for word in words]).reshape(points, width)
    place = np.cumsum([0, *counts])
    return {name: table[:, place[k]] for k, name in enumerate(names)}


def _count(word: str) -> int:
    """A count in a header; Python's own ``int`` also takes "1_0"."""
    if not (word.isascii() and word.isdigit() and len(word) < 20):
        raise ValueError(f"expected a count in its header, got {word[:40]!r}")
    return int(word)


def _check_count(points: int, width: int, there: int) -> None:
    if points < 1:
        raise ValueError(f"expected at least one point, got {points}")
    if points * width > there:
        raise ValueError(f"cut short: {points} points of {width} bytes are announced, {there} bytes are there")


def _unpack_lzf(packed: bytes, size: int) -> bytes:
    """Decompress LZF (Marc Lehmann's liblzf): runs of plain bytes, and references to bytes already written."""
    out = bytearray()
    place = 0
    while place < len(packed):
        control = packed[place]
        place += 1
        if control < 32:
            out += packed[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[place]
            place += 1
        back = ((control & 31) << 8) + packed[place] + 1
        place += 1
        first = len(out) - back
        if first < 0 or len(out) > size:
            raise ValueError("its compressed bytes are damaged")
        for k in range(length + 2):  # one by one: the reference may overlap the bytes it writes
            out.append(out[first + k])
    if len(out) != size:
        raise ValueError(f"its compressed bytes are damaged: {size} are announced, {len(out)} came")
    return bytes(out)
