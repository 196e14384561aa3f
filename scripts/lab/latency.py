"""From a camera's frame to its depth: a simulated camera in real time, and how long after its arrival a frame's depth is there."""

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from torchvts.core.checks import check_integer, check_positive
from torchvts.core.files import Pixels
from torchvts.model import Calibration
from torchvts.stream import Overlay, TactileFrame, TactileStream


class SimulatedCamera:
    """A :class:`~torchvts.stream.Reader` that delivers pictures at a steady rate in real time, whether or not somebody reads.

    Args:
        pictures: (H, W, 3) B, G, R, 8 bits, given in turn; the first ``undeformed`` frames are all the first one.
        fps: frames a second.
        frames: number of frames until it ends.
        undeformed: number of frames without contact at the start.
    Attributes:
        arrivals: time at which each frame that was read arrived, by ``time.monotonic``.
    """

    name, live = "simulated camera", True

    def __init__(self, pictures: Sequence[Pixels], fps: float, frames: int, undeformed: int = 15) -> None:
        self.fps = check_positive("fps", fps)
        self.frames = check_integer("frames", frames, 1)
        self.arrivals: list[float] = []
        self._closed = threading.Event()
        self._pictures, self._undeformed, self._next = list(pictures), undeformed, time.monotonic()

    def read(self) -> Pixels | None:
        """Wait for the next frame and return it. After the last one nothing comes until it is closed; then None."""
        number = len(self.arrivals)
        if number >= self.frames or self._closed.is_set():
            self._closed.wait()
            return None
        wait = self._next - time.monotonic()
        if wait > 0.0:
            time.sleep(wait)
        self._next = max(self._next + 1.0 / self.fps, time.monotonic() - 1.0 / self.fps)  # what nobody read in time is lost
        self.arrivals.append(time.monotonic())
        past = number - self._undeformed
        return self._pictures[0 if past < 0 else past % len(self._pictures)].copy()

    def close(self) -> None:
        """End it."""
        self._closed.set()


class Latency(NamedTuple):
    """What a stream of a simulated camera took.

    Attributes:
        numbers: of the frames whose depth was found, in order.
        delay_ms: from the arrival of each of them to its depth, ms.
        arrived: number of frames that arrived after the first ones.
        dropped: of them that nobody took.
        drawn: number of overlays that were drawn, in a thread of their own.
    """

    numbers: list[int]
    delay_ms: list[float]
    arrived: int
    dropped: int
    drawn: int

    def percentile(self, percent: float) -> float:
        """Of the delay, ms."""
        return float(np.percentile(self.delay_ms, percent))


def measure_latency(calibration: Calibration, pictures: Sequence[Pixels], fps: float = 60.0, frames: int = 600) -> Latency:
    """Depth of every frame of a simulated camera while each is drawn, and its delay.

    Args:
        calibration: of the unit.
        pictures: as :class:`SimulatedCamera` takes them, the first without contact.
        fps: frames a second.
        frames: number of frames after the first ones.
    """
    first = 20  # of which a stream takes five for the camera to settle and fifteen as its background
    camera = SimulatedCamera(pictures, fps, first + frames, first)
    numbers: list[int] = []
    delay_ms: list[float] = []
    drawn: list[int] = []
    overlay = Overlay()

    def draw(frame: TactileFrame) -> None:
        overlay(frame)
        drawn.append(frame.number)

    with TactileStream(camera, calibration, background_frames=15) as stream, ThreadPoolExecutor(1) as aside:
        before = len(camera.arrivals)
        for frame in stream:
            delay_ms.append(1000.0 * (time.monotonic() - camera.arrivals[before + frame.number]))
            numbers.append(frame.number)
            aside.submit(draw, frame)
            if frame.number == frames - 1:  # the newest frame is never dropped
                break
        dropped = stream.dropped
        camera.close()  # else the stream waits for its next frame
    return Latency(numbers, delay_ms, len(camera.arrivals) - before, dropped, len(drawn))
