"""From a camera's image to the compensated image: a chain of blocks that each do one thing."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.blur import MOST_BLUR_PX, blur, gaussian_weights
from ..core.checks import check_batch, check_field, check_least, check_positive, check_record, check_same_size, check_switch
from ..model import Calibration, FillMarkers, check_calibration
from .defects import FillDefects
from .drift import Drift


class Compensate(nn.Module):
    """Camera image to compensated image: linear light, with what the model and the background disagree on taken out.

    Printed markers are filled first; ``compensated = image^gamma * gain + offset``; pixels named in ``defects`` then become the
    mean of their nearest valid neighbours, the image is blurred, and the drift of the LEDs is divided out. The multiplicative form
    (gain = model / background) is exact for albedo, spots and vignetting, the additive form of the paper
    (offset = I_delta = model - background) for ambient light.

    Args:
        gain: (3, H, W), or None for 1.
        offset: (3, H, W), or None for 0.
        gamma: camera response, value = light^(1/gamma).
        defects: (H, W) bool, pixels that carry no information; None for none.
        blur_px: standard deviation of a Gaussian blur, pixels; 0 for none.
        markers: fills printed markers; None for a skin without.
        drift: divides out the drift of the LEDs; None for nothing.
        saturated_model: (3, H, W), the model's light where a channel is saturated in the background, 0 elsewhere; None for nowhere.
        saturation_light: linear light from which a channel is saturated.
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
        drift: Drift | None = None,
        saturated_model: Tensor | None = None,
        saturation_light: float = 1.0,
    ) -> None:
        super().__init__()
        if markers is not None:
            check_record("markers", markers, nn.Module, "FillMarkers() makes one")
        if drift is not None:
            check_record("drift", drift, Drift)
        linear, fill, smooth = Linearise(gamma), FillDefects(defects), Blur(blur_px)
        self.linear = nn.ModuleList(([] if markers is None else [markers]) + ([] if linear.gamma == 1.0 else [linear]))
        self.gain = Gain(gain, offset, saturated_model, saturation_light)
        self.clean = nn.ModuleList(([] if fill.defect.shape[0] == 0 else [fill]) + ([] if smooth.std_px == 0.0 else [smooth]))
        self.drift = nn.Identity() if drift is None else drift
        self.saturates = saturated_model is not None
        self.restores = drift is not None and self.saturates
        self.output_domain = "image" if gain is None and offset is None and linear.gamma == 1.0 else None

    @classmethod
    def from_calibration(cls, calibration: Calibration, drift: bool = False) -> "Compensate":
        """The block of a calibrated unit, whose background becomes ``calibration.flat``.

        Args:
            calibration: of the unit.
            drift: divide out the drift of the LEDs. With response fields up to 15 % always is.
        """
        check_calibration("calibration", calibration)
        check_switch("drift", drift)
        sensor = calibration.sensor
        by_response = calibration.response is not None
        block: Drift | None = None
        if drift:
            block = Drift(calibration.flat, calibration.compensated_noise_std, by_response, sensor.blur_px > 0.0)
        elif by_response:
            block = Drift()
        compensate = cls(
            calibration.gain,
            calibration.offset,
            sensor.exponent,
            calibration.defects,
            sensor.blur_px,
            calibration.markers,
            block,
            calibration.saturated_model,
            calibration.saturation_light,
        )
        compensate.output_domain = "ratio" if by_response else "light"
        return compensate

    if TYPE_CHECKING:

        def __call__(self, image: Tensor) -> Tensor: ...

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) image in [0, 1] to (B, 3, H, W), compensated: light, or for response fields light / background."""
        check_batch("image", image, 3)
        light = image
        for block in self.linear:  # only the blocks that the unit needs
            light = block(light)
        saturated = self.gain.saturated(light) if self.saturates else None
        light = self.gain(light, saturated)
        for block in self.clean:
            light = block(light)
        light = self.drift(light)
        return self.gain.restored(light, saturated) if self.restores and saturated is not None else light


class Linearise(nn.Module):
    """Camera values to linear light: value^gamma."""

    def __init__(self, gamma: float = 1.0) -> None:
        super().__init__()
        self.gamma = check_positive("gamma", gamma)

    def forward(self, image: Tensor) -> Tensor:
        return image if self.gamma == 1.0 else image.clamp_min(1e-6) ** self.gamma


class Gain(nn.Module):
    """light * gain + offset, and the model's light where a channel is saturated in both the frame and the background.

    Args:
        gain: (3, H, W), or None for 1.
        offset: (3, H, W), or None for 0.
        saturated_model: (3, H, W), the model's light where a channel is saturated in the background, 0 elsewhere; None for nowhere.
        saturation_light: linear light from which a channel is saturated.
    """

    gain: Tensor | None
    offset: Tensor | None
    saturated_model: Tensor | None

    def __init__(
        self, gain: Tensor | None, offset: Tensor | None, saturated_model: Tensor | None = None, saturation_light: float = 1.0
    ) -> None:
        super().__init__()
        for name, value in (("gain", gain), ("offset", offset), ("saturated_model", saturated_model)):
            if value is not None:
                check_field(name, value)
            self.register_buffer(name, None if value is None else value.detach().clone())
        self.saturation_light = check_positive("saturation_light", saturation_light)

    @torch.jit.export
    def saturated(self, light: Tensor) -> Tensor:
        """Where the frame and the background are both saturated, bool (B, 3, H, W)."""
        model = self.saturated_model
        if model is None:
            return torch.zeros_like(light, dtype=torch.bool)
        check_same_size("image", light, "the calibration", model.shape[1], model.shape[2])
        return (light >= self.saturation_light) & (model > 0)

    @torch.jit.export
    def restored(self, light: Tensor, saturated: Tensor) -> Tensor:
        """The model's light in saturated pixels."""
        model = self.saturated_model
        return light if model is None else torch.where(saturated, model, light)

    def forward(self, light: Tensor, saturated: Tensor | None = None) -> Tensor:
        gain, offset = self.gain, self.offset
        if gain is not None:
            check_same_size("image", light, "the calibration", gain.shape[1], gain.shape[2])
            light = light * gain
        if offset is not None:
            check_same_size("image", light, "the calibration", offset.shape[1], offset.shape[2])
            light = light + offset
        return light if saturated is None else self.restored(light, saturated)


class Blur(nn.Module):
    """Gaussian blur of ``std_px`` pixels; 0 for none."""

    def __init__(self, std_px: float = 0.0) -> None:
        super().__init__()
        self.std_px = check_least("blur_px", std_px, 0.0, MOST_BLUR_PX)
        self.weights = gaussian_weights(self.std_px)

    def forward(self, image: Tensor) -> Tensor:
        return blur(image, self.weights) if self.std_px > 0.0 else image
