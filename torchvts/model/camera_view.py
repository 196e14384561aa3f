"""How the sensor's image lies in the frames of its camera: bent by a lens, turned, mirrored, cut by a region, corners or a crop."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import brief, check_numbers

Corners = tuple[tuple[float, float], ...]
Matrix = tuple[tuple[float, ...], ...]


class CameraView(NamedTuple):
    """Makes images (B, 3, height, width) of raw frames (B, 3, H, W); the fields are those of :class:`Sensor`.

    Raises:
        ValueError: a frame that does not contain the region.
    """

    name: str
    size: tuple[int, int]
    turn_deg: int
    mirror: bool
    roi_px: tuple[int, int, int, int] | None
    corners_px: Corners | None
    raw_crop: float
    camera_matrix: Matrix | None
    distortion_coefficients: tuple[float, ...] | None

    def __call__(self, frame: Tensor) -> Tensor:
        if self.camera_matrix is None:
            image = self.cut(frame)
        else:
            image = _sampled(frame, _straight_grid(self, (frame.shape[2], frame.shape[3]), frame.dtype))
        return image if image.shape[2:] == self.size else _resized(image, self.size)

    def cut(self, frame: Tensor) -> Tensor:
        """Frames (B, C, H, W) turned, mirrored and cut; of the sensor's size only where there are corners."""
        if self.turn_deg:
            frame = frame.rot90(self.turn_deg // 90, (2, 3)).contiguous()
        if self.mirror:
            frame = frame.flip(3)
        height, width = frame.shape[2], frame.shape[3]
        if self.corners_px is not None:
            x, y = zip(*self.corners_px, strict=True)
            if min(*x, *y) < -0.5 or max(x) > width - 0.5 or max(y) > height - 0.5:
                raise self._missing("corners_px", height, width, self.corners_px)
            return _sampled(frame, _corners_grid(self.corners_px, self.size, (height, width), frame.dtype))
        if self.roi_px is not None:
            left, top, roi_width, roi_height = self.roi_px
            if left + roi_width > width or top + roi_height > height:
                raise self._missing("roi_px", height, width, self.roi_px)
            return frame[:, :, top : top + roi_height, left : left + roi_width]
        top, left = int(self.raw_crop * height), int(self.raw_crop * width)
        return frame[:, :, top : height - top, left : width - left]

    def _missing(self, key: str, height: int, width: int, value: object) -> ValueError:
        turned = f", turned by {self.turn_deg} degrees," if self.turn_deg else ""
        return ValueError(f"frame: {height} x {width}{turned} does not contain {key} {value} of sensor '{self.name}'")


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


def sides_of(corners: Corners) -> tuple[float, float]:
    """Mean length of the sides along x, and along y, pixels."""
    top, right, bottom, left = (math.dist(corners[k], corners[(k + 1) % 4]) for k in range(4))
    return 0.5 * (top + bottom), 0.5 * (right + left)


def check_raw_sizes(value: object) -> tuple[tuple[int, int], ...]:
    """Return sizes (height, width) of raw frames, or raise."""
    if not isinstance(value, list | tuple) or not all(isinstance(size, list | tuple) for size in value):
        raise TypeError(f"raw_size_px: expected sizes [[height, width], ...] of raw frames, got {brief(value)}")
    numbers = check_numbers("raw_size_px", value, (len(value), 2)) if value else ()
    if any(v != int(v) or v < 8 for v in numbers):
        raise ValueError(f"raw_size_px: expected whole numbers (height, width) of at least 8, got {value!r}")
    return tuple((int(numbers[k]), int(numbers[k + 1])) for k in range(0, len(numbers), 2))


def check_lens(matrix: object, coefficients: object) -> tuple[Matrix, tuple[float, ...]]:
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


def _sampled(frame: Tensor, grid: Tensor) -> Tensor:
    """Frames (B, C, H, W) at the places of a grid (1, h, w, 2)."""
    grid = grid.to(frame.device).expand(frame.shape[0], -1, -1, -1)
    return nn.functional.grid_sample(frame, grid, mode="bilinear", padding_mode="border", align_corners=True)


@lru_cache(maxsize=4)
def _straight_grid(view: CameraView, frame_size: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Where each pixel of what is cut out of a frame without distortion lies in the frame, as by :func:`_corners_grid`.

    The places are cut as frames are, so that frames are sampled once.
    """
    import cv2

    rows, columns = frame_size
    matrix, coefficients = np.array(view.camera_matrix), np.array(view.distortion_coefficients)
    maps = cv2.initUndistortRectifyMap(matrix, coefficients, np.eye(3), matrix, (columns, rows), cv2.CV_32FC1)
    with torch.inference_mode(False):
        place = view.cut(torch.from_numpy(np.stack(maps)).double()[None])  # (1, 2, h, w)
        most = torch.tensor([columns - 1.0, rows - 1.0], dtype=torch.float64)[None, :, None, None]
        beyond = float(torch.maximum(-place, place - most).max())
        if beyond > 1.0:
            raise ValueError(
                f"frame: of {rows} x {columns} sensor '{view.name}' needs pixels up to {beyond:.0f} beyond its edge, by its "
                "camera_matrix and distortion_coefficients: cut less out of it, by roi_px, corners_px or raw_crop"
            )
        return (2.0 * place / most - 1.0).permute(0, 2, 3, 1).to(dtype)


@lru_cache(maxsize=16)
def _corners_grid(corners_px: Corners, size: tuple[int, int], frame_size: tuple[int, int], dtype: torch.dtype) -> Tensor:
    """Where each pixel of an image of ``size`` lies in frames of ``frame_size``, (1, height, width, 2), from -1 to 1."""
    (height, width), (rows, columns) = size, frame_size
    with torch.inference_mode(False):
        outline = ((0.0, 0.0), (width - 1.0, 0.0), (width - 1.0, height - 1.0), (0.0, height - 1.0))
        image, frame = (torch.tensor([points], dtype=torch.float64) for points in (outline, corners_px))
        import kornia  # takes 0.3 to 0.5 s, and frames of the calibrated size do without

        to_frame = kornia.geometry.get_perspective_transform(image, frame)[0]
        x = torch.arange(width, dtype=torch.float64).expand(height, -1)
        y = torch.arange(height, dtype=torch.float64)[:, None].expand(-1, width)
        place = torch.stack((x, y, torch.ones_like(x)), 2) @ to_frame.T
        place = place[..., :2] / place[..., 2:]
        return (2.0 * place / torch.tensor([columns - 1.0, rows - 1.0], dtype=torch.float64) - 1.0)[None].to(dtype)


def _resized(frame: Tensor, size: tuple[int, int]) -> Tensor:
    """Frames (B, 3, H, W) at another size, smoothed where they become smaller."""
    resized = nn.functional.interpolate(frame, size, mode="bilinear", align_corners=False, antialias=True)
    return resized.clamp(0.0, 1.0)
