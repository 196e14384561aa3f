"""Reads frames of cameras, videos and folders of images."""

import threading
import time
import warnings
from collections.abc import Callable, Iterator
from itertools import chain, count, pairwise
from pathlib import Path
from typing import NamedTuple, Protocol

from torch import Tensor

from ..core.checks import check_integer, check_least, check_path, check_positive, check_record, parse_number
from ..core.containers import find_container
from ..core.files import IMAGE_SUFFIXES, REMEDIES, VIDEO_SUFFIXES, Pixels, rgb_from_bgr
from ..core.recordings import RawFrame, cut_short, image_files, raw_frames, video_rate
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
    """A frame that cannot be read, and why."""

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


NumberedFrame = tuple[int, float, Pixels | Unreadable]
"""Number in the source, time since its start in s, and the frame."""


class Stopped(OSError):
    """A live source gives no more frames."""


class LiveReader:
    """A source that does not wait, read by a thread of its own, because a camera that has hung blocks who reads it.

    A frame is read when it is asked for; after :meth:`drop_late` all are, and who comes late finds only the newest. What fails,
    ends or hangs is opened again for some time, then an error is raised. A recording (``live`` of the reader is False) has an end.

    Args:
        open_reader: opens the source.
        reconnect_s: for how long to try to open it again after it has stopped; 0 raises at once.
    Attributes:
        keep: is given every frame, in the thread; None for nothing.
        silent_s: a source that gives no frame for this long has stopped.
        started_s: time 0 of its frames, by :func:`time.monotonic`.
        dropped: number of frames that nobody took.
    Raises:
        OSError: by :meth:`read` and :meth:`take`: the source has stopped.
    """

    live = True

    def __init__(self, open_reader: Callable[[], Reader], reconnect_s: float = 0.0) -> None:
        self.reconnect_s, self._open = check_least("reconnect_s", reconnect_s), open_reader
        self.keep: Callable[[Pixels | Unreadable], None] | None = None
        self.reconnections = self.dropped = self._count = 0
        self.started_s = time.monotonic()
        self._changed, self._closed = threading.Condition(), threading.Event()
        self._asked = self._drops_late = False
        reader = open_reader()
        self.name, self.fps, self.silent_s = reader.name, reader.fps, max(SILENT_S, 2.0 / reader.fps)
        self._begin(reader)

    def _begin(self, reader: Reader) -> None:
        self._reader: Reader | None = reader
        self._newest: NumberedFrame | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, args=(reader,), name="torchvts-reader", daemon=True)
        self._thread.start()

    def _run(self, reader: Reader) -> None:
        """Read until the source ends, fails, or is no longer the one that is read: a read that hung may return long after."""
        error: Exception | None = None
        try:
            for _ in range(SETTLING if reader.live else 0):
                _read(reader)
            while self._is_wanted(reader) and (pixels := _read(reader)) is not None:
                if self.keep is not None and self._reader is reader:
                    self.keep(pixels)
                self._put(reader, pixels)
        except Exception as caught:  # raised by take()
            error = caught
        reader.close()
        with self._changed:
            if self._reader is reader:
                self._reader, self._error = None, error
                self._changed.notify_all()

    def _is_wanted(self, reader: Reader) -> bool:
        """Wait until a frame is asked for; whether it is one of this reader."""
        with self._changed:
            self._changed.wait_for(lambda: self._asked or self._drops_late or self._reader is not reader)
            return self._reader is reader

    def _put(self, reader: Reader, pixels: Pixels | Unreadable) -> None:
        with self._changed:
            if self._reader is reader:
                self.dropped += self._newest is not None
                self._newest, self._asked = (self._count, time.monotonic() - self.started_s, pixels), False
                self._count += 1
                self._changed.notify_all()

    def drop_late(self) -> None:
        """Read on by itself from now on, and keep only the newest frame; numbers and times begin anew."""
        with self._changed:
            self.started_s, self._count, self._drops_late = time.monotonic(), 0, True
            self._changed.notify_all()

    def take(self) -> NumberedFrame | None:
        """The next frame; waits for it; None at the end of a recording, and after :meth:`close`."""
        found = self._next()
        if not isinstance(found, Stopped):
            return found
        if self.reconnect_s == 0:
            raise OSError(f"source: {self.name} has stopped: {found}: unplugged? in use elsewhere?") from found
        reason, last = found, time.monotonic() + self.reconnect_s
        while isinstance(found, Stopped):
            if time.monotonic() > last:
                raise OSError(
                    f"source: {self.name} has stopped ({reason}) and did not come back within {self.reconnect_s:g} s: {found}"
                ) from found
            if self._closed.wait(RETRY_S):
                return None
            try:
                self._begin(self._open())
                found = self._next()
            except (OSError, ValueError) as error:
                found = Stopped(str(error))
        self.reconnections += 1
        return found

    def _next(self) -> NumberedFrame | Stopped | None:
        """The next frame, or why the source gives none; raises other errors of its thread."""
        with self._changed:
            self._asked = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._newest or self._reader is None, self.silent_s)
            newest, self._newest = self._newest, None
            if newest is None and self._reader is not None:
                self._reader, self._error = None, Stopped(f"no frame for {self.silent_s:g} s")
        if newest is not None or self._error is None:
            return newest
        if isinstance(self._error, Stopped):
            return self._error
        raise self._error

    def read(self) -> Pixels | Unreadable | None:
        """The pixels of :meth:`take`."""
        found = self.take()
        return None if found is None else found[2]

    def close(self) -> None:
        """Release the source; who waits for a frame gets None. One that hangs is left to its thread: it cannot be released."""
        self._closed.set()
        with self._changed:
            self._reader = self._error = self._newest = None
            self._changed.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2.0)


def _read(reader: Reader) -> Pixels | Unreadable | None:
    """The next frame of a reader; None at the end of a recording."""
    try:
        pixels = reader.read()
    except OSError as error:
        raise Stopped(str(error)) from error
    if pixels is None and reader.live:
        raise Stopped("it gives no more frames")
    return pixels


def times_file(recording: Path) -> Path:
    """The table of the times of a recording's frames: in a folder, beside a video."""
    return recording / "times.csv" if recording.is_dir() else Path(f"{recording}.times.csv")


def read_times(recording: Path) -> dict[str, float]:
    """Times of a recording's frames, s, by name; none where there is no table, ValueError where it is damaged."""
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
        spans = len(self.times) - 1
        self.fps = spans / (self.times[-1] - self.times[0]) if spans > 0 else video_rate(path)
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

    Images are (3, H, W) float32 in [0, 1], R, G, B, as they are: ``sensor.rectify`` cuts them.

    Args:
        source: a path, which goes on inside a container of several recordings (``day.h5/left/rgb``); or a camera by its index,
            name, path or URL, as :func:`open_source` takes it.
    Raises:
        OSError: no such file, folder or camera, or it has stopped.
        ImportError: the library of a container is not installed.
        ValueError: no images in the folder, several recordings of which none is named, or, later, a file that cannot be read.
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
        for number in count():
            if (pixels := reader.read()) is None:
                return
            if not isinstance(pixels, Unreadable):
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
        OSError: no such file, folder or camera.
        ValueError: not a video, no images, or settings of what is no camera.
    """
    check_least("reconnect_s", reconnect_s)
    check_record("settings", settings, CameraSettings)
    if isinstance(source, str) and source.isascii() and source.isdigit():
        source = int(source)
    if isinstance(source, int) and not isinstance(source, bool):
        index = check_integer("source", source, 0, MOST_CAMERAS)
        return LiveReader(lambda: Camera(index, settings), reconnect_s)
    text = str(check_path("source", source))
    path = Path(text)
    if not path.is_dir() and find_camera(text) is not None:
        return LiveReader(lambda: Camera(_index_of(text), settings), reconnect_s)  # found again: it may come back as another
    if settings != AS_IT_IS:
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
    """The index of a camera that a text named before; OSError where it is not there now."""
    index = find_camera(text)
    if index is None:
        raise OSError(f"source: expected a camera {text!r}, got none: unplugged? {found_cameras()}")
    return index


def check_reader(source: object) -> Reader:
    """Return a reader of the user's own, watched if it is live; TypeError or ValueError where it is none."""
    if missing := [name for name in ("read", "close", "name", "live", "fps") if not hasattr(source, name)]:
        got = f"{type(source).__name__} without {', '.join(missing)}"
        raise TypeError(f"source: expected a path, a camera's index or a Reader, got {got}")
    reader: Reader = source  # type: ignore[assignment]
    check_positive("source: fps", reader.fps)
    return LiveReader(lambda: reader) if reader.live else reader
