"""What frames were seen under, in words: light that is uneven otherwise than at calibration, and slopes that are in doubt."""

import torch

from ..compensate.light import UNEVEN, unevenness
from ..core.frame import Conditions
from ..model.calibration import Calibration, check_calibration
from .confidence import UNSEEN_DEG
from .depth import DepthPipeline

MOST = 3.0
"""Change of a channel's light, as a factor, that automatic exposure and white balance make at most."""

REMEDY = (
    "check the LEDs and the exposure, set gamma, saturation and white balance of the camera as at calibration, record without "
    "loss, leave skin free, or calibrate again"
)
"""What to do about a frame in doubt."""

LOST_SHARE = 0.5
"""Share of a channel that is black or saturated from which it is said."""


def usual_unseen_deg(calibration: Calibration, pipe: DepthPipeline) -> float:
    """What a frame of the undeformed skin hides at calibration, degrees: the background, with the noise of one image, by the unit's
    pipeline on the CPU."""
    check_calibration("calibration", calibration)
    value = calibration.background_value
    noise = torch.randn(value.shape, generator=torch.Generator().manual_seed(0)) * calibration.noise_std[:, None, None].float()
    kind = next(buffer.dtype for buffer in pipe.buffers() if buffer.is_floating_point())
    with torch.no_grad():
        return float(pipe.conditions((value + noise).clamp(0.0, 1.0)[None].to(kind)).unseen_deg)


def doubts_of(conditions: Conditions, usual_deg: float) -> list[str]:
    """For each frame why less may have been seen than is there, and what to do about it, or ""."""
    texts = []
    parts_of_light = conditions.light[:, :, 0], unevenness(conditions.light)
    for level, uneven, lost, unseen in zip(*parts_of_light, conditions.lost, conditions.unseen_deg, strict=True):
        parts = [
            f"channel {name} is black or saturated in {float(share):.0%} of the skin"
            for name, share in zip("RGB", lost)
            if float(share) > LOST_SHARE
        ]
        parts += [
            f"channel {name} has {float(one):.0%} of its light at calibration"
            for name, one in zip("RGB", level)
            if not 1.0 / MOST < one < MOST
        ]
        if float(unseen) > UNSEEN_DEG:
            parts.append(
                f"skin without contact looks {float(unseen) / usual_deg:.0f} times as rough as at calibration: slopes below "
                f"{float(unseen):.0f} degrees are in doubt, and depth may be too low"
            )
        if float(uneven.max()) > UNEVEN:
            each = ", ".join(f"{name} {float(one):.0%} +- {float(off):.0%}" for name, one, off in zip("RGB", level, uneven))
            parts.append(
                f"the light is not that of the background, nor a smooth change of it ({each}, uneven; or a "
                "contact over all of the skin)"
            )
        texts.append(f"{'; '.join(parts)}: {REMEDY}" if parts else "")
    return texts
