"""A tactile sensor as a camera of LeRobot: the image and the depth of the newest frame."""

import logging
import threading
import time
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.cameras import Camera, CameraConfig
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from numpy.typing import NDArray

from torchvts import Calibration
from torchvts.stream import FIRST_FRAMES, TactileStream
from torchvts.stream.devices import list_cameras
from torchvts.stream.messages import lerobot_frame


@CameraConfig.register_subclass("torchvts")
@dataclass(kw_only=True)
class TactileCameraConfig(CameraConfig):
    """A unit of a tactile sensor.

    Attributes:
        source: as of :class:`torchvts.stream.TactileStream`: the camera's number, name or serial number, or a recording.
        calibration: file of the unit's calibration; ``width`` and ``height``, where they are given, must be its sensor's.
        background_frames: frames without contact at the start.
        use_rgb: LeRobot records the image.
        use_depth: LeRobot records depth.
    """

    source: str
    calibration: str
    background_frames: int = FIRST_FRAMES
    use_rgb: bool = True
    use_depth: bool = True


class TactileCamera(Camera):
    """The rectified image, uint8 (H, W, 3), R, G, B, and depth, float32 (H, W, 1), metres: how far the skin is pressed in."""

    def __init__(self, config: TactileCameraConfig) -> None:
        super().__init__(config)
        self.config, self.use_rgb, self.use_depth = config, config.use_rgb, config.use_depth
        self.calibration = Calibration.load(config.calibration)
        sensor = self.calibration.sensor
        for name, asked, own in (("width", config.width, sensor.width), ("height", config.height, sensor.height)):
            if asked not in (None, own):
                raise ValueError(f"{name}: expected {own}, which sensor {sensor.name!r} of {config.calibration} has, got {asked}")
        self.width, self.height = sensor.width, sensor.height
        self._stream: TactileStream | None = None
        self._changed = threading.Condition()

    @property
    def is_connected(self) -> bool:
        """Whether the source is open."""
        return self._stream is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The cameras of this machine (Linux)."""
        return [{"name": device.names[0], "type": "torchvts", "id": device.node} for device in list_cameras()]

    @check_if_already_connected
    def connect(self, warmup: bool = True) -> None:
        """Open the source, whose first frames must be without contact; ``warmup`` waits for the first depth."""
        stream = TactileStream(self.config.source, self.calibration, background_frames=self.config.background_frames, realtime=True)
        logging.getLogger(__name__).info(str(stream.calibration))
        self._newest: tuple[float, dict[str, NDArray[Any]]] | None = None
        self._fresh = False
        self._ended: Exception | None = None
        self._stream = stream
        self._thread = threading.Thread(target=self._run, args=(stream,), name="torchvts-lerobot", daemon=True)
        self._thread.start()
        if warmup:
            with self._changed:
                self._changed.wait_for(lambda: self._newest or self._ended, 10.0)

    def _run(self, stream: TactileStream) -> None:
        ended: Exception = TimeoutError(f"{self.config.source}: no frame came: the recording has ended")
        try:
            with torch.inference_mode():
                for frame in stream:
                    arrays = lerobot_frame(frame, self.calibration.sensor.mm_per_pixel)
                    with self._changed:
                        self._newest, self._fresh = (stream.started_s + frame.time_s, arrays), True
                        self._changed.notify_all()
        except Exception as error:  # raised by the next read
            ended = error
        with self._changed:
            self._ended = ended
            self._changed.notify_all()

    @check_if_not_connected
    def read(self) -> NDArray[Any]:
        """The image of the next frame; waits for it."""
        self._fresh = False
        return self.async_read(timeout_ms=10_000)

    @check_if_not_connected
    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """The image of the newest frame that was not read by this; waits for it, then raises :class:`TimeoutError`."""
        with self._changed:
            self._changed.wait_for(lambda: self._fresh or self._ended, timeout_ms / 1e3)
            if not self._fresh:
                raise self._ended or TimeoutError(f"{self.config.source}: no frame came within {timeout_ms:g} ms")
            self._fresh = False
        return self.read_latest(float("inf"))

    @check_if_not_connected
    def read_latest_depth(self, max_age_ms: float = 500) -> NDArray[Any]:
        """As :meth:`read_latest`: depth."""
        return self.read_latest(max_age_ms, "tactile_depth")

    @check_if_not_connected
    def read_latest(self, max_age_ms: float = 500, key: str = "tactile") -> NDArray[Any]:
        """The image of the newest frame; one older than ``max_age_ms`` raises :class:`TimeoutError`."""
        with self._changed:
            if self._newest is None:
                raise RuntimeError(f"{self.config.source}: no frame has come yet: connect with warmup=True")
            taken_s, arrays = self._newest
            age_ms = 1e3 * (time.monotonic() - taken_s)
            if age_ms > max_age_ms:
                raise self._ended or TimeoutError(f"{self.config.source}: the newest frame is {age_ms:.0f} ms old")
            return arrays[f"observation.images.{key}"]

    def disconnect(self) -> None:
        """Release the source."""
        if self._stream is not None:
            self._stream.close()
            self._thread.join(timeout=5.0)
            self._stream = None
