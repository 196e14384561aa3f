"""In which unit and frame commands write clouds and poses."""

import numpy as np
import torch
from numpy.linalg import inv
from torch import Tensor

from ..core.checks import check_choice
from ..model import Sensor, check_sensor
from .rigid import adjoint, orthonormal

MM_OF = {"mm": 1.0, "m": 1000.0}
"""Units of length, in mm."""

SENSOR_AXES = "mm, x right, y up, z to the camera"


class OutputFrame:
    """The frame of the robot where the sensor file has ``sensor_to_robot``, else that of the sensor; in mm or m.

    Args:
        length_unit: "mm" or "m".
        sensor: of the clouds and poses; None for clouds whose frame is not known, which stay in it.
    Attributes:
        mm: one unit of length.
        axes: unit and axes in words, for files.
    Raises:
        ValueError: another unit.
    Example:
        >>> mount = ((0, 0, 1, 50), (0, 1, 0, 0), (-1, 0, 0, 120), (0, 0, 0, 1))  # mm
        >>> sensor = Sensor("rig", height=48, width=64, mm_per_pixel=0.2, sensor_to_robot=mount)
        >>> OutputFrame("m", sensor).points(torch.tensor([[1.0, 2.0, 3.0]]))
        tensor([[0.0530, 0.0020, 0.1190]], dtype=torch.float64)
    """

    def __init__(self, length_unit: str = "mm", sensor: Sensor | None = None) -> None:
        self.mm = MM_OF[check_choice("length_unit", length_unit, tuple(MM_OF))]
        self._from_sensor, axes = np.eye(4), "axes of the clouds" if sensor is None else SENSOR_AXES.removeprefix("mm, ")
        if sensor is not None:
            check_sensor("sensor", sensor)
        if sensor is not None and sensor.sensor_to_robot is not None:
            self._from_sensor, axes = orthonormal(np.array(sensor.sensor_to_robot)), "axes of the robot"
        self.axes = f"{length_unit}, {axes}"

    def points(self, points_mm: Tensor) -> Tensor:
        """Points (N, 3) of the sensor's frame, mm, in this one, float64."""
        turned = self.directions(points_mm)
        return (turned + torch.from_numpy(self._from_sensor[:3, 3])) / self.mm

    def directions(self, vectors: Tensor) -> Tensor:
        """Directions (N, 3), such as normals, float64."""
        return vectors.double() @ torch.from_numpy(self._from_sensor[:3, :3]).T

    def pose(self, T_target_source: Tensor) -> Tensor:
        """The same motion (4, 4) of points of this frame."""
        T = self._from_sensor @ T_target_source.numpy() @ inv(self._from_sensor)
        T[:3, 3] /= self.mm
        return torch.from_numpy(T)

    def covariance(self, covariance: Tensor) -> Tensor:
        """Covariance (6, 6) of a :class:`Registration`, for :meth:`pose`: rad, and this unit of length."""
        change = np.diag([1.0] * 3 + [1.0 / self.mm] * 3) @ adjoint(self._from_sensor)
        return torch.from_numpy(change @ covariance.numpy() @ change.T)
