"""The blocks of a pipeline around a network that gs_sdk trained."""

from pathlib import Path

from torch import Tensor, nn

from ..compensate import Compensate
from ..core.checks import check_image
from ..core.geometry import GradientFromNormal
from ..integration import PoissonDCT
from ..model import Sensor
from ..model.markers import FillMarkers
from ..normals import NormalFromMLP
from ..skin import ContactMask


def gs_sdk_blocks(
    weights: str | Path, background: Tensor, sensor: Sensor, markers: FillMarkers | None = None
) -> tuple[nn.Module, ...]:
    """Compensation, mask, normals, gradient and integrator of a network, on camera images as it was trained on.

    Args:
        weights: ``nnmodel.pth``, or a file of ``NormalFromMLP.save``.
        background: (3, H, W) in [0, 1], image of the unit without contact.
        sensor: the sensor.
        markers: what filled the markers of the background, and fills those of frames; None for a skin without.
    Raises:
        FileNotFoundError: no such weights.
        ValueError, TypeError: no such network, one that works on other images, or a background of another size, type or range.
    """
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    network = NormalFromMLP.load(weights, background)
    compensate = Compensate(blur_px=network.blur_px, markers=markers)
    flat = compensate(background[None])[0].clamp(0.0, 1.0)
    network.set_flat(flat)
    return (
        compensate,
        ContactMask(flat),
        network,
        GradientFromNormal(),
        PoissonDCT(sensor.mm_per_pixel),
    )
