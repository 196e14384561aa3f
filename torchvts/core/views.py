"""Whether an image shows a background's view of the skin, or that view turned, mirrored, cropped or with its channels swapped."""

from collections.abc import Callable
from itertools import permutations, product
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from .arrays import Array, cell_means, lower_median
from .levels import BLACK

CROPS = (0.1, 1.0 / 7.0, 0.2)
"""Shares of each side that one image may show beyond the other: raw frames of a GelSight Mini are cut by a seventh."""

PEDESTAL = 0.01
"""Added to image values before the logarithm: dark cells are noise."""

SAME_VIEW = 0.05
"""Median difference from the background, logarithm of the image value, up to which no other view is looked for. It is at most
0.05 for presses on 13 units, 0.08 on one whose light drifts, and 0.07 to 1.1 for these turned, mirrored or swapped."""

NEAR = 0.1
"""Difference of the logarithm below which a cell looks like the background."""

BETTER = 0.6
"""Another view is named if it leaves less than this part of the difference. On 14 units the best other view leaves at least 1.9
times as much of a press as it is, and at most 0.51 times of a turned, mirrored or swapped one."""

RECOLOURED = 0.035
"""Median difference that a change of the background's colours leaves at most: other gamma, saturation or stray light leave up to
0.027 on two units; of images cropped elsewhere than in the middle such a change leaves 0.045 and more."""

RECOLOUR_STEPS = 5
"""Steps of reweighted least squares by which a change of colours is fitted."""

LEAST_DECIDING = 0.1
"""Share of the cells in which another view of the background looks different, below which no image can show that view."""

Change = Callable[[Array], Array]


class OtherView(NamedTuple):
    """How an image shows the skin otherwise than a background.

    Attributes:
        name: "swapped", "turned", "shows_more" or "shows_less".
        what: such as "is turned by 180 degrees".
        undone: median difference from the background with that undone, logarithm of the image value.
        same: without.
    """

    name: str
    what: str
    undone: float
    same: float

    @property
    def cropped(self) -> bool:
        """Whether the image shows more or less of the skin."""
        return self.name.startswith("shows")

    def in_words(self) -> str:
        """Such as "is turned by 180 degrees (2% off the background with that undone, 31% as it is)"."""
        or_light = ", or its light has changed, or an object covers most of it" if self.cropped else ""
        return f"{self.what}{or_light} ({self.undone:.0%} off the background with that undone, {self.same:.0%} as it is)"


class Views:
    """Compares images with a background, in cells of 1/24 of its height, each channel's brightness aside.

    The measure is the median over cells of the largest difference of a channel: a contact changes less than half of the skin,
    and does not make it similar to another view. Only cells decide in which the background itself looks different when that is
    done to it: a flat contact on an even background is no other view. Stray light, gamma and saturation change the contrast of a
    background, and so does a crop of a smooth one: that is named unless a change of the colours explains the image better.

    Args:
        background: (3, H, W), image value.
    Example:
        >>> background = np.random.default_rng(0).uniform(0.2, 0.8, (3, 48, 64)).astype(np.float32)
        >>> views = Views(background)
        >>> views.other(views.cells(background[::-1])).what
        'has its channels swapped to the order B, G, R'
    """

    def __init__(self, background: Array) -> None:
        self._cell = max(1, min(background.shape[1:]) // 24)
        self.background = self.cells(background)
        self._own = own = _log(self.background)
        self._views: list[tuple[str, str, Change, Array, Array]] = []
        for name, what, change, other in _VIEWS:
            wanted = other(own)
            deciding = _differences(change(own), wanted) >= NEAR
            if float(deciding.mean()) >= LEAST_DECIDING:
                self._views.append((name, what, change, wanted, deciding))

    def cells(self, image: Array) -> Array:
        """(3, h, w) means of an image (3, H, W) over cells, which lie in its middle: a turned image has the same."""
        top, left = (size % self._cell // 2 for size in image.shape[1:])
        return cell_means(image[:, top:, left:], self._cell)

    def difference(self, cells: Array) -> float:
        """Median difference of :meth:`cells` of an image from the background's, logarithm of the image value.

        Cells do not count where a channel of the background is black: nothing darker can differ from it.
        """
        lit = (self.background > BLACK).all(axis=0)
        counted = lit if lit.any() else ~lit
        return _median(_differences(_log(cells)[:, counted, None], self._own[:, counted, None]))

    def other(self, cells: Array) -> OtherView | None:
        """The other view that :meth:`cells` of an image show; None where they show the background's, or none that is known."""
        seen = _log(cells)
        as_it_is = _differences(seen, self._own)
        if _median(as_it_is) <= SAME_VIEW:
            return None
        found = []
        for name, what, change, wanted, deciding in self._views:
            left = _differences(change(seen), wanted)
            if _median(left) < NEAR:  # most views end here
                undone, same = _median(left[deciding]), _median(as_it_is[deciding])
                view = OtherView(name, what, undone, same)
                if undone >= min(NEAR, BETTER * same):
                    continue
                if not view.cropped or self._recoloured(seen, deciding) > min(undone, RECOLOURED):
                    found.append(view)
        return min(found, key=lambda view: view.undone / view.same, default=None)

    def _recoloured(self, seen: Array, deciding: Array) -> float:
        """Median difference that is left in some cells when the background's colours are changed as those of the image suggest."""
        own, values = (np.exp(log).reshape(3, -1).T for log in (self._own, seen))
        weight = np.ones_like(own[:, :1])
        own = np.concatenate([own, weight], axis=1)
        for _ in range(RECOLOUR_STEPS):  # least absolute differences: a contact is none of the background's colours
            map_of_colours = np.linalg.lstsq(weight * own, weight * values, rcond=None)[0]
            off = np.abs(values - own @ map_of_colours).max(axis=1, keepdims=True)
            weight = np.maximum(off, PEDESTAL * NEAR) ** -0.5
        changed = np.maximum(own @ map_of_colours, PEDESTAL).T.reshape(seen.shape)
        return _median(_differences(seen, np.log(changed))[deciding])


def _log(cells: Array) -> Array:
    log: Array = np.log(cells + np.float32(PEDESTAL))
    return log


def _same(cells: Array) -> Array:
    return cells


def _middle(share: float) -> Change:
    """A function of (3, h, w) cells: their middle, without this share of each side, at their own size."""

    def middle(cells: Array) -> Array:
        top, left = round(share * cells.shape[1]), round(share * cells.shape[2])
        inner = torch.from_numpy(cells[None, :, top : cells.shape[1] - top, left : cells.shape[2] - left])
        return nn.functional.interpolate(inner, cells.shape[1:], mode="bilinear", align_corners=False)[0].numpy()

    return middle


def _known_views() -> list[tuple[str, str, Change, Change]]:
    """What may have happened to an image; what is done to its cells, and to the background's, so that they can be compared."""
    views: list[tuple[str, str, Change, Change]] = []
    for share in CROPS:
        by, middle = f"than the background, by {share:.0%} of each side", _middle(share)
        views.append(("shows_more", f"is cropped otherwise and shows more {by}", middle, _same))
        views.append(("shows_less", f"is cropped otherwise and shows less {by}", _same, middle))
    turns = (
        ("", 1, 1),
        ("is turned by 180 degrees", -1, -1),
        ("is mirrored left to right", 1, -1),
        ("is mirrored top to bottom", -1, 1),
    )
    for (turned, down, across), order in product(turns, permutations(range(3))):
        swapped = "has its channels swapped to the order " + ", ".join("RGB"[c] for c in order) if order != (0, 1, 2) else ""
        what = " and ".join(filter(None, (turned, swapped)))
        back = [order.index(c) for c in range(3)]
        name = "swapped" if swapped else "turned"
        if what:
            views.append((name, what, lambda cells, b=back, d=down, a=across: cells[b, ::d, ::a], _same))  # type: ignore[misc]
    return views


_VIEWS = _known_views()


def _differences(one: Array, other: Array) -> Array:
    """(h, w) largest difference of a channel, (3, h, w), beyond the median difference of that channel."""
    off = one - other
    differences: Array = np.abs(off - lower_median(off.reshape(3, -1))[:, None, None]).max(0)
    return differences


def _median(values: Array) -> float:
    return float(lower_median(values.reshape(-1)))
