"""Video files by OpenCV: their frames in order, and their rate."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .files import Pixels, check_text_name

ASSUMED_FPS = 30.0
"""Frames a second of images that say nothing of their times."""


def open_video(path: Path) -> Any:
    """OpenCV's capture of a video file, which may not be opened."""
    import cv2

    return cv2.VideoCapture(check_text_name("video", path))


def video_reads(path: Path) -> Iterator[Callable[[], Pixels]]:
    """Go through the frames of a video, of which there must be one; each is decoded by a call, before the next is asked for."""
    capture, number = open_video(path), 0

    def read() -> Pixels:
        there, pixels = capture.retrieve()
        if not there or pixels is None:  # a frame can be "there" and empty
            raise ValueError(f"{path}: frame {number} cannot be decoded")
        return pixels  # type: ignore[no-any-return]

    try:
        while capture.grab():
            yield read
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise ValueError(f"{path}: not a video, or cut short: no frame could be read")


def frames_a_second(capture: Any) -> float:
    """Rate of an OpenCV capture; :data:`ASSUMED_FPS` where it does not know."""
    import cv2

    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if 0.5 <= fps <= 1000.0 else ASSUMED_FPS
