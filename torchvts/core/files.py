"""Reads and writes images, videos, depth and tensors: errors name the file, files are written whole or not at all."""

import errno
import hashlib
import json
import os
import re
import secrets
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from torch import Tensor

from .checks import MOST_PIXELS, check_field, check_path

Pixels = np.ndarray[Any, Any]
"""OpenCV's image, (H, W, 3) B, G, R, uint8 or uint16."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
PAGED_SUFFIXES = (".tif", ".tiff")
VIDEO_SUFFIXES = (".avi", ".mp4", ".mov", ".mkv", ".webm")

REMEDIES = {
    ".db3": "name the folder of the bag, which has its metadata.yaml",
    ".parquet": "name the folder of the LeRobot data set",
    ".npz": "name one array: numpy.save(name, images), (T, H, W, 3), R, G, B",
    ".pkl": "it can run any program when it is opened: save its images by numpy.save, (T, H, W, 3), R, G, B",
    ".gz": "unpack it first",
    ".tgz": "unpack it first",
    ".rrd": "rerun keeps it for showing: give the camera's recording",
}
"""What helps with files that are not read, by suffix."""

IN_COLOUR = 6
"""OpenCV's IMREAD_ANYDEPTH | IMREAD_ANYCOLOR: grey stays grey, 16 bits stay 16, and an image that its EXIF tag turns is turned."""

MOST_OF_12_BITS = 4095
"""An image of 16 bits whose values stay below this is black, or of 12 bits."""

MOST_BYTES = 2**31
"""A larger file of an image, of tensors or of points is not read."""


def check_size(path: Path, kind: str) -> None:
    """Raise ValueError where a file is larger than :data:`MOST_BYTES`, and so no file of the kind."""
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ValueError(f"{path}: expected {kind} of at most {MOST_BYTES} bytes, got {size}: another file?")


def check_target(path: str | Path) -> Path:
    """Return a path at which a file can be written, or raise: asked before the work that leads to it."""
    path = check_path("path", path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: folder {path.parent} does not exist: make it first")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected the name of a file, got a folder")
    return path


def check_folder(path: str | Path) -> Path:
    """Return the path of a folder for results, which need not exist, or raise where a file has its name, or one above it."""
    path = check_path("path", path)
    taken = next((folder for folder in (path, *path.parents) if folder.exists()), path)
    if taken.exists() and not taken.is_dir():
        raise NotADirectoryError(f"{taken}: expected the name of a folder for the results, got that of a file")
    return path


def make_folder(path: str | Path) -> Path:
    """Make a folder for results, with those above it, where it is missing; raises as :func:`check_folder`."""
    path = check_folder(path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def check_text_name(name: str, path: str | Path) -> str:
    """Return a path as text for OpenCV, which crashes on names that are not UTF-8, or raise ValueError."""
    text = str(path)
    try:
        text.encode()
    except UnicodeEncodeError:
        raise ValueError(f"{name}: expected a name in UTF-8, which OpenCV needs, got {text!a}: rename it") from None
    return text


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Let errors of the block name the file that was to be written, as those of a full disk do not by themselves."""
    try:
        yield
    except OSError as error:
        if str(path) in str(error) or (error.filename is not None and error.errno not in _DISK):
            raise
        renamed = type(error)(f"{path}: cannot be written: {error.strerror or error}")
        renamed.errno = error.errno
        raise renamed from error


_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
"""The disk is full, a quota is used up, a limit of size is reached, the device fails, or may only be read."""


@contextmanager
def write_atomically(path: str | Path) -> Iterator[Path]:
    """Give a temporary file beside ``path``; it replaces ``path`` when the block ends without an error, and is removed otherwise.

    The temporary file keeps the suffix, because some writers look at it. A process that is killed in between leaves the old
    file as it was and a hidden ``.stem-xxxxxxxx.suffix`` beside it, which nothing reads. Errors name the file.
    """
    path = check_target(path)
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        temporary.open("xb").close()  # not by tempfile, whose files are private; reading the umask is not safe in threads
    except OSError as error:
        raise type(error)(f"{path}: cannot write into {path.parent}: {error.strerror}") from error
    try:
        with naming(path):
            yield temporary
            with temporary.open("rb") as stream:
                os.fsync(stream.fileno())
            if path.exists():
                temporary.chmod(path.stat().st_mode & 0o777)
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def natural_order(name: str) -> tuple[list[str | Decimal], str]:
    """Key that sorts names with their numbers as numbers, decimals of times too: 1.25, 1.5, 2, 10."""
    parts = re.split(r"([0-9]+(?:\.[0-9]+)?)", name)
    return [Decimal(part) if k % 2 else part for k, part in enumerate(parts)], name


def image_path(path: str | Path) -> Path:
    """The path of a file to read, or FileNotFoundError."""
    path = check_path("path", path)
    if path.is_dir():
        raise FileNotFoundError(f"{path}: expected an image, got a folder: name one of its files")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    return path


def read_image(path: str | Path) -> Tensor:
    """Read an image file as (3, H, W) float32 in [0, 1], channels R, G, B; 8 and 16 bits.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not an image, not in colour, or several: an animation, a TIFF of several pages.
    """
    return rgb_from_bgr(read_pixels(path))


def read_pixels(path: str | Path) -> Pixels:
    """Read an image file as OpenCV gives it, (H, W, 3) B, G, R, 8 or 16 bits; raises as :func:`read_image`."""
    path = image_path(path)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        raise ValueError(
            f"{path}: expected an image, got a video: torchvts.stream.read_background([path], sensor) makes a background of its "
            "first frames, torchvts reconstruct takes all of them"
        )
    if path.suffix.lower() in REMEDIES:
        raise ValueError(f"{path}: expected an image or a recording: {REMEDIES[path.suffix.lower()]}")
    with path.open("rb") as stream:
        check_still_head(stream.read(64), path)
    if (count := count_pages(path)) > 1:
        raise ValueError(f"{path}: expected one image, got a TIFF of {count} pages: vts.frames and torchvts reconstruct take all")
    return check_colour(decode_image(path, IN_COLOUR), path)


def check_still_head(head: bytes, path: Path) -> None:
    """Refuse by the first 64 bytes of an encoded image what has a palette or is an animation."""
    remedy = "save frames as PNG in true colour, as a TIFF of several pages or as a video without loss"
    indexed = {"a GIF": head[:4] == b"GIF8", "a PNG with a palette": head[12:16] == b"IHDR" and head[25:26] == b"\3"}
    indexed["a BMP with a palette"] = head[:2] == b"BM" and 0 < int.from_bytes(head[28:30], "little") <= 8
    for kind, is_it in indexed.items():
        if is_it:
            raise ValueError(f"{path}: expected an image of 8 bits a channel, got {kind}, which keeps 256 colours: {remedy}")
    if (head[8:16] == b"WEBPVP8X" and int.from_bytes(head[20:21], "big") & 2) or b"acTL" in head:
        raise ValueError(f"{path}: expected one image, got an animation: {remedy}")


def count_pages(path: Path) -> int:
    """Number of pages of a TIFF, of which the last may be cut short; 1 for other files."""
    import cv2

    if path.suffix.lower() not in PAGED_SUFFIXES or not path.is_file():
        return 1
    return max(1, cv2.imcount(check_text_name("path", path)))


def check_colour(pixels: Pixels | None, path: Path) -> Pixels:
    """The colours of a decoded image (H, W, 3 or 4), B, G, R; raises also where :func:`whole_levels` does."""
    if pixels is None:
        raise ValueError(f"{path}: not an image, or cut short")
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise ValueError(f"{path}: expected a colour image, got one of shape {pixels.shape}: three lights need three channels")
    return whole_levels(pixels[:, :, :3], path)


def whole_levels(pixels: np.ndarray[Any, Any], path: Path) -> Pixels:
    """The values of an image in 8 or 16 bits; floats in [0, 1] or [0, 255] become 8 bits where these are exact, else 16.

    Of 16 bits so dark that only 8, 10 or 12 of them seem used the scale cannot be known.
    """
    most = int(pixels.max(initial=0)) if pixels.dtype == np.uint16 else MOST_OF_12_BITS + 1
    if most <= MOST_OF_12_BITS:
        raise ValueError(
            f"{path}: expected 16 bits that reach beyond {MOST_OF_12_BITS}, got at most {most}: 8, 10 or 12 bits stored in 16? "
            "multiply them by 257, 64 or 16; or it is black"
        )
    if pixels.dtype.kind == "f":
        low, high = float(pixels.min(initial=np.inf)), float(pixels.max(initial=0.0))
        if not 0.0 <= low <= high <= 255.0:  # nor where one is no number
            raise ValueError(f"{path}: expected values in [0, 1] or [0, 255], got {low:.4g} to {high:.4g}: scale them before")
        levels = pixels.astype(np.float64) * (255.0 if high <= 1.0 else 1.0)
        whole = np.rint(levels)
        return whole.astype(np.uint8) if np.abs(levels - whole).max() < 1e-3 else np.rint(257.0 * levels).astype(np.uint16)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise ValueError(f"{path}: expected 8 or 16 bits per channel, got {pixels.dtype}")
    return pixels


def decode_image(path: Path, flags: int) -> Pixels | None:
    """An image file as OpenCV decodes it; None if it does not. Raises where it is larger than :data:`MOST_BYTES`."""
    check_size(path, "an image")
    data = np.fromfile(path, dtype=np.uint8)
    return decode_bytes(data, flags, str(path)) if len(data) else None


def decode_bytes(data: np.ndarray[Any, Any], flags: int, source: str) -> Pixels | None:
    """:func:`decode_image` for bytes in memory; refuses a PNG whose header gives too many pixels, as a small file can."""
    import cv2

    height, width = png_size(data[:24].tobytes()) or (0, 0)
    if width * height > MOST_PIXELS:
        raise ValueError(f"{source}: expected an image of at most {MOST_PIXELS} pixels, got one that says {height} x {width}")
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:  # damaged, or larger than OpenCV reads
        return None


def png_size(head: bytes) -> tuple[int, int] | None:
    """Height and width in the first 24 bytes of a PNG file; None for anything else."""
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    return height, width


def check_pixels(name: str, pixels: object) -> None:
    """Raise unless ``pixels`` is an array (H, W, 3) of 8 or 16 bits, unsigned: only then is its largest value known."""
    if not isinstance(pixels, np.ndarray) or pixels.dtype.kind != "u" or pixels.dtype.itemsize > 2:
        kind = f"an array of {pixels.dtype}" if isinstance(pixels, np.ndarray) else type(pixels).__name__
        raise TypeError(f"{name}: expected an array of uint8 or uint16, got {kind}: pixels.astype(np.uint8) of values 0 to 255")
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
        cause = "channels stand first: an image of torchvts already?" if pixels.shape[:1] == (3,) else "not in colour?"
        raise ValueError(f"{name}: expected (H, W, 3), B, G, R, got {pixels.shape}: {cause}")


def rgb_from_bgr(pixels: Pixels) -> Tensor:
    """OpenCV's (H, W, 3) B, G, R integers of 8 or 16 bits as (3, H, W) float32 in [0, 1], R, G, B."""
    check_pixels("pixels", pixels)
    scale, planes = np.float32(np.iinfo(pixels.dtype).max), pixels[:, :, ::-1].transpose(2, 0, 1)
    return torch.from_numpy(np.divide(planes, scale, out=np.empty(planes.shape, np.float32), dtype=np.float32))


def write_image(path: str | Path, image: Tensor) -> None:
    """Write (3, H, W) R, G, B in [0, 1] as an 8-bit image file.

    Raises:
        ValueError: another shape, or a suffix that is no image's.
    """
    write_pixels(check_path("path", path), bgr_from_rgb(image))


def bgr_from_rgb(image: Tensor) -> Pixels:
    """(3, H, W) R, G, B in [0, 1] as OpenCV's (H, W, 3) B, G, R in 8 bits."""
    check_field("image", image)
    levels = torch.round(image.detach().clamp(0, 1) * 255).to(torch.uint8).cpu()
    return np.ascontiguousarray(levels.flip(0).permute(1, 2, 0).numpy())


def image_to_bytes(image: Tensor) -> Tensor:
    """(3, H, W) R, G, B in [0, 1] as the bytes of a PNG, (N,) uint8: with 8 bits where they are exact, else with 16."""
    import cv2

    levels = image.detach().cpu().double() * 255.0
    depth = np.uint8 if bool((levels - levels.round()).abs().max() < 1e-3) else np.uint16
    pixels = torch.round(image.detach().cpu().double() * float(np.iinfo(depth).max)).flip(0).permute(1, 2, 0).numpy().astype(depth)
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not done:
        raise OSError("OpenCV could not encode the image as PNG")
    return torch.from_numpy(data.reshape(-1).copy())


def image_from_bytes(data: Tensor, size: tuple[int, int], source: str) -> Tensor:
    """Read what :func:`image_to_bytes` gave, (3, H, W) float64, or raise; the size is compared with the header before decoding."""
    import cv2

    raw = data.numpy() if data.dtype == torch.uint8 and data.dim() == 1 else np.zeros(0, np.uint8)
    claimed = png_size(raw[:24].tobytes())
    if claimed is None:
        raise ValueError(f"{source}: expected the bytes of a PNG")
    pixels = decode_bytes(raw, cv2.IMREAD_UNCHANGED, source) if claimed == size else None
    if pixels is None or pixels.shape != (*size, 3) or pixels.dtype not in (np.uint8, np.uint16):
        says = f"{claimed[0]} x {claimed[1]}"
        raise ValueError(f"{source}: expected a whole colour PNG of {size[0]} x {size[1]}, got one that says {says}")
    levels: Tensor = torch.from_numpy(np.ascontiguousarray(pixels[:, :, ::-1].transpose(2, 0, 1)).astype(np.float64))
    return levels / (255.0 if pixels.dtype == np.uint8 else 65535.0)


DEPTH_PNG_STEP_MM = 0.0001
DEPTH_PNG_ZERO = 32768


def write_depth_png(path: str | Path, depth_mm: Tensor) -> None:
    """Write depth of one frame as a 16-bit PNG: value = 32768 + depth / 0.0001 mm, so from -3.2768 to 3.2767 mm, or raise."""
    frame = depth_mm.detach().cpu().double().reshape(depth_mm.shape[-2], depth_mm.shape[-1])
    value = torch.round(frame / DEPTH_PNG_STEP_MM) + DEPTH_PNG_ZERO
    if not bool(torch.isfinite(frame).all()) or float(value.min()) < 0 or float(value.max()) > 65535:
        raise ValueError(
            "depth_mm: expected finite values in [-3.2768, 3.2767] mm for a PNG, "
            f"got [{frame.min():.4g}, {frame.max():.4g}]: write .npy, or ask vts.diagnose what is wrong with the frame"
        )
    write_pixels(Path(path), value.numpy().astype(np.uint16))


def read_depth_png(path: str | Path) -> Tensor:
    """Read what :func:`write_depth_png` wrote: (1, 1, H, W), mm."""
    import cv2

    path = image_path(path)
    pixels = decode_image(path, cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 2:
        raise ValueError(f"{path}: expected a 16-bit grey PNG with depth")
    return (torch.from_numpy(pixels.astype(np.float32)) - DEPTH_PNG_ZERO)[None, None] * DEPTH_PNG_STEP_MM


def write_pixels(path: Path, pixels: Pixels) -> None:
    """Write what :func:`read_pixels` reads, or one channel, (H, W)."""
    import cv2

    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise ValueError(f"{path}: expected a name ending in {', '.join(IMAGE_SUFFIXES)}, got {path.suffix!r}")
    done, data = cv2.imencode(path.suffix.lower(), pixels)  # the bytes are written here: names need not be UTF-8
    if not done:
        raise OSError(f"{path}: OpenCV could not encode it")
    with write_atomically(path) as temporary:
        temporary.write_bytes(data.tobytes())


def save_tensors(path: str | Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors and JSON metadata as one safetensors file with a checksum of both, whole or not at all."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    described = json.dumps({**metadata, "checksum": checksum(plain, metadata)}, allow_nan=False)
    with write_atomically(path) as temporary:
        temporary.write_bytes(safetensors.torch.save(plain, {"torchvts": described}))


def checksum(tensors: dict[str, Tensor], metadata: dict[str, Any]) -> str:
    """SHA-256 of the names, types, shapes and bytes of tensors, and of the metadata."""
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        digest.update(f"{name} {tensor.dtype} {list(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b"")
    return digest.hexdigest()


def load_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what :func:`save_tensors` wrote, or raise where it is damaged or another file. Nothing is unpickled."""
    path = check_path("path", path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    check_size(path, "a safetensors file of torchvts")
    content = path.read_bytes()  # read here: safetensors opens no names that are not UTF-8
    try:
        tensors = safetensors.torch.load(content)
        (length,) = struct.unpack("<Q", content[:8])
        metadata = json.loads(content[8 : 8 + length]).get("__metadata__") or {}
    except Exception as error:  # a damaged file may fail anywhere in the readers of safetensors and JSON
        raise ValueError(f"{path}: not a safetensors file, or cut short: {error}") from error
    if "torchvts" not in metadata:
        raise ValueError(f"{path}: a safetensors file, but not one written by torchvts")
    try:
        described = dict(json.loads(metadata["torchvts"]))
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: its metadata is damaged: {error}") from error
    given = described.pop("checksum", None)
    if given is None:
        raise ValueError(f"{path}: it has no checksum: written by another torchvts; make it again")
    if given != checksum(tensors, described):
        raise ValueError(f"{path}: damaged: its content is not what the checksum says; copy it again, or make it again")
    return tensors, described
