"""Reads recordings: images, folders of them, TIFFs of several pages, videos, containers; frames are decoded when asked for."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .containers import find_container, open_film
from .files import IMAGE_SUFFIXES, IN_COLOUR, VIDEO_SUFFIXES, Pixels, check_colour, count_pages, natural_order, read_pixels
from .videos import ASSUMED_FPS, frames_a_second, open_video, video_reads

PAGES = 16
"""Pages of a TIFF that are decoded at once."""


class RawFrame(NamedTuple):
    """A frame of a recording, not decoded yet; of a video it must be decoded before the next is asked for."""

    name: str  # stem of its file; of a video and of a TIFF of several pages with the number of the frame
    read: Callable[[], Pixels]  # decodes it, or raises OSError or ValueError


def raw_frames(source: str | Path) -> Iterator[RawFrame]:
    """The frames of an image, a TIFF of several pages, a folder of images (1, 2, 10), a video or a container, in order.

    What can be seen without decoding is refused at once; a video that gives no frame only while frames are asked for.
    """
    path = Path(source)
    if (film := open_film(path)) is not None:
        return _numbered(path, film.reads())
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
        return _numbered(path, video_reads(path))
    if (count := count_pages(path)) > 1:
        return _numbered(path, _of_pages(path, count))
    return iter([RawFrame(path.stem, lambda: read_pixels(path))])


def _numbered(path: Path, reads: Iterable[Callable[[], Pixels]]) -> Iterator[RawFrame]:
    return (RawFrame(f"{path.stem}_{number:06d}", read) for number, read in enumerate(reads))


def _of_pages(path: Path, count: int) -> Iterator[Callable[[], Pixels]]:
    import cv2

    data = np.fromfile(path, np.uint8)
    pages: list[Pixels] = []
    for number in range(count):
        if number % PAGES == 0:
            pages = list(cv2.imdecodemulti(data, IN_COLOUR, range=(number, min(number + PAGES, count)))[1])
        if number % PAGES >= len(pages):
            return  # cut short
        yield partial(check_colour, pages[number % PAGES], path)


def is_film(path: Path) -> bool:
    """Whether a path names frames with numbers: a video, a TIFF of several pages, or a recording in a container."""
    return path.suffix.lower() in VIDEO_SUFFIXES or count_pages(path) > 1 or find_container(path) is not None


def image_files(folder: Path) -> list[Path]:
    """Images of a folder in :func:`natural_order`, without hidden ones, which a killed writer may leave."""
    files = (p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith("."))
    return sorted(files, key=lambda p: natural_order(p.name))


def count_frames(source: str | Path) -> int:
    """Number of frames that :func:`raw_frames` will give, for progress bars; of a video the number in its header."""
    import cv2

    path = Path(source)
    if (film := open_film(path)) is not None:
        return film.length
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


def video_rate(path: Path) -> float:
    """:func:`frames_a_second` of a video file; :data:`ASSUMED_FPS` of others."""
    if path.is_dir() or path.suffix.lower() not in VIDEO_SUFFIXES:
        return ASSUMED_FPS
    capture = open_video(path)
    try:
        return frames_a_second(capture)
    finally:
        capture.release()
