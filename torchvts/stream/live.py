"""Depth of every frame of a source, with the time of each stage."""

import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..accelerated.threads import MOST_PIXELS, OneThread
from ..calibration import Press
from ..contact import ContactSettings
from ..core.checks import check_choice, check_integer, check_least, check_positive, check_record, check_switch
from ..core.files import check_pixels, rgb_from_bgr
from ..model import Calibration, Sensor
from ..pipeline import MODES, DepthOutput
from .background import FIRST_FRAMES, calibrate_background, find_background, use_calibration
from .follow_light import TIME_CONSTANT_S
from .recording import Recording
from .rezero import with_background
from .sources import SETTLING, LiveReader, NewestFrame, Pixels, Reader, Rectify, Replay, Unreadable, check_reader, open_source


class TactileFrame(NamedTuple):
    """A frame and its depth.

    Attributes:
        number: in the source, from 0.
        time_s: since the start of the source.
        image: (3, H, W), rectified, in the background's light.
        output: of the pipeline.
    """

    number: int
    time_s: float
    image: Tensor
    output: DepthOutput


STAGES = ("read", "wait", "rectify", "light", "depth", "draw", "view", "write")
"""In the order of a frame."""


class StageClock:
    """Measures the milliseconds of each stage, of the last 10,000 frames."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._frames: deque[dict[str, float]] = deque(maxlen=10_000)  # a camera may run for days
        self._now: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time of the block."""
        start = self._clock()
        try:
            yield
        finally:
            self._now[name] = self._now.get(name, 0.0) + 1000.0 * (self._clock() - start)

    def end_frame(self) -> None:
        """Close a frame: what was measured since the last call belongs to it."""
        self._frames.append(self._now)
        self._now = {}

    @property
    def last(self) -> dict[str, float]:
        """Stages of the last whole frame, ms."""
        return self._frames[-1] if self._frames else {}

    def median_ms(self) -> dict[str, float]:
        """Median of each stage over the frames in which it ran, in the order of a frame."""
        names = dict.fromkeys([*STAGES, *(name for frame in self._frames for name in frame)])
        names = {name: None for name in names if any(name in frame for frame in self._frames)}
        return {name: float(np.median([frame[name] for frame in self._frames if name in frame])) for name in names}


class TactileStream:
    """Depth of every frame of a camera, a video or a folder of images.

    The first frames must be without contact (:func:`find_background`). Without a calibration the unit is calibrated from them
    (:func:`calibrate_background`); with one they are compared with its background. Then each frame is rectified and goes the way
    of :class:`Recording`, which data sets share. Of cameras, and of recordings with ``realtime``, only the newest frame is taken
    and late ones are dropped; of other recordings all are. A frame that cannot be used (:class:`FrameCheck`) is left out.

    Args:
        source: a camera's index, a network camera's URL, a video file, a folder of images, or a :class:`Reader`.
        sensor_or_calibration: the sensor, which rectifies; or a calibration, if there is one.
        mode: "fast", "precise" or "auto".
        background_frames: number of frames without contact at the start; 0, with a calibration, uses that as it is.
        presses: of balls, to calibrate with; only without a calibration.
        realtime: play a recording at its own rate as if it were a camera.
        follow: follow slow drift of the light.
        network: a trained network in place of the calibration's model, see :func:`torchvts.pipeline.unit_pipeline`.
        device: of the pipeline, "cpu" or "cuda".
        time_constant_s: of following.
        reconnect_s: for how long a camera that has stopped is opened again before an error is raised; not with a :class:`Reader`.
        contact: thresholds of contact; None for the usual ones.
        clock: for tests.
    Attributes:
        calibration: of the unit.
        note: where the calibration comes from and what to expect of it, in words.
        metric: whether depth is in mm, as far as is known.
        dropped: number of frames that nobody took.
        left_out: (number, reason) of the frames that could not be used.
        stages: :class:`StageClock`.
        light: :class:`FollowLight`.
        fps: rate of the source.
    Raises:
        ValueError: contact or changing light in the first frames, or a source that cannot be read.
        OSError: no such source; also while frames are read: a camera was unplugged, or has stopped.
    Example:
        >>> with TactileStream(0, Sensor.load("gelsight_mini")) as stream:  # doctest: +SKIP
        ...     for number, time_s, image, out in stream:
        ...         print(number, float(out.depth_mm.max()))
    """

    def __init__(
        self,
        source: str | int | Path | Reader,
        sensor_or_calibration: Sensor | Calibration,
        *,
        mode: str = "auto",
        background_frames: int = FIRST_FRAMES,
        presses: Sequence[Press] = (),
        realtime: bool = False,
        follow: bool = True,
        network: str | Path | None = None,
        device: str = "cpu",
        time_constant_s: float = TIME_CONSTANT_S,
        reconnect_s: float = 0.0,
        contact: ContactSettings | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_choice("mode", mode, MODES)
        time_constant_s = check_positive("time_constant_s", time_constant_s)
        if contact is not None:
            check_record("contact", contact, ContactSettings, "ContactSettings(sigmas=...) makes one")
        if not isinstance(sensor_or_calibration, Sensor | Calibration):
            raise TypeError(
                f"sensor_or_calibration: expected a Sensor or a Calibration, got {type(sensor_or_calibration).__name__}"
            )
        given = isinstance(sensor_or_calibration, Calibration)
        check_integer("background_frames", background_frames, 0 if given else 3)
        if given and len(presses) > 0:
            raise ValueError(f"presses: expected none beside a calibration, got {len(presses)}: they are for calibrating")
        check_least("reconnect_s", reconnect_s)
        for name, switch in (("realtime", realtime), ("follow", follow)):
            check_switch(name, switch)
        self.reader: Reader
        if isinstance(source, str | int | Path):
            self.reader = open_source(source, reconnect_s)
        elif reconnect_s > 0:
            raise ValueError(f"reconnect_s: expected 0 with a reader of your own, got {reconnect_s:g}: it must reconnect by itself")
        else:
            self.reader = check_reader(source)
        self._newest: NewestFrame | None = None
        self._clock = clock
        self.left_out: list[tuple[int, str]] = []
        self._zero: list[Tensor] = []
        self._zero_missing = 0
        self._realtime = realtime or self.reader.live
        self.fps = self.reader.fps
        self.stages = StageClock()
        try:
            self._waiting = self._first_frames(background_frames)
            sensor = sensor_or_calibration if isinstance(sensor_or_calibration, Sensor) else sensor_or_calibration.sensor
            readable = [pixels for pixels in self._waiting if not isinstance(pixels, Unreadable)]
            self.rectify = Rectify(sensor, *readable[0].shape[:2])
            first = torch.cat([self._rectified(pixels) for pixels in readable])
            if isinstance(sensor_or_calibration, Sensor):
                found = calibrate_background(find_background(first, sensor)[0].clamp(0.0, 1.0), sensor, presses)
            else:
                found = use_calibration(sensor_or_calibration)
            self.calibration, self.note, self.metric = found
            self._start = partial(
                Recording,
                mode=mode,
                fps=self.fps,
                follow=follow,
                network=network,
                device=device,
                time_constant_s=time_constant_s,
                contact=contact,
                stage=self.stages.stage,
            )
            self._use(self._start(self.calibration, first=first if background_frames > 0 else None))
        except BaseException:
            self.reader.close()
            raise

    def _rectified(self, pixels: Pixels) -> Tensor:
        frame: Tensor = self.rectify(rgb_from_bgr(pixels)[None])
        return frame.clamp_(0.0, 1.0)

    def rezero(self, frames: int = FIRST_FRAMES) -> None:
        """Take the next frames, which must be without contact, as the background; until then depth goes on as before.

        Where contact or changing light is seen in them, a warning says so and the background stays.

        Args:
            frames: number of frames, at least 3.
        """
        self._zero, self._zero_missing = [], check_integer("frames", frames, 3)

    def _use(self, recording: Recording) -> None:
        """Go on with a recording: the first one, or that of a new background."""
        self.recording, self.light, self.pipe = recording, recording.light, recording.pipe

    def _collect(self, raw: Tensor) -> None:
        """Keep a frame for the new background, and change to it when there are enough."""
        self._zero.append(raw)
        self._zero_missing -= 1
        if self._zero_missing > 0:
            return
        first = torch.cat(self._zero)
        self._zero = []
        try:
            background = find_background(first, self.calibration.sensor)[0].clamp(0.0, 1.0)
            calibration = with_background(self.calibration, background)
            self._use(self._start(calibration, first=first))
        except ValueError as error:
            warnings.warn(f"re-zero refused, the background stays: {error}", stacklevel=3)
        else:
            self.calibration = calibration

    @property
    def dropped(self) -> int:
        """Number of frames that arrived while another was being worked on, and were left out."""
        return 0 if self._newest is None else self._newest.dropped

    @property
    def reconnections(self) -> int:
        """How often a camera that had stopped was opened again."""
        return self.reader.reconnections if isinstance(self.reader, LiveReader) else 0

    def _first_frames(self, count: int) -> list[Pixels | Unreadable]:
        """The first frames, of which ``count`` can be read, at least one."""
        if self.reader.live:  # exposure settles
            for _ in range(SETTLING):
                self.reader.read()
        frames: list[Pixels | Unreadable] = []
        readable = 0
        while readable < max(1, count):
            pixels = self.reader.read()
            if pixels is None:
                break
            if not isinstance(pixels, Unreadable):
                check_pixels(f"source: frame {len(frames)} of {self.reader.name}", pixels)
            frames.append(pixels)
            readable += not isinstance(pixels, Unreadable)
        if readable < max(1, count):
            raise ValueError(
                f"background_frames: expected at least {count} frames from {self.reader.name}, got {readable}: ask for fewer"
            )
        return frames

    def __enter__(self) -> "TactileStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop reading and release the source."""
        if self._newest is not None:
            self._newest.close()
        else:
            self.reader.close()

    def __iter__(self) -> Iterator[TactileFrame]:
        for index, time_s, pixels in self._frames():
            with self._threads(pixels):
                with self.stages.stage("rectify"):
                    raw, reason = self._usable(pixels)
                if raw is not None and self._zero_missing:
                    self._collect(raw)
                found = None if raw is None else self.recording(raw, time_s)
            if found is None:
                self.left_out.append((index, reason))
                warnings.warn(f"frame {index} left out: {reason}", stacklevel=2)
                continue
            image, output = found
            assert output is not None
            yield TactileFrame(index, time_s, image[0], output)
            self.stages.end_frame()

    def _threads(self, pixels: Pixels | Unreadable) -> AbstractContextManager[None]:
        """A small frame is worked on in one thread: others would wake up late between frames."""
        small = not isinstance(pixels, Unreadable) and pixels.shape[0] * pixels.shape[1] <= MOST_PIXELS
        return OneThread() if small else nullcontext()

    def _usable(self, pixels: Pixels | Unreadable) -> tuple[Tensor | None, str]:
        """A frame rectified; or None, and why it cannot be used."""
        if isinstance(pixels, Unreadable):
            return None, pixels.reason
        try:
            raw = self._rectified(pixels)
        except ValueError as error:
            return None, str(error)
        reason = self.recording.unusable(raw)
        return (None, reason) if reason else (raw, "")

    def _frames(self) -> Iterator[tuple[int, float, Pixels | Unreadable]]:
        if self._realtime:
            reader = self.reader if self.reader.live else Replay(self.reader, self._waiting)
            self._waiting = []
            self._newest = NewestFrame(reader, None if self.reader.live else self.fps, self._clock)
            while (item := self._take()) is not None:
                yield item
            return
        for index, pixels in enumerate(self._waiting):
            yield index, index / self.fps, pixels
        index = len(self._waiting)
        self._waiting = []
        while True:
            with self.stages.stage("read"):
                pixels_or_end = self.reader.read()
            if pixels_or_end is None:
                return
            yield index, index / self.fps, pixels_or_end
            index += 1

    def _take(self) -> tuple[int, float, Pixels | Unreadable] | None:
        assert self._newest is not None
        with self.stages.stage("wait"):
            return self._newest.take()
