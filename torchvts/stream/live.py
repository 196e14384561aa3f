"""Depth of every frame of a source, with the time of each stage."""

import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import CalibrationWarning, Press, calibrate
from ..core.checks import check_choice, check_integer, check_least, check_record, check_switch
from ..core.files import Pixels, rgb_from_bgr
from ..model import Calibration, Sensor
from ..pipeline import MODES, Conditions, DepthOutput
from ..skin import ContactSettings
from .background import FIRST_FRAMES, find_background, with_background
from .cameras import AS_IT_IS, CameraSettings
from .numbered import SourceFrames
from .record import Recorder
from .recording import NotAtRest, Recording
from .sources import LiveReader, Reader, Unreadable, check_reader, open_source
from .stages import StageClock


class TactileFrame(NamedTuple):
    """A frame and its depth.

    Attributes:
        number: in the source, from 0.
        time_s: since the start of the source.
        image: (3, H, W), rectified.
        output: of the pipeline.
    """

    number: int
    time_s: float
    image: Tensor
    output: DepthOutput


class TactileStream:
    """Depth of every frame of a camera, a video or a folder of images.

    The first frames must be without contact (:func:`find_background`). Without a calibration the unit is calibrated from them; with
    one they are compared with its background. Then each frame is rectified and goes the way of :class:`Recording`. Of cameras, and
    of recordings with ``realtime``, late frames are dropped. A frame that cannot be used (:class:`FrameCheck`) is left out.

    Args:
        source: a camera (:func:`find_camera`), a network camera's URL, a video file, a folder of images, or a :class:`Reader`.
        sensor_or_calibration: the sensor, which rectifies; or a calibration, if there is one.
        mode: "fast" or "precise".
        background_frames: number of frames without contact at the start; 0, with a calibration, uses that as it is.
        presses: of balls, to calibrate with; only without a calibration.
        realtime: play a recording at its own rate as if it were a camera.
        network: a trained network in place of the calibration's model, see :func:`torchvts.pipeline.unit_pipeline`.
        device: of the pipeline, "cpu" or "cuda".
        reconnect_s: for how long a camera that has stopped is opened again before an error is raised; not with a :class:`Reader`.
        contact: thresholds of contact; None for the usual ones.
        record: where the raw frames of a camera are written, see :class:`Recorder`; None for nowhere.
        settings: size, rate, exposure and white balance of a camera; not with a :class:`Reader`.
    Attributes:
        calibration: of the unit.
        left_out: (number, reason) of the frames that could not be used.
        recording: :class:`Recording`, that of the calibration and its background.
        recorder: :class:`Recorder` of the raw frames; None without ``record``.
        stages: :class:`StageClock`.
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
        mode: str = "fast",
        background_frames: int = FIRST_FRAMES,
        presses: Sequence[Press] = (),
        realtime: bool = False,
        network: str | Path | None = None,
        device: str = "cpu",
        reconnect_s: float = 0.0,
        contact: ContactSettings | None = None,
        record: str | Path | None = None,
        settings: CameraSettings = AS_IT_IS,
    ) -> None:
        check_choice("mode", mode, MODES)
        if contact is not None:
            check_record("contact", contact, ContactSettings, "ContactSettings(sigmas=...) makes one")
        check_record("settings", settings, CameraSettings)
        check_switch("realtime", realtime)
        self._sensor = _sensor_of(sensor_or_calibration, background_frames, presses)
        self.stages = StageClock()
        self.left_out: list[tuple[int, str]] = []
        self._zero: list[Tensor] = []
        self._doubted = False
        self._zero_frames = 0
        self.recorder: Recorder | None = None
        self._frames = SourceFrames(_reader_of(source, reconnect_s, settings), realtime, self.stages)
        self._begin = partial(Recording, mode=mode, network=network, device=device, contact=contact)
        try:
            if record is not None:
                if not isinstance(self.reader, LiveReader):
                    raise ValueError(f"record: expected a camera, got {self.reader.name}: it is a recording already")
                self.recorder = Recorder(record, self.fps)
                self.reader.keep = self.recorder.add
            readable = self._frames.read_first(background_frames)
            self._size = readable[0].shape[:2]
            first = torch.cat([self._rectified(pixels) for pixels in readable])
            self.calibration = _calibrated(first, sensor_or_calibration, presses)
            self.recording = self._begin(self.calibration, first=first if background_frames > 0 else None)
        except BaseException as error:
            self.close()
            if isinstance(error, NotAtRest) and isinstance(sensor_or_calibration, Sensor):  # the model that these frames made
                raise ValueError(
                    f"background: how sensor '{self._sensor.name}' is lit cannot be found in its first {background_frames} frames "
                    "alone: press a ball of known diameter at some places, and give the images: torchvts calibrate background.png "
                    "--sensor FILE --press ball.png 6.31 --press ... (presses=[...] in Python)"
                ) from error
            raise

    def _rectified(self, pixels: Pixels) -> Tensor:
        frame = rgb_from_bgr(pixels)[None]
        if pixels.shape[:2] != self._size:
            raise ValueError(f"frame: expected {self._size} like the first, got {pixels.shape[:2]}: the source has changed")
        found = self._sensor.rectify(frame)
        return found if found is frame else found.clamp(0.0, 1.0)

    def rezero(self, frames: int = FIRST_FRAMES) -> None:
        """Take the next ``frames``, at least 3, which must be without contact, as the background.

        Until then depth goes on as before. Where contact or changing light is seen, a warning says so and the background stays.
        """
        self._zero, self._zero_frames = [], check_integer("frames", frames, 3)

    def _collect(self, raw: Tensor) -> None:
        """Keep a frame for the new background, and change to it when there are enough."""
        self._zero.append(raw)
        if len(self._zero) < self._zero_frames:
            return
        first, self._zero, self._zero_frames = torch.cat(self._zero), [], 0
        try:
            background = find_background(first, self.calibration.sensor).clamp(0.0, 1.0)
            calibration = with_background(self.calibration, background)
            self.recording, self.calibration = self._begin(calibration, first=first), calibration
        except ValueError as error:
            warnings.warn(f"re-zero refused, the background stays: {error}", stacklevel=3)

    @property
    def reader(self) -> Reader:
        """What reads the source."""
        return self._frames.reader

    @property
    def fps(self) -> float:
        """Rate of the source, frames a second."""
        return self.reader.fps

    @property
    def metric(self) -> bool:
        """Whether depth is in mm, as far as is known."""
        return self.calibration.metric

    @property
    def conditions(self) -> Conditions | None:
        """What the last frame was seen under; None before the first."""
        return self.recording.conditions

    @property
    def doubt(self) -> str:
        """Why less may have been seen in the last frame than is there, in words; "" for nothing."""
        return self.recording.doubt

    @property
    def started_s(self) -> float:
        """Time 0 of the frames by :func:`time.monotonic`, the clock of all streams; of a recording that waits, its opening."""
        return self._frames.started_s

    @property
    def dropped(self) -> int:
        """Number of frames that arrived while another was being worked on, and were left out."""
        return self._frames.dropped

    def __enter__(self) -> "TactileStream":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop reading, release the source, and finish what is recorded."""
        self._frames.close()
        if self.recorder is not None:
            self.recorder.close()

    def __iter__(self) -> Iterator[TactileFrame]:
        for index, time_s, pixels in self._frames:
            try:
                with self.stages.stage("rectify"):
                    raw = self._usable(pixels)
            except ValueError as error:
                self.left_out.append((index, str(error)))
                warnings.warn(f"frame {index} left out: {error}", stacklevel=2)
                continue
            if self._zero_frames:
                self._collect(raw)
            with self.stages.stage("depth"):
                output = self.recording(raw)
            if self.doubt and not self._doubted:
                warnings.warn(f"frame {index}: {self.doubt}", stacklevel=2)
            self._doubted = bool(self.doubt)
            yield TactileFrame(index, time_s, raw[0], output)
            self.stages.end_frame()

    def _usable(self, pixels: Pixels | Unreadable) -> Tensor:
        """A frame rectified; ValueError where it cannot be used."""
        if isinstance(pixels, Unreadable):
            raise ValueError(pixels.reason)
        raw = self._rectified(pixels)
        if reason := self.recording.unusable(raw):
            raise ValueError(reason)
        return raw


def _sensor_of(unit: Sensor | Calibration, background_frames: int, presses: Sequence[Press]) -> Sensor:
    """The sensor of a unit, and whether first frames and presses go with it."""
    if not isinstance(unit, Sensor | Calibration):
        raise TypeError(f"sensor_or_calibration: expected a Sensor or a Calibration, got {type(unit).__name__}")
    if isinstance(unit, Sensor):
        check_integer("background_frames", background_frames, 3)
        return unit
    check_integer("background_frames", background_frames, 0)
    if len(presses) > 0:
        raise ValueError(f"presses: expected none beside a calibration, got {len(presses)}: they are for calibrating")
    return unit.sensor


def _calibrated(first: Tensor, unit: Sensor | Calibration, presses: Sequence[Press]) -> Calibration:
    """The calibration that was given, or that of the first frames, whose doubts it holds itself."""
    if isinstance(unit, Calibration):
        return unit
    background = find_background(first, unit).clamp(0.0, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return calibrate(background, unit, presses)


def _reader_of(source: str | int | Path | Reader, reconnect_s: float, settings: CameraSettings) -> Reader:
    """Open a source, or take a reader of the user's own."""
    if isinstance(source, str | int | Path):
        return open_source(source, reconnect_s, settings)
    if check_least("reconnect_s", reconnect_s) > 0:
        raise ValueError(f"reconnect_s: expected 0 with a reader of your own, got {reconnect_s:g}: it must reconnect by itself")
    if settings != AS_IT_IS:
        raise ValueError(f"settings: expected none with a reader of your own, got {settings}: it must ask the driver by itself")
    return check_reader(source)
