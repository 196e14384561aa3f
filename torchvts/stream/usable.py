"""Frames that cannot be used: black, cut short, of one colour, overexposed, 12 bits in 16, cropped or turned otherwise than the
background."""

import numpy as np
from torch import Tensor

from ..core.arrays import Array, array_of, lower_median
from ..core.checks import check_batch, check_field, check_range, check_same_size
from ..core.views import TWELVE_BITS, Views
from ..model.calibration import Calibration, check_calibration

DARK = 0.25
"""A frame whose median brightness, in all channels, is below this share of the background's shows no skin."""

BRIGHT = 0.985
"""Image value above which a cell is overexposed."""

MOST_OVEREXPOSED = 0.8
"""Share of the cells that may be overexposed."""

LIT, BLACK = 0.06, 2.0 / 255.0
"""A line of the background as bright as the one, in some channel, is black in a frame if all its values are below the other."""

VARIES = 3.0 * BLACK
"""A line in which a channel of the background varies by so much is lost in a frame where none varies by more than :data:`BLACK`:
decoders fill what did not arrive with grey."""

EVERY = 8
"""Of a line every so many pixels are looked at."""

ONE_COLOUR = 2.0 / 255.0
"""Range of the image value, in all channels, below which a frame shows nothing."""


class FrameCheck:
    """Says why a frame cannot be a frame of this unit; an empty text where it can.

    A frame is compared with the background in cells of 1/24 of its height; how another view is known: :class:`Views`.

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
        image = array_of(background)
        self._views = Views(image)
        self.background = self._views.background
        self._lit = [(channel, lit) for channel, lit in enumerate(self.background > LIT) if lit.any()]
        brightest, spread = _lines(image)
        self._lit_lines, self._varied_lines = brightest > LIT, spread > VARIES
        self._overexposed = _overexposed(self.background) > MOST_OVEREXPOSED

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "FrameCheck | None":
        """The check of a calibrated unit; None where no image of its background was taken."""
        check_calibration("calibration", calibration)
        return cls(calibration.background_value) if calibration.measured else None

    def __call__(self, frame: Tensor) -> str:
        """Why a frame (1, 3, H, W), rectified, in [0, 1], cannot be used."""
        check_batch("frame", frame, 3)
        check_same_size("frame", frame, "the background", *self.size)
        image = array_of(frame[0])
        cells = self._views.cells(image)
        if _range(cells) < ONE_COLOUR and _range(image) < ONE_COLOUR:  # the cells of most frames suffice
            return "the frame has one colour everywhere: black, overexposed, or not decoded"
        level = max(self._levels(cells), default=1.0)
        if level < DARK:
            cause, most = "black, or the LEDs were off", float(image.max())
            if most <= TWELVE_BITS + 1e-6:
                cause = f"its largest value is {round(65535 * most)} of 65535: 12 bits stored in 16?"
            return f"the frame is dark, {level:.0%} of the background's brightness: {cause}"
        brightest, spread = _lines(image)
        lost = np.count_nonzero(((brightest < BLACK) & self._lit_lines) | ((spread < BLACK) & self._varied_lines))
        if lost > 0:
            return (
                f"{lost} rows or columns of the frame are black or of one colour: it was cut short, or the camera has lost them "
                "since calibration"
            )
        if not self._overexposed and _overexposed(cells) > MOST_OVEREXPOSED:
            return "the frame is overexposed: nearly all of it is saturated"
        return self._other_view(cells)

    def other_view(self, frame: Tensor) -> str:
        """In which way a frame (1, 3, H, W) is cropped, turned or swapped otherwise than the background; an empty text for none."""
        return self._other_view(self._views.cells(array_of(frame[0])))

    def _levels(self, cells: Array) -> list[float]:
        """The light of the channels that are lit, relative to the background's."""
        ratio = cells / np.maximum(self.background, np.float32(1e-3))
        return [float(lower_median(ratio[channel][lit])) for channel, lit in self._lit]

    def _other_view(self, cells: Array) -> str:
        view = self._views.other(cells)
        return "" if view is None else f"the frame {view.in_words()}"


def _lines(image: Array) -> tuple[Array, Array]:
    """Largest value of each row, then of each column, of (3, H, W), and the largest range of a channel there."""
    rows, columns = image[:, :, ::EVERY], image[:, ::EVERY]
    most, least = (np.concatenate([of(rows, 2), of(columns, 1)], axis=1) for of in (np.max, np.min))
    return most.max(0), (most - least).max(0)


def _range(image: Array) -> float:
    """Largest range of a channel of (3, h, w)."""
    return float((image.max((1, 2)) - image.min((1, 2))).max())


def _overexposed(cells: Array) -> float:
    """Share of the cells (3, h, w) that are overexposed in all channels."""
    return float((cells.min(0) > BRIGHT).mean())
