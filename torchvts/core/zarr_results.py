"""The results of a recording as one zarr store, layout of zarr 2, which zarr 2 and 3 read; it is written without either.

A frame is a chunk: its row is read without the others, and a row without a chunk is a frame that was left out.
"""

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .files import write_atomically
from .results import MAPS, Facts

EMPTY = {"f": "NaN", "b": False}
"""Values of a frame that was left out, by the kind of its type."""


def join_as_zarr(path: str | Path, parts: Mapping[int, Path], count: int, left_out: Mapping[str, str]) -> None:
    """Write the frames of a recording as one zipped zarr store, whose row k is frame k; one frame is in memory at a time.

    Parts are files of :func:`torchvts.core.results.write_result` by row. The other rows hold NaN, and False in masks, and
    ``left_out`` says why.
    """
    with write_atomically(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        doubts: dict[str, str] = {}
        facts: dict[str, Any] = {}
        for row, part in parts.items():
            with np.load(part) as stored:
                maps = {name: stored[name] for name in MAPS}
                if doubt := str(stored["frame_doubts"][0]):
                    doubts[str(row)] = doubt
                facts = facts or {name: stored[name].tolist() for name in Facts._fields} | {
                    "units": json.loads(str(stored["units"]))
                }
            for name, values in maps.items():
                if row == next(iter(parts)):
                    _write_json(archive, f"{name}/.zarray", _layout(values, count))
                chunk = f"{name}/{row}{'.0' * values.ndim}"
                archive.writestr(zipfile.ZipInfo(chunk), zlib.compress(values.tobytes(), 1))  # of a fixed date: the same bytes
        _write_json(archive, ".zgroup", {"zarr_format": 2})
        _write_json(archive, ".zattrs", {**facts, "frame_doubts": doubts, "left_out": dict(left_out)})


def _layout(values: "np.ndarray[Any, Any]", count: int) -> dict[str, Any]:
    return {
        "zarr_format": 2,
        "shape": (count, *values.shape),
        "chunks": (1, *values.shape),
        "dtype": values.dtype.str,
        "compressor": {"id": "zlib", "level": 1},
        "fill_value": EMPTY[values.dtype.kind],
        "order": "C",
        "filters": None,
    }


def _write_json(archive: zipfile.ZipFile, name: str, content: Mapping[str, Any]) -> None:
    archive.writestr(zipfile.ZipInfo(name), json.dumps(content, indent=1))
