"""From raw camera frames to the sensor's images."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.checks import check_batch
from ..model import Sensor, check_sensor
from ..model.camera_view import CameraView, is_raw, places_in_frame, rectified


class Rectify(nn.Module):
    """Raw camera frames (B, 3, h, w) to the sensor's images (B, 3, H, W), as its sensor file says.

    The distortion of the lens is taken out, frames are turned, mirrored, cut by a region, four corners or a crop, and resized.
    Frames that are the sensor's images already stay as they are. It is differentiable in the frames, takes them on any device, and
    stands before a pipeline in ``nn.Sequential``, so that one graph leads from the camera to depth.

    Convention:
        Pixel centres are integers. ``roi_px`` and ``raw_crop`` hold whole pixels; ``corners_px`` are the centres of the image's
        corner pixels. Bilinear; where images become smaller, ``antialias`` of :func:`torch.nn.functional.interpolate`.

    Args:
        sensor: says where its image lies in raw frames.
    Raises:
        TypeError: no sensor.
        ValueError: a lens and a place of the gel in frames of no stated size, or places beyond the frame.
    Source:
        kornia's perspective transform and lens model (``distort_points``), which is OpenCV's.
    Example:
        >>> raw = torch.rand(2, 3, 480, 640)
        >>> Rectify(Sensor.load("gelsight_wedge"))(raw).shape
        torch.Size([2, 3, 300, 400])
    """

    view: CameraView
    if TYPE_CHECKING:  # not for TorchScript, see Gain
        places: Tensor | None

    def __init__(self, sensor: Sensor) -> None:
        super().__init__()
        check_sensor("sensor", sensor)
        if sensor.camera_matrix is not None and not sensor.raw_size_px:
            raise ValueError(
                f"sensor: expected raw_size_px beside camera_matrix of sensor '{sensor.name}', got none: state the (height, width) "
                "of the frames in which both were measured"
            )
        self.view = sensor.view
        places = places_in_frame(sensor, sensor.raw_size_px[0] if sensor.raw_size_px else (sensor.height, sensor.width))
        # in single precision, in which 1000 px are good to 3e-5; a part of no state, since the sensor says it
        self.register_buffer("places", None if places is None else places.to(torch.get_default_dtype()), persistent=False)

    if TYPE_CHECKING:

        def __call__(self, raw: Tensor) -> Tensor: ...

    def forward(self, raw: Tensor) -> Tensor:
        """(B, 3, h, w) raw frames to (B, 3, H, W).

        Raises:
            ValueError: another size than raw frames have, or frames that do not contain the place of the gel.
            TypeError: no floating-point tensor.
        """
        check_batch("raw", raw, 3)
        if not is_raw("raw", raw, self.view):
            return raw
        return rectified("raw", raw, self.view, self.places)

    def extra_repr(self) -> str:
        return f"'{self.view.name}', {self.view.size[0]} x {self.view.size[1]}"
