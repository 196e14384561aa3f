"""Depth of cameras, videos and folders of images, frame by frame; late frames are dropped, slow drift of the light is followed."""

from .background import calibrate_background, find_background
from .follow_light import FollowLight
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
    "calibrate_background",
    "find_background",
    "has_display",
    "open_source",
]
