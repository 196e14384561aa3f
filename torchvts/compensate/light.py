"""The light of a frame, relative to that of the background, found on its undeformed skin and divided out."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..core.checks import check_field, check_positive, check_same_size, check_shape
from ..core.levels import BLACK
from ..core.precision import widened
from ..model.calibration import PEDESTAL, Calibration, check_calibration

LIGHT_SAMPLES = 24
"""Samples along the shorter side from which the light is found; of smaller images it is taken to be the background's."""

LIGHT_EVERY = 3
"""Every so many rows and columns of the samples, one is a candidate for undeformed skin."""

ALIKE = 0.03
"""Scale of relative differences of light between samples that are undeformed skin, when candidates are compared."""

LIGHT_BETTER = 1.1
"""A surface must have this many times the support of the background's own light: it has parameters to spend."""

EXACT = 0.002
"""Least scale of residuals at which the background's own light is compared with the surface found, relative: half a grey level."""

DAMPING = 0.02
"""Least share of the samples that decides how far a step of the fit goes in any direction."""

LIGHT_STEPS = 12
"""Steps of the fit of the surface."""

FIRST_SCALE, LAST_SCALE = 0.06, 0.014
"""Scale of its residuals, relative, at first and from the middle of the steps on: from what a press makes in undeformed skin at
most down to the noise of real frames. Samples off by twice that, in each channel, do not count."""

UNEVEN = 0.06
"""Unevenness of the light's change that presses make at most."""

LEAST_LIGHT = 0.05
"""Least light, over the background's, that is divided by: where a surface is extrapolated it may be anything."""

MOST_LOST = 0.9
"""Share of the samples of a channel that may be black or saturated: with more, it gets the light of the others."""


class Samples(NamedTuple):
    """Samples of frames.

    Attributes:
        relative: light / (background + pedestal), (B, 3, N).
        share: the same of the background, (3, N); 0 where it is black or saturated.
        counts: 1 where a sample counts in a channel, else 0, (B, 3, N).
        saturated: where it is at least as bright as it seems, bool (B, 3, N).
    """

    relative: Tensor
    share: Tensor
    counts: Tensor
    saturated: Tensor


class Relight(nn.Module):
    r"""Linear light (B, 3, H, W) of frames, as it would be in the light of the background.

    Exposure and white balance multiply each channel, LEDs fade on their side of the skin, a press scatters light over all of it:
    on undeformed skin light / background is a smooth surface s, in each channel a polynomial of degree 2 in position. Where the
    skin has moved it is something else.

    1. A level of each channel. Candidates are the light of single samples, and 1: that of the background. The one near which most
       samples lie in all channels at once is taken.
    2. From there, that level and then a surface by Tukey's loss with a scale that shrinks. The light of the background, the level,
       the surface: the first is taken unless the next has clearly more samples to within their noise.

    Black samples do not count, saturated ones are lower bounds; a channel that has lost nine tenths of them gets the mean surface
    of the others. A saturated pixel is at least as bright as it seems: where it seems darker than the background, it is taken to
    be the background.

    Args:
        background: (3, H, W), linear light of the undeformed skin.
        exponent: linear light is image value to the power of this.
        saturation_light: linear light from which a channel is saturated.
        noise_std: (3, H, W), noise of linear light; None for half a grey level.
    Source:
        Tukey's loss by reweighted least squares, damped: Huber, Robust Statistics, 1981; a scale that shrinks: Blake and
        Zisserman, Visual Reconstruction, 1987; the rest is this project's.
    Example:
        >>> skin = torch.rand(3, 48, 64) * 0.1 + 0.4
        >>> bool((Relight(skin)(0.6 * skin[None]) - skin).abs().max() < 1e-5)
        True
    """

    background: Tensor
    sampled: Tensor
    share: Tensor
    place: Tensor
    to_terms: Tensor
    x: Tensor
    y: Tensor

    def __init__(
        self, background: Tensor, exponent: float = 1.0, saturation_light: float = 1.0, noise_std: Tensor | None = None
    ) -> None:
        super().__init__()
        check_field("background", background)
        self.saturation_light = check_positive("saturation_light", saturation_light)
        self.black = BLACK ** check_positive("exponent", exponent)
        self.size = (background.shape[1], background.shape[2])
        self.stride, self.shows = max(1, min(self.size) // LIGHT_SAMPLES), min(self.size) >= LIGHT_SAMPLES
        self.least = LEAST_LIGHT
        self.every, self.alike, self.damping, self.better, self.most_lost = LIGHT_EVERY, ALIKE, DAMPING, LIGHT_BETTER, MOST_LOST
        self.scales = [FIRST_SCALE * (LAST_SCALE / FIRST_SCALE) ** min(1.0, 2.0 * k / LIGHT_STEPS) for k in range(LIGHT_STEPS)]
        self.register_buffer("background", background.detach().clone())
        light = background.detach().double()
        sampled, brightest = grid_samples(light[None], self.stride)
        valid = (sampled[0] > self.black) & (brightest[0] < saturation_light)
        self.exact = EXACT
        if noise_std is not None:
            check_shape("noise_std", noise_std, background.shape, "background")
            noise = noise_std.detach().double() / (light + PEDESTAL) / (1.0 if self.stride < 3 else 3.0)
            self.exact = max(EXACT, float(0.5 * noise.square().flatten(1).median(dim=1).values.mean().mul(2.0).sqrt()))
        share = torch.where(valid, sampled[0] / (sampled[0] + PEDESTAL), torch.zeros_like(sampled[0])).flatten(1)
        terms = surface_terms(*self.size, self.stride).flatten(1)  # (6, N)
        place, to_terms = zip(*(_orthonormal(one * terms) for one in share))
        self.register_buffer("sampled", (sampled[0] + PEDESTAL).to(background.dtype))
        self.register_buffer("share", share.to(background.dtype))
        self.register_buffer("place", torch.stack(place).to(background.dtype))
        self.register_buffer("to_terms", torch.stack(to_terms).to(background.dtype))
        self.register_buffer("x", legendre(self.size[1], 1).to(background.dtype))
        self.register_buffer("y", legendre(self.size[0], 1).to(background.dtype))

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "Relight":
        """The block of a calibrated unit."""
        check_calibration("calibration", calibration)
        return cls(
            calibration.unclipped_background, calibration.sensor.exponent, calibration.saturation_light, calibration.light_noise_std
        )

    def forward(self, light: Tensor) -> Tensor:
        check_same_size("image", light, "the calibration", self.size[0], self.size[1])
        found = self.terms(light)
        if found is None:
            return light
        relit = light / self.surface(found.to(light.dtype)).clamp_min(self.least)
        saturated = light >= self.saturation_light
        hidden = saturated & ((relit < self.background) | (self.background >= self.saturation_light))
        return torch.where(hidden, self.background.to(light.dtype), relit)

    @torch.jit.export
    def light_of(self, light: Tensor) -> Tensor:
        """The coefficients of :meth:`terms`; those of unchanged light where the images are too small to show any."""
        terms = self.terms(light)
        return unchanged_light(light) if terms is None else terms.to(light.dtype)

    @torch.jit.export
    def terms(self, light: Tensor) -> Tensor | None:
        """The surface of linear light (B, 3, H, W) over the background's: coefficients (B, 3, 6) of :func:`surface_terms`, float64.

        None for images that are too small to show it.
        """
        if not self.shows:
            return None
        sampled, brightest = grid_samples(light, self.stride)
        relative = widened((sampled / self.sampled).flatten(2))  # (B, 3, N), with the pedestal
        share = self.share.to(relative.dtype)
        lit = (share > 0.0) & (sampled > self.black).flatten(2)
        saturated = (brightest >= self.saturation_light).flatten(2)
        known = (lit & ~saturated).to(relative.dtype).sum(dim=2, keepdim=True)
        known = known > (1.0 - self.most_lost) * (share > 0.0).to(relative.dtype).sum(dim=1)[:, None]
        samples = Samples(relative, share, (lit & known).to(relative.dtype), saturated)
        level = self.level(samples)
        samples = Samples(relative / level, share, samples.counts, saturated)
        place = self.place.to(relative.dtype)  # (3, 6, N)
        to_terms, known_ones = self.to_terms.to(relative.dtype), known.to(relative.dtype)
        as_is = Samples(relative, share, samples.counts, saturated)
        best = self.better * self.support(residual(as_is, torch.zeros_like(relative)), samples.counts)
        terms = _one(torch.zeros_like(relative[:, :, :6]))
        for some in (1, 6):  # a level of each channel, then a surface: the smallest that the samples ask for
            found = self.fit(samples, place[:, :some])
            support = self.support(residual(samples, (found[:, :, None] @ place[:, :some])[:, :, 0]), samples.counts)
            surface = level * ((found[:, :, None] @ to_terms[:, :some])[:, :, 0] + _one(terms))
            mean = (surface * known_ones).sum(dim=1, keepdim=True) / known_ones.sum(dim=1, keepdim=True).clamp_min(1.0)
            terms = torch.where((support > best)[:, None, None], torch.where(known, surface, mean), terms)
            best = torch.maximum(best, self.better * support)
        return terms

    def fit(self, samples: Samples, place: Tensor) -> Tensor:
        """Coefficients (B, 3, T) of terms (3, T, N) that the samples stay near, from 0 on."""
        found = torch.zeros(samples.relative.shape[0], 3, place.shape[1], dtype=place.dtype, device=place.device)
        damping = self.damping * torch.eye(place.shape[1], dtype=place.dtype, device=place.device)
        for scale in self.scales:
            off = residual(samples, (found[:, :, None] @ place)[:, :, 0])
            weight = (1.0 - (off * off).sum(dim=1, keepdim=True) / (12.0 * scale * scale)).clamp_min(0.0)
            weight = weight * weight * samples.counts / float(place.shape[2])
            form = (place * weight[:, :, None]) @ place.transpose(1, 2) + damping  # (B, 3, T, T)
            step: Tensor = torch.linalg.solve(form, ((off * weight)[:, :, None] @ place.transpose(1, 2)).transpose(2, 3))
            found = found + step[..., 0]
        return found

    @torch.jit.export
    def lost(self, light: Tensor) -> Tensor:
        """Share of the samples of each channel, (B, 3), that are black or saturated where the background is not."""
        sampled, brightest = grid_samples(light, self.stride)
        bad = ((sampled <= self.black) | (brightest >= self.saturation_light)).flatten(2)
        usable = self.share > 0.0
        share: Tensor = (bad & usable).to(light.dtype).sum(dim=2) / usable.to(light.dtype).sum(dim=1).clamp_min(1.0)
        return share

    def support(self, off: Tensor, counts: Tensor) -> Tensor:
        """How many samples residuals (B, 3, N) leave near a surface, (B,)."""
        weight = (1.0 - (off * off).sum(dim=1) / (12.0 * self.exact * self.exact)).clamp_min(0.0)
        return (weight * weight * counts.amax(dim=1)).sum(dim=1)

    def level(self, samples: Samples) -> Tensor:
        """The level of each channel's light, (B, 3, 1)."""
        relative, share, counts = samples.relative, samples.share, samples.counts
        rows, columns = self.sampled.shape[1], self.sampled.shape[2]
        first = self.every // 2
        at = torch.arange(rows * columns, device=relative.device).reshape(rows, columns)
        at = at[first :: self.every, first :: self.every].flatten()
        some = (relative / share.clamp_min(1e-6))[:, :, at]  # (B, 3, C)
        whole = counts[:, :, at]
        mean = (some * whole).sum(dim=1, keepdim=True) / whole.sum(dim=1, keepdim=True).clamp_min(1.0)
        some = torch.where(whole > 0.0, some, mean).clamp(0.1, 10.0)
        some = torch.cat((torch.ones_like(some[:, :, :1]), some), dim=2)
        squared = torch.zeros(relative.shape[0], some.shape[2], relative.shape[2], dtype=relative.dtype, device=relative.device)
        for c in range(3):
            off = (relative[:, c, None] / some[:, c, :, None]).detach() - share[c]
            off = torch.where(samples.saturated[:, c, None], off.clamp_min(0.0), off)
            squared = squared + off * off * counts[:, c, None]
        support = (1.0 - squared / (12.0 * self.alike * self.alike)).clamp_min(0.0)
        support = (support * support * counts.amax(dim=1)[:, None]).sum(dim=2)  # (B, 1 + C)
        best = support.argmax(dim=1)
        return some.gather(2, best[:, None, None].expand(-1, 3, 1))

    def surface(self, terms: Tensor) -> Tensor:
        """The surface of coefficients (B, 3, 6), (B, 3, H, W)."""
        x, y = self.x.to(terms.dtype), self.y.to(terms.dtype)[:, :, None]
        t = terms[..., None, None]  # in the order of surface_terms
        # product by product and sum by sum, as compiled kernels do: a fused operator rounds otherwise
        constant = t[:, :, 0] + t[:, :, 2] * y[1] + t[:, :, 5] * y[2]  # (B, 3, H, 1)
        once = t[:, :, 1] + t[:, :, 4] * y[1]
        return constant + once * x[1] + t[:, :, 3] * x[2]


class AsItIs(nn.Module):
    """Light that is taken to be that of the background."""

    def forward(self, light: Tensor) -> Tensor:
        return light

    @torch.jit.export
    def light_of(self, light: Tensor) -> Tensor:
        """See :meth:`Relight.light_of`."""
        return unchanged_light(light)

    @torch.jit.export
    def lost(self, light: Tensor) -> Tensor:
        """See :meth:`Relight.lost`."""
        return light.new_zeros(light.shape[0], 3)


def residual(samples: Samples, surface: Tensor) -> Tensor:
    """What samples are brighter than 1 + a surface (B, 3, N), which is weighted by their share: (B, 3, N)."""
    off = samples.relative - samples.share - surface
    return torch.where(samples.saturated, off.clamp_min(0.0), off) * samples.counts


def unchanged_light(images: Tensor) -> Tensor:
    """The coefficients (B, 3, 6) of frames (B, C, H, W) in the light of the background."""
    return _one(images.new_zeros(images.shape[0], 3, 6))


def _one(found: Tensor) -> Tensor:
    """The coefficients of a surface that is 1 everywhere."""
    one = torch.zeros_like(found)
    one[:, :, 0] = 1.0
    return one


def _orthonormal(terms: Tensor) -> tuple[Tensor, Tensor]:
    """Combinations of terms (6, N) that are orthonormal in the mean over N, (6, N), and what makes them of the terms, (6, 6)."""
    count = terms.shape[1]
    gram = terms @ terms.t() / count
    triangle = torch.linalg.cholesky(gram + 1e-9 * torch.eye(6, dtype=terms.dtype))
    inverse = torch.linalg.inv(triangle)
    return inverse @ terms, inverse


def grid_samples(image: Tensor, stride: int) -> tuple[Tensor, Tensor]:
    """Every ``stride``-th pixel of images (B, C, H, W): mean and largest of 3 x 3 pixels, where these do not overlap."""
    if stride < 3:
        one = image[:, :, stride // 2 :: stride, stride // 2 :: stride]
        return one, one
    first = stride // 2 - 1
    rows, columns = image.shape[2] // stride * stride, image.shape[3] // stride * stride
    total = image[:, :, first:rows:stride, first:columns:stride]
    most = total
    for k in range(1, 9):
        one = image[:, :, first + k // 3 : rows : stride, first + k % 3 : columns : stride]
        total, most = total + one, torch.maximum(most, one)
    return total / 9.0, most


def surface_terms(height: int, width: int, stride: int) -> Tensor:
    """The terms of the surface at every ``stride``-th pixel, (6, h, w), float64: products of Legendre polynomials."""
    y, x = legendre(height, stride)[:, :, None], legendre(width, stride)[:, None]  # (3, h, 1), (3, 1, w)
    return torch.stack((y[0] * x[0], y[0] * x[1], y[1] * x[0], y[0] * x[2], y[1] * x[1], y[2] * x[0]))


def legendre(length: int, stride: int) -> Tensor:
    """Legendre polynomials of degree 0 to 2 over a line of pixels, of mean square 1, at the samples, (3, n), float64."""
    last = length if stride < 3 else length // stride * stride
    place = (2.0 * torch.arange(stride // 2, last, stride, dtype=torch.float64) + 1.0) / float(length) - 1.0
    return torch.stack((torch.ones_like(place), 3.0**0.5 * place, 5.0**0.5 * (1.5 * place.square() - 0.5)))


def unevenness(light: Tensor) -> Tensor:
    """Root mean square over the image of what the light (B, 3, 6) of each channel is off its level, over that level, (B, 3)."""
    return light[:, :, 1:].square().sum(dim=2).sqrt() / light[:, :, 0].clamp_min(1e-6)
