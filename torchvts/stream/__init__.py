"""Depth of cameras, videos and folders of images, frame by frame; late frames are dropped, slow drift of the light is followed."""

from . import messages
from .aside import Aside
from .background import (
    FIRST_FRAMES,
    NOT_METRIC,
    calibrate_background,
    find_background,
    read_background,
    read_press_images,
    use_calibration,
)
from .follow_light import FollowLight
from .live import StageClock, TactileFrame, TactileStream
from .overlay import Overlay, Sheet, StreamReport, VideoFile, Window, has_display
from .recording import Recording, check_device
from .sources import NewestFrame, Reader, Rectify, RectifySizes, Unreadable, frames_a_second, open_source
from .usable import FrameCheck

__all__ = [
    "FIRST_FRAMES",
    "NOT_METRIC",
    "Aside",
    "FollowLight",
    "FrameCheck",
    "NewestFrame",
    "Overlay",
    "Reader",
    "Recording",
    "Rectify",
    "RectifySizes",
    "Sheet",
    "StageClock",
    "StreamReport",
    "TactileFrame",
    "TactileStream",
    "Unreadable",
    "VideoFile",
    "Window",
    "calibrate_background",
    "check_device",
    "find_background",
    "frames_a_second",
    "has_display",
    "messages",
    "open_source",
    "read_background",
    "read_press_images",
    "use_calibration",
]
