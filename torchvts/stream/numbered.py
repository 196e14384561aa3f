"""The frames of a source with number and time: of a recording all, of a source that does not wait the newest."""

import time
from collections import deque
from collections.abc import Iterator

from ..core.files import Pixels, check_pixels
from .sources import LiveReader, NumberedFrame, Reader, Unreadable
from .stages import StageClock


class Played:
    """A recording at its own rate, as if it were a camera: a frame is given when it is due; ``first`` were read before."""

    live = False

    def __init__(self, reader: Reader, first: deque[Pixels | Unreadable]) -> None:
        self.name, self.fps = reader.name, reader.fps
        self._reader, self._first, self._count, self._started_s = reader, first, 0, 0.0

    def read(self) -> Pixels | Unreadable | None:
        if self._count == 0:
            self._started_s = time.monotonic()
        pixels = self._first.popleft() if self._first else self._reader.read()
        if pixels is not None:
            time.sleep(max(0.0, self._started_s + self._count / self.fps - time.monotonic()))
        self._count += 1
        return pixels

    def close(self) -> None:
        self._reader.close()


class SourceFrames:
    """Frames of a source in order: first some that can be read, then all that it has by iteration, the first ones again.

    Of a live source, or a recording that is played at its own rate (``realtime``), only the newest frame is given. ``started_s`` is
    time 0 of the frames, by :func:`time.monotonic`.
    """

    def __init__(self, reader: Reader, realtime: bool, stages: StageClock) -> None:
        self.reader, self._realtime, self._stages = reader, realtime or reader.live, stages
        self._live: LiveReader | None = None
        self._given = 0
        self.started_s = time.monotonic()
        self.first: deque[Pixels | Unreadable] = deque()

    def read_first(self, least: int) -> list[Pixels]:
        """Read the first frames, until ``least``, or one, can be read; these. ValueError where the source has fewer."""
        readable, least = list[Pixels](), max(1, least)
        while len(readable) < least and (pixels := self.reader.read()) is not None:
            if not isinstance(pixels, Unreadable):
                check_pixels(f"source: frame {len(self.first)} of {self.reader.name}", pixels)
                readable.append(pixels)
            self.first.append(pixels)
        if len(readable) < least:
            raise ValueError(
                f"background_frames: expected at least {least} frames from {self.reader.name}, got {len(readable)}: ask "
                "for fewer, or for 0, which keeps a calibration's background (--background-frames)"
            )
        return readable

    @property
    def dropped(self) -> int:
        """Number of frames that arrived while another was being worked on, and were left out."""
        return 0 if self._live is None else self._live.dropped

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
            times = getattr(self.reader, "times", ())  # as recorded
            yield index, times[index] if index < len(times) else index / self.reader.fps, pixels

    def _newest_ones(self) -> Iterator[NumberedFrame]:
        """The frames that are the newest when they are asked for; of a recording the first ones are played again."""
        if self._live is None:
            if isinstance(self.reader, LiveReader):
                self._live = self.reader
                self.first.clear()  # they are gone
            else:
                self._live = LiveReader(lambda: Played(self.reader, self.first))
            self._live.drop_late()
            self.started_s = self._live.started_s
        while True:
            with self._stages.stage("wait"):
                newest = self._live.take()
            if newest is None:
                return
            yield newest

    def close(self) -> None:
        """Stop reading and release the source."""
        (self._live or self.reader).close()
