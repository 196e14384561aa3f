r"""Printed markers: dark dots that move with the skin are found in every frame and filled from around them.

A marker is dark under all three lights at once; a slope is darker under one and brighter under another. So a marker is darker
than its surroundings on both sides, in every direction and in every channel.
"""

import math

import numpy as np
import torch
from torch import Tensor, nn

from ..core.checks import (
    check_batch,
    check_field,
    check_integer,
    check_least,
    check_positive,
    check_range,
    check_same_size,
    check_tensor,
)
from ..core.noise import noise_std


def find_markers(
    image: Tensor, diameter_px: float = 9.0, contrast: float = 0.06, sigmas: float = 5.0, margin: float = 0.2
) -> Tensor:
    r"""Find the pixels of printed markers: small, roundish, darker than their surroundings in all channels. Scripts.

    On log light, take the mean of the two pixels ``diameter_px`` away on either side, minus the pixel itself: a ramp cancels,
    however steep. The least over four directions is a channel's marker depth: a line or rim is not darker than what follows along
    it, and a step is dark on one side only. A marker is where the least of the three channels reaches ``contrast`` and ``sigmas``
    times the noise of the frame. The shading of a contact may hide it in one channel: in a frame with other markers the mean of the
    channels then decides, with at least twice that depth and 0.4 of the frame's usual one. Pixels nearby that are darker than a
    first filling belong to the marker, and the mask grows by ``margin``.

    Args:
        image: (B, 3, H, W) in [0, 1], camera values or linear light.
        diameter_px: longest extent of a marker at half its depth; an error of a third has little effect.
        contrast: least depth of a marker, as the logarithm of value; 0.06 is 6 % darker than around.
        sigmas: the same, in units of the noise of the logarithm of value.
        margin: how far the mask reaches beyond the dark pixels, in diameters. On a 427 x 320 sensor with a sharpening
            camera 0.2, 0.3, 0.4 mark 30, 39, 51 % of the image and leave 21, 11, 4 % of the dots' pattern in the depth.
    Returns:
        (B, 1, H, W) bool; empty where there are none.
    Raises:
        ValueError: wrong shape, or an image not wider and higher than a marker.
    Source:
        The smallest second difference over directions is the blob measure "lesser eigenvalue of the Hessian" (Lindeberg,
        Feature detection with automatic scale selection, IJCV 30(2), 1998) at a finite reach.
    Example:
        >>> image = torch.full((1, 3, 64, 64), 0.5); image[..., 20:26, 30:36] = 0.2
        >>> mask = find_markers(image)
        >>> bool(mask[..., 20:26, 30:36].all()), bool(mask[..., 40:, :].any())
        (True, False)
    """
    check_batch("image", image, 3)
    if not torch.jit.is_scripting():
        check_positive("diameter_px", diameter_px), check_positive("contrast", contrast)
        check_positive("sigmas", sigmas), check_positive("margin", margin, 2.0)
    cell = max(1, int(diameter_px / 8.0))
    diameter = diameter_px / cell
    light = _log_light(image.detach(), cell)
    strict, mean, least = _marker_depth(light, diameter, contrast, sigmas)
    sure = torch.where(strict > least, strict, torch.zeros_like(strict))
    count = (sure > 0).to(strict.dtype).sum((1, 2, 3), keepdim=True)
    usual = sure.square().sum((1, 2, 3), keepdim=True) / sure.sum((1, 2, 3), keepdim=True).clamp_min(1e-6)
    hidden = (mean > 2.0 * least) & (mean > 0.4 * usual) & (strict > -0.5 * mean) & (count > 4.0 * diameter * diameter)
    candidate = torch.where((sure > 0) | hidden, mean, torch.zeros_like(mean))
    half = max(1, int(0.5 * diameter + 0.5))
    core = (candidate > 0) & (candidate > 0.5 * _square_max(candidate, half))
    near = _octagon_max(core.to(mean.dtype), max(2, int(0.35 * diameter + 0.5))) > 0.5
    # nearby pixels that are darker than a first filling
    grey = light.mean(dim=1, keepdim=True)
    drop = torch.where(near, fill_markers(grey, near, 2) - grey, torch.zeros_like(grey))
    mask = near & (drop > 0.2 * _square_max(drop, half))
    grown = mask.to(mean.dtype)
    if cell > 1:
        grown = nn.functional.interpolate(grown, scale_factor=float(cell), mode="nearest")
    # lenses and sharpening leave a bright edge around a marker: include it
    return _octagon_max(grown[:, :, : image.shape[2], : image.shape[3]], max(1, int(margin * diameter_px + 0.5))) > 0.5


def fill_markers(image: Tensor, mask: Tensor, relaxations: int = 4) -> Tensor:
    r"""Fill the pixels of ``mask`` smoothly from around them; all others keep their value. Scripts.

    Pull-push: means of the unmarked pixels on coarser and coarser grids until no hole is left, then back to finer grids, where
    each hole takes the coarser value and relaxes towards the membrane (Laplace) through its rim. Differentiable in the unmarked
    pixels.

    Args:
        image: (B, C, H, W).
        mask: (B, 1, H, W) bool.
        relaxations: per grid; 4 leave about 3 % of a ramp's rise across a marker.
    Returns:
        (B, C, H, W); an image that is all mask becomes zero.
    Raises:
        ValueError: shapes that do not match.
    Source:
        Gortler, Grzeszczuk, Szeliski, Cohen, The Lumigraph, SIGGRAPH 1996, section 3.4 (pull-push).
    Example:
        >>> image = torch.full((1, 3, 32, 32), 0.5); image[..., 8:14, 8:14] = 0.1
        >>> bool((fill_markers(image, image[:, :1] < 0.3) - 0.5).abs().max() < 1e-6)
        True
    """
    if not torch.jit.is_scripting():
        check_tensor("image", image)
        check_tensor("mask", mask)
        check_integer("relaxations", relaxations, 0, 1000)
    check_batch("image", image, image.shape[1] if image.dim() == 4 else 3)
    if mask.dtype != torch.bool:
        raise TypeError(f"mask: expected torch.bool, got {mask.dtype}: threshold it")
    if mask.dim() != 4 or mask.shape[0] != image.shape[0] or mask.shape[1] != 1:
        raise ValueError(f"mask: expected [{image.shape[0]}, 1, H, W] like image, got {list(mask.shape)}")
    check_same_size("mask", mask, "the image", image.shape[2], image.shape[3])
    value = torch.where(mask, torch.zeros_like(image), image)
    weight = (~mask).to(image.dtype)
    values, weights = [value], [weight]
    while value.shape[2] > 1 or value.shape[3] > 1:  # pull
        weight_coarse = nn.functional.avg_pool2d(weight, 2, ceil_mode=True)
        value = nn.functional.avg_pool2d(value * weight, 2, ceil_mode=True) / weight_coarse.clamp_min(1e-6)
        weight = weight_coarse
        values.append(value)
        weights.append(weight)
    for level in range(len(values) - 2, -1, -1):  # push
        coarse, value = value, values[level]
        hole = weights[level] == 0
        size = [value.shape[2], value.shape[3]]
        value = torch.where(hole, nn.functional.interpolate(coarse, size=size, mode="bilinear", align_corners=False), value)
        for _ in range(relaxations):
            value = torch.where(hole, _neighbour_mean(value), value)
    return value


FEWEST_DOTS = 8
"""Dots that a skin has at least, and from which its shift is told; fewer are dust."""

LEAST_PRINTED = 20
"""Dots that a pattern has at least of which nothing is said; a Wedge's housing shows 10, a worn skin 7, patterns 63 and more."""

REGULAR = 0.75
"""Share of them that lie as far from their nearest neighbour as usual, within a fifth: 0.88 and more of patterns."""


def find_dots(background: Tensor, markers: "FillMarkers") -> Tensor:
    """Centres of the printed dots of a background (3, H, W): (N, 2) float64, x and y in pixels; specks are none.

    A centre is the mean place of what a dot takes from the logarithm of light.
    """
    if markers.diameter_px == 0.0:
        return torch.zeros(0, 2, dtype=torch.float64)
    found = find_markers(background[None], markers.diameter_px, markers.contrast, markers.sigmas, markers.margin)
    light = _log_light(background[None].detach().double(), 1).mean(1, keepdim=True)
    place, area, _, _ = _blobs(found, fill_markers(light, found) - light)
    return place[area > 0.3 * area.median()] if len(area) else place


def is_printed(background: Tensor, markers: "FillMarkers") -> bool:
    """Whether what is found in a background (3, H, W) is a regular pattern of dots, and not dust."""
    dots = find_dots(background, markers)
    if len(dots) < LEAST_PRINTED:
        return False
    nearest = torch.cdist(dots, dots).fill_diagonal_(torch.inf).amin(dim=1)
    return bool(((nearest / nearest.median() - 1.0).abs() < 0.2).double().mean() > REGULAR)


class FillMarkers(nn.Module):
    """:func:`find_markers`, then :func:`fill_markers`; first in the chain, before the compensation.

    With ``diameter_px`` 0, which :meth:`from_background` sets for a skin without markers, images are unchanged.

    Args:
        diameter_px, contrast, sigmas, margin: as for :func:`find_markers`.

    Example:
        >>> image = torch.full((1, 3, 64, 64), 0.5); image[..., 20:26, 30:36] = 0.2
        >>> bool((FillMarkers()(image) - 0.5).abs().max() < 1e-4)
        True
    """

    def __init__(self, diameter_px: float = 9.0, contrast: float = 0.06, sigmas: float = 5.0, margin: float = 0.2) -> None:
        super().__init__()
        self.diameter_px = check_least("diameter_px", diameter_px, 0.0, 1000.0)
        self.contrast = check_positive("contrast", contrast)
        self.sigmas = check_positive("sigmas", sigmas)
        self.margin = check_positive("margin", margin, 2.0)

    @classmethod
    def from_background(cls, background: Tensor, margin: float = 0.2) -> "FillMarkers":
        """Make the block for a unit.

        The reach at which most is found dark shows the markers completely; the 90th percentile of their longer sides there is the
        diameter. The contrast is a fifth of the 5th percentile of their depths. Fewer than :data:`FEWEST_DOTS` are dust.

        Args:
            background: (3, H, W) in [0, 1], image without contact.
            margin: as for :func:`find_markers`.
        Example:
            >>> FillMarkers.from_background(torch.full((3, 64, 64), 0.5)).diameter_px
            0.0
        """
        check_field("background", background)
        check_range("background", background)
        none = cls(0.0, margin=margin)
        light, diameter, best = _log_light(background[None], 1), 0.0, 0.0
        reach = 3.0
        while reach < min(background.shape[1:]) / 8.0:
            depth, _, least = _marker_depth(light, reach, none.contrast, none.sigmas)
            found = float(torch.where(depth > least, depth, 0.0).sum())
            if found > 1.1 * best:  # a longer reach must find clearly more, because it includes neighbours
                diameter, best = reach, found
            reach *= 1.15
        if diameter == 0.0:
            return none
        for _ in range(2):  # the reach is the diameter, so repeat with the measured one
            strict, mean, least = _marker_depth(light, diameter, none.contrast, none.sigmas)
            peak = _square_max(torch.where(strict > least, mean, 0.0), max(1, math.ceil(0.5 * diameter)))
            _, _, side, largest = _blobs((peak > 0) & (mean > 0.5 * peak), mean)
            if len(side) < FEWEST_DOTS:
                return none
            diameter = float(side.quantile(0.9))
        return cls(diameter, max(none.contrast, float(largest.quantile(0.05)) / 5.0), margin=margin)

    def forward(self, image: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 3, H, W)."""
        check_batch("image", image, 3)
        if self.diameter_px == 0.0:
            return image
        return fill_markers(image, find_markers(image, self.diameter_px, self.contrast, self.sigmas, self.margin))

    def to_dict(self) -> dict[str, float]:
        """The arguments."""
        return {name: getattr(self, name) for name in ("diameter_px", "contrast", "sigmas", "margin")}

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value:.3g}" for name, value in self.to_dict().items())


def _log_light(image: Tensor, cell: int) -> Tensor:
    """Logarithm of value over cells of ``cell`` pixels, or over 3 x 3 pixels around each where cells are pixels."""
    if cell > 1:
        image = nn.functional.avg_pool2d(image, cell, ceil_mode=True)
    else:
        image = nn.functional.avg_pool2d(nn.functional.pad(image, [1, 1, 1, 1], mode="replicate"), 3, 1)
    return torch.log(image.clamp_min(0.0) + 0.03)  # a pedestal, because the dark corners of an image are all noise


def _marker_depth(light: Tensor, diameter: float, contrast: float, sigmas: float) -> tuple[Tensor, Tensor, Tensor]:
    """How much darker a pixel is than both sides, as the logarithm of value, and the least depth that counts, (B, 1, 1, 1).

    The depth of the least channel and of the mean of channels, (B, 1, H, W) each, the first -9 on a step, dark on one side only.
    """
    far = max(2, int(diameter + 0.5))
    near = max(1, int(0.7071 * diameter + 0.5))
    height, width = light.shape[2], light.shape[3]
    if min(height, width) <= far:
        raise ValueError(f"image: expected more than {far} cells of pixels each way for such markers, got {height} x {width}")
    noise = noise_std(light).amax(dim=1)
    grey = light.mean(dim=1, keepdim=True)
    wide = torch.cat((light, grey), dim=1)
    wide = nn.functional.pad(wide, [far, far, far, far], mode="reflect")  # completes a marker cut by the border
    sides, darker = torch.full_like(light, math.inf), torch.full_like(grey, math.inf)
    for dy, dx in [(0, far), (far, 0), (near, near), (near, -near)]:
        one = wide[:, :, far + dy : far + dy + height, far + dx : far + dx + width]
        other = wide[:, :, far - dy : far - dy + height, far - dx : far - dx + width]
        sides = torch.minimum(sides, one[:, :3] + other[:, :3])
        darker = torch.minimum(darker, torch.minimum(one[:, 3:], other[:, 3:]))
    depth = 0.5 * sides - light  # (B, 3, H, W)
    mean = depth.mean(dim=1, keepdim=True)
    least = (sigmas * noise).clamp_min(contrast)[:, None, None, None]
    closed = darker - grey > 0.2 * mean
    return torch.where(closed, depth.amin(dim=1, keepdim=True), -9.0 * torch.ones_like(mean)), mean, least


def _line_max(image: Tensor, half: int, dim: int) -> Tensor:
    """Largest value within ``half`` pixels along ``dim``, by windows that double."""
    size = 2 * half + 1
    wide = nn.functional.pad(image, [half, half, 0, 0] if dim == 3 else [0, 0, half, half], value=-math.inf)
    done = 1
    while done < size:
        step = min(done, size - done)
        length = wide.shape[dim] - step
        wide = torch.maximum(wide.narrow(dim, 0, length), wide.narrow(dim, step, length))
        done += step
    return wide


def _square_max(image: Tensor, half: int) -> Tensor:
    """Largest value in the square of 2 ``half`` + 1 pixels around each."""
    return _line_max(_line_max(image, half, 3), half, 2)


def _octagon_max(image: Tensor, reach: int) -> Tensor:
    """Largest value in an octagon of radius ``reach`` pixels."""
    square = _square_max(image, reach // 2)
    rest = reach - reach // 2
    return torch.maximum(_line_max(square, rest, 3), _line_max(square, rest, 2))


def _neighbour_mean(image: Tensor) -> Tensor:
    wide = nn.functional.pad(image, [1, 1, 1, 1], mode="replicate")
    across = wide[:, :, 1:-1, :-2] + wide[:, :, 1:-1, 2:]
    return 0.25 * (across + wide[:, :, :-2, 1:-1] + wide[:, :, 2:, 1:-1])


def _blobs(mask: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Place (N, 2) weighed by value, area, longer side, px, and largest value of the parts of a mask (1, 1, H, W)."""
    import cv2

    mask, value = mask[0, 0].cpu(), value[0, 0].cpu()
    number, label, stats, _ = cv2.connectedComponentsWithStats(mask.numpy().astype(np.uint8))
    blob, weight = torch.from_numpy(label).long()[mask], value[mask].clamp_min(1e-6)
    y, x = mask.nonzero().to(weight.dtype).T
    total, across, down = (torch.bincount(blob, weight * of, number)[1:] for of in (torch.ones_like(x), x, y))
    width, height, area = torch.from_numpy(stats[1:, 2:]).to(weight.dtype).T
    largest = torch.zeros(number, dtype=weight.dtype).scatter_reduce(0, blob, weight, "amax")[1:]
    return torch.stack((across / total, down / total), 1), area, torch.maximum(width, height), largest
