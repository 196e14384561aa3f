"""Writes videos whole or not at all, in a thread of their own."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ..core.checks import check_path, check_positive
from ..core.files import Pixels, check_text_name, write_atomically
from ..core.videos import open_video

CODES = {".webm": "VP80", ".mp4": "mp4v", ".avi": "MJPG", ".mkv": "FFV1"}
"""Suffixes of the videos that can be written, and OpenCV's code for each."""

MOST_WAITING = 8
"""So many pictures wait to be written before who brings more waits."""


class InTurn:
    """Calls functions in a thread of its own, one after the other; who brings too many at once waits."""

    def __init__(self) -> None:
        self._pool, self._waiting = ThreadPoolExecutor(1), deque[Future[Any]]()

    def submit(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Call it later; raises what an earlier call raised."""
        self._waiting.append(self._pool.submit(function, *arguments))
        while len(self._waiting) > MOST_WAITING:
            self._waiting.popleft().result()

    def finish(self) -> None:
        """Wait for all calls; raises what one of them raised."""
        self._pool.shutdown()
        while self._waiting:
            self._waiting.popleft().result()


class VideoFile:
    """Writes a video whole or not at all: under a temporary name, renamed when the block ends and all frames can be read back.

    OpenCV reports no error of a write, as on a full disk. A thread encodes while the next frame is worked on.

    Args:
        path: .webm (VP8, which browsers play), .mp4 (MPEG-4 part 2), .avi (MJPG) or .mkv (FFV1, which loses nothing
            of an even size).
        fps: frames a second.
        keep: keep what can be read where not all could be written, and raise all the same.
    Raises:
        ValueError: another suffix, or pictures of several sizes.
        OSError: OpenCV cannot write it, or not all of it: the disk is full.
    """

    def __init__(self, path: str | Path, fps: float, keep: bool = False) -> None:
        self.keep = keep
        self.path, self.fps = check_path("video", path), check_positive("fps", fps)
        if self.path.suffix.lower() not in CODES:
            raise ValueError(f"video: expected a name ending in {', '.join(CODES)}, got {self.path.name!r}")
        check_text_name("video", self.path)
        self._file: Any = None
        self._writer: Any = None
        self._temporary, self._size, self._count = self.path, tuple[int, ...](), 0
        self._encoder = InTurn()

    def __enter__(self) -> "VideoFile":
        self._file = write_atomically(self.path)
        self._temporary = self._file.__enter__()
        return self

    def write(self, picture: Pixels) -> None:
        """Append a frame, (H, W, 3) B, G, R, 8 bits, which must not be changed any more; all of one size."""
        import cv2

        if self._writer is None:
            self._size, code = picture.shape[:2], cv2.VideoWriter.fourcc(*CODES[self.path.suffix.lower()])
            self._writer = cv2.VideoWriter(str(self._temporary), code, self.fps, self._size[::-1])
            if not self._writer.isOpened():
                raise OSError(f"video: {self.path}: OpenCV cannot write this kind of file here: try .avi")
        if picture.shape[:2] != self._size:
            raise ValueError(f"video: expected pictures of {self._size} like the first, got {picture.shape[:2]}")
        self._encoder.submit(self._writer.write, picture)
        self._count += 1

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        whole = False
        try:
            self._encoder.finish()
            whole = True
        finally:
            if self._writer is not None:
                self._writer.release()
            there = count_packets(self._temporary) if kind is None and self._count else 0
            if there and (self.keep or (whole and there == self._count)):
                self._file.__exit__(None, None, None)
            else:
                self._file.__exit__(Exception, Exception(), None)  # removes the temporary file
        if kind is None and there != self._count:
            raise OSError(
                f"video: {self.path}: cannot be written: {there} of {self._count} frames can be read back"
                f"{' and are kept' * (self.keep and there > 0)}: is the disk full?"
            )


def count_packets(path: Path) -> int:
    """Number of frames that a video file holds; they are read, and decoded only where OpenCV has no FFmpeg."""
    import cv2

    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    if not capture.isOpened():
        capture = open_video(path)
    count = 0
    while capture.grab():
        count += 1
    capture.release()
    return count
