"""Writes points and surfaces as PLY, PCD, OBJ and X3P; nothing beyond NumPy is needed."""

import hashlib
import io
import math
import zipfile
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from torch import Tensor

from ..core.files import write_atomically
from ..core.geometry import depth_to_points
from .output_frame import OutputFrame

Array = np.ndarray[Any, Any]


def write_ply(path: Path, points: Array, normals: Array | None, text: str) -> None:
    """Points (N, 3) and normals (N, 3) as binary PLY, float64."""
    columns = [points] if normals is None else [points, normals]
    names = ("x", "y", "z", "nx", "ny", "nz")[: 3 * len(columns)]
    head = ["ply", "format binary_little_endian 1.0", f"comment {text}", f"element vertex {len(points)}"]
    head += [*(f"property double {name}" for name in names), "end_header", ""]
    _write(path, "\n".join(head).encode() + np.hstack(columns).astype("<f8").tobytes())


def write_pcd(path: Path, points: Array, normals: Array | None, text: str) -> None:
    """Points (N, 3) and normals (N, 3) as binary PCD, float32."""
    columns = [points] if normals is None else [points, normals]
    names = ("x", "y", "z", "normal_x", "normal_y", "normal_z")[: 3 * len(columns)]
    head = ["# .PCD v0.7 - Point Cloud Data file format", f"# {text}", "VERSION 0.7", f"FIELDS {' '.join(names)}"]
    head += [f"{key} {' '.join(value * len(names))}" for key, value in (("SIZE", ["4"]), ("TYPE", ["F"]), ("COUNT", ["1"]))]
    head += [f"WIDTH {len(points)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {len(points)}", "DATA binary", ""]
    _write(path, "\n".join(head).encode() + np.hstack(columns).astype("<f4").tobytes())


def write_obj(
    path: Path, depth_mm: Tensor, normal: Tensor, contact: Tensor, mm_per_pixel: float, frame: OutputFrame, text: str = ""
) -> None:
    """The contact as a surface in Wavefront OBJ.

    Args:
        path: the file.
        depth_mm: one frame, (1, 1, H, W), mm.
        normal: (1, 3, H, W), of the pipeline.
        contact: (1, 1, H, W) bool; four neighbours in contact make two triangles.
        mm_per_pixel: pitch, mm.
        frame: in which it is written.
        text: comment at its beginning, one line; without one the frame's axes.
    """
    inside = contact[0, 0].cpu().numpy()
    points = frame.points(depth_to_points(depth_mm, mm_per_pixel, contact).cpu()).numpy()
    normals = frame.directions((normal[0].permute(1, 2, 0)[contact[0, 0]] * normal.new_tensor([1.0, -1.0, 1.0])).cpu()).numpy()
    index = np.cumsum(inside.ravel()).reshape(inside.shape)  # from 1, as OBJ counts
    block = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:] & inside[1:, 1:]
    a, b, c, d = (part[block] for part in (index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]))
    faces = np.concatenate((np.stack((a, b, d), 1), np.stack((a, d, c), 1)))  # counter-clockwise from the camera
    lines = [f"# torchvts: {text or frame.axes}"]
    digits = 6 + round(math.log10(frame.mm))  # nm
    lines += [f"v {x:.{digits}f} {y:.{digits}f} {z:.{digits}f}" for x, y, z in points.tolist()]
    lines += [f"vn {x:.6f} {y:.6f} {z:.6f}" for x, y, z in normals.tolist()]
    lines += [f"f {i}//{i} {j}//{j} {k}//{k}" for i, j, k in faces.tolist()]
    _write(path, ("\n".join(lines) + "\n").encode())


X3P_AXES = "m, x right, y up, z to the camera"

X3P_XML = """<?xml version="1.0" encoding="UTF-8"?>
<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">
  <Record1>
    <Revision>ISO5436 - 2000</Revision>
    <FeatureType>SUR</FeatureType>
    <Axes>
      <CX><AxisType>I</AxisType><DataType>D</DataType><Increment>{pitch_m!r}</Increment><Offset>{left_m!r}</Offset></CX>
      <CY><AxisType>I</AxisType><DataType>D</DataType><Increment>{pitch_m!r}</Increment><Offset>{bottom_m!r}</Offset></CY>
      <CZ><AxisType>A</AxisType><DataType>D</DataType><Increment>1</Increment><Offset>0</Offset></CZ>
    </Axes>
  </Record1>
  <Record2>
    <Date>1970-01-01T00:00:00Z</Date>
    <Instrument><Manufacturer>torchvts</Manufacturer><Model>{sensor}</Model><Serial/><Version/></Instrument>
    <CalibrationDate>1970-01-01T00:00:00Z</CalibrationDate>
    <ProbingSystem><Type>Contacting</Type><Identification>visual-tactile sensor</Identification></ProbingSystem>
    <Comment>{text}; both dates are unknown</Comment>
  </Record2>
  <Record3>
    <MatrixDimension><SizeX>{columns}</SizeX><SizeY>{rows}</SizeY><SizeZ>1</SizeZ></MatrixDimension>
    <DataLink><PointDataLink>bindata/data.bin</PointDataLink><MD5ChecksumPointData>{md5}</MD5ChecksumPointData></DataLink>
  </Record3>
  <Record4><ChecksumFile>md5checksum.hex</ChecksumFile></Record4>
</p:ISO5436_2>
"""
"""Metadata of an X3P file. Its times are not known: they are the first that there is."""


def write_x3p(path: Path, depth_mm: Tensor, contact: Tensor, mm_per_pixel: float, sensor: str = "", text: str = "") -> None:
    """The contact as a surface in X3P, for metrology: heights in metres, x right, y up, z to the camera; NaN outside of it.

    Args:
        path: the file.
        depth_mm: one frame, (1, 1, H, W), mm.
        contact: (1, 1, H, W) bool.
        mm_per_pixel: pitch, mm.
        sensor: its name.
        text: a comment.
    Source:
        ISO 25178-72 (ISO 5436-2): a zip of main.xml, the heights as little-endian doubles, row by row from the bottom, and MD5.
    """
    heights = (depth_mm.double() * 1e-3).masked_fill(~contact, math.nan)[0, 0].flip(0).cpu().numpy()  # rows upwards
    rows, columns = heights.shape
    data, pitch_m = heights.astype("<f8").tobytes(), 1e-3 * mm_per_pixel
    xml = X3P_XML.format(
        pitch_m=pitch_m,
        left_m=-0.5 * (columns - 1) * pitch_m,
        bottom_m=-0.5 * (rows - 1) * pitch_m,
        sensor=escape(sensor),
        text=escape(text),
        columns=columns,
        rows=rows,
        md5=hashlib.md5(data, usedforsecurity=False).hexdigest(),
    ).encode()
    sums = f"{hashlib.md5(xml, usedforsecurity=False).hexdigest()} *main.xml\n".encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (("main.xml", xml), ("bindata/data.bin", data), ("md5checksum.hex", sums)):
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)  # without the time of writing
    _write(path, packed.getvalue())


def _write(path: Path, data: bytes) -> None:
    with write_atomically(path) as temporary:
        temporary.write_bytes(data)
