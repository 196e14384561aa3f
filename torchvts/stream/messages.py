"""Frames of a stream as plain records for robots: the fields of ROS messages, and the features of a LeRobot data set.

Neither ROS nor LeRobot is imported. Field names, encodings and byte layouts are theirs, so their constructors take these records.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from ..core.checks import check_choice, check_integer, check_positive, check_record
from ..core.geometry import depth_to_points
from ..model import Sensor
from ..skin import DotMotion, SkinMotion
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
    "dots_message",
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

DOT_FIELDS = ("x", "y", "z", "dx", "dy", "dz")
"""Values of a point of :func:`dots_message`, likewise."""

STATE_NAMES = ("contact_area_mm2", "largest_depth_mm")
"""What :func:`lerobot_frame` states of a frame beside its images."""

LEROBOT_DEPTH = {"depth_min": -0.0001, "depth_max": 0.004, "use_log": False}
"""For LeRobot's ``DepthEncoderConfig``, metres: a video of depth has steps of 1 um up to 4 mm. Its own range begins at 10 mm."""


@dataclass(frozen=True)
class Header:
    """The fields of ``std_msgs/Header``, the stamp as its two integers: seconds, and nanoseconds beyond these."""

    sec: int
    nanosec: int
    frame_id: str


@dataclass(frozen=True)
class ImageMessage:
    """The fields of ``sensor_msgs/Image``; ``step`` are the bytes of a row."""

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
    """The fields of ``sensor_msgs/PointCloud2``, of a cloud in one row: ``height`` is 1, and ``width`` the number of points.

    ``fields`` are those of :data:`POINT_FIELDS` or :data:`DOT_FIELDS`; ``is_dense``: no point is NaN.
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
    """Stamp of a frame, of the sensor's coordinate frame ``frame_id``; ``start_s`` is when the stream started, 0 counts from then.

    Raises:
        ValueError: a time below zero, or not finite.
    """
    time_s = start_s + frame.time_s
    if not math.isfinite(time_s) or time_s < 0.0:
        raise ValueError(f"start_s: expected frame {frame.number} at 0 s or later, got {time_s}: ROS has no negative stamps")
    sec, nanosec = divmod(round(time_s * 1e9), 1_000_000_000)
    return Header(sec, nanosec, frame_id)


def image_message(frame: TactileFrame, frame_id: str = "tactile", start_s: float = 0.0) -> ImageMessage:
    """The camera's image, rectified, 8 bits of R, G, B, encoding "rgb8"; arguments as of :func:`header`."""
    pixels = _rgb8(frame.image)
    height, width, _ = pixels.shape
    return ImageMessage(header(frame, frame_id, start_s), height, width, "rgb8", 0, 3 * width, pixels.tobytes())


def depth_message(frame: TactileFrame, frame_id: str = "tactile", start_s: float = 0.0) -> ImageMessage:
    """How far the skin is pressed in, metres (REP 118), encoding "32FC1", little-endian; arguments as of :func:`header`."""
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
    return _cloud(header(frame, frame_id, start_s), POINT_FIELDS, np.concatenate((points_m, normals), axis=1))


def dots_message(frame: TactileFrame, moved: DotMotion, frame_id: str = "tactile", start_s: float = 0.0) -> CloudMessage:
    """Printed dots as points: where each is, and how far it has moved from rest, in the axes of :func:`cloud_message`, metres.

    Point k is dot k in all frames; a dot that is not seen is NaN. ``moved`` is what :class:`torchvts.SkinMotion` gives for the
    frame; the other arguments are those of :func:`header`.
    """
    check_record("moved", moved, DotMotion)
    displacement, rest = _numpy(moved.displacement_mm)[0], np.pad(_numpy(moved.rest_mm), ((0, 0), (0, 1)))
    values = 1e-3 * np.concatenate((rest + displacement, displacement), axis=1) * np.tile([1.0, -1.0, 1.0], 2)
    values[~_numpy(moved.seen)[0]] = np.nan
    return _cloud(header(frame, frame_id, start_s), DOT_FIELDS, values)


def _cloud(stamp: Header, names: tuple[str, ...], values: Array) -> CloudMessage:
    fields, step = tuple(PointField(name, 4 * index, FLOAT32, 1) for index, name in enumerate(names)), 4 * len(names)
    dense, data = not bool(np.isnan(values).any()), values.astype("<f4").tobytes()
    return CloudMessage(stamp, 1, len(values), fields, False, step, len(data), data, dense)


def lerobot_features(sensor: Sensor, name: str = "tactile", image_dtype: str = "video", dots: int = 0) -> dict[str, dict[str, Any]]:
    """The features of a LeRobot data set that hold a tactile stream, for ``LeRobotDataset.create(..., features=...)``.

    Args:
        sensor: gives the size of the frames.
        name: of the sensor, as in "observation.images.<name>".
        image_dtype: "video" or "image": how the data set stores images and depth. Videos need :data:`LEROBOT_DEPTH`.
        dots: printed dots whose motion is stored too, ``len(motion.rest_px)`` of a :class:`torchvts.SkinMotion`; 0 for none.
    Returns:
        Dtype, shape and names of the axes of the camera's image, of depth, whose unit is in its info, of :data:`STATE_NAMES`, and
        of the dots.
    Example:
        >>> lerobot_features(Sensor("rig", 240, 320, 0.06))["observation.images.tactile_depth"]["info"]
        {'is_depth_map': True, 'depth_unit': 'm'}
    """
    check_choice("image_dtype", image_dtype, ("video", "image"))
    height, width = sensor.height, sensor.width
    axes, depth = ["height", "width", "channels"], {"is_depth_map": True, "depth_unit": "m"}
    number = check_integer("dots", dots, 0)
    moved = {"dtype": "float32", "shape": (number, 4), "names": ["dots", "x_y_depth_mm_seen"]}
    features: dict[str, dict[str, Any]] = {
        f"observation.images.{name}": {"dtype": image_dtype, "shape": (height, width, 3), "names": axes},
        f"observation.images.{name}_depth": {"dtype": image_dtype, "shape": (height, width, 1), "names": axes, "info": depth},
        f"observation.{name}.state": {"dtype": "float32", "shape": (len(STATE_NAMES),), "names": list(STATE_NAMES)},
    }
    return features | {f"observation.{name}.dots": moved} if number else features


def lerobot_frame(
    frame: TactileFrame, mm_per_pixel: float, name: str = "tactile", moved: DotMotion | None = None
) -> dict[str, Array]:
    """A frame as the arrays that :func:`lerobot_features` describes.

    Args:
        frame: of a :class:`TactileStream`.
        mm_per_pixel: pitch, mm.
        name: of the sensor, as in the features.
        moved: of the printed dots, what :class:`torchvts.SkinMotion` gives for the frame; None for none.
    Returns:
        uint8 (H, W, 3), float32 (H, W, 1), depth in metres, and float32 (2,); with ``moved`` float32 (N, 4): displacement along x,
        along y and depth, mm, and 1 where the dot is seen. One that is not seen has what its neighbours expect.
    """
    dots = {}
    if moved is not None:
        check_record("moved", moved, DotMotion)
        values = np.concatenate((_numpy(moved.displacement_mm)[0], _numpy(moved.seen)[0, :, None]), axis=1)
        dots = {f"observation.{name}.dots": values.astype(np.float32)}
    depth_mm = _numpy(frame.output.depth_mm)[0, 0].astype(np.float32)
    area_mm2 = float(frame.output.contact.sum()) * check_positive("mm_per_pixel", mm_per_pixel) ** 2
    return {
        f"observation.images.{name}": _rgb8(frame.image),
        f"observation.images.{name}_depth": (1e-3 * depth_mm)[..., None],
        f"observation.{name}.state": np.array([area_mm2, depth_mm.max()], dtype=np.float32),
        **dots,
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
    motion: SkinMotion | None = None,
) -> int:
    """Write a stream as one episode of a LeRobot data set.

    Args:
        frames: a :class:`TactileStream`, or some of its frames.
        mm_per_pixel: pitch, mm.
        dataset: made with the features of :func:`lerobot_features`.
        task: what is done in the episode, in words.
        name: of the sensor, as in the features.
        motion: follows the printed dots from frame to frame; then the features need their number. None for none.
    Returns:
        The number of frames; without any the episode is not saved. Where the source stops with an error, or Ctrl-C ends it, the
        frames until then are saved, and the error is raised.
    """
    count, moved = 0, None
    try:
        for frame in frames:
            if motion is not None:
                moved = motion(frame.image[None], frame.output.depth_mm, moved)
            dataset.add_frame({**lerobot_frame(frame, mm_per_pixel, name, moved), "task": task})
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
