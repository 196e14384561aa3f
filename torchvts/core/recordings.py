"""Reads recordings: an image, a TIFF of several pages, a folder of images, a video; a frame is decoded when it is asked for."""

import re
from collections.abc import Callable, Iterator
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .files import (
    IMAGE_SUFFIXES,
    IN_COLOUR,
    VIDEO_SUFFIXES,
    check_colour,
    check_text_name,
    count_pages,
    read_pixels,
)

Pixels = np.ndarray[Any, Any]

PAGES = 16
"""Pages of a TIFF that are decoded at once."""

ASSUMED_FPS = 30.0
"""Frames a second of images that say nothing of their times."""


class RawFrame(NamedTuple):
    """A frame of a recording, not decoded yet.

    Attributes:
        name: stem of its file; of a video and of a TIFF of several pages with the number of the frame.
        read: decodes it, (H, W, 3) B, G, R, uint8 or uint16; raises OSError or ValueError. Of a video only before the next is asked
            for.
    """

    name: str
    read: Callable[[], Pixels]


def raw_frames(source: str | Path) -> Iterator[RawFrame]:
    """The frames of an image, a TIFF of several pages, a folder of images (1, 2, 10) or a video, in order.

    Raises:
        FileNotFoundError: no such file or folder.
        ValueError: a folder without images; while frames are asked for: a video that gives none.
    """
    path = Path(source)
    if path.is_dir():
        files = image_files(path)
        if not files:
            known = ", ".join(IMAGE_SUFFIXES)
            raise ValueError(f"source: expected a folder of images ({known}), got {path}: no images in this folder")
        return (frame for file in files for frame in _of_file(file))
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file or folder")
    return _of_file(path)


def _of_file(path: Path) -> Iterator[RawFrame]:
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _of_video(path)
    if (count := count_pages(path)) > 1:
        return _of_pages(path, count)
    return iter([RawFrame(path.stem, lambda: read_pixels(path))])


def _of_video(path: Path) -> Iterator[RawFrame]:
    capture, number = open_video(path), 0

    def read() -> Pixels:
        there, pixels = capture.retrieve()
        if not there:
            raise ValueError(f"{path}: frame {number} cannot be decoded")
        return pixels  # type: ignore[no-any-return]

    try:
        while capture.grab():
            yield RawFrame(f"{path.stem}_{number:06d}", read)
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise ValueError(f"{path}: not a video, or cut short: no frame could be read")


def _of_pages(path: Path, count: int) -> Iterator[RawFrame]:
    import cv2

    data = np.fromfile(path, np.uint8)
    pages: list[Pixels] = []
    for number in range(count):
        if number % PAGES == 0:
            pages = list(cv2.imdecodemulti(data, IN_COLOUR, range=(number, min(number + PAGES, count)))[1])
        if number % PAGES >= len(pages):
            return  # cut short
        yield RawFrame(f"{path.stem}_{number:06d}", partial(check_colour, pages[number % PAGES], path))


def is_film(path: Path) -> bool:
    """Whether a file has frames with numbers: a video, or a TIFF of several pages."""
    return path.suffix.lower() in VIDEO_SUFFIXES or count_pages(path) > 1


def natural_order(name: str) -> tuple[list[str | Decimal], str]:
    """Key that sorts names with their numbers as numbers, decimals of times too.

    Example:
        >>> sorted(["10.png", "2.png", "1.25.png", "1.5.png"], key=natural_order)
        ['1.25.png', '1.5.png', '2.png', '10.png']
    """
    parts = re.split(r"([0-9]+(?:\.[0-9]+)?)", name)
    return [Decimal(part) if k % 2 else part for k, part in enumerate(parts)], name


def image_files(folder: Path) -> list[Path]:
    """Images of a folder in :func:`natural_order`, without hidden ones, which a killed writer may leave."""
    files = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return sorted(files, key=lambda p: natural_order(p.name))


def count_frames(source: str | Path) -> int:
    """Number of frames that :func:`raw_frames` will give, for progress bars; of a video the number in its header."""
    import cv2

    path = Path(source)
    if path.is_dir():
        return sum(count_frames(file) for file in image_files(path))
    if path.suffix.lower() in VIDEO_SUFFIXES:
        try:
            return max(0, int(open_video(path).get(cv2.CAP_PROP_FRAME_COUNT)))
        except ValueError:  # its name
            return 1
    return count_pages(path)


def cut_short(path: Path, count: int) -> str:
    """What to say of a film of which fewer frames could be read than its header announces; "" where it is whole.

    Containers that hold no number give one by length and rate, which is some frames off.
    """
    announced = count_frames(path)
    least = 0.9 * announced - 1 if path.suffix.lower() in VIDEO_SUFFIXES else announced
    return f"cut short? it announces {announced} frames, {count} could be read" if count < least else ""


def open_video(path: Path) -> Any:
    """OpenCV's capture of a video file, which may not be opened.

    Raises:
        ValueError: the name is not UTF-8.
    """
    import cv2

    return cv2.VideoCapture(check_text_name("video", path))


def frames_a_second(capture: Any) -> float:
    """Rate of an OpenCV capture; :data:`ASSUMED_FPS` where it does not know."""
    import cv2

    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if 0.5 <= fps <= 1000.0 else ASSUMED_FPS


def video_rate(path: Path) -> float:
    """:func:`frames_a_second` of a video file; :data:`ASSUMED_FPS` of others."""
    if path.is_dir() or path.suffix.lower() not in VIDEO_SUFFIXES:
        return ASSUMED_FPS
    capture = open_video(path)
    try:
        return frames_a_second(capture)
    finally:
        capture.release()


CODECS = {
    **dict.fromkeys(("FMP4", "mp4v", "XVID", "DIVX", "DX50", "MP42", "MP43"), "MPEG-4"),
    **dict.fromkeys(("h264", "H264", "avc1", "X264"), "H.264"),
    **dict.fromkeys(("hevc", "HEVC", "hvc1", "hev1"), "H.265"),
    **dict.fromkeys(("MJPG", "mjpg"), "Motion JPEG"),
    **dict.fromkeys(("FFV1", "HFYU", "FFVH", "MPNG", "png ", "I420", "YUY2", "YUYV", "\0\0\0\0"), ""),
}
"""OpenCV's codes of codecs, and the names of those that lose something; others are shown by their code."""


def lossy_codec(capture: Any) -> str:
    """Name of the codec of an OpenCV capture; empty where it loses nothing, or is not known."""
    import cv2

    code = int(capture.get(cv2.CAP_PROP_FOURCC))
    letters = max(code, 0).to_bytes(8, "little")[:4].decode("latin-1")
    return CODECS.get(letters, letters)


def video_codec(path: Path) -> str:
    """:func:`lossy_codec` of a video file; "JPEG" of such an image or a folder of them."""
    if path.suffix.lower() in VIDEO_SUFFIXES and not path.is_dir():
        capture = open_video(path)
        try:
            return lossy_codec(capture)
        finally:
            capture.release()
    first = next(iter(image_files(path)), path) if path.is_dir() else path
    return "JPEG" if first.suffix.lower() in (".jpg", ".jpeg") else ""
