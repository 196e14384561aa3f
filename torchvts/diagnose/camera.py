"""What the camera did to an image: noise, levels, compression, clipping, spots, blur."""

import math

import numpy as np
import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights
from ..skin.weight import spread_of

BLOCK = 8
"""Side of a JPEG block, pixels."""

SPOT_SPREADS = 6.0
"""Spreads of undeformed skin beyond which a pixel is a spot."""

MOVES = 0.02
"""How far a press may move skin beside it, over the shorter side of the image."""


def levels_of(image: Tensor) -> float:
    """Number of grey levels, 255 for 8 bits, inf for floats: by the widest spacing that at least 99 % of the values keep to."""
    values = image.detach().double().flatten()
    values = values[(values > 0.0) & (values < 1.0)]  # without clipped ones
    if len(values) < 100:
        return math.inf
    for bits in range(1, 9):
        count = 2**bits - 1
        scaled = values * count
        if float(((scaled - scaled.round()).abs() < 1e-3).double().mean()) > 0.99:
            return float(count)
    return math.inf


def blockiness(image: Tensor) -> tuple[float, float]:
    """Ratio of second differences across the borders of 8 x 8 blocks to those elsewhere, and by how much they are larger.

    The ratio is 1 for an uncompressed image (3, H, W). It is measured at every phase of the grid, so of cropped images too. Smooth
    structure cancels in second differences, and a median leaves out the rims of objects.
    """
    red, green, blue = image.double()
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    most, step = 1.0, 0.0
    for plane in (luma, luma.t()):
        first = plane[:, 1:] - plane[:, :-1]
        jump = (first[:, 1:-1] - 0.5 * (first[:, :-2] + first[:, 2:])).abs()
        limit = 2.5 * jump.median().clamp_min(1e-9)
        columns = jump.clamp_max(float(limit)).mean(0)  # one jump per column border
        whole = columns.shape[0] // BLOCK * BLOCK
        if whole == 0:
            continue
        phases = columns[:whole].reshape(-1, BLOCK).median(0).values
        best = int(phases.argmax())
        others = torch.cat((phases[:best], phases[best + 1 :]))
        usual = float(others.median().clamp_min(1e-9))
        if float(phases[best]) / usual > most:
            most, step = float(phases[best]) / usual, float(phases[best]) - usual
    return most, step


def new_spots(image: Tensor, expected: Tensor, noise_std: Tensor, widest_px: int, free: Tensor) -> tuple[int, int, int]:
    """Small places that are darker or brighter than the background predicts, in all channels alike: (number, pixels, black ones).

    A slope takes light from one LED and gives it to another; a spot takes it from all. What counts lies beyond the spread of the
    frame's own skin, and beyond the darkest and brightest that the background has within :data:`MOVES`: skin moves with its spots.
    Images are (3, H, W), ``noise_std`` (3,) is of their difference, ``free`` (H, W) the skin without contact, with spots on it.
    """
    import cv2

    noise = noise_std.reshape(3, 1, 1)
    log_ratio = (image.clamp_min(1e-3) / expected.clamp_min(1e-3)).log()
    window = 2 * (max(3, widest_px) // 2) + 1
    planes = ((log_ratio + 1.0) * 127.5).clamp(0, 255).byte().numpy()
    smooth = torch.from_numpy(np.stack([cv2.medianBlur(plane, window) for plane in planes])).float() / 127.5 - 1.0
    smooth = blur(smooth[None], gaussian_weights(0.25 * window))[0]
    off = log_ratio - smooth
    reach = max(2, round(MOVES * min(image.shape[1:])))
    log = expected.clamp_min(1e-3).log()
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    darkest, brightest = (
        torch.from_numpy(np.stack([change(plane, around) for plane in log.numpy()])) for change in (cv2.erode, cv2.dilate)
    )
    if int(free.sum()) < 100:
        return 0, 0, 0
    spread = spread_of(off[:, free].abs()[None], 0.0)[0, :, :, None]
    least = torch.maximum(5.0 * noise / expected.clamp_min(1e-3), SPOT_SPREADS * spread).clamp_min(0.04)
    beside = np.ones((2 * widest_px + 1, 2 * widest_px + 1), np.uint8)
    still = torch.from_numpy(cv2.dilate((~free).numpy().astype(np.uint8), beside) == 0)  # skin beside a contact wrinkles
    inner = torch.zeros_like(free)
    inner[reach:-reach, reach:-reach] = True
    lit = (expected > 6.0 * noise).all(0) & still & inner
    dead = (image < 3.0 * noise).all(0) & lit
    found = ((off + log < darkest - least).all(0) | (off + log > brightest + least).all(0) | dead) & lit
    number, label, stats, _ = cv2.connectedComponentsWithStats(found.numpy().astype(np.uint8), connectivity=8)
    extent = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    kept = (extent <= widest_px) & (np.arange(number) > 0)
    mask = torch.from_numpy(kept[label])
    return int(kept.sum()), int(mask.sum()), int((mask & dead).sum())


def texture_share(image: Tensor, background: Tensor, noise_std: Tensor, background_noise: Tensor, free: Tensor) -> float | None:
    """Power of an image's fine texture over the background's, of free skin; None where the background has none beyond its noise.

    Power, not likeness: skin that is stretched keeps its texture, elsewhere. Images are (3, H, W), their noises (3,).
    """
    if int(free.sum()) < 100:
        return None
    now, before = (_fine_power(planes, free) for planes in (image, background))
    noise = float((background_noise.double() ** 2).sum())
    if before < 2.0 * noise:
        return None
    return max(0.0, now - float((noise_std.double() ** 2).sum())) / (before - noise)


def pattern_likeness(image: Tensor, background: Tensor, noise_std: Tensor, free: Tensor) -> float | None:
    """Correlation of an image's fine pattern with the background's, of free skin; None where that has none beyond its noise (3,).

    On one unit it is 0.06 at least, where noise hides the pattern, and usually 0.1 to 0.5; on others of the same type at most 0.04.
    """
    noise = float((noise_std.double() ** 2).sum())
    if int(free.sum()) < 100 or _fine_power(background, free) < 1.1 * noise:
        return None
    now, before = (_pattern(planes)[:, free] for planes in (image, background))
    kept = (now.abs() < _most(now)) & (before.abs() < _most(before))
    now, before = now * kept, before * kept
    return float((now * before).sum() / (now.square().sum() * before.square().sum()).sqrt().clamp_min(1e-12))


def _pattern(image: Tensor) -> Tensor:
    log = image.double().clamp_min(0.01).log()[None]
    return (blur(log, gaussian_weights(1.0)) - blur(log, gaussian_weights(3.0)))[0]


def _most(values: Tensor) -> Tensor:
    """Six standard deviations, robustly."""
    return 6.0 * 1.4826 * values.abs().median(dim=1, keepdim=True).values


def _fine_power(image: Tensor, where: Tensor) -> float:
    planes = image.double()[None]
    fine = (planes - nn.functional.avg_pool2d(planes, 5, 1, 2, count_include_pad=False))[0][:, where]
    limit = 8.0 * fine.square().mean(1, keepdim=True).sqrt()
    return float((fine.square() * (fine.abs() < limit)).mean(1).sum()) / (1.0 - 1.0 / 25.0)  # what white noise keeps is 1
