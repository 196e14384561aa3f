"""Depth of cameras, videos and folders of images, frame by frame; late frames are dropped."""

from ..model.usable import FrameCheck
from . import messages
from .background import FIRST_FRAMES, find_background, read_background, read_press_images, with_background
from .cameras import Camera, CameraSettings
from .devices import find_camera
from .files import StreamReport
from .keys import Keys
from .live import TactileFrame, TactileStream
from .overlay import Overlay, Sheet
from .record import Recorder
from .recording import Recording, check_device
from .sources import Reader, Unreadable, frames, open_source
from .stages import StageClock
from .video import VideoFile
from .view import LiveView, has_screen, require_rerun

__all__ = [
    "FIRST_FRAMES",
    "Camera",
    "CameraSettings",
    "FrameCheck",
    "Keys",
    "LiveView",
    "Overlay",
    "Reader",
    "Recorder",
    "Recording",
    "Sheet",
    "StageClock",
    "StreamReport",
    "TactileFrame",
    "TactileStream",
    "Unreadable",
    "VideoFile",
    "check_device",
    "find_background",
    "find_camera",
    "frames",
    "has_screen",
    "messages",
    "open_source",
    "read_background",
    "read_press_images",
    "require_rerun",
    "with_background",
]
