"""Reads frames of cameras, videos and folders of images."""

import queue
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from ..core.checks import brief, check_integer, check_least, check_path, check_positive, check_record, parse_number
from ..core.containers import find_container
from ..core.files import IMAGE_SUFFIXES, REMEDIES, VIDEO_SUFFIXES, Pixels, rgb_from_bgr
from ..core.recordings import (
    RawFrame,
    cut_short,
    image_files,
    raw_frames,
    video_rate,
)
from .cameras import AS_IT_IS, Camera, CameraSettings
from .devices import find_camera, found_cameras

MOST_CAMERAS = 99
"""Largest index of a camera: OpenCV takes the hundreds as the number of a driver, and crashes on negative ones."""

URLS = ("rtsp://", "rtsps://", "http://", "https://", "udp://", "tcp://", "rtmp://")
"""How the address of a network camera begins."""

SILENT_S = 10.0
"""A live source that gives no frame for this long has stopped: OpenCV's own limit for cameras under Linux."""

RETRY_S = 0.5
"""Pause before a live source is tried again."""

SETTLING = 5
"""So many first frames of a camera are left out, while its exposure settles."""


class Unreadable(NamedTuple):
    """A frame that cannot be read.

    Attributes:
        reason: why.
    """

    reason: str


class Reader(Protocol):
    """A source of frames.

    Attributes:
        name: shown to the user.
        live: whether it does not wait for who reads.
        fps: frames a second, known or assumed.
    """

    name: str
    live: bool
    fps: float

    def read(self) -> Pixels | Unreadable | None:
        """The next frame, (H, W, 3) B, G, R, uint8 or uint16; why it cannot be read; None at the end.

        A live source has no end: where it stops, it raises OSError. None of a live source counts as such an error, too.
        """

    def close(self) -> None:
        """Release the device or file."""


class LiveReader:
    """A live source that never ends without a word: it is opened again for some time, then an error is raised.

    The source is read by a thread of its own, because a camera that has hung blocks who reads it.

    Args:
        open_reader: opens the source.
        reconnect_s: for how long to try to open it again after it has stopped; 0 raises at once.
        sleep: for tests.
    Attributes:
        silent_s: a source that gives no frame for this long has stopped.
        reconnections: how often it was opened again.
    Raises:
        OSError: by :meth:`read`: the source has stopped.
    """

    live = True

    def __init__(
        self,
        open_reader: Callable[[], Reader],
        reconnect_s: float = 0.0,
        sleep: Callable[[float], Any] | None = None,
    ) -> None:
        self.reconnect_s, self.silent_s = check_least("reconnect_s", reconnect_s), SILENT_S
        self.reconnections = 0
        self._closed = threading.Event()
        self._open, self._sleep = open_reader, sleep or self._closed.wait
        reader = open_reader()
        self.name, self.fps = reader.name, reader.fps
        self._worker = _ReadingThread(reader)

    def read(self) -> Pixels | Unreadable | None:
        """The next frame; None only after :meth:`close`.

        Raises:
            OSError: the source has stopped, and did not come back within ``reconnect_s``.
        """
        try:
            return self._worker.read(self.silent_s)
        except OSError as error:
            if self.reconnect_s == 0 and not self._closed.is_set():
                raise OSError(f"source: {self.name} has stopped: {error}: unplugged? in use elsewhere?") from error
            reason = error
        return self._read_again(reason)

    def _read_again(self, reason: OSError) -> Pixels | Unreadable | None:
        """The first frame after the source was opened again."""
        last = time.monotonic() + self.reconnect_s
        while not self._closed.is_set():
            self._worker.close()
            try:
                self._worker = _ReadingThread(self._open())
                for _ in range(SETTLING):
                    self._worker.read(self.silent_s)
                pixels = self._worker.read(self.silent_s)
                self.reconnections += 1
                return pixels
            except (OSError, ValueError) as error:
                if time.monotonic() > last:
                    raise OSError(
                        f"source: {self.name} has stopped ({reason}) and did not come back within {self.reconnect_s:g} s: {error}"
                    ) from error
            self._sleep(RETRY_S)
        return None

    def close(self) -> None:
        """Release the source; one that hangs is left to its thread, since it cannot be released while it is read."""
        self._closed.set()
        self._worker.close()


class _ReadingThread:
    """Reads, and at last closes, a source in a thread of its own."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._asked: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._found: queue.SimpleQueue[Pixels | Unreadable | Exception | None] = queue.SimpleQueue()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="torchvts-camera", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while self._asked.get():
            try:
                self._found.put(self._reader.read())
            except Exception as error:  # raised by read()
                self._found.put(error)
        self._reader.close()

    def read(self, seconds: float) -> Pixels | Unreadable:
        """The next frame, within so many seconds.

        Raises:
            OSError: there is none.
        """
        if self._closed or not self._thread.is_alive():
            raise OSError("it is closed")
        self._asked.put(True)
        try:
            found = self._found.get(timeout=seconds)
        except queue.Empty:
            self._asked.put(False)
            raise OSError(f"no frame for {seconds:g} s") from None
        if found is None:
            raise OSError("it gives no more frames")
        if isinstance(found, Exception):
            raise found
        return found

    def close(self) -> None:
        """Close the source, and wait for that unless it hangs; who waits for a frame gets an error."""
        if self._closed:
            return
        self._closed = True
        self._asked.put(False)
        self._found.put(OSError("it is closed"))
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)


def times_file(recording: Path) -> Path:
    """The table of the times of a recording's frames: in a folder, beside a video."""
    return recording / "times.csv" if recording.is_dir() else Path(f"{recording}.times.csv")


def read_times(recording: Path) -> dict[str, float]:
    """Times of a recording's frames, s, by name; none where there is no table.

    Raises:
        ValueError: the table is damaged.
    """
    path = times_file(recording)
    if not path.is_file():
        return {}
    try:
        head, *lines = filter(None, path.read_text(encoding="utf-8").splitlines())
        found = {name: parse_number(time_s) for name, time_s, *_ in (line.split(",") for line in lines)}
        if head.startswith("frame,time_s") and all(a < b for a, b in pairwise(found.values())):
            return found
    except ValueError:
        pass
    raise ValueError(f"{path}: expected lines of frame,time_s, times that rise: remove it to read the frames without times")


def rate_of(times: Sequence[float], otherwise: float) -> float:
    """Frames a second of frames at these times, s; the other value where there are not two."""
    return otherwise if len(times) < 2 else (len(times) - 1) / (times[-1] - times[0])


def time_of(index: int, fps: float, times: Sequence[float]) -> float:
    """Time of a frame of a recording since its start, s: as recorded, else by the rate."""
    return times[index] if index < len(times) else index / fps


class FileReader:
    """A recording: a video, an image, a TIFF of several pages, or a folder of images by name, numbers as numbers."""

    live = False

    def __init__(self, path: Path) -> None:
        self.name, known = str(path), read_times(path)
        self._path, self._count = path, 0
        try:
            frames = raw_frames(path)
            first = next(frames)
        except ValueError as error:
            raise ValueError(f"source: {str(error).removeprefix('source: ')}") from error
        self._frames: Iterator[RawFrame] = chain((first,), frames)
        names = [file.stem for file in image_files(path)] if path.is_dir() else list(known)
        self.times = [known[name] for name in names] if all(name in known for name in names) else []
        self.fps = rate_of(self.times, video_rate(path))
        self.fps_assumed = not self.times and path.suffix.lower() not in VIDEO_SUFFIXES

    def read(self) -> Pixels | Unreadable | None:
        frame = next(self._frames, None)
        if frame is None:
            if self._count and (text := cut_short(self._path, self._count)):
                warnings.warn(f"{self.name}: {text}", stacklevel=2)
            self._count = 0
            return None
        self._count += 1
        try:
            return frame.read()
        except (ValueError, OSError) as error:
            return Unreadable(str(error))

    def close(self) -> None:
        self._frames = iter(())


def frames(source: str | int | Path) -> Iterator[tuple[str, Tensor]]:
    """The frames of an image, a folder, a TIFF of several pages, a video, a container or a camera: pairs of a name and an image.

    Images are (3, H, W) float32 in [0, 1], R, G, B, as they are: ``sensor.rectify`` cuts them. A camera gives all its frames, until
    it stops or nobody asks.

    Args:
        source: a path, which goes on inside a container of several recordings (``day.h5/left/rgb``); or a camera by its index,
            name, path or URL, as :func:`open_source` takes it.
    Raises:
        FileNotFoundError: no such file or folder, and no such camera.
        ImportError: the library of a container is not installed.
        ValueError: no images in the folder, or several recordings of which none is named; while frames are asked for: a file
            that cannot be read.
        OSError: no such camera, or it has stopped.
    Example:
        >>> import tempfile, torch, torchvts as vts
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for k in range(2):
        ...         vts.write_image(f"{folder}/{k}.png", torch.full((3, 4, 6), 0.5 * k))
        ...     [(name, image.shape) for name, image in vts.frames(folder)]
        [('0', torch.Size([3, 4, 6])), ('1', torch.Size([3, 4, 6]))]
    """
    path = None if isinstance(source, int) else check_path("source", source)
    if path is not None and (path.exists() or find_container(path)) and find_camera(str(path)) is None:
        return ((frame.name, rgb_from_bgr(frame.read())) for frame in raw_frames(path))
    return _of_camera(open_source(source))


def _of_camera(reader: Reader) -> Iterator[tuple[str, Tensor]]:
    try:
        for number in range(-SETTLING, sys.maxsize):
            pixels = reader.read()
            if pixels is None:
                return
            if number >= 0 and not isinstance(pixels, Unreadable):
                yield f"{number:06d}", rgb_from_bgr(pixels)
    finally:
        reader.close()


def open_source(source: str | int | Path, reconnect_s: float = 0.0, settings: CameraSettings = AS_IT_IS) -> Reader:
    """Open a camera (:func:`find_camera`), a network camera by its URL, or what :func:`frames` reads.

    Args:
        source: what to open.
        reconnect_s: for how long a camera that has stopped is tried again before :class:`OSError` is raised.
        settings: what is asked of a camera's driver.
    Raises:
        FileNotFoundError: no such file or folder.
        OSError: no such camera.
        ValueError: not a video, no images, or settings of what is no camera.
    """
    check_least("reconnect_s", reconnect_s)
    check_record("settings", settings, CameraSettings)
    if isinstance(source, int) and not isinstance(source, bool):
        index = check_integer("source", source, 0, MOST_CAMERAS)
        return LiveReader(lambda: Camera(index, settings), reconnect_s)
    text = str(check_path("source", source))
    if text.isascii() and text.isdigit():
        if len(text) > 9 or int(text) > MOST_CAMERAS:
            raise ValueError(f"source: expected a camera's index of at most {MOST_CAMERAS}, got {brief(text)}")
        return LiveReader(lambda: Camera(int(text), settings), reconnect_s)
    path = Path(text)
    if not path.is_dir() and find_camera(text) is not None:
        return LiveReader(lambda: Camera(_index_of(text), settings), reconnect_s)  # found again: it may come back as another
    if settings.given:
        raise ValueError(f"settings: size, rate, exposure and white balance are those of a camera of this machine, got {text}")
    if isinstance(source, str) and source.lower().startswith(URLS):
        return LiveReader(lambda: Camera(source), reconnect_s)
    if path.is_dir() or find_container(path):
        return FileReader(path)
    if not path.is_file():
        raise FileNotFoundError(
            "source: expected a file, a folder, a URL, or a camera by index, /dev path, name or serial number, "
            f"got {text}: no such file or folder, and no such camera; {found_cameras()}"
        )
    known = VIDEO_SUFFIXES + IMAGE_SUFFIXES
    if path.suffix.lower() not in known:
        remedy = REMEDIES.get(path.suffix.lower(), f"one of {', '.join(known)}, a folder, or a camera's index")
        raise ValueError(f"source: {path}: expected a video, an image or a container: {remedy}")
    return FileReader(path)


def _index_of(text: str) -> int:
    """The index of a camera that a text named before.

    Raises:
        OSError: it is not there now.
    """
    index = find_camera(text)
    if index is None:
        raise OSError(f"source: expected a camera {text!r}, got none: unplugged? {found_cameras()}")
    return index


def check_reader(source: object) -> Reader:
    """Return a reader of the user's own, watched if it is live.

    Raises:
        TypeError: no reader.
        ValueError: its rate is no number above 0.
    """
    if not callable(getattr(source, "read", None)) or not callable(getattr(source, "close", None)):
        raise TypeError(f"source: expected a path, a camera's index or a Reader, got {type(source).__name__}")
    reader: Reader = source  # type: ignore[assignment]
    for name in ("name", "live", "fps"):
        if not hasattr(reader, name):
            raise TypeError(f"source: expected a Reader with name, live and fps, got {type(source).__name__} without {name}")
    check_positive("source: fps", reader.fps)
    return LiveReader(lambda: reader) if reader.live else reader
