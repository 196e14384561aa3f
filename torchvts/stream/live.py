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
from .background import (
    FIRST_FRAMES,
    find_background,
    with_background,
)
from .cameras import AS_IT_IS, CameraSettings
from .numbered import SourceFrames
from .record import Recorder
from .recording import NotAtRest, Recording
from .sources import LiveReader, Reader, Unreadable, check_reader, open_source
from .stages import StageClock

UNKNOWN_LIGHT = (
    "background: how sensor '{0}' is lit cannot be found in its first {1} frames alone: press a ball of known diameter at some "
    "places, and give the images: torchvts calibrate background.png --sensor FILE --press ball.png 6.31 --press ... makes what "
    "--calibration takes (presses=[...] in Python)"
)
"""What is said where the first frames, taken for the background, fit the model that was found in them badly."""


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

    The first frames must be without contact (:func:`find_background`). Without a calibration the unit is calibrated from them
    (:func:`torchvts.calibrate`), and ``print(stream.calibration)`` says what speaks against it; with one they are compared with its
    background. Then each frame is rectified and goes the way of :class:`Recording`, which data sets share. Of cameras, and of
    recordings with ``realtime``, only the newest frame is taken and late ones are dropped; of other recordings all are. A frame
    that cannot be used (:class:`FrameCheck`) is left out.

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
        self._zero_missing = 0
        self.recorder: Recorder | None = None
        self._frames = SourceFrames(_reader_of(source, reconnect_s, settings), realtime, self.stages)
        self._begin = partial(Recording, mode=mode, network=network, device=device, contact=contact, stage=self.stages.stage)
        try:
            if record is not None:
                self._record(record)
            readable = self._frames.read_first(background_frames)
            self._size = readable[0].shape[:2]
            first = torch.cat([self._rectified(pixels) for pixels in readable])
            self.calibration = _calibrated(first, sensor_or_calibration, presses)
            self.recording = self._begin(self.calibration, first=first if background_frames > 0 else None)
        except BaseException as error:
            self.close()
            if isinstance(error, NotAtRest) and isinstance(sensor_or_calibration, Sensor):  # what these frames made fits none
                raise ValueError(UNKNOWN_LIGHT.format(self._sensor.name, int(background_frames))) from error
            raise

    def _record(self, path: str | Path) -> None:
        """Record the camera from now on."""
        if not isinstance(self.reader, LiveReader):
            raise ValueError(f"record: expected a camera, got {self.reader.name}: it is a recording already")
        self.recorder = Recorder(path, self.fps)
        self.reader.keep = self.recorder.add

    def _rectified(self, pixels: Pixels) -> Tensor:
        frame = rgb_from_bgr(pixels)[None]
        if pixels.shape[:2] != self._size:
            raise ValueError(f"frame: expected {self._size} like the first, got {pixels.shape[:2]}: the source has changed")
        found = self._sensor.rectify(frame)
        return found if found is frame else found.clamp(0.0, 1.0)

    def rezero(self, frames: int = FIRST_FRAMES) -> None:
        """Take the next frames, which must be without contact, as the background; until then depth goes on as before.

        Where contact or changing light is seen in them, a warning says so and the background stays.

        Args:
            frames: number of frames, at least 3.
        """
        self._zero, self._zero_missing = [], check_integer("frames", frames, 3)

    def _collect(self, raw: Tensor) -> None:
        """Keep a frame for the new background, and change to it when there are enough."""
        self._zero.append(raw)
        self._zero_missing -= 1
        if self._zero_missing > 0:
            return
        first = torch.cat(self._zero)
        self._zero = []
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
            with self.stages.stage("rectify"):
                raw, reason = self._usable(pixels)
            if raw is not None and self._zero_missing:
                self._collect(raw)
            if raw is None:
                self.left_out.append((index, reason))
                warnings.warn(f"frame {index} left out: {reason}", stacklevel=2)
                continue
            output = self.recording(raw)
            if self.doubt and not self._doubted:
                warnings.warn(f"frame {index}: {self.doubt}", stacklevel=2)
            self._doubted = bool(self.doubt)
            yield TactileFrame(index, time_s, raw[0], output)
            self.stages.end_frame()

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
    if settings.given:
        raise ValueError(f"settings: expected none with a reader of your own, got {settings}: it must ask the driver by itself")
    return check_reader(source)
