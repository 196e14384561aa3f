"""Reads frames of cameras, videos and folders, keeps the newest one of those that do not wait, and rectifies them."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import kornia
import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import brief, check_batch, check_image_size, check_integer, check_path
from ..core.files import IMAGE_SUFFIXES, VIDEO_SUFFIXES, image_files, read_pixels
from ..model import Sensor, check_sensor

Pixels = np.ndarray[Any, Any]


MOST_CAMERAS = 99
"""Largest index of a camera: OpenCV takes the hundreds as the number of a driver, and crashes on negative ones."""


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
        """The next frame, (H, W, 3) B, G, R, 8 or 16 bits; why it cannot be read; None at the end."""

    def close(self) -> None:
        """Release the device or file."""


class CaptureReader:
    """A camera (an index) or a video file, by OpenCV."""

    def __init__(self, source: int | Path) -> None:
        import cv2

        self.live = isinstance(source, int)
        self.name = f"camera {source}" if self.live else str(source)
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else str(source))
        if not self._capture.isOpened():
            self._capture.release()
            if self.live:
                raise OSError(f"source: expected a camera with index {source}, got none that opens: plugged in? in use elsewhere?")
            raise ValueError(f"source: {source}: not a video, or cut short: it does not open")
        if self.live:
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self.fps = frames_a_second(self._capture)

    def read(self) -> Pixels | None:
        there, pixels = self._capture.read()
        return pixels if there else None

    def close(self) -> None:
        self._capture.release()


def frames_a_second(capture: Any) -> float:
    """Rate of an OpenCV capture; 30 where it does not know."""
    import cv2

    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if 0.5 <= fps <= 1000.0 else 30.0


class FolderReader:
    """A folder of images, by name."""

    def __init__(self, folder: Path, fps: float = 30.0) -> None:
        self.name, self.live, self.fps = str(folder), False, fps
        files = image_files(folder)
        if not files:
            raise ValueError(
                f"source: expected a folder of images ({', '.join(IMAGE_SUFFIXES)}), got {folder}: no images in this folder"
            )
        self._files = iter(files)

    def read(self) -> Pixels | Unreadable | None:
        path = next(self._files, None)
        if path is None:
            return None
        try:
            return read_pixels(path)
        except (ValueError, OSError) as error:
            return Unreadable(str(error))

    def close(self) -> None:
        self._files = iter(())


def open_source(source: str | int | Path) -> Reader:
    """Open a camera by its index (digits), a video file, or a folder of images.

    Raises:
        FileNotFoundError: no such file or folder.
        OSError: no such camera.
        ValueError: not a video, or no images.
    """
    if isinstance(source, int) and not isinstance(source, bool):
        return CaptureReader(check_integer("source", source, 0, MOST_CAMERAS))
    text = str(check_path("source", source))
    if text.isascii() and text.isdigit():
        if len(text) > 9 or int(text) > MOST_CAMERAS:
            raise ValueError(f"source: expected a camera's index of at most {MOST_CAMERAS}, got {brief(text)}")
        return CaptureReader(int(text))
    path = Path(text)
    if path.is_dir():
        return FolderReader(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"source: expected a file, a folder or a camera's index (digits), got {path}: no such file or folder"
        )
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ValueError(f"source: {path}: expected a video ({', '.join(VIDEO_SUFFIXES)}), a folder of images or a camera's index")
    return CaptureReader(path)


class NewestFrame:
    """Keeps the newest frame of a source that does not wait: a thread reads, and who comes late finds only the last frame.

    Args:
        reader: read by the thread until it ends or :meth:`close`.
        rate: frames a second at which a recording is played; None for a camera, which has its own.
        clock: for tests.
        sleep: for tests.
    """

    def __init__(
        self,
        reader: Reader,
        rate: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Any] | None = None,
    ) -> None:
        self.dropped = 0
        self._reader, self._rate, self._clock = reader, rate, clock
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._sleep = sleep or self._stop.wait
        self._newest: tuple[int, float, Pixels | Unreadable] | None = None
        self._error: BaseException | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="torchvts-reader", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            start, index = self._clock(), 0
            while not self._stop.is_set():
                pixels = self._reader.read()
                if pixels is None:
                    break
                if self._rate is not None:
                    wait = start + index / self._rate - self._clock()
                    if wait > 0:
                        self._sleep(wait)
                self.put(index, self._clock() - start, pixels)
                index += 1
        except Exception as error:  # raised by take()
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify_all()

    def put(self, index: int, time_s: float, pixels: Pixels | Unreadable) -> None:
        """Put a frame in place of the last one, which is dropped if nobody took it."""
        with self._changed:
            self.dropped += self._newest is not None
            self._newest = (index, time_s, pixels)
            self._changed.notify_all()

    def take(self) -> tuple[int, float, Pixels | Unreadable] | None:
        """The newest frame that was not taken yet; waits for it; None at the end. Raises what the reader raised."""
        with self._changed:
            while self._newest is None and not self._ended:
                self._changed.wait(0.2)  # so that Ctrl-C interrupts it
            newest, self._newest = self._newest, None
            if newest is None and self._error is not None:
                raise self._error
            return newest

    def close(self) -> None:
        """End the thread, then release the source."""
        self._stop.set()
        self._thread.join(timeout=5.0)
        self._reader.close()


class Rectify(nn.Module):
    """:meth:`Sensor.rectify` for frames of one size, with a sampling grid that is made once.

    Args:
        sensor: the sensor.
        height: pixels of the camera's frames.
        width: pixels of the camera's frames.
    Raises:
        ValueError: the frame does not contain the region that the sensor names.
    Example:
        >>> corners = ((1, 1), (14, 2), (13, 10), (2, 9))
        >>> Rectify(Sensor("rig", 8, 10, 0.1, corners_px=corners), 12, 16)(torch.zeros(1, 3, 12, 16)).shape
        torch.Size([1, 3, 8, 10])
    """

    grid: Tensor

    def __init__(self, sensor: Sensor, height: int, width: int) -> None:
        super().__init__()
        check_sensor("sensor", sensor)
        check_image_size("height", height, "width", width)
        self.sensor = sensor
        self.frame_size = (height, width)
        sensor.rectify(torch.zeros(1, 3, height, width))  # raises where it does not fit
        grid = torch.zeros(0)
        if sensor.corners_px is not None:
            right, bottom = sensor.width - 1.0, sensor.height - 1.0
            target = torch.tensor([[[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]]], dtype=torch.float64)
            corners = torch.tensor([sensor.corners_px], dtype=torch.float64)
            to_frame = kornia.geometry.get_perspective_transform(target, corners)[0]
            x = torch.arange(sensor.width, dtype=torch.float64).expand(sensor.height, -1)
            y = torch.arange(sensor.height, dtype=torch.float64)[:, None].expand(-1, sensor.width)
            position = torch.stack((x, y, torch.ones_like(x)), 2) @ to_frame.T
            position = position[..., :2] / position[..., 2:]
            grid = (2.0 * position / torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64) - 1.0)[None].float()
        self.register_buffer("grid", grid)

    def forward(self, frame: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 3, sensor.height, sensor.width)."""
        check_batch("frame", frame, 3)
        if frame.shape[2:] != self.frame_size:
            raise ValueError(
                f"frame: expected {self.frame_size} like the first, got {tuple(frame.shape[2:])}: the source has changed"
            )
        if self.grid.numel() == 0:
            return self.sensor.rectify(frame)
        grid = self.grid.to(frame.dtype).expand(frame.shape[0], -1, -1, -1)
        return nn.functional.grid_sample(frame, grid, mode="bilinear", padding_mode="zeros", align_corners=True)


class RectifySizes:
    """:class:`Rectify` for frames of any size that the sensor accepts; each size is prepared once."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self._of_size: dict[tuple[int, int], Rectify] = {}

    def __call__(self, frame: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 3, sensor.height, sensor.width), in [0, 1]."""
        size = (frame.shape[2], frame.shape[3])
        if size not in self._of_size:
            self._of_size[size] = Rectify(self.sensor, *size)
        rectified: Tensor = self._of_size[size](frame)
        return rectified.clamp(0.0, 1.0)


class Replay:
    """A reader that gives frames that were already read, then those of another reader."""

    def __init__(self, reader: Reader, first: Sequence[Pixels | Unreadable]) -> None:
        self.name, self.live, self.fps = reader.name, reader.live, reader.fps
        self._reader, self._first = reader, iter(list(first))

    def read(self) -> Pixels | Unreadable | None:
        pixels = next(self._first, None)
        return self._reader.read() if pixels is None else pixels

    def close(self) -> None:
        self._reader.close()
