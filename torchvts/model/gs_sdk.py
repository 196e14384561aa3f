"""Read and write the formats of gs_sdk: calibration folders, height maps, gradients, images (:meth:`Sensor.load`: sensor files).

Only the formats are used, none of gs_sdk's code. Convention of gs_sdk: images are B, G, R uint8 (H, W, 3); the height
map is H = -z / mm_per_pixel, so pixels, negative where the skin is pressed in; gradients are d(H)/dx and d(H)/dy per pixel.
"""

import csv
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..core.checks import brief, check_batch, check_float_tensor, check_path, check_positive, parse_number
from ..core.files import bgr_from_rgb, read_image, rgb_from_bgr
from ..core.recordings import image_files

CATALOG_COLUMNS = ("experiment_reldir", "diameter(mm)")
LABEL_COLUMNS = ("experiment_reldir", "diameter_mm", "center_x_px", "center_y_px", "contact_radius_px")

MOST_TABLE_BYTES = 2**24
"""Limit for tables of presses, which have some kilobytes."""


class GsSdkPress(NamedTuple):
    """One ball pressed on the sensor.

    Attributes:
        name: ``experiment_reldir`` in the catalog.
        image: (3, H, W) in [0, 1], R, G, B, of the background's size.
        ball_diameter_mm: mm.
        center_px: (x, y) of the ball in pixels, from ``label.npz``; None without that file.
        radius_px: radius of the contact in pixels, from ``label.npz``; None without that file.
    """

    name: str
    image: Tensor
    ball_diameter_mm: float
    center_px: tuple[float, float] | None
    radius_px: float | None


def _other_way(folder: Path) -> str:
    """How to calibrate from a folder without a catalog, if it holds images."""
    images = [path.name for path in image_files(folder)]
    if not images:
        return ""
    first = "background.png" if "background.png" in images else images[0]
    return f"; without a catalog, name the images: torchvts calibrate {folder / first} --press IMAGE DIAMETER_MM"


def read_calibration_folder(folder: str | Path) -> tuple[Tensor, list[GsSdkPress]]:
    """Read a calibration folder in gs_sdk's layout.

    The layout: ``catalog.csv`` with the columns ``experiment_reldir,diameter(mm)``, ``background.png``, and for every row
    ``<experiment_reldir>/gelsight.png`` and, once labelled, ``<experiment_reldir>/label.npz`` with ``center`` (x, y) and
    ``radius`` in pixels.

    Args:
        folder: the folder that holds ``catalog.csv``.
    Returns:
        The background (3, H, W) in [0, 1], R, G, B, and the presses in the order of the catalog.
    Raises:
        FileNotFoundError: the folder, the catalog, the background or the image of a press is missing.
        ValueError: an empty catalog, other columns, a bad diameter, a press named twice or outside the folder, an image of
            another size than the background, a damaged label. Names the file and the line.
    Source:
        the folder format of gs_sdk (Huang et al., NormalFlow, RA-L 2024).
    Example:
        >>> read_calibration_folder("no/such/folder")
        Traceback (most recent call last):
        ...
        FileNotFoundError: no/such/folder: no such folder: expected one with catalog.csv and background.png
    """
    folder = check_path("folder", folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder: expected one with catalog.csv and background.png")
    catalog, background_path = folder / "catalog.csv", folder / "background.png"
    for path in (catalog, background_path):
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: no such file: a calibration folder of gs_sdk holds catalog.csv and background.png{_other_way(folder)}"
            )
    background = read_image(background_path)
    presses: list[GsSdkPress] = []
    seen: set[Path] = set()
    for line, row in _read_table(catalog, CATALOG_COLUMNS):
        where = f"{catalog}, line {line}"
        name = row["experiment_reldir"]
        diameter = _number(where, "diameter(mm)", row["diameter(mm)"])
        if not 0.0 < diameter <= 1000.0:
            raise ValueError(f"{where}: diameter(mm): expected a ball's diameter in mm, got {brief(row['diameter(mm)'])}")
        press = _inside(folder, name, where)
        if press in seen:
            raise ValueError(f"{where}: experiment_reldir: {brief(name)} is given twice: remove one of the lines")
        seen.add(press)
        # a link may lead out of the folder as well as a name
        image_path, label_path = (_inside(folder, f"{name}/{file}", where) for file in ("gelsight.png", "label.npz"))
        image = read_image(image_path)
        if image.shape != background.shape:
            (height, width), (expected_height, expected_width) = image.shape[1:], background.shape[1:]
            raise ValueError(
                f"{image_path}: expected {expected_height} x {expected_width} like background.png, got {height} x {width}: "
                "both must come from the same sensor settings"
            )
        center, radius = _read_label(label_path) if label_path.is_file() else (None, None)
        presses.append(GsSdkPress(name, image, diameter, center, radius))
    return background, presses


def read_labels(folder: str | Path) -> dict[str, tuple[float, float, float | None]]:
    """Read ``labels.csv`` of a folder: for every press the ball's centre and the radius of its contact.

    Args:
        folder: the folder that holds ``labels.csv``, with the columns ``experiment_reldir,diameter_mm,center_x_px,
            center_y_px,contact_radius_px``; the last may be empty.
    Returns:
        {experiment_reldir: (x, y, radius or None)}, pixels.
    Raises:
        FileNotFoundError: no such file.
        ValueError: empty, other columns, a bad number, a press named twice.
    """
    path = check_path("folder", folder) / "labels.csv"
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file: expected a table of {','.join(LABEL_COLUMNS)}")
    labels: dict[str, tuple[float, float, float | None]] = {}
    for line, row in _read_table(path, LABEL_COLUMNS):
        where = f"{path}, line {line}"
        name, text = row["experiment_reldir"], row["contact_radius_px"]
        if name in labels:
            raise ValueError(f"{where}: experiment_reldir: {brief(name)} is given twice: remove one of the lines")
        radius = _number(where, "contact_radius_px", text) if text else None
        if radius is not None and radius <= 0.0:
            raise ValueError(f"{where}: contact_radius_px: expected a number above 0, or nothing, got {brief(text)}")
        x, y = (_number(where, column, row[column]) for column in ("center_x_px", "center_y_px"))
        labels[name] = (x, y, radius)
    return labels


def depth_from_height_map(height_map_px: Tensor | np.ndarray[Any, Any], mm_per_pixel: float) -> Tensor:
    """Depth from gs_sdk's height map: z = -H * mm_per_pixel.

    Args:
        height_map_px: (H, W), pixels, negative where the skin is pressed in; floating point.
        mm_per_pixel: pixel pitch, mm (gs_sdk's ``ppmm``).
    Returns:
        (1, 1, H, W), mm, positive where the skin is pressed in; float32 or float64 as given.
    Raises:
        ValueError, TypeError: names the argument.
    Example:
        >>> depth_from_height_map(np.full((2, 2), -20.0), 0.05)[0, 0, 0]
        tensor([1., 1.], dtype=torch.float64)
    """
    pitch = check_positive("mm_per_pixel", mm_per_pixel)
    return (0.0 - _map("height_map_px", height_map_px) * pitch)[None, None]  # 0 - H, so that 0 does not become -0


def height_map_from_depth(depth_mm: Tensor, mm_per_pixel: float) -> np.ndarray[Any, Any]:
    """gs_sdk's height map from a depth: H = -z / mm_per_pixel; the inverse of :func:`depth_from_height_map`.

    Args:
        depth_mm: (1, 1, H, W), mm.
        mm_per_pixel: pixel pitch, mm.
    Returns:
        numpy, (H, W), pixels.
    Raises:
        ValueError, TypeError: names the argument.
    """
    pitch = check_positive("mm_per_pixel", mm_per_pixel)
    frame = _frame("depth_mm", depth_mm, 1)[0]
    return np.asarray((0.0 - frame / pitch).numpy())


def gradient_from_gs_sdk(gx: Tensor | np.ndarray[Any, Any], gy: Tensor | np.ndarray[Any, Any]) -> Tensor:
    """Gradient of depth from gs_sdk's gradients of the height map: dz/dx = -d(H)/dx, since pixels cancel.

    Args:
        gx: (H, W), d(H)/dx, pixels per pixel.
        gy: (H, W), d(H)/dy, pixels per pixel.
    Returns:
        (1, 2, H, W), (dz/dx, dz/dy), mm per mm.
    Raises:
        ValueError, TypeError: names the argument.
    Example:
        >>> gradient_from_gs_sdk(np.full((1, 1), 0.5), np.zeros((1, 1))).flatten()
        tensor([-0.5000,  0.0000], dtype=torch.float64)
    """
    x, y = _map("gx", gx), _map("gy", gy)
    if x.shape != y.shape:
        raise ValueError(f"gy: expected {tuple(x.shape)} like gx, got {tuple(y.shape)}: both must come from one image")
    return 0.0 - torch.stack((x, y))[None]


def gradient_to_gs_sdk(gradient: Tensor) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """gs_sdk's gradients from a gradient of depth; the inverse of :func:`gradient_from_gs_sdk`.

    Args:
        gradient: (1, 2, H, W), (dz/dx, dz/dy), mm per mm.
    Returns:
        d(H)/dx and d(H)/dy, numpy, (H, W) each, pixels per pixel.
    Raises:
        ValueError, TypeError: names the argument.
    """
    turned = 0.0 - _frame("gradient", gradient, 2)
    return np.asarray(turned[0].numpy()), np.asarray(turned[1].numpy())


def image_from_bgr(pixels: np.ndarray[Any, Any]) -> Tensor:
    """Convert an image of gs_sdk or OpenCV.

    Args:
        pixels: (H, W, 3) uint8 or uint16, **B, G, R**.
    Returns:
        (3, H, W) float32 in [0, 1], **R, G, B**.
    Raises:
        ValueError, TypeError: names the argument.
    Example:
        >>> image_from_bgr(np.array([[[0, 51, 255]]], dtype=np.uint8)).flatten()
        tensor([1.0000, 0.2000, 0.0000])
    """
    return rgb_from_bgr(pixels)


def image_to_bgr(image: Tensor) -> np.ndarray[Any, Any]:
    """Convert an image for gs_sdk or OpenCV.

    Args:
        image: (3, H, W), floating point in [0, 1], **R, G, B**.
    Returns:
        (H, W, 3) uint8, **B, G, R**, rounded and clamped to 0-255.
    Raises:
        ValueError, TypeError: names the argument.
    """
    return bgr_from_rgb(image)


def _map(name: str, values: Tensor | np.ndarray[Any, Any]) -> Tensor:
    if not isinstance(values, Tensor | np.ndarray):
        raise TypeError(f"{name}: expected an array or a tensor, got {type(values).__name__}: gs_sdk's maps are float32 arrays")
    tensor = values if isinstance(values, Tensor) else torch.from_numpy(np.ascontiguousarray(values))
    if tensor.dim() != 2:
        raise ValueError(f"{name}: expected (H, W), got {tuple(tensor.shape)}: gs_sdk's maps have no batch and no channel")
    check_float_tensor(name, tensor)
    return tensor


def _frame(name: str, tensor: Tensor, channels: int) -> Tensor:
    check_batch(name, tensor, channels)
    if tensor.shape[0] != 1:
        raise ValueError(f"{name}: expected one frame, (1, {channels}, H, W), got {tuple(tensor.shape)}: loop over the batch")
    return tensor[0].detach().cpu()


def _read_table(path: Path, columns: tuple[str, ...]) -> list[tuple[int, dict[str, str]]]:
    """Rows of a CSV file with exactly these columns, each with its line number; empty lines are skipped."""
    if path.stat().st_size > MOST_TABLE_BYTES:
        raise ValueError(
            f"{path}: expected a table of at most {MOST_TABLE_BYTES} bytes, got {path.stat().st_size}: not a CSV table"
        )
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.reader(stream, strict=True)
            lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(cell.strip() for cell in row)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: not a CSV table: {error}") from error
    expected = ",".join(columns)
    if not lines:
        raise ValueError(f"{path}: empty: expected the line {expected} and one line for every press")
    header = lines[0][1]
    if sorted(header) != sorted(columns):
        cause = "write commas, and decimal points" if ";" in header[0] else "is it a table of another tool?"
        raise ValueError(f"{path}: expected the columns {expected}, got {','.join(header)}: {cause}")
    if len(lines) == 1:
        raise ValueError(f"{path}: no presses: expected one line for every press below {expected}")
    for line, cells in lines[1:]:
        if len(cells) != len(columns):
            raise ValueError(f"{path}, line {line}: expected {len(columns)} values, got {len(cells)}: {brief(','.join(cells))}")
        if not cells[header.index("experiment_reldir")]:
            raise ValueError(f"{path}, line {line}: experiment_reldir: expected the folder of the press, got nothing")
    return [(line, dict(zip(header, cells))) for line, cells in lines[1:]]


def _number(where: str, column: str, text: str) -> float:
    try:
        return parse_number(text)
    except ValueError as error:
        raise ValueError(f"{where}: {column}: {error}") from error


def _inside(folder: Path, name: str, where: str) -> Path:
    """``folder / name``, or raise if that is outside of the folder: a foreign catalog may name any file."""
    root = folder.resolve()
    path = root if "\0" in name else (root / name.replace("\\", "/")).resolve()  # a catalog written on Windows
    if path == root or not path.is_relative_to(root):
        raise ValueError(f"{where}: experiment_reldir: expected a folder inside {folder}, got {brief(name)}, which is not")
    return path


def _read_label(path: Path) -> tuple[tuple[float, float], float]:
    try:
        with zipfile.ZipFile(path) as archive:
            if max((entry.file_size for entry in archive.infolist()), default=0) > 65536:
                raise ValueError("its arrays are larger than a centre and a radius")
        with np.load(path, allow_pickle=False) as stored:
            center = np.asarray(stored["center"], dtype=np.float64).ravel()
            radius = np.asarray(stored["radius"], dtype=np.float64).ravel()
    except KeyError as error:
        raise ValueError(f"{path}: expected the arrays 'center' and 'radius', one is missing: {error}") from error
    except Exception as error:  # a damaged file may fail anywhere in the readers of zip and npy
        raise ValueError(f"{path}: not a label of gs_sdk, or cut short: {error}") from error
    if center.shape != (2,) or radius.shape != (1,):
        raise ValueError(f"{path}: expected center (x, y) and one radius, got shapes {center.shape} and {radius.shape}")
    if not (np.isfinite(center).all() and np.isfinite(radius).all() and radius[0] > 0):
        raise ValueError(f"{path}: expected finite pixels and a radius above 0, got {center.tolist()} and {radius.tolist()}")
    return (float(center[0]), float(center[1])), float(radius[0])
