"""The way of each frame of a recording: is it usable, the light of the background, depth. Live streams and data sets share it."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..core.cells import whole_cell_means
from ..core.checks import check_positive, check_switch
from ..core.spelling import suggest
from ..model import Calibration, check_calibration
from ..pipeline import DepthOutput, DepthPipeline, FrozenPipeline, unit_pipeline
from ..skin import ContactMask, ContactSettings
from .background import find_background
from .follow_light import FollowLight
from .usable import FrameCheck

MOST_LIGHT_CHANGE = 0.15
"""First frames whose light differs more from the calibration's are those of another unit or exposure."""


def check_device(device: str) -> torch.device:
    """The device of that name, if this machine has it.

    Raises:
        ValueError: no such device here.
    """
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

    The first frames show the skin without contact. The noise of the contact mask and the light of the recording are measured in
    them, and they are compared with the background of the calibration. Without first frames the calibration is used as it is.

    Args:
        calibration: of the unit.
        mode: "fast", "precise" or "auto".
        first: (N, 3, H, W), the first frames, rectified; None for none.
        fps: frames a second.
        follow: follow slow drift of the light.
        network: a trained network in place of the calibration's model, see :func:`torchvts.pipeline.unit_pipeline`.
        device: of the pipeline, "cpu" or "cuda"; frames come and go on the CPU.
        contact: thresholds of contact; None for the usual ones.
        codec: of the video, see :func:`find_background`.
        stage: makes a context in which a stage of that name runs, to measure its time.
    Attributes:
        pipe: the pipeline, frozen.
    Raises:
        ValueError: contact or changing light in the first frames, or those of another unit.
    """

    def __init__(
        self,
        calibration: Calibration,
        mode: str = "auto",
        first: Tensor | None = None,
        *,
        fps: float = 30.0,
        follow: bool = True,
        network: str | Path | None = None,
        device: str = "cpu",
        contact: ContactSettings | None = None,
        codec: str = "",
        stage: Callable[[str], AbstractContextManager[Any]] = lambda name: nullcontext(),
    ) -> None:
        check_calibration("calibration", calibration)
        check_switch("follow", follow)
        fps = check_positive("fps", fps)
        self._light = FollowLight(calibration.background_value)
        self._filled = calibration.markers if first is None else None
        self._unlearned: tuple[Tensor, Tensor, float] | None = None
        self.device = check_device(device)
        pipe = unit_pipeline(calibration, mode, network, contact).float().requires_grad_(False)
        self.check = FrameCheck.from_calibration(calibration)
        self._fps, self._follow, self._stage = fps, follow, stage
        self._before: float | None = None
        image = None if first is None else find_background(first, codec=codec)
        if first is not None:
            _learn_unrest(pipe, first)
        self.pipe: FrozenPipeline = pipe.to(self.device).freeze()
        if image is not None:
            self._start(calibration, image[None])

    def unusable(self, frame: Tensor) -> str:
        """Why a frame (1, 3, H, W), rectified, cannot be used; an empty text where it can."""
        return "" if self.check is None else self.check(frame)

    def __call__(self, frame: Tensor, time_s: float, solve: bool = True) -> tuple[Tensor, DepthOutput | None]:
        """Take the next frame.

        Args:
            frame: (1, 3, H, W) in [0, 1], rectified, usable.
            time_s: its time.
            solve: whether its depth is wanted; else only the light is followed.
        Returns:
            The frame in the background's light, and its depth.
        """
        self.learn()
        with torch.inference_mode(), self._stage("light"):
            image = self._light.correct(frame)
        output: DepthOutput | None = None
        if solve or self._follow:
            with self._stage("depth"):
                given = image.to(self.device)
                if solve:
                    found, moved = self.pipe.both(given)
                    output = DepthOutput(*(part.cpu() for part in found))
                else:
                    moved = self.pipe.moved(given)
            if self._follow:
                seconds = 1.0 / self._fps if self._before is None else time_s - self._before
                if self._filled is not None:
                    frame = self._filled(frame)
                # copies: the caller may write into what is returned
                self._unlearned = (frame.clone() if image is frame else frame, moved.cpu(), seconds)
        self._before = time_s
        return image, output

    @property
    def light(self) -> FollowLight:
        """The light, learned from all frames so far."""
        self.learn()
        return self._light

    def learn(self) -> None:
        """Learn the light of the last frame, which no depth but that of the next one needs; called when there is time."""
        if self._unlearned is not None:
            with torch.inference_mode(), self._stage("light"):
                self._light.update(*self._unlearned)
            self._unlearned = None

    def _start(self, calibration: Calibration, image: Tensor) -> None:
        """Start from the light of the first frames, and refuse another unit and a contact in them."""
        if reason := self.unusable(image):
            raise ValueError(f"background: the first frames cannot be used: {reason}")
        light = self.light
        light.start(image if calibration.markers is None else calibration.markers(image))
        level = max(abs(v - 1.0) for v in light.level)
        if level > MOST_LIGHT_CHANGE:
            raise ValueError(
                f"background: the light is {level:.0%} off the calibration's: another unit, exposure or LEDs; calibrate again"
            )
        corrected = light.correct(image)
        deformed = self.pipe.moved(corrected.to(self.device))
        if bool(deformed.any()):
            raise NotAtRest(
                f"background: the first frames show contact on {float(deformed.float().mean()):.1%} of the skin against the "
                "calibration's background: start without contact, calibrate again if the skin or the camera's compression has "
                "changed, or use the calibration as it is (background_frames=0, --background-frames 0)"
            )
        light.set_background(corrected)
