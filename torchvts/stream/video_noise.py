"""The contact mask of a recording: a video's frames differ by more than the noise of its pixels, for it is compressed."""

import torch
from torch import Tensor

from ..accelerated import ContactMask
from ..contact import ContactMask as PlainContactMask
from ..contact.masks import MOST_FAR_FIELD, most_far_field
from ..model import Calibration


def with_video_noise(mask: PlainContactMask, noise: Tensor, calibration: Calibration | None) -> PlainContactMask:
    """The mask with the noise of a video where that is larger than its own.

    Args:
        mask: of a pipeline.
        noise: (3, H, W), noise of the image's value between frames.
        calibration: whose compensation the mask follows; None for a network's, which takes images as they are.
    """
    if calibration is None:
        compensated, far_field = 2.0**0.5 * noise, MOST_FAR_FIELD
    else:
        exponent, far_field = calibration.sensor.exponent, most_far_field(calibration)
        value = calibration.background.float().clamp_min(1e-6) ** (1.0 / exponent)
        compensated = noise.float() * exponent * torch.maximum(value, noise.float()) ** (exponent - 1.0)
        if calibration.gain is not None:
            compensated = compensated * calibration.gain.float() * 2.0**0.5
    most = torch.maximum(1.0 / mask.per_noise, compensated.to(mask.per_noise))
    return ContactMask(mask.flat, most, mask.sigmas, mask.min_size_px, far_field).eval()
