"""How the sensor's image lies in the frames of its camera: bent by a lens, turned, mirrored, cut by a region, corners or a crop."""

import warnings
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import brief, check_numbers

if TYPE_CHECKING:
    from .sensor import Sensor

Corners = tuple[tuple[float, float], ...]

MOST_BEYOND_PX = 1.0
"""Frames are sampled up to so far beyond their edge, px, where their outermost pixel is repeated."""


class CameraView(NamedTuple):
    """What is taken of raw frames, as numbers that a script can hold; :attr:`Sensor.view` makes it.

    Attributes:
        name: the sensor's.
        size: height and width of its images.
        raw_sizes: heights and widths of raw frames; none where all are that hold the place.
        turn_deg: anticlockwise turn, 0, 90, 180 or 270.
        mirror: whether turned frames are mirrored left to right.
        place: "roi_px" or "corners_px", what says where the gel lies; "" where frames are cropped.
        extent_px: left, top, right and bottom of that place, pixel centres.
        raw_crop: share to cut off each side.
        bent: whether the distortion of a lens is taken out.
    """

    name: str
    size: tuple[int, int]
    raw_sizes: list[tuple[int, int]]
    turn_deg: int
    mirror: bool
    place: str
    extent_px: tuple[float, float, float, float]
    raw_crop: float
    bent: bool


def is_raw(name: str, frame: Tensor, view: CameraView) -> bool:
    """Whether frames (B, 3, h, w) are raw, or the sensor's images already. Scripts.

    Frames of a whole multiple of the sensor's resolution count as raw, with a warning, where nothing is cut, turned or bent.
    Others are refused.
    """
    rows, columns = frame.shape[2], frame.shape[3]
    for height, width in view.raw_sizes:
        if rows == height and columns == width:
            return True
    if view.place != "" and len(view.raw_sizes) == 0:
        return True
    if view.place == "" and rows == view.size[0] and columns == view.size[1]:
        return False
    times = rows // view.size[0]
    plain = view.place == "" and view.raw_crop == 0.0 and view.turn_deg == 0 and not view.mirror and not view.bent
    if plain and times >= 2 and rows == times * view.size[0] and columns == times * view.size[1]:
        warnings.warn(
            f"{name}: {rows} x {columns}, {times} times the resolution of sensor '{view.name}', is scaled: if that is right, "
            f"raw_size_px: [[{rows}, {columns}]] in the sensor file says so; if the gel is only a part, roi_px",
            stacklevel=2,
        )
        return True
    raise ValueError(f"{name}: {_misfit(view, rows, columns)}")


def rectified(name: str, frame: Tensor, view: CameraView, places: Tensor | None) -> Tensor:
    """Images (B, 3, height, width) of raw frames (B, 3, h, w), sampled once and resized at most once. Scripts.

    ``places``, (1, h, w, 2), are those of :func:`places_in_frame`. Frames that do not contain the place of the gel are refused.
    """
    image = _sampled(frame, places) if view.bent and places is not None else _taken(name, frame, view, places)
    if image.shape[2] != view.size[0] or image.shape[3] != view.size[1]:
        image = nn.functional.interpolate(image, view.size, mode="bilinear", align_corners=False, antialias=True)
    return image


@lru_cache(maxsize=8)
def places_in_frame(sensor: "Sensor", frame_size: tuple[int, int]) -> Tensor | None:
    """Where each pixel of what is taken lies in frames of a size, (1, h, w, 2), x and y, px, float64; None where it is cut out.

    Behind a lens in raw frames, within which they must lie; otherwise in turned and mirrored ones, whose size does not matter.
    """
    if sensor.corners_px is None and sensor.camera_matrix is None:
        return None
    from kornia.geometry import get_perspective_transform, transform_points  # takes 0.4 s; most sensors do without
    from kornia.geometry.calibration import distort_points

    with torch.inference_mode(False):
        corners = None
        if sensor.corners_px is not None:
            height, width = sensor.height, sensor.width
            outline = ((0.0, 0.0), (width - 1.0, 0.0), (width - 1.0, height - 1.0), (0.0, height - 1.0))
            image, frame = (torch.tensor([points], dtype=torch.float64) for points in (outline, sensor.corners_px))
            corners = transform_points(get_perspective_transform(image, frame), _pixels(height, width)).reshape(1, height, width, 2)
        if sensor.camera_matrix is None:
            return corners
        rows, columns = frame_size
        matrix, coefficients = (
            torch.tensor([values], dtype=torch.float64) for values in (sensor.camera_matrix, sensor.distortion_coefficients)
        )
        seen = distort_points(_pixels(rows, columns), matrix, coefficients).reshape(1, rows, columns, 2)
        # taken as frames are, so that frames are sampled once
        places = _taken("frame", seen.permute(0, 3, 1, 2), sensor.view, corners).permute(0, 2, 3, 1).contiguous()
        beyond = float(torch.maximum(-places, places - torch.tensor([columns - 1.0, rows - 1.0], dtype=torch.float64)).max())
        if beyond > MOST_BEYOND_PX:
            raise ValueError(
                f"frame: of {rows} x {columns} sensor '{sensor.name}' needs pixels up to {beyond:.0f} beyond its edge, by its "
                "camera_matrix and distortion_coefficients: cut less out of it, by roi_px, corners_px or raw_crop"
            )
        return places


def _pixels(height: int, width: int) -> Tensor:
    """x and y of all pixels, (1, height * width, 2)."""
    y, x = torch.meshgrid(torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij")
    return torch.stack((x, y), 2).reshape(1, -1, 2)


def _taken(name: str, frame: Tensor, view: CameraView, corners: Tensor | None) -> Tensor:
    """Frames (B, C, h, w) turned, mirrored, and cut or, with the places of corners, sampled."""
    if view.turn_deg != 0:
        frame = frame.rot90(view.turn_deg // 90, (2, 3)).contiguous()
    if view.mirror:
        frame = frame.flip(3)
    rows, columns = frame.shape[2], frame.shape[3]
    left, top, right, bottom = view.extent_px
    if view.place != "" and (min(left, top) < -0.5 or right > columns - 0.5 or bottom > rows - 0.5):
        turned = f", turned by {view.turn_deg} degrees," if view.turn_deg != 0 else ""
        raise ValueError(
            f"{name}: {rows} x {columns}{turned} does not contain {view.place} of sensor '{view.name}', columns {left} to "
            f"{right} and rows {top} to {bottom}"
        )
    if corners is not None:
        return _sampled(frame, corners)
    if view.place != "":
        return frame[:, :, int(top) : int(bottom) + 1, int(left) : int(right) + 1]
    down, across = int(view.raw_crop * rows), int(view.raw_crop * columns)
    return frame[:, :, down : rows - down, across : columns - across]


def _sampled(frame: Tensor, places: Tensor) -> Tensor:
    """Frames (B, C, h, w) at places (1, height, width, 2), bilinearly, as kornia's ``remap``: to load it takes 0.4 s."""
    places = places.to(frame.device, frame.dtype)
    x, y = 2.0 / (frame.shape[3] - 1) * places[..., 0] - 1.0, 2.0 / (frame.shape[2] - 1) * places[..., 1] - 1.0
    grid = torch.stack((x, y), 3).expand(frame.shape[0], -1, -1, -1)
    return nn.functional.grid_sample(frame, grid, mode="bilinear", padding_mode="border", align_corners=True)


def _misfit(view: CameraView, rows: int, columns: int) -> str:
    """Why frames of a size are neither raw nor the sensor's images, and what would make them so."""
    height, width = view.size
    raw = " or ".join([f"{some} x {more}" for some, more in view.raw_sizes])
    if view.place != "":
        expected = f"raw frames of {raw}, in which sensor '{view.name}' has its {view.place}"
        cause = "another mode of the camera"
        first_rows, first_columns = view.raw_sizes[0]
        if rows * first_columns == columns * first_rows:
            cause += f", of another resolution: resize frames, or measure {view.place} and raw_size_px in these"
        return f"expected {expected}, got {rows} x {columns}: {cause}"
    own = width / height
    cause = "another aspect ratio, so another sensor, crop or mode of the camera"
    if abs(columns / rows / own - 1.0) <= 0.01:
        cause = f"resize it, load the sensor with height={rows}, width={columns}, or give it roi_px: [0, 0, {columns}, {rows}]"
        if view.raw_crop > 0.0:
            cause = f"frames as the camera gives them? then the sensor file needs [{rows}, {columns}] in raw_size_px, too"
    elif abs(rows / columns / own - 1.0) <= 0.01:
        turn = f"turn_deg: {view.turn_deg}" if view.turn_deg % 180 != 0 else "turn_deg: 90 (or 270)"
        cause = f"height and width exchanged? or a turned camera: it needs {turn}, and raw_size_px: [[{rows}, {columns}]] alone"
    others = f", or raw frames of {raw}," if raw != "" else ""
    return f"expected {height} x {width}{others} for sensor '{view.name}', got {rows} x {columns}: {cause}"


def camera_above(sensor: "Sensor") -> tuple[float, float, float] | None:
    """Where the camera of a sensor stands above the middle of the skin, mm: along x and y of the image, and height.

    Four corners of the skin, which is a plane, and their places in frames without distortion give its pose. None without a camera
    matrix, or where the size of raw frames must be known and is not: of turned or mirrored ones, and without a region or corners.

    Source:
        Zhang, A flexible new technique for camera calibration, PAMI 22(11), 2000, section 3.1.
    """
    height, width = sensor.height, sensor.width
    raw_size = sensor.raw_size_px[0] if sensor.raw_size_px else None
    placed = sensor.corners_px or sensor.roi_px
    if sensor.camera_matrix is None or (raw_size is None and (sensor.turn_deg or sensor.mirror or not placed)):
        return None
    rows, columns = (1, 1) if raw_size is None else raw_size if sensor.turn_deg % 180 == 0 else raw_size[::-1]  # of turned frames
    corners = np.array([[0.0, 0.0], [width - 1.0, 0.0], [width - 1.0, height - 1.0], [0.0, height - 1.0]])
    if sensor.corners_px is not None:
        frame = np.array(sensor.corners_px)
    else:
        top, left = int(sensor.raw_crop * rows), int(sensor.raw_crop * columns)
        region = sensor.roi_px or (left, top, columns - 2 * left, rows - 2 * top)
        frame = (corners + 0.5) * np.array(region[2:]) / (width, height) - 0.5 + np.array(region[:2])
    if sensor.mirror:
        frame = np.stack((columns - 1.0 - frame[:, 0], frame[:, 1]), 1)
    for _ in range(sensor.turn_deg // 90):  # back by 90 degrees, clockwise
        frame, rows, columns = np.stack((rows - 1.0 - frame[:, 1], frame[:, 0]), 1), columns, rows
    (fx, _, cx), (_, fy, cy), _ = sensor.camera_matrix
    ray = (frame - (cx, cy)) / (fx, fy)
    skin = (corners - (0.5 * (width - 1), 0.5 * (height - 1))) * sensor.mm_per_pixel
    ones, zeros = np.ones((4, 1)), np.zeros((4, 3))
    plane = np.hstack((skin, ones))
    system = np.vstack((np.hstack((plane, zeros, -ray[:, :1] * plane)), np.hstack((zeros, plane, -ray[:, 1:] * plane))))
    homography = np.linalg.svd(system)[2][-1].reshape(3, 3)
    homography /= 0.5 * (np.linalg.norm(homography[:, 0]) + np.linalg.norm(homography[:, 1]))
    along_x, along_y, shift = homography.T * np.sign(homography[2, 2])
    center = -np.stack((along_x, along_y, np.cross(along_x, along_y))) @ shift
    return float(center[0]), float(center[1]), abs(float(center[2]))


def check_corners(value: object) -> Corners:
    """Return four corners, or raise if they are no convex quadrilateral, clockwise on the screen."""
    numbers = check_numbers("corners_px", value, (4, 2))
    corners = tuple((numbers[i], numbers[i + 1]) for i in (0, 2, 4, 6))

    def turn(k: int) -> float:
        (x0, y0), (x1, y1), (x2, y2) = (corners[(k + i) % 4] for i in range(3))
        return (x1 - x0) * (y2 - y1) - (y1 - y0) * (x2 - x1)  # y points down, so clockwise is positive

    if not all(turn(k) > 0 for k in range(4)):
        raise ValueError(
            "corners_px: expected a convex quadrilateral in the order top left, top right, bottom right, "
            f"bottom left, got {value!r}"
        )
    return corners


def check_raw_sizes(value: object) -> tuple[tuple[int, int], ...]:
    """Return sizes (height, width) of raw frames, or raise."""
    if not isinstance(value, list | tuple) or not all(isinstance(size, list | tuple) for size in value):
        raise TypeError(f"raw_size_px: expected sizes [[height, width], ...] of raw frames, got {brief(value)}")
    numbers = check_numbers("raw_size_px", value, (len(value), 2)) if value else ()
    if any(v != int(v) or v < 8 for v in numbers):
        raise ValueError(f"raw_size_px: expected whole numbers (height, width) of at least 8, got {value!r}")
    return tuple((int(numbers[k]), int(numbers[k + 1])) for k in range(0, len(numbers), 2))


def check_lens(matrix: object, coefficients: object) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Return OpenCV's camera matrix and distortion coefficients, or raise."""
    if matrix is None or coefficients is None:
        raise ValueError("camera_matrix, distortion_coefficients: expected both or none: cv2.calibrateCamera gives both")
    numbers = check_numbers("camera_matrix", matrix, (3, 3))
    if min(numbers[0], numbers[4]) <= 0 or (numbers[1], numbers[3], *numbers[6:]) != (0, 0, 0, 0, 1):
        raise ValueError(f"camera_matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, got {brief(matrix)}")
    if not isinstance(coefficients, list | tuple) or len(coefficients) not in (4, 5, 8, 12, 14):
        raise ValueError(
            f"distortion_coefficients: expected 4, 5, 8, 12 or 14 numbers k1, k2, p1, p2, k3, ..., got {brief(coefficients)}"
        )
    rows = tuple(numbers[i : i + 3] for i in (0, 3, 6))
    return rows, check_numbers("distortion_coefficients", coefficients, (len(coefficients),))
