"""Result files: depth, normals and masks of a frame or of a whole video as one npz, with units, pitch and calibration."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .arrays import Array
from .checks import check_path, in_one_line
from .files import write_atomically
from .frame import DepthOutput

UNITS = {
    "depth_mm": "mm above the undeformed skin, towards the camera: positive where an object presses",
    "gradient": "mm per mm, (d depth / dx, d depth / dy), x right, y down",
    "normals": "unit vectors, x right, y down, z to the camera",
    "contact": "where the object touches the skin",
    "deformed": "where the skin has moved",
    "mm_per_pixel": "mm",
    "metric": "whether lengths are in mm: the calibration does not doubt its scale",
    "doubts": "why not to trust the calibration, a sentence each",
    "frame_doubts": "of each frame, why less may have been seen than is there; empty for nothing",
}
"""What the arrays of a result file are; the file carries it."""

MAPS = {"depth_mm": (1, "f4"), "normals": (3, "f4"), "gradient": (2, "f4"), "contact": (1, "?"), "deformed": (1, "?")}
"""Channels and type of each array: (B, channels, H, W) in a :class:`Result`; in a file (H, W) where there is one channel."""

PER_FRAME = ("frames", "frame_doubts")
"""Texts of which each frame has one."""

FORMAT = 2
"""Version of the layout."""


class Result(NamedTuple):
    """What a result file holds.

    Attributes:
        depth_mm: (B, 1, H, W), mm; B is 1 for a frame, the number of frames for a video.
        normals: (B, 3, H, W), unit vectors, x right, y down, z to the camera.
        gradient: (B, 2, H, W), (d depth / dx, d depth / dy), mm per mm.
        contact: (B, 1, H, W) bool, where the object touches the skin.
        deformed: (B, 1, H, W) bool, where the skin has moved.
        mm_per_pixel: pitch, mm.
        units: of each array, in words.
        calibration: file name of the calibration.
        sensor: name of the sensor.
        frames: name of each frame.
        metric: whether lengths are in mm: its calibration does not doubt its scale.
        doubts: why not to trust the calibration, a sentence each.
        frame_doubts: of each frame, why less may have been seen than is there; "" for nothing.
    """

    depth_mm: Tensor
    normals: Tensor
    gradient: Tensor
    contact: Tensor
    deformed: Tensor
    mm_per_pixel: float
    units: Mapping[str, str]
    calibration: str
    sensor: str
    frames: Sequence[str]
    metric: bool
    doubts: Sequence[str]
    frame_doubts: Sequence[str]

    def __repr__(self) -> str:
        count, _, height, width = self.depth_mm.shape
        size = f"{count} frame{'s' if count != 1 else ''} of {height} x {width} px, {self.mm_per_pixel:g} mm per pixel"
        deepest = f"deepest {float(self.depth_mm.max()):.3f} mm{'' if self.metric else ', NOT METRIC'}"
        doubted = sum(doubt != "" for doubt in self.frame_doubts)
        doubt = f", {doubted} IN DOUBT" if doubted else ""
        return f"Result({size}, {deepest}{doubt}, sensor {self.sensor!r}, calibration {self.calibration!r})"


class Facts(NamedTuple):
    """What a result file says beside the maps of a frame, as in a :class:`Result`."""

    mm_per_pixel: float
    calibration: str
    sensor: str
    metric: bool = True
    doubts: Sequence[str] = ()


def write_result(path: str | Path, output: DepthOutput, facts: Facts, frame: str, doubt: str = "", compressed: bool = True) -> None:
    """Write one frame as npz; the same values give the same bytes.

    Args:
        path: the file, ending in .npz.
        output: of the pipeline, of one frame.
        facts: of the unit that it is from.
        frame: its name.
        doubt: why less may have been seen in it than is there; "" for nothing.
        compressed: False for what is joined with others, and compressed then.
    """
    maps = zip(MAPS, (output.depth_mm, output.normal, output.gradient, output.contact, output.deformed))
    arrays = {name: values[0].detach().cpu().numpy().astype(MAPS[name][1]) for name, values in maps}
    arrays = {name: values[0] if MAPS[name][0] == 1 else values for name, values in arrays.items()}
    given = facts._replace(doubts=np.array(facts.doubts, dtype=np.str_))._asdict()  # type: ignore[arg-type]
    own = {"frames": [frame], "frame_doubts": [doubt], "units": json.dumps(UNITS), "format": FORMAT}
    with write_atomically(path) as temporary, _archive(temporary, compressed) as archive:
        for name, values in {**arrays, **given, **own}.items():
            _write_array(archive, name, [np.asarray(values)], None)


def join_results(path: str | Path, parts: Sequence[Path]) -> None:
    """Join files of :func:`write_result`, in order, into one npz whose arrays have the frames first; one frame is in memory."""
    with write_atomically(path) as temporary, _archive(temporary) as archive:
        with np.load(parts[0]) as first:
            shared = {name: first[name] for name in (*Facts._fields, "units", "format")}
        for name, values in shared.items():
            _write_array(archive, name, [values], None)
        for name in PER_FRAME:
            _write_array(archive, name, [np.concatenate([_part(part, name) for part in parts])], None)
        for name in MAPS:
            _write_array(archive, name, (_part(part, name) for part in parts), len(parts))


def _part(path: Path, name: str) -> Array:
    with np.load(path) as stored:
        values: Array = stored[name]
    return values


def _archive(path: Path, compressed: bool = True) -> zipfile.ZipFile:
    return zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED, compresslevel=1)


def _write_array(archive: zipfile.ZipFile, name: str, arrays: Any, count: int | None) -> None:
    """One array of an npz; with ``count``, that many arrays of one shape along a new first axis."""
    with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:  # of a fixed date: the same values give the same bytes
        for number, values in enumerate(arrays):
            if number == 0:
                shape = values.shape if count is None else (count, *values.shape)
                head = {"descr": np.lib.format.dtype_to_descr(values.dtype), "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, head)
            stream.write(np.ascontiguousarray(values).tobytes())


def read_result(path: str | Path) -> Result:
    """Read a result file of ``torchvts reconstruct --format npz``, of one frame or of a video. Nothing is unpickled.

    Args:
        path: the .npz file.
    Raises:
        FileNotFoundError: no such file.
        ValueError: not such a file, or a damaged one.
    Example:
        >>> import tempfile
        >>> flat, mask = torch.zeros(1, 1, 4, 6), torch.zeros(1, 1, 4, 6, dtype=torch.bool)
        >>> output = DepthOutput(flat, flat.expand(1, 2, 4, 6), torch.ones(1, 3, 4, 6), mask, mask)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_result(f"{folder}/0.npz", output, Facts(0.05, "unit.safetensors", "rig"), "0.png")
        ...     result = read_result(f"{folder}/0.npz")
        >>> result.depth_mm.shape, result.mm_per_pixel, result.frames, result.metric
        (torch.Size([1, 1, 4, 6]), 0.05, ['0.png'], True)
    """
    path = check_path("path", path)
    if not path.is_file():
        hint = ": name one of its .npz files" if path.is_dir() else ""
        raise FileNotFoundError(f"{path}: no such result file{hint}")
    if path.suffix.lower() != ".npz":
        raise ValueError(f"{path}: expected a name ending in .npz, got {path.suffix!r}: reconstruct with --format npz")
    try:
        with path.open("rb") as stream, np.load(stream) as archive:
            return _result(dict(archive))
    except Exception as error:  # a damaged file may fail anywhere in the readers of zip, npy and JSON
        raise ValueError(f"{path}: not a result of torchvts reconstruct, or damaged: {in_one_line(error)[:200]}") from error


def _result(stored: Mapping[str, Array]) -> Result:
    missing = [name for name in (*MAPS, *Facts._fields, *PER_FRAME, "units") if name not in stored]
    if missing:
        raise ValueError(f"it has no {', '.join(missing)}: of another torchvts? reconstruct again")
    if int(stored.get("format", np.asarray(FORMAT))) > FORMAT:
        raise ValueError(f"it has layout {int(stored['format'])}, this version reads {FORMAT}: update torchvts")
    frames = [str(name) for name in stored["frames"]]
    depth = stored["depth_mm"]
    if depth.ndim not in (2, 3) or (depth.ndim == 2 and len(frames) != 1):
        raise ValueError(f"depth_mm: expected (H, W), or (N, H, W) for N frames, got {depth.shape} for {len(frames)}")
    maps: dict[str, Tensor] = {}
    for name, (channels, kind) in MAPS.items():
        shape = (*((len(frames),) if depth.ndim == 3 else ()), *((channels,) if channels > 1 else ()), *depth.shape[-2:])
        if stored[name].shape != shape or stored[name].dtype != np.dtype(kind):
            raise ValueError(f"{name}: expected {shape}, {np.dtype(kind)}, got {stored[name].shape}, {stored[name].dtype}")
        maps[name] = torch.from_numpy(stored[name].reshape(len(frames), channels, *depth.shape[-2:]))
    return Result(
        **maps,
        mm_per_pixel=float(stored["mm_per_pixel"]),
        units=json.loads(str(stored["units"])),
        calibration=str(stored["calibration"]),
        sensor=str(stored["sensor"]),
        frames=frames,
        metric=bool(stored["metric"]),
        doubts=[str(doubt) for doubt in stored["doubts"]],
        frame_doubts=[str(doubt) for doubt in stored["frame_doubts"]],
    )
