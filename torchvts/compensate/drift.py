"""How the light of each LED has drifted since calibration, found in the undeformed part of a frame and divided out."""

from typing import Final

import torch
from torch import Tensor, nn

from ..core.checks import check_field, check_same_size, may_read
from ..core.robust import half_sample_mode
from ..core.smooth import grid_samples, without_smooth_change

LEAST_DRIFT, MOST_DRIFT = 0.01, 0.15
"""Drift, relative, above the error of the mode itself, and the largest that is believed."""

SAME_SKIN = 2.0
"""Samples this many times :data:`LEAST_DRIFT` from a level, in each channel, are skin of that level."""

MORE_SKIN = 1.2
"""So many times as many samples must have another level before the channels' own modes are given up for it."""

MOST_BY_MODE = 0.149
"""A mode that says more is held at its limit: the other estimator takes over."""

TAKEN_OVER = 0.15
"""It does so where it says more than this."""

LEAST_LEVEL, MOST_LEVEL = 0.01, 0.35
"""Drift, relative, that counts in the statistics of all channels, and the largest that is believed."""

LEAST_SKIN = 0.05
"""Share of pixels of undeformed skin that these need."""

SHARE_OF_MOST, SHARE_OF_FEW = 0.7, 0.4
"""A drift is believed if so many times as few pixels are undeformed without it: where they are more than half of all, and else."""


class Drift(nn.Module):
    """Divide each channel of compensated images (B, 3, H, W) by its brightness relative to calibration.

    Two estimators. :meth:`by_mode`, for response fields, whose compensated image is 1 where the skin is undeformed: the mode of all
    pixels, up to 15 %. :meth:`by_statistics`, for lights: the undeformed pixels are found by all three channels, up to 35 %, and
    the estimator refuses where it cannot distinguish them from contact. Given ``background`` and ``by_mode_first``, the second
    takes over where the first reaches its limit. No gradient flows through either.

    Args:
        background: (3, H, W), the compensated image of the undeformed skin; None: by mode alone.
        noise_std: (3, H, W), noise of the compensated image; needed with ``background``.
        by_mode_first: whether a press changes the light of the whole skin a little, as with response fields on real sensors.
        blurred: whether the compensated image is blurred; else the samples are means of 3 x 3 pixels, which have less noise.
    Source:
        the half-sample mode: Bickel and Fruhwirth, Computational Statistics and Data Analysis 50(12), 2006; the rest is this
        project's.
    """

    background: Tensor | None
    noise: Tensor | None
    most_by_mode: Final[float] = MOST_BY_MODE
    same_skin: Final[float] = SAME_SKIN
    more_skin: Final[int] = round(100 * MORE_SKIN)
    taken_over: Final[float] = TAKEN_OVER
    least_level: Final[float] = LEAST_LEVEL
    most_level: Final[float] = MOST_LEVEL
    least_skin: Final[float] = LEAST_SKIN
    share_of_most: Final[float] = SHARE_OF_MOST
    share_of_few: Final[float] = SHARE_OF_FEW

    def __init__(
        self,
        background: Tensor | None = None,
        noise_std: Tensor | None = None,
        by_mode_first: bool = False,
        blurred: bool = False,
    ) -> None:
        super().__init__()
        self.by_mode_first, self.size = by_mode_first, (0, 0)
        samples, noise = None, None
        if background is not None and noise_std is not None:
            check_field("background", background)
            check_field("noise_std", noise_std)
            self.size = (background.shape[1], background.shape[2])
            samples, noise = self.samples(background[None])[0], self.samples(noise_std[None])[0]
            if not blurred and min(background.shape[1], background.shape[2]) >= 180:
                noise = noise / 3.0  # of a mean of nine
        self.register_buffer("background", None if samples is None else samples.detach().clone())
        self.register_buffer("noise", None if noise is None else noise.detach().clone())

    def forward(self, light: Tensor) -> Tensor:
        background, noise = self.background, self.noise
        if background is None or noise is None:
            return light / self.by_mode(light)
        check_same_size("image", light, "the calibration", self.size[0], self.size[1])
        if self.by_mode_first:
            near = self.by_mode(light)
            held = ((near - 1.0).abs() >= self.most_by_mode).any(dim=1, keepdim=True)
            if may_read(near) and not bool(held.any()):
                return light / near
            far = self.by_statistics(light, background, noise)
            return light / torch.where(held & ((far - 1.0).abs() > self.taken_over), far, near)
        level = self.by_statistics(light, background, noise)
        if may_read(level) and bool((level == 1.0).all()):
            return light
        return light / level

    def by_mode(self, ratio: Tensor, least: float = LEAST_DRIFT, most: float = MOST_DRIFT) -> Tensor:
        """Brightness of each channel (B, 3, 1, 1): the mode of image / background, held to 1 +- ``most``.

        A press scatters light over the whole skin and LEDs drift: on a GelSight Mini up to 1 %, on another 5 %. Where no channel is
        ``least`` off it is left at 1, because there the error of the mode is no smaller (relief 26 against 28 um on the first
        Mini); from twice that it counts in full. Where a shade lies over half of the skin the modes of two channels may be of
        different halves: levels that most samples have in all three channels at once replace them (:meth:`of_one_skin`).
        """
        some = _grid(ratio.detach()).flatten(2)
        drift = (half_sample_mode(some.sort(dim=-1).values) - 1.0).clamp(-most, most)  # (B, 3)
        drift = self.of_one_skin(some - 1.0, drift, least)
        weight = (drift.abs().amax(dim=1, keepdim=True) / least - 1.0).clamp(0.0, 1.0)
        return (1.0 + weight * drift)[..., None, None]

    def of_one_skin(self, some: Tensor, drift: Tensor, least: float) -> Tensor:
        """Drift of the channels (B, 3), each found by itself, made that of one part of the skin.

        Candidates are the mode of one channel in all three, and no drift; that near which most samples lie in all channels at once
        is taken, if they are clearly more than near the channels' own modes. Modes that agree within ``least`` stay.

        Args:
            some: samples of image / background - 1, (B, 3, N).
            drift: the modes, (B, 3).
            least: see :meth:`by_mode`.
        """
        agree = drift.amax(dim=1, keepdim=True) - drift.amin(dim=1, keepdim=True) < least
        if may_read(agree) and bool(agree.all()):
            return drift
        near = self.same_skin * least
        most, best = self.near(some, drift, near) * self.more_skin, drift
        for k in range(4):
            other = drift[:, k : k + 1].expand(-1, 3) if k < 3 else torch.zeros_like(drift)
            count = self.near(some, other, near) * 100
            best = torch.where(count > most, other, best)
            most = torch.maximum(count, most)
        return torch.where(agree, drift, best)

    def near(self, some: Tensor, level: Tensor, reach: float) -> Tensor:
        """How many samples (B, 3, N) lie within ``reach`` of levels (B, 3) in all channels, (B, 1)."""
        inside = ((some - level[:, :, None]).abs() < reach).all(dim=1)
        return inside.sum(dim=1, keepdim=True)

    def by_statistics(self, light: Tensor, background: Tensor, noise_std: Tensor) -> Tensor:
        """Brightness of each channel (B, 3, 1, 1), 1 where the undeformed skin cannot be distinguished from contact.

        At the modes of the three channels, pixels that are undeformed in all three at once are counted, each by exp(-chi^2 / 2),
        chi in units of noise; their means refine the modes. There must be 5 % of such pixels, and a channel's drift is believed
        only if they become less than 0.4 times as many without it, or 0.7 times if they are more than half of all: the flat top
        of a tilted punch larger than half of the image has a mode of its own in one channel, but the skin around it is
        undeformed without the drift.

        Args:
            light: (B, 3, H, W), compensated frames.
            background: (3, h, w), samples of the compensated background.
            noise_std: (3, h, w), their noise.
        """
        least = self.least_level
        background = background.clamp_min(1e-6)
        ratio = self.samples(light.detach()) / background
        variance = (noise_std / background) ** 2 + least**2
        # an LED that drifts takes the middle of all pixels along
        still = ((ratio.flatten(2).median(dim=-1).values - 1.0).abs() < 0.5 * least).all(dim=1)[:, None, None, None]
        if may_read(ratio) and bool(still.all()):
            return torch.ones_like(ratio[:, :, :1, :1])
        level = half_sample_mode(ratio.flatten(2).sort(dim=-1).values)[..., None, None]
        for _ in range(2):
            chi = ((ratio - level) ** 2 / variance).sum(dim=1, keepdim=True)
            weight = torch.exp(-0.5 * chi) / variance
            level = (weight * ratio).sum(dim=(2, 3), keepdim=True) / weight.sum(dim=(2, 3), keepdim=True).clamp_min(1e-12)
        off = (ratio - level) ** 2 / variance
        chi = off.sum(dim=1, keepdim=True)
        # a Gaussian in three channels has a mean exp(-chi^2 / 2) of 2^(-3/2)
        undeformed = torch.exp(-0.5 * chi).mean(dim=(2, 3), keepdim=True) * 2.0**1.5
        without = torch.exp(-0.5 * (chi - off + (ratio - 1.0) ** 2 / variance)).mean(dim=(2, 3), keepdim=True) * 2.0**1.5
        drift = (level - 1.0).abs()
        share = torch.where(undeformed > 0.5, self.share_of_most, self.share_of_few)
        sure = (drift > least) & (drift < self.most_level) & (undeformed > self.least_skin) & (without < share * undeformed)
        return torch.where(sure & ~still, level, torch.ones_like(level))

    def samples(self, image: Tensor) -> Tensor:
        """Some thousand pixels of an image on a grid, each the mean of 3 x 3 pixels where these do not overlap."""
        return grid_samples(image, grid_stride(image))


class SmoothDrift(nn.Module):
    """Divide each channel of images / background (B, 3, H, W) by a smooth surface through its undeformed part.

    An LED fades on its side of the skin, a hand darkens one side: what :class:`Drift` leaves of that, and what a press scatters,
    :func:`~torchvts.core.smooth.smooth_change` finds.
    """

    def forward(self, ratio: Tensor) -> Tensor:
        return without_smooth_change(ratio)


def grid_stride(image: Tensor) -> int:
    """Distance of the samples: 60 of them along the shorter side."""
    return stride_of(image.shape[2], image.shape[3])


def stride_of(height: int, width: int) -> int:
    """The same of a size."""
    return max(1, min(height, width) // 60)


def _grid(image: Tensor) -> Tensor:
    stride = grid_stride(image)
    return image[:, :, stride // 2 :: stride, stride // 2 :: stride]
