"""Frames that cannot be used: black, cut short, of one colour, overexposed, 12 bits in 16, cropped or turned otherwise than the
background."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import check_batch, check_field, check_range, check_same_size
from ..model.calibration import Calibration, check_calibration
from .cells import Array, array_of, cell_means, lower_median

DARK = 0.25
"""A frame whose median brightness, in all channels, is below this share of the background's shows no skin."""

BRIGHT = 0.985
"""Image value above which a cell is overexposed."""

MOST_OVEREXPOSED = 0.8
"""Share of the cells that may be overexposed."""

LIT, BLACK = 0.06, 2.0 / 255.0
"""A line of the background as bright as the one, in some channel, is black in a frame if all its values are below the other."""

EVERY = 8
"""Of a line every so many pixels are looked at."""

TWELVE_BITS = 4095.0 / 65535.0
"""Largest value of 12 bits stored in 16."""

ONE_COLOUR = 2.0 / 255.0
"""Range of the image value, in all channels, below which a frame shows nothing."""

CROP = 1.0 / 7.0
"""Share that is cut off each side of raw frames of a GelSight Mini."""

NEAR = 0.1
"""Relative difference below which a cell looks like the background."""

LIKE = 0.55
"""Share of the cells that look like the background from which a frame shows its view."""

LEAST_DECIDING = 0.1
"""Share of the cells in which another view of the background looks different, below which no frame can show that view."""


def _centre(cells: Array) -> Array:
    """The middle of (3, h, w) cells, without :data:`CROP` a side, at their own size."""
    top, left = round(CROP * cells.shape[1]), round(CROP * cells.shape[2])
    middle = torch.from_numpy(cells[None, :, top : cells.shape[1] - top, left : cells.shape[2] - left])
    return nn.functional.interpolate(middle, cells.shape[1:], mode="bilinear", align_corners=False)[0].numpy()


_Change = Callable[[Array], Array]


def _same(cells: Array) -> Array:
    return cells


_VIEWS: tuple[tuple[str, _Change, _Change], ...] = (
    ("is cropped otherwise and shows more than the background", _centre, _same),
    ("is cropped otherwise and shows less than the background", _same, _centre),
    ("is turned by 180 degrees", lambda cells: cells[:, ::-1, ::-1], _same),
    ("is mirrored left to right", lambda cells: cells[:, :, ::-1], _same),
    ("is mirrored top to bottom", lambda cells: cells[:, ::-1], _same),
    ("has red and blue swapped", lambda cells: cells[::-1], _same),
)
"""What may have happened to a frame; what is done to its cells and to the background's so that they can be compared."""


class FrameCheck:
    """Says why a frame cannot be a frame of this unit; an empty text where it can.

    A frame is compared with the background in cells of 1/24 of its height. It shows another view if more than half of the cells are
    like the background's when it is cropped, turned or mirrored, and 1.5 times as many as without that. Only cells count in which
    the background itself looks different when that is done to it: a flat contact on an even background is no other view. A contact
    changes the frame where it lies, and does not make it similar to another view.

    Args:
        background: (3, H, W), image value of the unit without contact.
    Example:
        >>> import torch
        >>> check = FrameCheck(torch.rand(3, 48, 64) * 0.2 + 0.4)
        >>> check(torch.zeros(1, 3, 48, 64))
        'the frame has one colour everywhere: black, overexposed, or not decoded'
    """

    def __init__(self, background: Tensor) -> None:
        check_field("background", background)
        check_range("background", background)
        self.size = (background.shape[1], background.shape[2])
        self.cell = max(1, min(self.size) // 24)
        image = array_of(background)
        self.background = cell_means(image, self.cell)
        self._lit = [(channel, lit) for channel, lit in enumerate(self.background > LIT) if lit.any()]
        self._lit_lines = _lines(image) > LIT
        self._overexposed = _overexposed(self.background) > MOST_OVEREXPOSED
        self._views = []
        for what, change, other in _VIEWS:
            own, wanted = change(self.background), other(self.background)
            deciding = ~_alike(_ratio(own, wanted))
            if float(deciding.mean()) >= LEAST_DECIDING:
                self._views.append((what, change, own, wanted, deciding))

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "FrameCheck | None":
        """The check of a calibrated unit; None where no image of its background was taken."""
        check_calibration("calibration", calibration)
        value = calibration.background.float() ** (1.0 / calibration.sensor.exponent)
        return cls(value.clamp(0.0, 1.0)) if calibration.measured else None

    def __call__(self, frame: Tensor) -> str:
        """Why a frame (1, 3, H, W), rectified, in [0, 1], cannot be used."""
        check_batch("frame", frame, 3)
        check_same_size("frame", frame, "the background", *self.size)
        image = array_of(frame[0])
        cells = cell_means(image, self.cell)
        if _range(cells) < ONE_COLOUR and _range(image) < ONE_COLOUR:  # the cells of most frames suffice
            return "the frame has one colour everywhere: black, overexposed, or not decoded"
        ratio = _ratio(cells, self.background)
        level = max([float(lower_median(ratio[channel][lit])) for channel, lit in self._lit], default=1.0)
        if level < DARK:
            cause, most = "black, or the LEDs were off", float(image.max())
            if most <= TWELVE_BITS + 1e-6:
                cause = f"its largest value is {round(65535 * most)} of 65535: 12 bits stored in 16?"
            return f"the frame is dark, {level:.0%} of the background's brightness: {cause}"
        black = np.count_nonzero((_lines(image) < BLACK) & self._lit_lines)
        if black > 0:
            return (
                f"{black} rows or columns of the frame are black: it was cut short, or the camera has lost them since calibration"
            )
        if not self._overexposed and _overexposed(cells) > MOST_OVEREXPOSED:
            return "the frame is overexposed: nearly all of it is saturated"
        return self._other_view(cells, _likeness(ratio))

    def other_view(self, frame: Tensor) -> str:
        """In which way a frame (1, 3, H, W) is cropped, turned or swapped otherwise than the background; an empty text for none."""
        cells = cell_means(array_of(frame[0]), self.cell)
        return self._other_view(cells, _likeness(_ratio(cells, self.background)))

    def _other_view(self, cells: Array, as_it_is: float) -> str:
        if as_it_is > LIKE:
            return ""
        found = [("", 0.0, 0.0)]
        for what, change, own, wanted, deciding in self._views:
            seen = change(cells)
            alike = _alike(_ratio(seen, wanted))
            undone, same = (float(part[deciding].mean()) for part in (alike, _alike(_ratio(seen, own))))
            if min(undone, float(alike.mean())) >= 0.5 and undone >= 1.5 * same:
                found.append((what, undone, same))
        what, best, same = max(found, key=lambda view: view[1])
        if not what:
            return ""
        return f"the frame {what}: with that undone {best:.0%} of what differs looks like the background, else {same:.0%}"


def _lines(image: Array) -> Array:
    """Largest value of each row, then of each column, of (3, H, W)."""
    return np.concatenate([image[:, :, ::EVERY].max(0).max(1), image[:, ::EVERY].max((0, 1))])


def _range(image: Array) -> float:
    """Largest range of a channel of (3, h, w)."""
    return float((image.max((1, 2)) - image.min((1, 2))).max())


def _overexposed(cells: Array) -> float:
    """Share of the cells (3, h, w) that are overexposed in all channels."""
    return float((cells.min(0) > BRIGHT).mean())


def _ratio(one: Array, other: Array) -> Array:
    return one / np.maximum(other, np.float32(1e-3))


def _alike(ratio: Array) -> Array:
    """(h, w) bool: cells whose ratio (3, h, w) is within :data:`NEAR` of the median of each channel."""
    median = np.maximum(lower_median(ratio.reshape(3, -1)), np.float32(1e-3))
    alike: Array = np.abs(ratio / median[:, None, None] - 1.0).max(0) < NEAR
    return alike


def _likeness(ratio: Array) -> float:
    """Share of the cells that are alike."""
    return float(_alike(ratio).mean())
