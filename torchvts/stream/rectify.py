"""Rectifies camera frames with a sampling grid that is made once for each size."""

import kornia
import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_image_size
from ..model import Sensor, check_sensor


class Rectify(nn.Module):
    """:meth:`Sensor.rectify` for frames of one size, with a sampling grid that is made once.

    Args:
        sensor: the sensor.
        height: pixels of the camera's frames.
        width: pixels of the camera's frames.
    Raises:
        ValueError: the frame does not contain the region that the sensor names.
    Example:
        >>> corners = ((1, 1), (14, 2), (13, 10), (2, 9))
        >>> Rectify(Sensor("rig", 8, 10, 0.1, corners_px=corners), 12, 16)(torch.zeros(1, 3, 12, 16)).shape
        torch.Size([1, 3, 8, 10])
    """

    grid: Tensor

    def __init__(self, sensor: Sensor, height: int, width: int) -> None:
        super().__init__()
        check_sensor("sensor", sensor)
        check_image_size("height", height, "width", width)
        self.sensor = sensor
        self.frame_size = (height, width)
        sensor.rectify(torch.zeros(1, 3, height, width))  # raises where it does not fit
        grid = torch.zeros(0)
        if sensor.corners_px is not None:
            right, bottom = sensor.width - 1.0, sensor.height - 1.0
            target = torch.tensor([[[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]]], dtype=torch.float64)
            corners = torch.tensor([sensor.corners_px], dtype=torch.float64)
            to_frame = kornia.geometry.get_perspective_transform(target, corners)[0]
            x = torch.arange(sensor.width, dtype=torch.float64).expand(sensor.height, -1)
            y = torch.arange(sensor.height, dtype=torch.float64)[:, None].expand(-1, sensor.width)
            position = torch.stack((x, y, torch.ones_like(x)), 2) @ to_frame.T
            position = position[..., :2] / position[..., 2:]
            grid = (2.0 * position / torch.tensor([width - 1.0, height - 1.0], dtype=torch.float64) - 1.0)[None].float()
        self.register_buffer("grid", grid)

    def forward(self, frame: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 3, sensor.height, sensor.width)."""
        check_batch("frame", frame, 3)
        if frame.shape[2:] != self.frame_size:
            raise ValueError(
                f"frame: expected {self.frame_size} like the first, got {tuple(frame.shape[2:])}: the source has changed"
            )
        if self.grid.numel() == 0:
            return self.sensor.rectify(frame)
        grid = self.grid.to(frame.dtype).expand(frame.shape[0], -1, -1, -1)
        return nn.functional.grid_sample(frame, grid, mode="bilinear", padding_mode="zeros", align_corners=True)


class RectifySizes:
    """:class:`Rectify` for frames of any size that the sensor accepts; each size is prepared once."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self._of_size: dict[tuple[int, int], Rectify] = {}

    def __call__(self, frame: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 3, sensor.height, sensor.width), in [0, 1]."""
        size = (frame.shape[2], frame.shape[3])
        if size not in self._of_size:
            self._of_size[size] = Rectify(self.sensor, *size)
        rectified: Tensor = self._of_size[size](frame)
        return rectified.clamp(0.0, 1.0)
