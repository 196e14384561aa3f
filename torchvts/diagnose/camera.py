"""What the camera did to an image: noise, levels, compression, clipping, spots, blur."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

BLOCK = 8
"""Side of a JPEG block, pixels."""


def levels_of(image: Tensor) -> float:
    """Number of grey levels of the full range: 255 for 8 bits, inf for floats.

    It follows from the widest spacing that at least 99 % of the values keep to.

    Example:
        >>> levels_of(torch.round(torch.rand(3, 32, 32) * 63) / 63)
        63.0
    """
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


def blockiness(image: Tensor) -> float:
    """Ratio of second differences across the borders of 8 x 8 blocks to those elsewhere; 1 for an uncompressed image.

    Measured along rows and columns and at every phase of the grid, so that it works for cropped images too. Smooth structure
    cancels in second differences, and a median leaves out the rims of objects.

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
    """New spots on the skin or the lens.

    Attributes:
        number: how many.
        pixels: how many pixels they have.
        dead: how many of these pixels are black.
        mask: (H, W) bool, their pixels.
    """

    number: int
    pixels: int
    dead: int
    mask: Tensor


def new_spots(image: Tensor, expected: Tensor, noise_std: Tensor, widest_px: int, contact: Tensor) -> Spots:
    """Find small places that are darker or brighter than the background predicts, in all channels alike.

    A slope takes light from one LED and gives it to another; a spot takes it from all. The ratio of image and expectation is
    compared with its median over a window as wide as the widest spot. Contacts are left out: steep walls are dark in all
    channels too.

    Args:
        image: (3, H, W), values.
        expected: (3, H, W), values predicted from the background.
        noise_std: (3,), of their difference.
        widest_px: diameter of the widest spot.
        contact: (H, W) bool; parts of it no wider than a spot do not count as contact.
    """
    import cv2

    number, label, stats, _ = cv2.connectedComponentsWithStats(contact.numpy().astype(np.uint8), connectivity=8)
    wide = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) > 1.5 * widest_px
    pressed = cv2.dilate((wide & (np.arange(number) > 0))[label].astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    value, predicted = image.double().numpy(), expected.double().numpy()
    noise = noise_std.double().numpy()[:, None, None]
    dead = (value < 3.0 * noise).all(0) & (predicted > 12.0 * noise).all(0)
    log_ratio = np.log(np.maximum(value, 1e-3) / np.maximum(predicted, 1e-3)).astype(np.float32)
    window = 2 * (max(3, widest_px) // 2) + 1
    bytes_of = np.clip((log_ratio + 1.0) * 127.5, 0, 255).astype(np.uint8)
    smooth = np.stack([cv2.medianBlur(plane, window) for plane in bytes_of]).astype(np.float32) / 127.5 - 1.0
    smooth = np.stack([cv2.GaussianBlur(plane, (0, 0), 0.25 * window) for plane in smooth])
    residual = log_ratio - smooth
    least = np.maximum(0.04, 5.0 * noise / np.maximum(value, 3.0 * noise))
    dark = ((residual < -least) & (predicted > 6.0 * noise)).all(0)
    bright = ((residual > least) & (predicted > 6.0 * noise)).all(0)
    found = ((dark | bright | dead) & ~pressed).astype(np.uint8)
    number, label, stats, _ = cv2.connectedComponentsWithStats(found, connectivity=8)
    extent = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    kept = (extent <= widest_px) & (np.arange(number) > 0)
    mask = kept[label]
    return Spots(int(kept.sum()), int(mask.sum()), int((mask & dead).sum()), torch.from_numpy(mask))


def texture_share(image: Tensor, expected: Tensor, noise_std: Tensor, where: Tensor) -> tuple[float, float]:
    """Share of the background's fine texture that is left in an image, and the standard error of this share.

    It is the regression of the band-passed image on the band-passed background: 1 for a sharp image, 0 where blur has
    removed the texture. Where the background has no texture beyond its noise, the standard error is infinite.

    Args:
        image: (3, H, W), values.
        expected: (3, H, W), values predicted from the background.
        noise_std: (3,), of each.
        where: (H, W) bool, pixels without contact.
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
