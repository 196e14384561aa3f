"""Pose of pressed objects, and point clouds of contacts. Reading and registering clouds needs Open3D."""

from .clouds import contact_cloud, read_point_cloud, write_point_cloud
from .direct import register_depth
from .output_frame import OutputFrame
from .points import register_points
from .result import Registration
from .tracker import PoseTracker, TrackedPose

__all__ = [
    "OutputFrame",
    "PoseTracker",
    "Registration",
    "TrackedPose",
    "contact_cloud",
    "read_point_cloud",
    "register_depth",
    "register_points",
    "write_point_cloud",
]
