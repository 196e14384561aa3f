"""A camera, with the size, rate, exposure and white balance that its driver takes."""

import sys
import warnings
from typing import NamedTuple

from ..core.checks import check_integer, check_positive
from ..core.files import Pixels, check_text_name
from ..core.videos import frames_a_second
from .devices import found_cameras


class CameraSettings(NamedTuple):
    """What is asked of a camera's driver; None leaves it as it is.

    Attributes:
        size_px: width and height of the frames.
        fps: frames a second.
        exposure: in the unit of the driver (Linux: 0.1 ms); automatic exposure is switched off.
        white_balance: colour temperature, K; automatic white balance is switched off.
    """

    size_px: tuple[int, int] | None = None
    fps: float | None = None
    exposure: float | None = None
    white_balance: float | None = None


AS_IT_IS = CameraSettings()
"""Nothing is asked."""


class Camera:
    """A camera (an index) or a network camera (a URL), by OpenCV; what the driver does not take of the settings is warned of.

    Where it does not take size or rate, as an uncompressed format may not allow them, they are asked for in MJPG.

    Raises:
        OSError: no such camera.
        ValueError: settings that make no sense.
    """

    live = True

    def __init__(self, source: int | str, settings: CameraSettings = AS_IT_IS) -> None:
        import cv2

        self.name = f"camera {source}" if isinstance(source, int) else source
        self._capture = cv2.VideoCapture(source if isinstance(source, int) else check_text_name("source", source))
        try:
            if not self._capture.isOpened():
                hint = f"plugged in? in use elsewhere? {found_cameras()}"
                if isinstance(source, int):
                    raise OSError(f"source: expected a camera with index {source}, got none that opens: {hint}")
                raise OSError(f"source: expected a network camera at {source}, got none that opens: is the address right?")
            self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
            self._ask(settings)
        except BaseException:
            self.close()
            raise
        self.fps = frames_a_second(self._capture)

    def read(self) -> Pixels | None:
        there, pixels = self._capture.read()
        return pixels if there else None

    def close(self) -> None:
        self._capture.release()

    def _ask(self, settings: CameraSettings) -> None:
        """Ask the driver for the settings, and warn of those that it does not take."""
        import cv2

        form: dict[str, tuple[int, float]] = {}  # OpenCV's properties and values: of the frames, then of the light
        if settings.size_px is not None:
            width, height = (check_integer("size_px", value, 1) for value in settings.size_px)
            form |= {"width": (cv2.CAP_PROP_FRAME_WIDTH, width), "height": (cv2.CAP_PROP_FRAME_HEIGHT, height)}
        if settings.fps is not None:
            form["fps"] = (cv2.CAP_PROP_FPS, check_positive("fps", settings.fps))
        self._set(form)
        if self._not_taken(form):
            self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
            self._set(form)
        light: dict[str, tuple[int, float]] = {}
        if settings.exposure is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0 if sys.platform.startswith("linux") else 0.25)
            light["exposure"] = (cv2.CAP_PROP_EXPOSURE, float(settings.exposure))
        if settings.white_balance is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_WB, 0.0)
            light["white balance"] = (cv2.CAP_PROP_WB_TEMPERATURE, check_positive("white_balance", settings.white_balance))
        self._set(light)
        for text in self._not_taken(form | light):  # read back when all are set: the size limits the rate
            warnings.warn(f"{self.name}: asked for {text}", stacklevel=2)

    def _set(self, asked: dict[str, tuple[int, float]]) -> None:
        for key, value in asked.values():
            self._capture.set(key, value)

    def _not_taken(self, asked: dict[str, tuple[int, float]]) -> list[str]:
        """What the driver did not take of what was asked, in words."""
        taken = {name: float(self._capture.get(key)) for name, (key, _) in asked.items()}
        return [
            f"{name} {value:g}, the driver took {taken[name]:g}"
            for name, (_, value) in asked.items()
            if abs(taken[name] - value) > 0.01 * abs(value)
        ]
