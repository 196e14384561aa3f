"""The way of each frame of a recording: is it usable, depth, what it was seen under. Live streams and data sets share it."""

import math
from pathlib import Path

import torch
from torch import Tensor

from ..core.cells import whole_cell_means
from ..core.spelling import suggest
from ..model import Calibration, check_calibration
from ..model.usable import FrameCheck
from ..pipeline import Conditions, DepthOutput, DepthPipeline, FrozenPipeline, doubts_of, unit_pipeline, usual_unseen_deg
from ..skin import ContactMask, ContactSettings
from .background import find_background


def check_device(device: str) -> torch.device:
    """The device of that name; ValueError where this machine has none."""
    try:
        found = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f"device: expected cpu, cuda or cuda:N, got {device!r}{suggest(device, ('cpu', 'cuda'))}") from error
    if found.type == "cuda" and (found.index or 0) >= torch.cuda.device_count():
        raise ValueError(f"device: expected cpu, got {device!r}: this machine, or this build of torch, has no such GPU")
    return found


class NotAtRest(ValueError):
    """The first frames show contact against the background of the calibration."""


def _learn_unrest(pipe: DepthPipeline, images: Tensor) -> None:
    """Raise the least spread of a pipeline's mask to what images without contact show from frame to frame.

    Compression changes few cells at a time, and those more than their spread says. So it is that of a Gaussian which exceeds as
    rarely what one change in a thousand exceeds; of white noise it is its standard deviation. Of slopes and colour the lesser,
    since a contact needs both.
    """
    mask = pipe.mask
    if not isinstance(mask, ContactMask):
        return
    cell = max(1, min(images.shape[2:]) // mask.cells)
    colours, slopes = [], []
    with torch.inference_mode():
        for image in images:
            frame, gradient = pipe.frame_of(image[None])
            change = mask.change(frame.image, cell)
            colours.append(change - change.mean(dim=1, keepdim=True))
            slopes.append(whole_cell_means(gradient, cell))
        seen = [colours] + [slopes] * pipe.takes_slopes
        changes = [torch.cat(cells) - torch.cat(cells).median(dim=0).values for cells in seen]
        spreads = [float(v.abs().flatten().kthvalue(math.ceil(0.999 * v.numel())).values) / 3.29 for v in changes]
    mask.least_spread = max(mask.least_spread, min(spreads))


class Recording:
    """Depth of the frames of one recording, in order, by one calibration.

    The first frames show the skin without contact. The noise of the contact mask is measured in them, and they are compared with
    the background of the calibration. Without first frames the calibration is used as it is.

    Args:
        calibration: of the unit.
        mode: "fast" or "precise".
        first: (N, 3, H, W), the first frames, rectified; None for none.
        network: a trained network in place of the calibration's model, see :func:`torchvts.pipeline.unit_pipeline`.
        device: of the pipeline, "cpu" or "cuda"; frames come and go on the CPU.
        contact: thresholds of contact; None for the usual ones.
    Attributes:
        pipe: the pipeline, frozen.
        conditions: what the last frame was seen under; None before the first.
        doubt: why less may have been seen in it than is there, in words; "" for nothing.
    Raises:
        ValueError: contact or changing light in the first frames, or those of another unit.
    """

    def __init__(
        self,
        calibration: Calibration,
        mode: str = "fast",
        first: Tensor | None = None,
        *,
        network: str | Path | None = None,
        device: str = "cpu",
        contact: ContactSettings | None = None,
    ) -> None:
        check_calibration("calibration", calibration)
        self.device = check_device(device)
        pipe = unit_pipeline(calibration, mode, network, contact).float().requires_grad_(False)
        self.check = FrameCheck.from_calibration(calibration)
        self.conditions: Conditions | None = None
        self.doubt = ""
        image = None if first is None else find_background(first)[None]
        if first is not None:
            _learn_unrest(pipe, first)
        self._usual_deg = usual_unseen_deg(calibration, pipe)
        self.pipe: FrozenPipeline = pipe.to(self.device).freeze()
        if image is not None:
            self._refuse_contact(image)

    def unusable(self, frame: Tensor) -> str:
        """Why a frame (1, 3, H, W), rectified, cannot be used; an empty text where it can."""
        return "" if self.check is None else self.check(frame)

    def __call__(self, frame: Tensor) -> DepthOutput:
        """Depth of the next frame, (1, 3, H, W) in [0, 1], rectified, usable."""
        with torch.inference_mode():
            output, conditions = self.pipe.with_conditions(frame.to(self.device))
        self.conditions = Conditions(*(part.cpu() for part in conditions))
        self.doubt = doubts_of(self.conditions, self._usual_deg)[0]
        return DepthOutput(*(part.cpu() for part in output))

    def _refuse_contact(self, image: Tensor) -> None:
        """Refuse another unit and a contact in the first frames."""
        if reason := self.unusable(image):
            raise ValueError(f"background: the first frames cannot be used: {reason}")
        deformed = self(image).deformed
        if bool(deformed.any()):
            raise NotAtRest(
                f"background: the first frames show contact on {float(deformed.float().mean()):.1%} of the skin against the "
                "calibration's background: start without contact, calibrate again if the skin or the camera's compression has "
                "changed, or use the calibration as it is (background_frames=0, --background-frames 0)"
            )
