"""From a camera's image to the compensated image: a chain of blocks that each do one thing."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.blur import MOST_BLUR_PX, blur, gaussian_weights
from ..core.checks import check_batch, check_field, check_least, check_positive, check_record, check_same_size
from ..model import Calibration, FillMarkers, check_calibration
from .defects import FillDefects
from .light import AsItIs, Relight


class Compensate(nn.Module):
    """Camera image to compensated image: linear light, with what the model and the background disagree on taken out.

    Printed markers are filled first, and light = image^gamma is taken to what it would be in the light of the background;
    ``compensated = light * gain + offset``; pixels named in ``defects`` then become the mean of their nearest valid neighbours, and
    the image is blurred. The multiplicative form
    (gain = model / background) is exact for albedo, spots and vignetting, the additive form of the paper
    (offset = I_delta = model - background) for ambient light.

    Args:
        gain: (3, H, W), or None for 1.
        offset: (3, H, W), or None for 0.
        gamma: camera response, value = light^(1/gamma).
        defects: (H, W) bool, pixels that carry no information; None for none.
        blur_px: standard deviation of a Gaussian blur, pixels; 0 for none.
        markers: fills printed markers; None for a skin without.
        relight: divides out how the light of a frame differs from the background's; None for nothing.
    Attributes:
        output_domain: what the compensated images are, a key of ``torchvts.normals.DOMAINS``; None where that is not known.
    Source:
        eq. 8 of the paper for the offset.
    Example:
        >>> Compensate(offset=torch.full((3, 4, 4), 0.1))(torch.zeros(1, 3, 4, 4)).max()
        tensor(0.1000)
    """

    output_domain: str | None

    def __init__(
        self,
        gain: Tensor | None = None,
        offset: Tensor | None = None,
        gamma: float = 1.0,
        defects: Tensor | None = None,
        blur_px: float = 0.0,
        markers: FillMarkers | None = None,
        relight: Relight | None = None,
    ) -> None:
        super().__init__()
        if markers is not None:
            check_record("markers", markers, nn.Module, "FillMarkers() makes one")
        if relight is not None:
            check_record("relight", relight, Relight)
        linear, fill, smooth = Linearise(gamma), FillDefects(defects), Blur(blur_px)
        self.linear = nn.ModuleList(([] if markers is None else [markers]) + ([] if linear.gamma == 1.0 else [linear]))
        self.relight = AsItIs() if relight is None else relight
        self.gain = Gain(gain, offset)
        self.clean = nn.ModuleList(([] if fill.defect.shape[0] == 0 else [fill]) + ([] if smooth.std_px == 0.0 else [smooth]))
        self.output_domain = "image" if gain is None and offset is None and linear.gamma == 1.0 else None

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "Compensate":
        """The block of a calibrated unit, whose background becomes ``calibration.flat``."""
        check_calibration("calibration", calibration)
        sensor = calibration.sensor
        compensate = cls(
            calibration.gain,
            calibration.offset,
            sensor.exponent,
            calibration.defects,
            sensor.blur_px,
            calibration.markers,
            Relight.from_calibration(calibration),
        )
        compensate.output_domain = "light" if calibration.response is None else "ratio"
        return compensate

    if TYPE_CHECKING:

        def __call__(self, image: Tensor) -> Tensor: ...

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) image in [0, 1] to (B, 3, H, W), compensated: light, or for response fields light / background."""
        check_batch("image", image, 3)
        light = self.gain(self.relight(self.linear_light(image)))
        for block in self.clean:
            light = block(light)
        compensated: Tensor = light
        return compensated

    def linear_light(self, image: Tensor) -> Tensor:
        """Images (B, 3, H, W) in linear light, with printed markers filled."""
        for block in self.linear:  # only the blocks that the unit needs
            image = block(image)
        return image

    @torch.jit.export
    def lost(self, image: Tensor) -> Tensor:
        """Share of each channel that is black or saturated where the background is not, (B, 3)."""
        return self.relight.lost(self.linear_light(image))

    @torch.jit.export
    def light_of(self, image: Tensor) -> Tensor:
        """The light of images (B, 3, H, W) over the background's, (B, 3, 6), see :meth:`Relight.terms`."""
        return self.relight.light_of(self.linear_light(image))


class Linearise(nn.Module):
    """Camera values to linear light: value^gamma."""

    def __init__(self, gamma: float = 1.0) -> None:
        super().__init__()
        self.gamma = check_positive("gamma", gamma)

    def forward(self, image: Tensor) -> Tensor:
        return image if self.gamma == 1.0 else image.clamp_min(1e-6) ** self.gamma


class Gain(nn.Module):
    """light * gain + offset.

    Args:
        gain: (3, H, W), or None for 1.
        offset: (3, H, W), or None for 0.
    """

    if TYPE_CHECKING:  # to TorchScript each is what it is: torch.jit.trace fails on optional tensors
        gain: Tensor | None
        offset: Tensor | None

    def __init__(self, gain: Tensor | None, offset: Tensor | None) -> None:
        super().__init__()
        for name, value in (("gain", gain), ("offset", offset)):
            if value is not None:
                check_field(name, value)
            self.register_buffer(name, None if value is None else value.detach().clone())

    def forward(self, light: Tensor) -> Tensor:
        gain, offset = self.gain, self.offset
        if gain is not None:
            check_same_size("image", light, "the calibration", gain.shape[1], gain.shape[2])
            light = light * gain
        if offset is not None:
            check_same_size("image", light, "the calibration", offset.shape[1], offset.shape[2])
            light = light + offset
        return light


class Blur(nn.Module):
    """Gaussian blur of ``std_px`` pixels; 0 for none."""

    def __init__(self, std_px: float = 0.0) -> None:
        super().__init__()
        self.std_px = check_least("blur_px", std_px, 0.0, MOST_BLUR_PX)
        self.weights = gaussian_weights(self.std_px)

    def forward(self, image: Tensor) -> Tensor:
        return blur(image, self.weights) if self.std_px > 0.0 else image
