"""Whether an image can be used: one table of checks, which calibration, streams, data sets and diagnose ask."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from torch import Tensor

from ..core.arrays import Array, array_of, lower_median
from ..core.checks import check_batch, check_field, check_range, check_same_size
from ..core.levels import BLACK, BRIGHT, DARK, LIT, MOST_SATURATED, bits_of
from ..core.views import Views
from .calibration import Calibration, check_calibration

VARIES = 3.0 * BLACK
"""A line in which a channel of the background varies by so much is lost in a frame where none varies by more than
:data:`~torchvts.core.levels.BLACK`: decoders fill what did not arrive with grey."""

EVERY = 8
"""Of a line every so many pixels are looked at."""


class Flaw(NamedTuple):
    """Why an image cannot be used.

    Attributes:
        name: of the check: "one_colour", "dark", "overexposed", "no_colour", "cut_short",
            or how the view is another: "swapped", "turned",
            "shows_more", "shows_less".
        text: what it does or is, such as "is dark, 6% of the background's brightness: black, or the LEDs were off".
    """

    name: str
    text: str


class FrameCheck:
    """Says why a frame cannot be a frame of this unit; an empty text where it can.

    A frame is compared with the background in cells of 1/24 of its height; how another view is known:
    :class:`torchvts.core.views.Views`.

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
        self.views = Views(image)
        self.background = self.views.background
        self._lit = [(channel, lit) for channel, lit in enumerate(self.background > LIT) if lit.any()]
        brightest, spread = _lines(image)
        self.lit_lines, self.varied_lines = brightest > LIT, spread > VARIES

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "FrameCheck | None":
        """The check of a calibrated unit; None where no image of its background was taken."""
        check_calibration("calibration", calibration)
        return cls(calibration.background_value) if calibration.measured else None

    def __call__(self, frame: Tensor) -> str:
        """Why a frame (1, 3, H, W), rectified, in [0, 1], cannot be used."""
        check_batch("frame", frame, 3)
        check_same_size("frame", frame, "the background", *self.size)
        flaw = self.flaw(frame)
        return "" if flaw is None else f"the frame {flaw.text}"

    def flaw(self, frame: Tensor) -> Flaw | None:
        """The first flaw of a frame (1, 3, H, W), in the order of :data:`CHECKS`."""
        image = array_of(frame[0])
        cells = self.views.cells(image)
        return next((flaw for check in CHECKS if (flaw := check(self, image, cells)) is not None), None)

    def other_view(self, frame: Tensor) -> Flaw | None:
        """In which way a frame (1, 3, H, W) is cropped, turned or swapped otherwise than the background."""
        image = array_of(frame[0])
        return other_view(self, image, self.views.cells(image))

    def level(self, cells: Array) -> float:
        """The light of the channel that has most of its own left, relative to the background's; 1 where none is lit."""
        ratio = cells / np.maximum(self.background, np.float32(1e-3))
        return max((float(lower_median(ratio[channel][lit])) for channel, lit in self._lit), default=1.0)


def one_colour(check: FrameCheck, image: Array, cells: Array) -> Flaw | None:
    """Nothing is seen."""
    if _range(cells) >= BLACK or _range(image) >= BLACK:  # the cells of most frames suffice
        return None
    return Flaw("one_colour", "has one colour everywhere: black, overexposed, or not decoded")


def dark(check: FrameCheck, image: Array, cells: Array) -> Flaw | None:
    """No channel has a quarter of its light."""
    level = check.level(cells)
    if level >= DARK:
        return None
    bits = bits_of(float(image.max()))
    return Flaw("dark", f"is dark, {level:.0%} of the background's brightness: {bits or 'black, or the LEDs were off'}")


def no_colour(check: FrameCheck, image: Array, cells: Array) -> Flaw | None:
    """All channels are the same."""
    if float((cells.max(0) - cells.min(0)).max()) >= BLACK or float(np.ptp(check.background, axis=0).max()) < LIT:
        return None
    return Flaw("no_colour", "has no colour: all channels are the same; record in colour")


def cut_short(check: FrameCheck, image: Array, cells: Array) -> Flaw | None:
    """Rows or columns did not arrive."""
    brightest, spread = _lines(image)
    lost = np.count_nonzero(((brightest < BLACK) & check.lit_lines) | ((spread < BLACK) & check.varied_lines))
    if lost == 0:
        return None
    text = f"has {lost} rows or columns that are black or of one colour: it was cut short, or the camera has lost them"
    return Flaw("cut_short", f"{text} since calibration")


def overexposed(check: FrameCheck, image: Array, cells: Array) -> Flaw | None:
    """More than half of its values are saturated."""
    share = float((cells > BRIGHT).mean())
    if share <= MOST_SATURATED or float((check.background > BRIGHT).mean()) > MOST_SATURATED:
        return None
    return Flaw("overexposed", f"is overexposed: {share:.0%} of its values are saturated: lower the exposure")


def other_view(check: FrameCheck, image: Array, cells: Array) -> Flaw | None:
    """It is turned, mirrored, cropped, or its channels are swapped."""
    view = check.views.other(cells)
    return None if view is None else Flaw(view.name, view.in_words())


CHECKS: tuple[Callable[[FrameCheck, Array, Array], Flaw | None], ...] = (
    one_colour,
    dark,
    overexposed,
    no_colour,
    cut_short,
    other_view,
)
"""What is asked of an image, (3, H, W), and its means over cells, in this order."""


def _lines(image: Array) -> tuple[Array, Array]:
    """Largest value of each row, then of each column, of (3, H, W), and the largest range of a channel there."""
    rows, columns = image[:, :, ::EVERY], image[:, ::EVERY]
    most, least = (np.concatenate([of(rows, 2), of(columns, 1)], axis=1) for of in (np.max, np.min))
    return most.max(0), (most - least).max(0)


def _range(image: Array) -> float:
    """Largest range of a channel of (3, h, w)."""
    return float((image.max((1, 2)) - image.min((1, 2))).max())
