"""Whether given images can be calibrated from: refused, or left out, before anything is fitted."""

import statistics
from collections.abc import Sequence

import torch
from torch import Tensor

from ..core.arrays import array_of
from ..core.levels import DARK, DARKEST, MOST_SATURATED, SATURATED, bits_of
from ..model.calibration import PEDESTAL
from ..model.usable import FrameCheck
from ..normals.shadowed import UNCHANGED_NOISES
from .presses import Press
from .regions import LIGHT_DRIFT

UNIFORM_COLOUR = 0.05
"""Variation of a background's colour, RMS of the differences of log R, G and B, below which no coloured lights are seen."""

ACHROMATIC = 0.25
"""Share of a contact's change of light that is a change of colour, below which the lights have no colours."""

OTHER_UNIT = 0.12
"""Difference from the background, median over the skin and over the presses, logarithm of the image value, from which presses
are of another unit, light or crop."""


def check_exposure(background: Tensor) -> None:
    """Raise unless every channel of a background has light in the whole range of values, is not saturated, and varies.

    Raises:
        ValueError: names the channel and the value.
    """
    for name, channel in zip("RGB", background.detach(), strict=True):
        mean, saturated = float(channel.mean()), float((channel > SATURATED).double().mean())
        if mean < DARKEST:
            raise ValueError(
                f"background: expected light in channel {name}, got a mean of {mean:.4f}: black image, LED or exposure off"
            )
        if saturated > MOST_SATURATED:
            raise ValueError(
                f"background: expected light below the camera's limit, got a channel {name} that is saturated "
                f"in {saturated:.0%} of the image: lower the exposure"
            )
        if float(channel.max() - channel.min()) < 1e-6:
            raise ValueError(
                f"background: expected light that varies, got a channel {name} that is constant at {mean:.4f}: "
                "not a camera image of a lit skin"
            )
    if bits := bits_of(float(background.max())):
        raise ValueError(f"background: expected values up to 1: {bits}")


def check_light(background: Tensor, presses: Sequence[Press]) -> None:
    """Raise for a greyscale background, and for contacts that change the brightness of the skin, but not its colour.

    Where the skin tilts, coloured lights from different sides change R, G and B differently. Under white light all three
    change alike, whichever way the skin tilts.

    Args:
        background: (3, H, W) in [0, 1].
        presses: of balls.
    Raises:
        ValueError: R, G and B of the background are the same everywhere, or change alike in the median of all contacts.
    """
    if float((background.amax(dim=0) - background.amin(dim=0)).max()) < 1e-3:
        raise ValueError(
            "background: expected an image in colour, got one whose R, G and B are the same everywhere: a greyscale image? "
            "photometric depth needs coloured lights and a colour camera"
        )
    shares = [share for share in (colour_share(item.image, background) for item in presses) if share is not None]
    if shares and statistics.median(shares) < ACHROMATIC:
        raise ValueError(
            "presses: expected contacts that change the colour of the skin, got "
            f"R, G and B that change alike (the change of colour is {statistics.median(shares):.2f} of the change of light, 1 and "
            "more under coloured lights): this sensor has no coloured lights: photometric depth is not possible; "
            "or its skin was changed since the background, as by markers"
        )


def colourless(background: Tensor) -> str:
    """Why a background shows no coloured lights, or "": lights of different colours at different places give different colours.

    Where contacts are given, these decide.
    """
    variation = colour_variation(background)
    if variation >= UNIFORM_COLOUR:
        return ""
    return (
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
    if float(length.max()) < UNCHANGED_NOISES * LIGHT_DRIFT:
        return None
    contact = change[:, length > 0.4 * length.max()]
    colour = torch.stack((contact[0] - contact[1], contact[2] - contact[1]))
    return float((colour.square().mean() / contact.square().mean()).sqrt())


def sort_presses(background: Tensor, presses: Sequence[Press]) -> tuple[list[Press], list[tuple[int, str]]]:
    """Presses that can be held against the background. A few that cannot are left out; if they are half of all, none is used.

    Args:
        background: (3, H, W) in [0, 1].
        presses: checked, with names.
    Returns:
        The presses that are kept; the index among those given, and why, of each other.
    Raises:
        ValueError: presses with a flaw (:class:`torchvts.model.usable.FrameCheck`), or of another unit; one image with two
            diameters; a background much darker than the presses.
    """
    if not presses:
        return [], []
    check = FrameCheck(background.detach())
    flaws = [check.flaw(press.image[None]) for press in presses]
    _check_darkness(background, [press.image for press, flaw in zip(presses, flaws) if flaw is None or flaw.name != "overexposed"])
    odd = [(k, flaw) for k, flaw in enumerate(flaws) if flaw is not None]
    if 2 * len(odd) >= len(presses):
        k, flaw = odd[0]
        raise ValueError(
            f"presses: expected the background's view of the skin in its light, got {len(odd)} of {len(presses)} that are none: "
            f"{presses[k].name} {flaw.text}: take, read and turn the presses as the background"
        )
    difference = statistics.median(check.views.difference(check.views.cells(array_of(press.image))) for press in presses)
    if difference > OTHER_UNIT:
        raise ValueError(
            f"presses: expected the light of the background, got images that differ from it by {difference:.0%} in the median of "
            f"the skin, at most {OTHER_UNIT:.0%} is usual: another unit, another light, or another crop"
        )
    reasons = {k: f"it {flaw.text}" for k, flaw in odd}
    for k, press in enumerate(presses):
        place = next(i for i, one in enumerate(presses) if torch.equal(one.image, press.image))
        first = presses[place]
        if first.ball_diameter_mm != press.ball_diameter_mm:
            raise ValueError(
                f"presses: expected one diameter for an image, got {first.ball_diameter_mm:g} mm for {first.name} and "
                f"{press.ball_diameter_mm:g} mm for {press.name}, which are one image: a wrong file, or a wrong diameter"
            )
        if k not in reasons and place != k:
            reasons[k] = f"it is {first.name} once more"
    return [press for k, press in enumerate(presses) if k not in reasons], sorted(reasons.items())


def _check_darkness(background: Tensor, presses: Sequence[Tensor]) -> None:
    """Raise if the background is much darker than presses, in their median."""
    level = statistics.median(float(image.double().mean()) for image in presses) if presses else 0.0
    share = float(background.double().mean()) / max(level, 1e-9)
    if share < DARK:
        cause = bits_of(float(background.max())) or "black, or the LEDs were off"
        raise ValueError(f"background: expected a brightness like that of the presses, got {share:.0%} of it: {cause}")


def _cells(image: Tensor, rows: int) -> Tensor:
    """Logarithm of an image on cells, (3, h, w), about ``rows`` along the shorter side."""
    cell = max(1, min(image.shape[1:]) // rows)
    return (torch.nn.functional.avg_pool2d(image.detach().cpu().double()[None], cell)[0] + PEDESTAL).log()
