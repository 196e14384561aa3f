"""What the camera did to an image: noise, levels, compression, clipping, spots, blur."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

BLOCK = 8
"""Side of a JPEG block, pixels."""


def levels_of(image: Tensor) -> float:
    """How many levels a full range would have: 255 for 8 bits, inf for floats.

    The values' common step: the widest spacing that at least 99 % of the values keep to.

    Example:
        >>> levels_of(torch.round(torch.rand(3, 32, 32) * 63) / 63)
        63.0
    """
    values = image.detach().double().flatten()
    values = values[(values > 0.0) & (values < 1.0)]  # clipped ones tell nothing
    if len(values) < 100:
        return math.inf
    for bits in range(1, 9):
        count = 2**bits - 1
        scaled = values * count
        if float(((scaled - scaled.round()).abs() < 1e-3).double().mean()) > 0.99:
            return float(count)
    return math.inf


def blockiness(image: Tensor) -> float:
    """Second differences across the borders of 8 x 8 blocks over those elsewhere, the largest over channels; 1 for none.

    Along rows and columns, at every phase of the grid, so that a cropped image is seen too. What is smooth cancels, and a median
    filter of the means leaves rims out.

    Args:
        image: (3, H, W).
    """
    red, green, blue = image.double()
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    most = 1.0
    for plane in (luma, luma.t()):
        first = plane[:, 1:] - plane[:, :-1]
        jump = (first[:, 1:-1] - 0.5 * (first[:, :-2] + first[:, 2:])).abs()
        limit = 2.5 * jump.median().clamp_min(1e-9)
        columns = jump.clamp_max(float(limit)).mean(0)  # one jump per column border
        whole = columns.shape[0] // BLOCK * BLOCK
        phases = columns[:whole].reshape(-1, BLOCK).median(0).values
        best = int(phases.argmax())
        others = torch.cat((phases[:best], phases[best + 1 :]))
        most = max(most, float(phases[best] / others.median().clamp_min(1e-9)))
    return most


class Spots(NamedTuple):
    """New spots: how many, how many pixels, how many of those read nothing, and which they are, (H, W) bool."""

    number: int
    pixels: int
    dead: int
    mask: Tensor


def new_spots(image: Tensor, expected: Tensor, noise_std: Tensor, widest_px: int, contact: Tensor) -> Spots:
    """Small places that are darker or brighter than the image at rest foretells, in all channels alike.

    Slopes take light from one lamp and give it to another; a spot takes it from all. The ratio of image and expectation is
    compared with its median over a window as wide as the widest spot. In a contact nothing is sought: cliffs are dark in all
    channels too.

    Args:
        image, expected: (3, H, W), values. noise_std: (3,), of their difference. widest_px: diameter of the widest spot.
        contact: (H, W) bool; parts of it no wider than a spot do not count as such.
    """
    import cv2

    number, label, stats, _ = cv2.connectedComponentsWithStats(contact.numpy().astype(np.uint8), connectivity=8)
    wide = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) > 1.5 * widest_px
    touched = cv2.dilate((wide & (np.arange(number) > 0))[label].astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    value, rest = image.double().numpy(), expected.double().numpy()
    noise = noise_std.double().numpy()[:, None, None]
    dead = (value < 3.0 * noise).all(0) & (rest > 12.0 * noise).all(0)
    log_ratio = np.log(np.maximum(value, 1e-3) / np.maximum(rest, 1e-3)).astype(np.float32)
    window = 2 * (max(3, widest_px) // 2) + 1
    bytes_of = np.clip((log_ratio + 1.0) * 127.5, 0, 255).astype(np.uint8)
    smooth = np.stack([cv2.medianBlur(plane, window) for plane in bytes_of]).astype(np.float32) / 127.5 - 1.0
    smooth = np.stack([cv2.GaussianBlur(plane, (0, 0), 0.25 * window) for plane in smooth])
    departs = log_ratio - smooth
    least = np.maximum(0.04, 5.0 * noise / np.maximum(value, 3.0 * noise))
    dark = ((departs < -least) & (rest > 6.0 * noise)).all(0)
    bright = ((departs > least) & (rest > 6.0 * noise)).all(0)
    found = ((dark | bright | dead) & ~touched).astype(np.uint8)
    number, label, stats, _ = cv2.connectedComponentsWithStats(found, connectivity=8)
    extent = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    kept = (extent <= widest_px) & (np.arange(number) > 0)
    mask = kept[label]
    return Spots(int(kept.sum()), int(mask.sum()), int((mask & dead).sum()), torch.from_numpy(mask))


def texture_share(image: Tensor, expected: Tensor, noise_std: Tensor, where: Tensor) -> tuple[float, float]:
    """How much of the reference's fine texture is left in an image, and the standard error of that figure.

    The regression of the band-passed image on the band-passed reference over pixels at rest: 1 for a sharp image, 0 where blur has
    taken the texture. Where the reference has no texture beyond its noise, the standard error is infinite.

    Args:
        image, expected: (3, H, W), values. noise_std: (3,), of each. where: (H, W) bool, at rest.
    """
    fine, same = _band(image), _band(expected)
    inside = where.flatten()
    fine, same = fine.flatten(1)[:, inside], same.flatten(1)[:, inside]
    if fine.shape[1] < 100:
        return 1.0, math.inf
    noise = (noise_std.double() ** 2 * BAND_NOISE)[:, None]
    limit = 8.0 * same.square().mean(1, keepdim=True).sqrt()
    kept = (same.abs() < limit) & (fine.abs() < limit)
    power = (same.square() * kept).sum() - (noise * kept).sum()
    if float(power) <= float((noise * kept).sum()):
        return 1.0, math.inf
    share = float((fine * same * kept).sum() / power)
    spread = float(((noise * same.square()) * kept).sum().sqrt() / power)
    return share, spread


BAND_NOISE = 0.96
"""Variance that white noise of variance one keeps in :func:`_band`."""


def _band(image: Tensor) -> Tensor:
    planes = image.double()[None]
    return (planes - nn.functional.avg_pool2d(planes, 5, 1, 2, count_include_pad=False))[0]
