"""The frames of a source with number and time: of a recording all, of a source that does not wait the newest."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from ..core.checks import check_positive
from ..core.files import Pixels, check_pixels
from .sources import SETTLING, Reader, Unreadable, time_of
from .stages import StageClock

NumberedFrame = tuple[int, float, Pixels | Unreadable]
"""Number in the source, time since its start in s, and the frame."""


class NewestFrame:
    """Keeps the newest frame of a source that does not wait: a thread reads, and who comes late finds only the last frame.

    Args:
        reader: read by the thread until it ends or :meth:`close`.
        rate: frames a second at which a recording is played; None for a camera, which has its own.
        clock: for tests.
        sleep: for tests.
        first: frames that were read before, which come first.
    Attributes:
        started_s: time 0 of its frames by ``clock``.
    """

    def __init__(
        self,
        reader: Reader,
        rate: float | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], Any] | None = None,
        first: deque[Pixels | Unreadable] | None = None,
    ) -> None:
        if rate is not None:
            check_positive("rate", rate)
        self.dropped = 0
        self.started_s = clock()
        self._reader, self._rate, self._first, self._clock = reader, rate, first, clock
        self._changed, self._stop = threading.Condition(), threading.Event()
        self._sleep = sleep or self._stop.wait
        self._newest: NumberedFrame | None = None
        self._error: BaseException | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="torchvts-reader", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            start, index = self.started_s, 0
            while not self._stop.is_set():
                pixels = self._first.popleft() if self._first else self._reader.read()
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

    def take(self) -> NumberedFrame | None:
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
        if self._reader.live:
            self._reader.close()  # ends a read that waits
        self._thread.join(timeout=5.0)
        self._reader.close()


class SourceFrames:
    """Frames of a source in order: first some that can be read, kept in ``first``, then all that it has by iteration.

    The source is closed where it has too few.

    A recording gives the first ones again. Of a live source, or a recording that is played at its own rate, only the newest
    frame is given.

    Args:
        reader: the source.
        least: number of first frames that must be readable.
        realtime: play a recording at its own rate.
        stages: measures reading and waiting.
    Attributes:
        started_s: time 0 of the frames, by :func:`time.monotonic`.
        first: the first frames of which ``least`` can be read, at least one.
    Raises:
        ValueError: the source has fewer.
    """

    def __init__(self, reader: Reader, least: int, realtime: bool, stages: StageClock) -> None:
        self.reader, self._realtime, self._stages = reader, realtime or reader.live, stages
        self._newest: NewestFrame | None = None
        self._given = 0
        self.started_s = time.monotonic()
        self.first: deque[Pixels | Unreadable] = deque()
        try:
            self._read_first(max(1, least))
        except BaseException:
            reader.close()
            raise

    def _read_first(self, least: int) -> None:
        reader = self.reader
        if reader.live:  # exposure settles
            for _ in range(SETTLING):
                reader.read()
        while len(self.readable) < least and (pixels := reader.read()) is not None:
            if not isinstance(pixels, Unreadable):
                check_pixels(f"source: frame {len(self.first)} of {reader.name}", pixels)
            self.first.append(pixels)
        if len(self.readable) < least:
            raise ValueError(
                f"background_frames: expected at least {least} frames from {reader.name}, got {len(self.readable)}: ask for fewer, "
                "or for 0, which keeps a calibration's background (--background-frames)"
            )

    @property
    def readable(self) -> list[Pixels]:
        """Those of the first frames that can be read."""
        return [pixels for pixels in self.first if not isinstance(pixels, Unreadable)]

    @property
    def dropped(self) -> int:
        """Number of frames that arrived while another was being worked on, and were left out."""
        return 0 if self._newest is None else self._newest.dropped

    def __iter__(self) -> Iterator[NumberedFrame]:
        return self._newest_ones() if self._realtime else self._all()

    def _all(self) -> Iterator[NumberedFrame]:
        """Every frame, the first ones again."""
        while True:
            if self.first:
                pixels: Pixels | Unreadable | None = self.first.popleft()
            else:
                with self._stages.stage("read"):
                    pixels = self.reader.read()
            if pixels is None:
                return
            index, self._given = self._given, self._given + 1
            yield index, time_of(index, self.reader.fps, getattr(self.reader, "times", ())), pixels

    def _newest_ones(self) -> Iterator[NumberedFrame]:
        """The frames that are the newest when they are asked for; of a recording the first ones are played again."""
        if self._newest is None and self.reader.live:
            self.first.clear()  # they are gone
        if self._newest is None:
            self._newest = NewestFrame(self.reader, None if self.reader.live else self.reader.fps, first=self.first)
        self.started_s = self._newest.started_s
        while True:
            with self._stages.stage("wait"):
                newest = self._newest.take()
            if newest is None:
                return
            yield newest

    def close(self) -> None:
        """Stop reading and release the source."""
        (self._newest or self.reader).close()
