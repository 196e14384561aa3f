"""Draws frames of a stream: the image beside depth with contours, and a sheet of frames."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ..core.checks import check_positive
from ..core.files import Pixels
from .live import TactileFrame

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Overlay:
    """Draws a frame: the image with its contact outlined, beside it depth in colour with contour lines, text and a bar beneath.

    The range of colours grows with the deepest press so far, over round values; ten lines fill it. Zero keeps its colour, and depth
    below zero has another one (:func:`torchvts.viz.depth_colors`).

    Args:
        mm_per_pixel: pixel pitch, mm.
        metric: whether depth is in mm; otherwise the overlay says that it is not.
    """

    TEXT_HEIGHT = 86

    def __init__(self, mm_per_pixel: float, metric: bool = True) -> None:
        from ..viz import depth_colors  # Matplotlib is slow to import

        self.mm_per_pixel, self.metric, self.range_mm = check_positive("mm_per_pixel", mm_per_pixel), metric, 0.1
        colors, _ = depth_colors(-1.0, 1.0)
        self._table = np.ascontiguousarray((255.0 * colors(np.linspace(0.0, 1.0, 256))[:, None, 2::-1] + 0.5).astype(np.uint8))
        self._line = np.where(self._table.mean(2, keepdims=True) < 128, 255, 60).astype(np.uint8).repeat(3, 2)

    def depth(self, depth_mm: Tensor) -> Pixels:
        """Depth (1, 1, H, W) as colours with contour lines, (H, W, 3) B, G, R."""
        import cv2

        depth = depth_mm[0, 0].float().numpy()
        high = float(depth.max())
        self.range_mm = round_up(self.range_mm, high)
        level = np.clip(127.5 * (1.0 + depth / self.range_mm) + 0.5, 0.0, 255.0).astype(np.uint8)
        picture: Pixels = cv2.applyColorMap(level, self._table)
        if high > 0.02 * self.range_mm:
            smooth = cv2.blur(np.maximum(depth, 0.0), (3, 3))
            step = cv2.convertScaleAbs(smooth, alpha=10.0 / self.range_mm, beta=-0.5)  # ten lines over the range
            lines = np.zeros(step.shape, np.uint8)
            lines[:, 1:] |= (step[:, 1:] != step[:, :-1]).view(np.uint8)
            lines[1:] |= (step[1:] != step[:-1]).view(np.uint8)
            on = lines.astype(bool)
            picture[on] = self._line[level[on], 0]
        return picture

    def __call__(self, frame: TactileFrame, lines: Sequence[str] = ()) -> Pixels:
        """The overlay, B, G, R, with text; images narrower than 300 pixels are shown larger.

        Long lines are wrapped to the width of the image, and text beyond the fourth line is left out.
        """
        import cv2

        height, width = frame.image.shape[1:]
        left = np.ascontiguousarray((frame.image.flip(0).permute(1, 2, 0) * 255.0 + 0.5).to(torch.uint8).numpy())
        cv2.drawContours(left, outlines(frame.output.contact[0, 0].numpy()), -1, (255, 255, 255), 1, cv2.LINE_AA)
        right = self.depth(frame.output.depth_mm)
        larger = -(-300 // width)
        height, width = height * larger, width * larger
        out = np.zeros((height + self.TEXT_HEIGHT + height % 2, 2 * width, 3), np.uint8)
        for picture, x in ((left, 0), (right, width)):
            if larger > 1:
                picture = cv2.resize(picture, (width, height), interpolation=cv2.INTER_NEAREST)
            out[:height, x : x + width] = picture
        _draw_scale(out, self.mm_per_pixel / larger, width, height)
        out[height + 8 : height + 18, width + 6 : -6] = cv2.resize(self._table[128:].transpose(1, 0, 2), (width - 12, 10))
        end = f"{self.range_mm:g} mm"
        _write(out, "0", (width + 6, height + 34))
        _write(out, end, (2 * width - 6 - 8 * len(end), height + 34))
        unit = "mm" if self.metric else "mm, NOT METRIC"
        texts = [f"depth 0 to {self.range_mm:g} {unit}, a line every {self.range_mm / 10:g}", *lines]
        shown = [part for text in texts for part in _wrapped(text, width - 12)][:4]
        for k, line in enumerate(shown):
            _write(out, line, (6, height + 18 + 20 * k))
        return out


def round_up(range_mm: float, high_mm: float) -> float:
    """The next round range that holds ``high_mm``; ``range_mm`` where it holds it already."""
    from ..viz import ROUND

    while high_mm > range_mm:
        power = 10.0 ** np.floor(np.log10(range_mm) + 1e-9)
        range_mm = float(power * next(value for value in ROUND if value > range_mm / power + 1e-6))
    return range_mm


def outlines(contact: Pixels) -> list[Pixels]:
    """Outlines of a mask (H, W), smoothed, each (n, 1, 2) whole pixels, x and y."""
    import cv2

    if not contact.any():
        return []
    smooth = (cv2.blur(contact.view(np.uint8) * 255, (7, 7)) > 127).view(np.uint8)
    return list(cv2.findContours(smooth, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0])


def _wrapped(text: str, width: int) -> list[str]:
    """A text in lines of at most so many pixels, broken between words."""
    import cv2

    found: list[str] = []
    for word in text.split(" "):
        line = f"{found[-1]} {word}" if found else word
        if found and cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, 0.43, 1)[0][0] <= width:
            found[-1] = line
        else:
            found.append(word)
    return found


def _write(out: Pixels, text: str, place: tuple[int, int], color: int = 230) -> None:
    import cv2

    cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.43, (color,) * 3, 1, cv2.LINE_AA)


def _draw_scale(out: Pixels, mm_per_pixel: float, left: int, bottom: int) -> None:
    """A bar of 1, 2 or 5 times a power of ten mm, a sixth of the image long at most, in the lower left corner of the depth."""
    import cv2

    most = left * mm_per_pixel / 6.0
    power = 10.0 ** np.floor(np.log10(most))
    length = power * max(s for s in (1.0, 2.0, 5.0) if s * power <= most)
    x, y = left + 10, bottom - 10
    cv2.line(out, (x, y), (x + round(length / mm_per_pixel), y), (40, 40, 40), 2)
    _write(out, f"{length:g} mm", (x, y - 6), 40)


class Sheet:
    """Keeps depth of frames in contact, and draws six of them, evenly spaced in time, in one range of colours.

    Args:
        mm_per_pixel: pixel pitch, mm.
        metric: whether depth is in mm; otherwise the sheet says that it is not.
        doubts: why not to trust it, a sentence each, below the panels.
    """

    _MOST = 48

    def __init__(self, mm_per_pixel: float, metric: bool = True, doubts: Sequence[str] = ()) -> None:
        self.mm_per_pixel, self.metric, self.doubts = check_positive("mm_per_pixel", mm_per_pixel), metric, doubts
        self._kept: list[tuple[float, Tensor, str]] = []
        self._every = self._seen = 0

    def add(self, frame: TactileFrame, doubt: str = "") -> None:
        """Keep a frame with contact, and why it is in doubt; of a long stream every second, fourth, ... of them."""
        if not bool(frame.output.contact.any()):
            return
        if self._seen % (1 << self._every) == 0:
            self._kept.append((frame.time_s, frame.output.depth_mm[0, 0].half().cpu(), doubt))
        self._seen += 1
        if len(self._kept) > self._MOST:
            self._kept, self._every = self._kept[::2], self._every + 1

    @property
    def any_contact(self) -> bool:
        """Whether there is something to draw."""
        return bool(self._kept)

    def figure(self) -> "Figure":
        """The sheet; ValueError where no frame was in contact."""
        if not self._kept:
            raise ValueError("sheet: expected frames with contact, got none: there is nothing to draw")
        from ..viz import sheet_figure

        most = max(float(depth.max()) for _, depth, _ in self._kept)
        deep = [kept for kept in self._kept if float(kept[1].max()) >= 0.1 * most]  # no panel without a visible depth
        places = np.unique(np.linspace(0, len(deep) - 1, 6).round().astype(int))
        chosen = [(time_s, depth.double().numpy(), doubt) for time_s, depth, doubt in (deep[k] for k in places)]
        title = f"{len(chosen)} of {self._seen} frames in contact"
        return sheet_figure(chosen, self.mm_per_pixel, title, self.metric, self.doubts)
