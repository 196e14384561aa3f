"""Depth of every frame of a source, with the time of each stage."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import check_choice, check_integer, check_positive
from ..core.files import rgb_from_bgr
from ..model.calibration import Calibration
from ..model.sensor import Sensor
from ..pipeline import MODES, DepthOutput, DepthPipeline
from .background import TIME_CONSTANT_S, FollowLight, calibrate_at_rest, contact_in_video, given_at_rest, rest_image
from .sources import NewestFrame, Pixels, Reader, Rectify, Replay, open_source


class TactileFrame(NamedTuple):
    """number in the source, from 0; time_s since its start; image (3, H, W), rectified, in the background's light; the depth."""

    number: int
    time_s: float
    image: Tensor
    output: DepthOutput


class StageClock:
    """Milliseconds by stage, of the last 10,000 frames."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._frames: deque[dict[str, float]] = deque(maxlen=10_000)  # a camera may run for days
        self._now: dict[str, float] = {}
        self._started: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is done inside."""
        start = self._clock()
        try:
            yield
        finally:
            self._now[name] = self._now.get(name, 0.0) + 1000.0 * (self._clock() - start)

    def watch(self, pipe: DepthPipeline) -> list[Any]:
        """Time the blocks of a pipeline; returns what ``remove()`` ends it."""
        handles: list[Any] = []
        for name in ("compensate", "contact", "normals", "gradient", "integrate"):
            block = getattr(pipe, name)

            def before(_module: nn.Module, _inputs: Any, name: str = name) -> None:
                self._started[name] = self._clock()

            def after(_module: nn.Module, _inputs: Any, _output: Any, name: str = name) -> None:
                self._now[name] = self._now.get(name, 0.0) + 1000.0 * (self._clock() - self._started[name])

            handles += [block.register_forward_pre_hook(before), block.register_forward_hook(after)]
        return handles

    def end_frame(self) -> None:
        """What was timed since the last call was one frame."""
        self._frames.append(self._now)
        self._now = {}

    @property
    def last(self) -> dict[str, float]:
        """Stages of the last whole frame, ms."""
        return self._frames[-1] if self._frames else {}

    def median_ms(self) -> dict[str, float]:
        """Median of each stage over the frames in which it ran."""
        names = dict.fromkeys(name for frame in self._frames for name in frame)
        return {name: float(np.median([frame[name] for frame in self._frames if name in frame])) for name in names}


def _reader(source: Reader) -> Reader:
    if not callable(getattr(source, "read", None)):
        raise TypeError(f"source: expected a path, a camera's index or a Reader, got {type(source).__name__}")
    return source


class TactileStream:
    """Depth of every frame of a camera, a video or a folder of images.

    The first frames are taken at rest (:func:`rest_image`); without a calibration the unit is calibrated from them
    (:func:`calibrate_at_rest`), with one they are held against its background and must be free of contact. Then each frame is
    rectified, brought into the background's light (:class:`FollowLight`), and sent through the pipeline. Of cameras, and of
    recordings with ``realtime``, only the newest frame is taken and late ones are dropped; of recordings else all.

    Args:
        source: a camera's index, a video file, a folder of images, or a :class:`Reader`.
        sensor_or_calibration: what rectifies, and the calibration, if there is one.
        mode: "fast", "precise" or "auto". background_frames: how many frames are at rest at the start.
        realtime: play a recording at its own rate as if it were a camera. follow: follow slow drift of the light.
        time_constant_s: of following.
    Attributes:
        calibration; told: what is to be known of it, in words; metric: whether depth is, as far as it knows;
        dropped: frames nobody took; stages: :class:`StageClock`;
        light: :class:`FollowLight`; fps: rate of the source.
    Raises:
        ValueError, OSError: the source, or contact or changing light in the first frames; says which.
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
        background_frames: int = 12,
        realtime: bool = False,
        follow: bool = True,
        time_constant_s: float = TIME_CONSTANT_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        check_choice("mode", mode, MODES)
        check_integer("background_frames", background_frames, 3)
        check_positive("time_constant_s", time_constant_s)
        given = sensor_or_calibration if isinstance(sensor_or_calibration, Calibration) else None
        if given is None and not isinstance(sensor_or_calibration, Sensor):
            raise TypeError(
                f"sensor_or_calibration: expected a Sensor or a Calibration, got {type(sensor_or_calibration).__name__}"
            )
        sensor = sensor_or_calibration.sensor if isinstance(sensor_or_calibration, Calibration) else sensor_or_calibration
        self.reader: Reader = open_source(source) if isinstance(source, str | int | Path) else _reader(source)
        self._newest: NewestFrame | None = None
        self._hooks: list[Any] = []
        try:
            self._clock, self._follow = clock, follow
            self._realtime = realtime or self.reader.live
            self.fps = self.reader.fps
            self.stages = StageClock()
            self._waiting = self._first_frames(background_frames)
            self.rectify = Rectify(sensor, *self._waiting[0].shape[:2])
            rest = torch.cat([self.rectify(rgb_from_bgr(pixels)[None]) for pixels in self._waiting])
            image, noise = rest_image(rest)
            at_rest = calibrate_at_rest(image, sensor) if given is None else given_at_rest(given)
            self.calibration, self.told, self.metric = at_rest
            value = self.calibration.background.float() ** (1.0 / self.calibration.sensor.exponent)
            self.light = FollowLight(value, time_constant_s)
            self.pipe = DepthPipeline.from_calibration(self.calibration, mode).float()
            self.pipe.contact = contact_in_video(self.calibration, noise)
            image = image[None].clamp(0.0, 1.0)
            if given is not None:
                self._check_rest(image)
            self.light.set_rest(self.light.correct(image))
            self._hooks = self.stages.watch(self.pipe)
        except BaseException:
            self.reader.close()
            raise

    @property
    def dropped(self) -> int:
        """Frames that came while another was worked on, and were left out."""
        return 0 if self._newest is None else self._newest.dropped

    def _first_frames(self, count: int) -> list[Pixels]:
        if self.reader.live:  # exposure settles
            for _ in range(5):
                self.reader.read()
        frames: list[Pixels] = []
        while len(frames) < count:
            pixels = self.reader.read()
            if pixels is None:
                break
            frames.append(pixels)
        if len(frames) < count:
            raise ValueError(
                f"background_frames: expected at least {count} frames from {self.reader.name}, got {len(frames)}: ask for fewer"
            )
        return frames

    def _check_rest(self, image: Tensor) -> None:
        """Bring the first frames into the calibration's light, and refuse a contact in them."""
        light = self.light
        light.start(image if self.calibration.markers is None else self.calibration.markers(image))
        level = max(abs(v - 1.0) for v in light.level)
        if level > 0.15:
            raise ValueError(
                f"background: the light is {level:.0%} off the calibration's: another unit, exposure or lamps; calibrate again"
            )
        with torch.inference_mode():
            contact = self.pipe.contact(self.pipe.compensate(light.correct(image)))
        if bool(contact.any()):
            raise ValueError(
                f"background: the first frames show contact on {float(contact.float().mean()):.1%} of the skin against the "
                "calibration's background: start without contact, or calibrate again if the skin has changed"
            )

    def __enter__(self) -> "TactileStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the reading and let go of the source."""
        for handle in self._hooks:
            handle.remove()
        self._hooks = []
        if self._newest is not None:
            self._newest.close()
        else:
            self.reader.close()

    def __iter__(self) -> Iterator[TactileFrame]:
        before = None
        for index, time_s, pixels in self._frames():
            with torch.inference_mode():
                with self.stages.stage("rectify"):
                    raw = self.rectify(rgb_from_bgr(pixels)[None]).clamp_(0.0, 1.0)
                with self.stages.stage("light"):
                    image = self.light.correct(raw)
                output = self.pipe(image)
                if self._follow:
                    with self.stages.stage("light"):
                        self.light.update(raw, output.contact, 1.0 / self.fps if before is None else time_s - before)
            before = time_s
            yield TactileFrame(index, time_s, image[0], output)
            self.stages.end_frame()

    def _frames(self) -> Iterator[tuple[int, float, Pixels]]:
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

    def _take(self) -> tuple[int, float, Pixels] | None:
        assert self._newest is not None
        with self.stages.stage("wait"):
            return self._newest.take()
