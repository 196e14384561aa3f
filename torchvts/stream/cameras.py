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

    @property
    def given(self) -> bool:
        """Whether anything is asked."""
        return any(value is not None for value in self)


AS_IT_IS = CameraSettings()
"""Nothing is asked."""


class Camera:
    """A camera (an index) or a network camera (a URL), by OpenCV; what the driver does not take of the settings is warned of.

    Where it does not take size or rate, as an uncompressed format may not allow them, they are asked for in MJPG.

    Args:
        source: the camera's index, or a URL.
        settings: what is asked of the driver.
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
            if not self._capture.isOpened() and isinstance(source, int):
                raise OSError(
                    f"source: expected a camera with index {source}, got none that opens: plugged in? in use elsewhere? "
                    f"{found_cameras()}"
                )
            if not self._capture.isOpened():
                raise OSError(
                    f"source: expected a network camera at {source}, got none that opens: is it on? is the address right?"
                )
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

        form, fixed = _asked(settings)
        if not self._take(form):
            self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))
            self._take(form)
        if settings.exposure is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0 if sys.platform.startswith("linux") else 0.25)
        if settings.white_balance is not None:
            self._capture.set(cv2.CAP_PROP_AUTO_WB, 0.0)
        self._take(fixed)
        for name, (key, value) in (form | fixed).items():  # read back when all are set: the size limits the rate
            if not self._takes(key, value):
                taken = float(self._capture.get(key))
                warnings.warn(f"{self.name}: asked for {name} {value:g}, the driver took {taken:g}", stacklevel=2)

    def _take(self, asked: dict[str, tuple[int, float]]) -> bool:
        """Ask the driver, and say whether it took all."""
        for key, value in asked.values():
            self._capture.set(key, value)
        return all(self._takes(key, value) for key, value in asked.values())

    def _takes(self, key: int, value: float) -> bool:
        return abs(float(self._capture.get(key)) - value) <= 0.01 * abs(value)


def _asked(settings: CameraSettings) -> tuple[dict[str, tuple[int, float]], dict[str, tuple[int, float]]]:
    """OpenCV's properties and values by name: of the frames, and of the light."""
    import cv2

    form: dict[str, tuple[int, float]] = {}
    if settings.size_px is not None:
        width, height = (check_integer("size_px", value, 1) for value in settings.size_px)
        form |= {"width": (cv2.CAP_PROP_FRAME_WIDTH, width), "height": (cv2.CAP_PROP_FRAME_HEIGHT, height)}
    if settings.fps is not None:
        form["fps"] = (cv2.CAP_PROP_FPS, check_positive("fps", settings.fps))
    fixed: dict[str, tuple[int, float]] = {}
    if settings.exposure is not None:
        fixed["exposure"] = (cv2.CAP_PROP_EXPOSURE, float(settings.exposure))
    if settings.white_balance is not None:
        fixed["white balance"] = (cv2.CAP_PROP_WB_TEMPERATURE, check_positive("white_balance", settings.white_balance))
    return form, fixed
