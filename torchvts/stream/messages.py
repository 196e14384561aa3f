"""Frames of a stream as plain records for robots: the fields of ROS messages, and the features of a LeRobot data set.

Neither ROS nor LeRobot is imported. Field names, encodings and byte layouts are theirs, so their constructors take these records.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from ..core.checks import check_choice, check_positive
from ..core.geometry import depth_to_points
from ..model import Sensor
from .live import TactileFrame

__all__ = [
    "LEROBOT_DEPTH",
    "CloudMessage",
    "EpisodeDataset",
    "Header",
    "ImageMessage",
    "PointField",
    "cloud_message",
    "depth_message",
    "header",
    "image_message",
    "lerobot_features",
    "lerobot_frame",
    "record_episode",
]

Array = np.ndarray[Any, Any]

FLOAT32 = 7
"""``sensor_msgs/PointField.FLOAT32``."""

POINT_FIELDS = ("x", "y", "z", "normal_x", "normal_y", "normal_z")
"""Values of a point of :func:`cloud_message`, each a little-endian float32."""

STATE_NAMES = ("contact_area_mm2", "largest_depth_mm")
"""What :func:`lerobot_frame` states of a frame beside its images."""

LEROBOT_DEPTH = {"depth_min": -0.0001, "depth_max": 0.004, "use_log": False}
"""For LeRobot's ``DepthEncoderConfig``, metres: a video of depth has steps of 1 um up to 4 mm. Its own range begins at 10 mm."""


@dataclass(frozen=True)
class Header:
    """The fields of ``std_msgs/Header``, the stamp as its two integers.

    Attributes:
        sec: seconds of the stamp.
        nanosec: nanoseconds beyond these, 0 to 999,999,999.
        frame_id: name of the coordinate frame.
    """

    sec: int
    nanosec: int
    frame_id: str


@dataclass(frozen=True)
class ImageMessage:
    """The fields of ``sensor_msgs/Image``.

    Attributes:
        header: stamp and frame.
        height: rows.
        width: columns.
        encoding: "rgb8", or "32FC1" for depth in metres (REP 118).
        is_bigendian: 0.
        step: bytes of a row.
        data: step * height bytes, row by row.
    """

    header: Header
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: bytes


@dataclass(frozen=True)
class PointField:
    """The fields of ``sensor_msgs/PointField``: name, byte offset in a point, type, and number of values."""

    name: str
    offset: int
    datatype: int
    count: int


@dataclass(frozen=True)
class CloudMessage:
    """The fields of ``sensor_msgs/PointCloud2``, of an unordered cloud.

    Attributes:
        header: stamp and frame.
        height: 1.
        width: number of points; 0 without contact.
        fields: of a point, in the order of :data:`POINT_FIELDS`.
        is_bigendian: False.
        point_step: bytes of a point.
        row_step: bytes of all points.
        data: row_step bytes.
        is_dense: True: no point is invalid.
    """

    header: Header
    height: int
    width: int
    fields: tuple[PointField, ...]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: bytes
    is_dense: bool


def header(frame: TactileFrame, frame_id: str, start_s: float = 0.0) -> Header:
    """Stamp of a frame.

    Args:
        frame: of a :class:`TactileStream`.
        frame_id: name of the sensor's coordinate frame.
        start_s: the time at which the stream started, s; 0 counts from its start.
    Raises:
        ValueError: a time below zero, or not finite.
    """
    time_s = start_s + frame.time_s
    if not math.isfinite(time_s) or time_s < 0.0:
        raise ValueError(f"start_s: expected frame {frame.number} at 0 s or later, got {time_s}: ROS has no negative stamps")
    sec, nanosec = divmod(round(time_s * 1e9), 1_000_000_000)
    return Header(sec, nanosec, frame_id)


def image_message(frame: TactileFrame, frame_id: str = "tactile", start_s: float = 0.0) -> ImageMessage:
    """The camera's image, rectified, 8 bits of R, G, B, encoding "rgb8".

    Arguments are those of :func:`header`.
    """
    pixels = _rgb8(frame.image)
    height, width, _ = pixels.shape
    return ImageMessage(header(frame, frame_id, start_s), height, width, "rgb8", 0, 3 * width, pixels.tobytes())


def depth_message(frame: TactileFrame, frame_id: str = "tactile", start_s: float = 0.0) -> ImageMessage:
    """Depth in metres, as ROS wants it: how far the skin is pressed in, not the distance to the camera.

    Encoding "32FC1", little-endian. Arguments are those of :func:`header`.
    """
    depth_m = (1e-3 * _numpy(frame.output.depth_mm)[0, 0]).astype("<f4")
    height, width = depth_m.shape
    return ImageMessage(header(frame, frame_id, start_s), height, width, "32FC1", 0, 4 * width, depth_m.tobytes())


def cloud_message(frame: TactileFrame, mm_per_pixel: float, frame_id: str = "tactile", start_s: float = 0.0) -> CloudMessage:
    """The contact as points with normals: x right, y up, z towards the camera, metres.

    One point for each pixel in contact, none without contact. ``mm_per_pixel`` is the pitch, mm; the other arguments are those of
    :func:`header`.
    """
    out = frame.output
    points_m = 1e-3 * _numpy(depth_to_points(out.depth_mm, check_positive("mm_per_pixel", mm_per_pixel), out.contact))
    normals = _numpy(out.normal[0].movedim(0, -1)[out.contact[0, 0]]) * np.array([1.0, -1.0, 1.0])  # image y down, point y up
    values = np.concatenate((points_m, normals), axis=1).astype("<f4")
    fields = tuple(PointField(name, 4 * index, FLOAT32, 1) for index, name in enumerate(POINT_FIELDS))
    step = 4 * len(POINT_FIELDS)
    stamp = header(frame, frame_id, start_s)
    return CloudMessage(stamp, 1, len(values), fields, False, step, step * len(values), values.tobytes(), True)


def lerobot_features(sensor: Sensor, name: str = "tactile", image_dtype: str = "video") -> dict[str, dict[str, Any]]:
    """The features of a LeRobot data set that hold a tactile stream, for ``LeRobotDataset.create(..., features=...)``.

    Args:
        sensor: gives the size of the frames.
        name: of the sensor, as in "observation.images.<name>".
        image_dtype: "video" or "image": how the data set stores images and depth. Videos need :data:`LEROBOT_DEPTH`.
    Returns:
        Dtype, shape and names of the axes of the camera's image, of depth, whose unit is in its info, and of :data:`STATE_NAMES`.
    Example:
        >>> lerobot_features(Sensor("rig", 240, 320, 0.06))["observation.images.tactile_depth"]["info"]
        {'is_depth_map': True, 'depth_unit': 'm'}
    """
    check_choice("image_dtype", image_dtype, ("video", "image"))
    height, width = sensor.height, sensor.width
    axes, depth = ["height", "width", "channels"], {"is_depth_map": True, "depth_unit": "m"}
    return {
        f"observation.images.{name}": {"dtype": image_dtype, "shape": (height, width, 3), "names": axes},
        f"observation.images.{name}_depth": {"dtype": image_dtype, "shape": (height, width, 1), "names": axes, "info": depth},
        f"observation.{name}.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
    }


def lerobot_frame(frame: TactileFrame, mm_per_pixel: float, name: str = "tactile") -> dict[str, Array]:
    """A frame as the arrays that :func:`lerobot_features` describes.

    Args:
        frame: of a :class:`TactileStream`.
        mm_per_pixel: pitch, mm.
        name: of the sensor, as in the features.
    Returns:
        uint8 (H, W, 3), float32 (H, W, 1), depth in metres, and float32 (2,).
    """
    depth_mm = _numpy(frame.output.depth_mm)[0, 0].astype(np.float32)
    area_mm2 = float(frame.output.contact.sum()) * check_positive("mm_per_pixel", mm_per_pixel) ** 2
    return {
        f"observation.images.{name}": _rgb8(frame.image),
        f"observation.images.{name}_depth": (1e-3 * depth_mm)[..., None],
        f"observation.{name}.state": np.array([area_mm2, depth_mm.max()], dtype=np.float32),
    }


class EpisodeDataset(Protocol):
    """What :func:`record_episode` needs of a data set; ``lerobot.datasets.lerobot_dataset.LeRobotDataset`` has it."""

    def add_frame(self, frame: dict[str, Any]) -> None:
        """Add a frame to the episode."""

    def save_episode(self) -> None:
        """End the episode."""


def record_episode(
    frames: Iterable[TactileFrame],
    mm_per_pixel: float,
    dataset: EpisodeDataset,
    task: str,
    name: str = "tactile",
) -> int:
    """Write a stream as one episode of a LeRobot data set.

    Args:
        frames: a :class:`TactileStream`, or some of its frames.
        mm_per_pixel: pitch, mm.
        dataset: made with the features of :func:`lerobot_features`.
        task: what is done in the episode, in words.
        name: of the sensor, as in the features.
    Returns:
        The number of frames; without any the episode is not saved. Where the source stops with an error, or Ctrl-C ends it, the
        frames until then are saved, and the error is raised.
    """
    count = 0
    try:
        for frame in frames:
            dataset.add_frame({**lerobot_frame(frame, mm_per_pixel, name), "task": task})
            count += 1
    finally:
        if count > 0:
            dataset.save_episode()
    return count


def _numpy(tensor: Tensor) -> Array:
    values: Array = tensor.detach().cpu().numpy()
    return values


def _rgb8(image: Tensor) -> Array:
    """(3, H, W) in [0, 1] as uint8 (H, W, 3)."""
    rounded: Array = np.rint(255.0 * np.clip(_numpy(image), 0.0, 1.0)).astype(np.uint8)
    return np.ascontiguousarray(rounded.transpose(1, 2, 0))
