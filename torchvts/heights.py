r"""How high a contact stands, by its brightness: what slopes do not tell where a cliff cuts it off from the skin at rest.

Near lights shine differently on what is nearer to them. For each pixel, L(z)^-1 I has length 1 at the true depth z; its
derivative along z is 0.01 to 0.1 per mm. One pixel tells a height to some tenths of a millimetre, all pixels of a contact to
some hundredths.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from .compensate import blur, gaussian_weights
from .contact import reconstruct
from .core.checks import check_batch, check_field, check_least, check_positive, check_record, check_same_size, check_shape
from .core.geometry import gradient_from_normal
from .integration import label_contacts
from .record import Calibration, check_calibration
from .shading import PointLights, gloss_lobe, inverse_light_matrix, light_matrix

STEP_MM = 0.2
"""Depth over which the derivative of brightness is taken."""

STEEPEST = 1.0
"""Pixels steeper than this do not vote: walls are seen half, and a light may be kept from them."""

LEAST_PIXELS = 40
"""A contact of fewer votes is left where it is."""

MODEL_STD = 0.0015
"""Brightness that the light model gets wrong even where it fits the image at rest: TACTO's renders, over 1 to 2 mm."""

UNSEEN_STD = 0.01
"""How far lamps may have changed where no skin at rest is in sight to tell."""

MISFIT_PART = 0.2
"""What part of the misfit at rest, which compensation takes out, comes back where the skin is pressed in."""

PIECES = 4
"""Contact and skin at rest are cut into so many rows and columns; how far the pieces differ tells how far they are wrong."""


MOST_EVIDENCE, MOST_COMPANY = 40.0, 24.0
"""Doubled log odds that a pixel may have by itself, and by its neighbours: they decide where it does not know."""

COMPANY = 3.0
"""How much the mean of the neighbours counts. Walls 1 mm high, noise 0.003: 5 pixels in 8 frames wrong with 1, none with 3."""

MOST_MISFIT = 30.0
"""Squared deviations, over three channels, from which a pixel is neither skin at rest nor top: it keeps its place."""


class Heights(NamedTuple):
    """What brightness tells of depth.

    Attributes:
        depth_mm: (B, 1, H, W), as given, corrected by what the pixels around tell. weight: (B, 1, H, W), how much each pixel tells
            by itself, 1 / mm^2; 0 for those that do not vote.
        lift_mm: (B, 1, H, W), the same for all pixels of a contact: how much higher it stands than the depth that was given.
        lift_std_mm: (B, 1, H, W), its standard deviation, errors of the light model included; infinite where nothing is told.
    """

    depth_mm: Tensor
    weight: Tensor
    lift_mm: Tensor
    lift_std_mm: Tensor


class HeightFromBrightness(nn.Module):
    """Heights of contacts under known lights; they decide where contacts stand, and carry no gradients.

    Args:
        lights: the three lights. noise_std: (3, H, W), of the compensated image. mm_per_pixel: pixel pitch, mm.
        misfit: what the lights leave of the image at rest, relative. full_above: (3, H, W), compensated intensity from which a
            channel counts as saturated; None for never.
    Source:
        that the length of L(z)^-1 I tells of depth: near lights, Queau, Durix, Wu, Cremers, Lauze, Durou, LED-based
        photometric stereo, JMIV 60(3), 2018; heights of contacts, their deviation and their rims: this project.
    Example:
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> up = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, 24, 32)
        >>> raised = lights(torch.full((1, 1, 24, 32), 0.8), up, 0.3)  # all of a flat skin, without a slope to tell
        >>> heights = HeightFromBrightness(lights, torch.full((3, 24, 32), 0.002), 0.3)
        >>> told = heights(raised, up, torch.zeros(1, 1, 24, 32), torch.ones(1, 1, 24, 32, dtype=torch.bool))
        >>> round(float(told.lift_mm[0, 0, 12, 16]), 1)
        0.8
    """

    noise_std: Tensor
    full_above: Tensor

    def __init__(
        self, lights: PointLights, noise_std: Tensor, mm_per_pixel: float, misfit: float = 0.0, full_above: Tensor | None = None
    ) -> None:
        super().__init__()
        check_record("lights", lights, PointLights, "PointLights(position_mm, albedo) makes them")
        check_field("noise_std", noise_std)
        check_least("misfit", misfit)
        if full_above is not None:
            check_shape("full_above", full_above, noise_std.shape, "noise_std")
        self.lights = PointLights(lights.position_mm.detach(), lights.albedo.detach(), lights.gloss).requires_grad_(False)
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.model_std = max(MODEL_STD, MISFIT_PART * misfit)
        self.smoothing_px = max(1.0, min(noise_std.shape[1], noise_std.shape[2]) / 60.0)
        self.register_buffer("noise_std", noise_std.detach().clamp_min(1e-6))
        full = torch.full_like(noise_std, torch.inf) if full_above is None else full_above.detach().clone()
        self.register_buffer("full_above", full)

    @classmethod
    def from_calibration(cls, calibration: Calibration) -> "HeightFromBrightness":
        """Of a unit calibrated by lights.

        Raises:
            ValueError: one calibrated by response fields, which know nothing of distances to lights.
        """
        check_calibration("calibration", calibration)
        if calibration.lights is None:
            raise ValueError("calibration: expected one by lights, got one by response fields: brightness tells them no distance")
        sensor, misfit = calibration.sensor, 0.0
        if calibration.gain is not None:
            cell = max(1, min(sensor.height, sensor.width) // 30)
            gain = nn.functional.avg_pool2d(calibration.gain[None], cell)
            log = gain.clamp_min(1e-6).log().flatten(2)
            spread = (log - log.median(dim=2, keepdim=True).values).abs().median(dim=2).values  # full pixels under lamps aside
            misfit = 1.4826 * float(spread.max())
        noise, full = calibration.compensated_noise_std, calibration.full_above
        return cls(calibration.lights, noise, sensor.mm_per_pixel, misfit, full)

    def forward(self, compensated: Tensor, normal: Tensor, depth_mm: Tensor, contact: Tensor) -> Heights:
        """Heights at a depth near the true one.

        Args:
            compensated: (B, 3, H, W). normal: (B, 3, H, W), for what gloss adds. depth_mm: (B, 1, H, W).
            contact: bool (B, 1, H, W).
        Raises:
            ValueError: wrong shapes. TypeError: wrong kinds of numbers.
        """
        self._check(compensated, normal, depth_mm, contact=contact)
        image, depth, noise = compensated.detach().double(), depth_mm.detach().double(), self.noise_std.double()
        position, albedo = self.lights.position_mm.double(), self.lights.albedo.double()
        lit = ((image > 4.0 * noise) & (image < self.full_above)).all(dim=1, keepdim=True)
        if self.lights.glossy:
            lobe = gloss_lobe(light_matrix(depth, position, albedo, self.mm_per_pixel), normal.detach().double())
            image = image / (1.0 + self.lights.gloss.double().reshape(1, 3, 1, 1) * lobe)
        inverse = inverse_light_matrix(depth, position, albedo, self.mm_per_pixel)
        above = inverse_light_matrix(depth + STEP_MM, position, albedo, self.mm_per_pixel)
        vector = (inverse * image[:, None]).sum(2)
        length = vector.norm(dim=1, keepdim=True).clamp_min(1e-12)
        per_mm = ((above * image[:, None]).sum(2).norm(dim=1, keepdim=True) - length) / STEP_MM
        along = ((vector / length)[:, :, None] * inverse).sum(1)  # how each channel moves the length
        length_std = (along * noise).square().sum(1, keepdim=True).sqrt()
        steep = gradient_from_normal(vector / length).square().sum(1, keepdim=True) > STEEPEST**2
        votes = lit & ~steep & (vector[:, 2:3] > 0) & (per_mm.abs() > 1e-4)
        votes = votes & (nn.functional.max_pool2d((~contact).to(image.dtype), 3, 1, 1) == 0)
        missing = torch.where(votes, (1.0 - length) / torch.where(votes, per_mm, 1.0), 0.0)
        weight = torch.where(votes, (per_mm / length_std).square(), 0.0)
        weights = gaussian_weights(self.smoothing_px)
        total, wide = blur(weight * missing, weights), blur(weight, weights)
        lift, lift_std = torch.zeros_like(depth), torch.full_like(depth, torch.inf)
        for frame in range(len(depth)):
            away = nn.functional.max_pool2d(contact[frame].to(image.dtype), 5, 1, 2)[0] == 0
            _, off = _by_pieces(away & lit[frame, 0], length[frame, 0] - 1.0, length_std[frame, 0].square().reciprocal())
            model_std = math.hypot(self.model_std, float(off.square().mean().sqrt()) if len(off) > 0 else UNSEEN_STD)
            label = label_contacts(contact[frame : frame + 1])[0, 0]
            for number in range(1, int(label.amax()) + 1):
                mine = label == number
                mean, std = _pooled(mine, missing[frame, 0], weight[frame, 0], per_mm[frame, 0], model_std)
                lift[frame, 0, mine], lift_std[frame, 0, mine] = mean, std
        told = (depth + total / wide.clamp_min(1e-12), weight, lift, lift_std)
        return Heights(*(value.to(depth_mm.dtype) for value in told))

    def reach(
        self, compensated: Tensor, normal: Tensor, depth_mm: Tensor, contact: Tensor, apart: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Contacts with cliffs all around, their rims sought again: a pixel belongs to what its brightness is nearer to.

        That is the skin at rest, or the contact beside it, as high and as inclined as there. Pixels that are steep, or like
        neither, keep their place.

        Args:
            compensated, normal, depth_mm, contact: as for :meth:`forward`, the depth lifted. apart: bool (B, 1, H, W), the pixels
                of contacts with cliffs all around.
        Returns:
            contact, apart and depth_mm, with the pixels that were won and lost.
        Raises:
            ValueError: wrong shapes. TypeError: wrong kinds of numbers.
        """
        self._check(compensated, normal, depth_mm, contact=contact, apart=apart)
        compensated, normal, depth_mm = compensated.detach(), normal.detach(), depth_mm.detach()
        image, noise = compensated.double(), self.noise_std.double()
        steep = gradient_from_normal(normal).square().sum(1, keepdim=True) > STEEPEST**2
        sure = (apart & ~steep).double()
        weights = gaussian_weights(self.smoothing_px)
        around = blur(sure, weights)
        beside = blur(torch.cat((depth_mm, normal), dim=1).double() * sure, weights) / around.clamp_min(1e-12)
        top = self.lights(beside[:, 0:1].to(depth_mm.dtype), _unit(beside[:, 1:4]).to(depth_mm.dtype), self.mm_per_pixel).double()
        up = torch.zeros_like(top)
        up[:, 2] = 1.0
        rest = self.lights(torch.zeros_like(depth_mm), up.to(depth_mm.dtype), self.mm_per_pixel).double()
        seen, apart_by = (image - rest) / noise, (top - rest) / noise
        square = apart_by.square().sum(1, keepdim=True).clamp_min(1e-12)
        part = (seen * apart_by).sum(1, keepdim=True) / square  # 0 at rest, 1 on top, between for a pixel that sees both
        own = (square * (2.0 * part - 1.0)).clamp(-MOST_EVIDENCE, MOST_EVIDENCE)  # log odds of top, doubled
        evidence = own + (COMPANY * blur(own, [0.25, 0.5, 0.25])).clamp(-MOST_COMPANY, MOST_COMPANY) > 0
        neither = (seen - part.clamp(0.0, 1.0) * apart_by).square().sum(1, keepdim=True) > MOST_MISFIT
        local = around > 1e-3
        candidates = torch.where(local & ~steep & ~neither & (apart | ~contact), evidence, contact)
        found = reconstruct(contact & candidates, candidates)
        won = found & ~contact
        return found, (apart | won) & found, torch.where(won, beside[:, 0:1].to(depth_mm.dtype), depth_mm)

    def _check(self, compensated: Tensor, normal: Tensor, depth_mm: Tensor, **masks: Tensor) -> None:
        check_batch("compensated", compensated, 3)
        check_same_size("compensated", compensated, "the calibration", self.noise_std.shape[1], self.noise_std.shape[2])
        one_channel = (compensated.shape[0], 1, *compensated.shape[2:])
        for name, value, shape in (("normal", normal, compensated.shape), ("depth_mm", depth_mm, one_channel)):
            check_batch(name, value, shape[1])
            check_shape(name, value, shape, "compensated")
        for name, value in masks.items():
            check_shape(name, value, one_channel, "compensated")
            if value.dtype != torch.bool:
                raise TypeError(f"{name}: expected bool, got {value.dtype}: threshold it")


def _unit(vector: Tensor) -> Tensor:
    length = vector.norm(dim=1, keepdim=True)
    up = torch.zeros_like(vector)
    up[:, 2] = 1.0
    return torch.where(length > 0, vector / length.clamp_min(1e-12), up)


def _by_pieces(mine: Tensor, values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and weighted means of ``values`` in the pieces of a region (H, W); pieces of next to no weight are left out."""
    rows, columns = torch.nonzero(mine & (weight > 0), as_tuple=True)
    if len(rows) == 0:
        return weight.new_zeros(0), weight.new_zeros(0)
    place = [PIECES * (at - at.min()) // (at.max() - at.min() + 1) for at in (rows, columns)]
    piece, weights = PIECES * place[0] + place[1], weight[rows, columns]
    total = torch.bincount(piece, weights, PIECES**2)
    told = total > 0.02 * total.sum()
    return total[told], torch.bincount(piece, weights * values[rows, columns], PIECES**2)[told] / total[told]


def _pooled(mine: Tensor, missing: Tensor, weight: Tensor, per_mm: Tensor, model_std: float) -> tuple[float, float]:
    """Mean over the pixels of one contact (H, W), mm, and its standard deviation."""
    weight = weight * mine
    if int((weight > 0).sum()) < LEAST_PIXELS:
        return 0.0, math.inf
    weights, means = _by_pieces(mine, missing, weight)
    share = weights / weights.sum()
    mean = (share * means).sum()
    scatter = (share * (means - mean).square()).sum() / max(1, len(means) - 1)
    usual_per_mm = ((weight * per_mm.square()).sum() / weight.sum()).sqrt()
    return float(mean), float(torch.sqrt(scatter + 1.0 / weight.sum() + (model_std / usual_per_mm).square()))
