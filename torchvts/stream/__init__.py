"""Floor 4: frames as they come: a camera, a video or a folder of images in, depth out; late frames dropped, slow light followed."""

from .background import FollowLight, calibrate_at_rest, rest_image
from .live import StageClock, TactileFrame, TactileStream
from .overlay import Overlay, StreamReport, VideoFile, Window, has_display
from .sources import NewestFrame, Reader, Rectify, open_source

__all__ = [
    "FollowLight",
    "NewestFrame",
    "Overlay",
    "Reader",
    "Rectify",
    "StageClock",
    "StreamReport",
    "TactileFrame",
    "TactileStream",
    "VideoFile",
    "Window",
    "calibrate_at_rest",
    "has_display",
    "open_source",
    "rest_image",
]
