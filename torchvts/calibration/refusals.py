"""Why images cannot be calibrated from: no coloured lights, a frame cropped otherwise, and presses of which none can be used."""

import math
import statistics
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..model.calibration import PEDESTAL
from .contacts import DARK, Contact
from .presses import Press, Touch

UNIFORM_COLOUR = 0.05
"""Variation of a background's colour, RMS of the differences of log R, G and B, below which no coloured lights are seen. It is
0.018 under the white light of a 9DTact and 0.16 to 0.56 on six sensors with coloured lights."""

ACHROMATIC = 0.25
"""Share of a contact's change of light that is a change of colour, below which the lights have no colours. It is 0.07 for the ball
on the 9DTact, and 1.0 to 1.7 on five sensors with coloured lights."""

FAINT = 0.03
"""Change of the logarithm of the light from which a contact is seen at all."""

CHANGED_FRAME = 0.6
"""Another crop is named if it leaves less than this part of the difference between background and presses."""

SAME_SKIN = 0.04
"""Median difference that another crop may leave: it is at most 0.036 on 14 units, and 0.044 to 0.22 where it is another unit."""


class NoUsablePress(ValueError):
    """No press can be used for a fit; ``contacts`` carry the reasons."""

    def __init__(self, contacts: Sequence[Contact]) -> None:
        super().__init__("presses: none can be used: " + "; ".join(f"{c.name}: {c.reason}" for c in contacts))
        self.contacts = list(contacts)


def check_colour(background: Tensor) -> None:
    """Raise for a greyscale image.

    Raises:
        ValueError: R, G and B are the same everywhere.
    """
    if float((background.amax(dim=0) - background.amin(dim=0)).max()) < 1e-3:
        raise ValueError(
            "background: expected an image in colour, got one whose R, G and B are the same everywhere: a greyscale image? "
            "photometric depth needs coloured lights and a colour camera"
        )


def check_coloured_contacts(background: Tensor, given: Sequence[Press | Touch]) -> None:
    """Raise if contacts change the brightness of the skin, but not its colour.

    Where the skin tilts, coloured lights from different sides change R, G and B differently. Under white light all three
    change alike, whichever way the skin tilts.

    Args:
        background: (3, H, W) in [0, 1].
        given: presses and touches.
    Raises:
        ValueError: in the median of all contacts that are seen.
    """
    shares = [share for share in (colour_share(item.image, background) for item in given) if share is not None]
    if shares and statistics.median(shares) < ACHROMATIC:
        raise ValueError(
            f"{'presses' if isinstance(given[0], Press) else 'touches'}: expected contacts that change the colour of the skin, got "
            f"R, G and B that change alike (the change of colour is {statistics.median(shares):.2f} of the change of light, 1 and "
            "more under coloured lights): this sensor has no coloured lights: photometric depth is not possible"
        )


def check_coloured_background(background: Tensor) -> None:
    """Raise if a background has the same colour everywhere. Where contacts are given, these decide.

    Raises:
        ValueError: lights of different colours at different places give different colours.
    """
    variation = colour_variation(background)
    if variation < UNIFORM_COLOUR:
        raise ValueError(
            f"background: expected light whose colour varies over the image, got a variation of {variation:.1%}, at least "
            f"{UNIFORM_COLOUR:.0%} is usual: this sensor has no coloured lights: photometric depth is not possible; if it has "
            "them, give presses, which show it"
        )


def colour_variation(background: Tensor) -> float:
    """RMS of the variation of log R - log G and log B - log G over an image (3, H, W), on coarse cells."""
    log = _cells(background, 24)
    difference = torch.stack((log[0] - log[1], log[2] - log[1]))
    return float((difference - difference.mean(dim=(1, 2), keepdim=True)).square().mean().sqrt())


def colour_share(image: Tensor, background: Tensor) -> float | None:
    """Change of colour over change of light where an image (3, H, W) differs most from the background; None where it hardly does.

    The change of light is that of log R, log G and log B; the change of colour that of log R - log G and log B - log G.
    """
    change = _cells(image, 120) - _cells(background, 120)
    change = change - change.flatten(1).median(dim=1).values[:, None, None]
    length = change.square().sum(dim=0).sqrt()
    if float(length.max()) < FAINT:
        return None
    contact = change[:, length > 0.4 * length.max()]
    colour = torch.stack((contact[0] - contact[1], contact[2] - contact[1]))
    return float((colour.square().mean() / contact.square().mean()).sqrt())


class Crop(NamedTuple):
    """How frames are cropped relative to the background.

    Attributes:
        scale: size of what the background shows in the frames.
        shift_px: (x, y) of the background's centre in the frames, relative to theirs.
    """

    scale: float
    shift_px: tuple[float, float]

    def in_words(self) -> str:
        """Such as "1.20 times as large and shifted by (10, -12) px"."""
        x, y = self.shift_px
        return f"{self.scale:.2f} times as large and shifted by ({x:.0f}, {y:.0f}) px"


def other_crop(background: Tensor, frames: Sequence[Tensor]) -> Crop | None:
    """The crop of frames relative to a background, if it explains their difference; else None.

    The median of the frames is compared with the scaled and shifted background on coarse cells, each channel's brightness aside.
    Dark frames are left out: they show nothing.

    Args:
        background: (3, H, W) in [0, 1].
        frames: (3, H, W) each, at least one.
    """
    frames = [frame for frame in frames if float(frame.mean()) >= DARK * float(background.mean())]
    if not frames:
        return None
    stride = max(1, len(frames) // 15)
    best, least, plain = (1.0, 0.0, 0.0), math.inf, math.inf
    for reach, rows in ((1.0, 30), (0.25, 30), (0.08, 60)):
        seen = torch.stack([_cells(frame, rows) for frame in frames[::stride]]).median(dim=0).values[None].float()
        own = _cells(background, rows)[None].float()
        plain = float(_difference(seen, own, torch.tensor([[1.0, 0.0, 0.0]]))[0])
        scales = best[0] * torch.exp(torch.linspace(-0.4, 0.4, 9) * reach)
        shifts = [centre + 0.3 * reach * torch.linspace(-1.0, 1.0, 9) for centre in best[1:]]
        tried = torch.cartesian_prod(scales, *shifts)
        left = torch.cat([_difference(seen, own, tried[k : k + 81]) for k in range(0, len(tried), 81)])
        k = int(left.argmin())
        if math.isfinite(float(left[k])):
            best, least = tuple(tried[k].tolist()), float(left[k])
    moved = max(abs(math.log(best[0])), abs(best[1]), abs(best[2]))
    if least > min(SAME_SKIN, CHANGED_FRAME * plain) or moved < 0.02:
        return None
    height, width = background.shape[1:]
    return Crop(best[0], (0.5 * width * best[1], 0.5 * height * best[2]))


def _difference(seen: Tensor, own: Tensor, tried: Tensor) -> Tensor:
    """(N,) median difference of frames (1, 3, h, w) from the background scaled and shifted by (N, 3), in half-widths, -heights."""
    count, size = len(tried), seen.shape[2:]
    theta = torch.zeros(count, 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = 1.0 / tried[:, 0]
    theta[:, :, 2] = -tried[:, 1:] / tried[:, :1]
    grid = torch.nn.functional.affine_grid(theta, [count, 3, *size], align_corners=False)
    warped = torch.nn.functional.grid_sample(own.expand(count, -1, -1, -1), grid, align_corners=False)
    inside = (grid.abs() < 1.0).all(dim=3)[:, None]
    off = torch.where(inside, warped - seen, torch.nan).flatten(2)
    off = (off - off.nanmedian(dim=2, keepdim=True).values).abs().flatten(1)
    share = inside.double().mean(dim=(1, 2, 3))
    return torch.where(share > 0.4, off.nanmedian(dim=1).values.nan_to_num(math.inf), math.inf)


def _cells(image: Tensor, rows: int) -> Tensor:
    """Logarithm of an image on cells, (3, h, w), about ``rows`` along the shorter side."""
    cell = max(1, min(image.shape[1:]) // rows)
    return (torch.nn.functional.avg_pool2d(image.detach().cpu().double()[None], cell)[0] + PEDESTAL).log()
