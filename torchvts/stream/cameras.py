"""Cameras by index, device path or name, with the resolution, rate and exposure that the driver takes."""

import sys
import warnings
from pathlib import Path
from typing import NamedTuple

from ..core.checks import check_integer, check_positive
from .sources import CaptureReader

_NAMES = Path("/sys/class/video4linux")


class CameraSettings(NamedTuple):
    """What is asked of a camera's driver; None leaves it as it is.

    Attributes:
        size_px: width and height of the frames.
        fps: frames a second.
        exposure: in the unit of the driver (Linux: 0.1 ms); automatic exposure is switched off.
    """

    size_px: tuple[int, int] | None = None
    fps: float | None = None
    exposure: float | None = None

    @property
    def given(self) -> bool:
        """Whether anything is asked."""
        return any(value is not None for value in self)


def find_camera(source: str, names: Path = _NAMES) -> int | None:
    """Index of the camera that a text names: digits, a path such as /dev/video2, or a part of the device's name; None if none does.

    Args:
        source: the text.
        names: folder where Linux lists the names of cameras.
    Raises:
        ValueError: several cameras have that name.
    """
    if source.isdigit():
        return int(source)
    if source.startswith("/dev/"):
        number = Path(source).resolve().name.removeprefix("video")
        return int(number) if number.isdigit() else None
    found: dict[str, list[int]] = {}
    if not Path(source).exists() and "://" not in source and names.is_dir():
        for device in sorted(names.glob("video*")):
            name = (device / "name").read_text(encoding="utf-8", errors="replace").strip()
            if source.lower() in name.lower():
                found.setdefault(name, []).append(int(device.name.removeprefix("video")))
    if len(found) > 1:
        raise ValueError(f"source: expected the name of one camera, got {source!r}, which {' and '.join(sorted(found))} have")
    return min(next(iter(found.values()))) if found else None  # one camera may have several nodes, of which the first gives frames


class Camera(CaptureReader):
    """A camera with settings; what the driver does not take is warned of.

    Args:
        index: the camera's index.
        settings: what is asked of the driver.
    Raises:
        OSError: no such camera.
        ValueError: settings that make no sense.
    """

    def __init__(self, index: int, settings: CameraSettings) -> None:
        import cv2

        super().__init__(index)
        try:
            asked: list[tuple[str, int, float]] = []
            if settings.size_px is not None:
                width, height = (check_integer("size_px", value, 1) for value in settings.size_px)
                asked += [("width", cv2.CAP_PROP_FRAME_WIDTH, width), ("height", cv2.CAP_PROP_FRAME_HEIGHT, height)]
            if settings.fps is not None:
                asked.append(("fps", cv2.CAP_PROP_FPS, check_positive("fps", settings.fps)))
            if settings.exposure is not None:
                manual = 1.0 if sys.platform.startswith("linux") else 0.25
                self._capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, manual)
                asked.append(("exposure", cv2.CAP_PROP_EXPOSURE, float(settings.exposure)))
            for _, key, value in asked:
                self._capture.set(key, value)
            for name, key, value in asked:  # read back when all are set: the size limits the rate
                taken = float(self._capture.get(key))
                if abs(taken - value) > 0.01 * abs(value):
                    warnings.warn(f"camera {index}: asked for {name} {value:g}, the driver took {taken:g}", stacklevel=2)
            if settings.fps is not None:
                self.fps = float(self._capture.get(cv2.CAP_PROP_FPS)) or self.fps
        except BaseException:
            self.close()
            raise
