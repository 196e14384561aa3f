"""How far each printed dot of a skin has moved, in millimetres, with its covariance."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.checks import (
    MOST_NUMBER,
    check_batch,
    check_field,
    check_float_tensor,
    check_numbers,
    check_positive,
    check_range,
    check_same_count,
    check_same_size,
)
from ..core.geometry import gradient_of_depth
from ..model.calibration import Calibration, check_calibration
from ..model.markers import FEWEST_DOTS, find_dots
from .dot_motion import DotMotion, matern
from .dots import DotTemplates, quadratic

PEDESTAL = 0.25
"""Added to the light before its logarithm: dark pixels are all noise in a ratio."""

PATCH = 1.4
"""Half a dot's patch, in diameters, and at most half a spacing."""

COARSE_PATCH = 0.55
"""Half a patch of the first level, in spacings."""

REACH = 1.6
"""Of the dots beside a dot, in spacings."""

AGREES = 0.3
"""A dot that has moved otherwise than its neighbours by so many spacings is another dot; less where they tell less."""

LENGTH = 2.2
"""Of the Gaussian process of motion, in spacings."""

NUGGET = 1e-4
"""Its noise, in units of its variance."""

BEND_SHARE = 0.33
"""Skin bends more smoothly within a dot than the process (Matern 5/2) says: standard deviation, measured in units of it."""

FLOOR_PX = 0.003
"""Error of a place beside noise and bends: what drawn dots under a contact's shading are off without noise."""

NEAREST_CAMERA_MM = 20.0
"""Height of a camera above the skin where none is known, at least."""

DEPTH_SHARE, DEPTH_MM = 0.1, 0.01
"""Standard deviation of depth: a share of it, and so many mm."""


class SkinMotion(nn.Module):
    """Motion of the printed dots of a skin: images (B, 3, H, W) and their depth to a :class:`DotMotion`.

    A dot is looked for where the frame before had it. Without one, the dots that have hardly moved are found first, then, ring by
    ring, each near where the others expect it (a Gaussian process); what is not joined to most of the dots in this way is not seen.
    The process bends the patches, too: a dot tells the mean motion of its rim, which is not that of its middle where skin bends.
    Frames of a batch do not influence one another, and nothing is remembered between calls. Displacements are differentiable in the
    images and in depth.

    Args:
        background: (3, H, W) in [0, 1], the skin at rest with its dots, as the camera gives it.
        dots_px: (N, 2), places of the dots.
        diameter_px: of a dot.
        mm_per_pixel: pixel pitch, mm.
        camera_mm: (x, y, height) of a pinhole camera above the skin at rest, image axes from the middle; an infinite height for an
            orthographic camera. None where it is not known: then skin that is pressed toward the camera seems to come nearer to its
            axis, by :attr:`DotMotion.pinhole_mm` at most.
    Raises:
        ValueError, TypeError: names the argument; too few dots.
    Source:
        the regression is that of :class:`~torchvts.skin.dots.DotTemplates`; the rest is this project's.
    """

    middle_px: Tensor
    rest_px: Tensor
    rest_mm: Tensor
    camera: Tensor
    beside: Tensor
    terms: Tensor
    alike: Tensor
    slopes: Tensor
    by_bend: Tensor
    prior: Tensor

    def __init__(
        self,
        background: Tensor,
        dots_px: Tensor,
        diameter_px: float,
        mm_per_pixel: float,
        camera_mm: tuple[float, float, float] | None = None,
    ) -> None:
        super().__init__()
        check_field("background", background)
        check_range("background", background)
        self.diameter_px = check_positive("diameter_px", diameter_px)
        self.mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
        self.height, self.width = background.shape[1], background.shape[2]
        check_float_tensor("dots_px", dots_px)
        if dots_px.dim() != 2 or dots_px.shape[1] != 2 or not bool(torch.isfinite(dots_px).all()):
            raise ValueError(f"dots_px: expected finite places (N, 2), got {tuple(dots_px.shape)}: find_dots gives them")
        rim = 0.5 * self.diameter_px
        most = dots_px.new_tensor([self.width - 1.0, self.height - 1.0]) - rim
        dots = dots_px[((dots_px > rim) & (dots_px < most)).all(dim=1)].to(background.dtype)
        if len(dots) < FEWEST_DOTS:
            raise ValueError(
                f"background: expected a skin with at least {FEWEST_DOTS} printed dots that lie wholly in view, got {len(dots)}: a "
                "skin without dots shows no motion that could be told from a change of light"
            )
        distance = torch.cdist(dots, dots)
        self.spacing_px = float(distance.topk(2, largest=False).values[:, 1].median())
        if self.spacing_px <= 0.0:
            raise ValueError("dots_px: expected places that differ, got most of them twice: find_dots gives each once")
        self.knows_camera = camera_mm is not None
        x, y, height = (0.0, 0.0, math.inf) if camera_mm is None else check_camera(camera_mm)
        self.agrees, self.most_px = AGREES, 0.3 * self.diameter_px
        self.rounds = math.ceil(math.sqrt(2.0 * len(dots)))  # rings of dots around one in a corner
        self.nearest_mm, self.pedestal, self.depth_share, self.depth_mm = NEAREST_CAMERA_MM, PEDESTAL, DEPTH_SHARE, DEPTH_MM
        self.nugget, self.bend_share, self.floor_px = NUGGET, BEND_SHARE, FLOOR_PX
        middle = 0.5 * dots.new_tensor([self.width - 1.0, self.height - 1.0])
        self.register_buffer("beside", distance < REACH * self.spacing_px)
        grey = self.log_light(background[None])
        half = min(PATCH * self.diameter_px, 0.5 * self.spacing_px)
        self.rim_px, blur_px = 0.8 * half, max(self.diameter_px / 3.0, self.spacing_px / 5.0)
        self.coarse = DotTemplates(grey, dots, COARSE_PATCH * self.spacing_px, max(1, int(blur_px / 2.0)), blur_px)
        self.fine = DotTemplates(grey, dots, half, max(1, int(self.diameter_px / 10.0)), 0.1 * self.diameter_px)
        # the process: how alike dots move, derivatives of this, and what bends do to places
        length = LENGTH * self.spacing_px
        far = (dots[:, None] - dots).double() / length
        r = math.sqrt(5.0) * far.norm(dim=-1, keepdim=True)
        bends = torch.stack((far[..., 0] ** 2, far[..., 0] * far[..., 1], far[..., 1] ** 2), -1)
        bends = ((1.0 + r) * torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64) - 5.0 * bends) / length
        slopes = torch.cat(((1.0 + r) * far, bends), -1) * torch.exp(-r) * (-5.0 / (3.0 * length))
        prior = torch.tensor([[3, 0, 1], [0, 1, 0], [1, 0, 3]], dtype=torch.float64) * (25.0 / 3.0 / length**4)  # of bends
        by_bend = self.fine.by_bend.double()
        for name, value in (
            ("middle_px", middle),
            ("rest_px", dots),
            ("rest_mm", (dots - middle) * self.mm_per_pixel),
            ("camera", torch.tensor([x, y, 1.0 / height], dtype=torch.float64)),
            ("terms", torch.cat((self.fine.patch, quadratic(self.fine.patch)), dim=-1)),
            ("alike", matern(far.norm(dim=-1))),
            ("slopes", slopes.mT),
            ("by_bend", torch.einsum("nkjq,nmq->nkjm", by_bend, slopes[..., 2:]).flatten(1, 2)),
            ("prior", torch.einsum("nkjq,qr,nljr->nkl", by_bend, prior, by_bend)),
        ):
            self.register_buffer(name, value.to(background.dtype))

    @classmethod
    def from_calibration(cls, calibration: Calibration, camera_mm: tuple[float, float, float] | None = None) -> "SkinMotion":
        """The module of a calibrated unit whose skin has printed dots.

        Args:
            calibration: of the unit.
            camera_mm: as for the class; None for :attr:`Sensor.camera_mm`, which the sensor's ``camera_matrix`` gives.
        Raises:
            TypeError: no Calibration.
            ValueError: no dots in the background.
        Example:
            >>> from torchvts import Sensor
            >>> from torchvts.scenes import DottedSkin, Drag
            >>> skin, drag = DottedSkin(120, 160, 0.125), Drag(shift_mm=(0.3, 0.0), press_mm=0.5)
            >>> cal = Calibration.from_lights(skin.lights, Sensor("rig", 120, 160, 0.125), skin.image())
            >>> moved = SkinMotion.from_calibration(cal)(skin.image(drag)[None], skin.depth_mm(drag).float())
            >>> middle = moved.rest_mm.norm(dim=1).argmin()
            >>> [round(v, 1) + 0.0 for v in moved.displacement_mm[0, middle].tolist()], bool(moved.seen[0, middle])
            ([0.3, 0.0, 0.5], True)
        """
        check_calibration("calibration", calibration)
        name, markers = calibration.sensor.name, calibration.markers
        if markers is None:
            raise ValueError(
                f"calibration: expected a skin with printed dots, got none in the background of sensor '{name}': without dots no "
                "motion can be told from a change of light; for irregular dots the sensor file needs markers: true"
            )
        if calibration.printed is None:
            raise ValueError(
                f"calibration: expected the background of sensor '{name}' with its dots, got one in which they are filled: "
                "calibrate the unit again, an older torchvts did not keep them"
            )
        camera = calibration.sensor.camera_mm if camera_mm is None else camera_mm
        dots = find_dots(calibration.printed, markers)
        return cls(calibration.printed, dots, markers.diameter_px, calibration.sensor.mm_per_pixel, camera).eval()

    if TYPE_CHECKING:

        def __call__(self, images: Tensor, depth_mm: Tensor, last: DotMotion | None = None) -> DotMotion: ...

    def forward(self, images: Tensor, depth_mm: Tensor, last: DotMotion | None = None) -> DotMotion:
        """Images (B, 3, H, W) in [0, 1], their depth (B, 1, H, W), mm, and the motion of the frames before, of B frames or one.

        Images and depth of another precision than the module's are brought to that, which the motion has.

        Raises:
            ValueError: shapes that differ from the background's or from each other. TypeError: not floating point.
        """
        check_batch("images", images, 3)
        check_batch("depth_mm", depth_mm, 1)
        check_same_size("images", images, "the calibration", self.height, self.width)
        check_same_size("depth_mm", depth_mm, "images", self.height, self.width)
        check_same_count("depth_mm", depth_mm, "images", images.shape[0])
        images, depth_mm = images.to(self.rest_px.dtype), depth_mm.to(self.rest_px.dtype)
        start = self.rest_px[None]
        if last is not None:
            if not torch.jit.is_scripting():
                check_last(last)
            check_same_count("last", last.displacement_mm, "images", images.shape[0])
            if last.displacement_mm.shape[1] != self.rest_px.shape[0]:
                raise ValueError(
                    f"last: expected the motion of {self.rest_px.shape[0]} dots, got {last.displacement_mm.shape[1]}: of another "
                    "unit?"
                )
            start = self.px_of(last.displacement_mm.detach())
        grey = self.log_light(images)
        coarse, fine = self.coarse.prepare(grey.detach()), self.fine.prepare(grey)
        start = start.expand(images.shape[0], -1, -1)
        place, seen = self.find(coarse, fine.detach(), start, last is not None)
        same = torch.eye(2, dtype=place.dtype, device=place.device)
        place = torch.where(seen[..., None], self.fine.step(fine.detach(), place, self.fine.patch, same), place)
        around, warp, beside = self.surroundings(place, seen)
        for _ in range(2):
            place = torch.where(seen[..., None], self.fine.step(fine.detach(), place, around, warp), place)
        place, covariance, there = self.fine.settle(fine, place, around, self.most_px)
        if place.requires_grad:  # a dot that moves bends the skin in others
            shares = self.process(place - self.rest_px, seen)[0]
            by_bend = self.by_bend.reshape(-1, 2, 2, place.shape[1])
            bends = torch.einsum("nkjm,bmj->bnk", by_bend, shares - shares.detach())
            place = place - (warp @ bends[..., None])[..., 0]
        noise = (covariance + self.floor_px**2 * same) * seen[..., None, None].to(place.dtype)
        return self.in_mm(place, noise + beside, seen & there, depth_mm)

    def log_light(self, images: Tensor) -> Tensor:
        """(B, 1, H, W): mean of the channels' logarithms, in which light from opposite sides cancels."""
        return torch.log(images.clamp_min(0.0) + self.pedestal).mean(dim=1, keepdim=True)

    def find(self, coarse: Tensor, fine: Tensor, start: Tensor, known_start: bool) -> tuple[Tensor, Tensor]:
        """Places (B, N, 2) px of dots, and which are seen, (B, N) bool; others are where their neighbours expect them."""
        place, seen = self.register(coarse, fine, start)
        seen = self.consistent(place - start, seen, known_start)
        for _ in range(1 if known_start else self.rounds):
            _, _, expected, variance, _ = self.process(place - start, seen)
            expected = start + expected
            known_px = self.spacing_px * (self.agrees - variance)
            wanted = ~seen & (known_px > 0.0) & self.in_view(expected)
            if not bool(wanted.any()):
                break
            tried, there = self.register(coarse, fine, expected)
            gained = wanted & there & ((tried - expected).square().sum(-1).sqrt() < known_px)  # others in the next round
            if not bool(gained.any()):
                break
            place = torch.where(gained[..., None], tried, place)
            seen = self.consistent(place - start, seen | gained, known_start)
        return torch.where(seen[..., None], place, start + self.process(place - start, seen)[2]), seen

    def register(self, coarse: Tensor, fine: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Places of dots (B, N, 2) px from a start, and whether they are there."""
        place, _ = self.coarse.search(coarse, start, 0.35 * self.spacing_px)
        place, there = self.fine.search(fine, place, self.most_px)
        return place, there & self.in_view(place)

    def in_view(self, place: Tensor) -> Tensor:
        """Whether dots at places (B, N, 2) px are nearly wholly in view."""
        x, y, rim = place[..., 0], place[..., 1], self.rim_px
        return (x > rim) & (y > rim) & (x < float(self.width) - 1.0 - rim) & (y < float(self.height) - 1.0 - rim)

    def process(self, moved: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The Gaussian process through motions (B, N, 2) px of seen dots.

        Returns:
            The shares of dots in its mean, (B, N, 2), and its inverse covariance, (B, N, N), in units of its variance; the motion
            of each dot that the others expect, (B, N, 2), and the variance of this, (B, N), in these units; and the units around
            each dot, (B, N) px^2: with them others miss the dots there by as much as they should.
        Source:
            Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, eq. 2.25, 2.26 and 5.12 (leave one out).
        """
        known = seen.to(moved.dtype)
        system = self.alike * known[:, :, None] * known[:, None] + torch.diag_embed(self.nugget + 1.0 - known)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(system))
        shares = inverse @ (moved * known[..., None])
        alike = self.alike * known[:, None]
        left_out = 1.0 / inverse.diagonal(dim1=1, dim2=2)
        mean = torch.where(seen[..., None], moved - shares * left_out[..., None], alike @ shares)
        variance = torch.where(seen, left_out, 1.0 - ((alike @ inverse) * alike).sum(-1))
        missed = 0.5 * shares.square().sum(-1) * left_out
        around = self.beside.to(moved.dtype)
        unit = (around @ missed[..., None])[..., 0] / (around @ known[..., None])[..., 0].clamp_min(1.0)
        return shares, inverse, mean, variance, unit

    def surroundings(self, place: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Patches (B, N, P, 2) px as the process bends them, their warp (B, N, 2, 2), and a covariance (B, N, 2, 2) px^2.

        This is of a seen dot what is not known of its bend, of another what is not known of its place.
        """
        shares, inverse, _, variance, unit = self.process(place - self.rest_px, seen)
        slopes = self.slopes @ shares[:, None]  # (B, N, 5, 2)
        slopes = torch.cat((slopes[..., :2, :].clamp(-0.6, 0.6), slopes[..., 2:, :]), -2)
        same = torch.eye(2, dtype=place.dtype, device=place.device)
        bend = (self.by_bend * seen.to(place.dtype)[:, None, None]).flatten(1, 2)  # (B, 4 N, N): both axes, by bends along both
        half = (bend @ inverse).reshape(len(place), -1, 2, 2, place.shape[1])
        told = half.flatten(3) @ bend.reshape(half.shape).flatten(3).mT
        bends = self.bend_share**2 * (self.prior - told)
        unknown = torch.where(seen[..., None, None], bends, variance[..., None, None] * same)
        return self.fine.patch + self.terms @ slopes, same + slopes[..., :2, :].mT, unit[..., None, None] * unknown

    def consistent(self, moved: Tensor, seen: Tensor, known_start: bool) -> Tensor:
        """Seen dots without those whose motion, (B, N, 2) px, contradicts their neighbours, the worst first.

        Without a frame before, what neighbours do not join to most of the others is left out, too: it may have moved by a spacing.
        """
        for _ in range(self.rounds):
            _, _, mean, variance, _ = self.process(moved, seen)
            miss = (moved - mean).square().sum(-1).sqrt() * (seen & (variance < self.agrees)).to(moved.dtype)
            worst = (miss > self.agrees * self.spacing_px) & (miss >= (miss[:, None] * self.beside).amax(-1))
            if not bool(worst.any()):
                break
            seen = seen & ~worst
        return seen if known_start else self.joined(moved, seen)

    def joined(self, moved: Tensor, seen: Tensor) -> Tensor:
        """Seen dots that neighbours which moved alike, (B, N, 2) px, join to most of the others."""
        agree = (torch.cdist(moved, moved) < 1.5 * self.agrees * self.spacing_px) & self.beside & seen[:, None] & seen[:, :, None]
        label = torch.where(seen, torch.arange(1, moved.shape[1] + 1, device=moved.device), 0)
        for _ in range(moved.shape[1]):
            before = label
            label = torch.maximum(label, torch.where(agree, label[:, None], 0).amax(-1))
            if bool((label == before).all()):
                break
        sizes = torch.zeros_like(moved[..., 0]).scatter_add(1, (label - 1).clamp_min(0), seen.to(moved.dtype))
        return seen & (label - 1 == sizes.argmax(dim=1, keepdim=True))

    def in_mm(self, place: Tensor, covariance: Tensor, seen: Tensor, depth_mm: Tensor) -> DotMotion:
        """The record of places (B, N, 2) px and their covariance: through the camera, with depth as the third coordinate."""
        maps = torch.cat((depth_mm, gradient_of_depth(depth_mm.detach(), self.mm_per_pixel)), dim=1).expand(len(place), -1, -1, -1)
        grid = (place / self.middle_px - 1.0)[:, :, None]
        at = nn.functional.grid_sample(maps, grid, "bilinear", "border", align_corners=True)[..., 0].mT  # (B, N, 3)
        depth, slope = at[..., :1], at[..., 1:].detach()
        axis = self.camera[:2]
        from_axis = (place - self.middle_px) * self.mm_per_pixel - axis
        nearer = 1.0 - depth * self.camera[2]
        displacement = torch.cat((from_axis * nearer + axis - self.rest_mm, depth), dim=-1)
        # derivatives by depth, and by the place, mm of the image
        by_depth = torch.cat((-from_axis * self.camera[2], torch.ones_like(depth)), dim=-1).detach()[..., None]
        by_place = nearer.detach()[..., None] * torch.eye(3, 2, dtype=place.dtype, device=place.device)
        by_place = by_place + by_depth * slope[..., None, :]
        depth_variance = ((self.depth_share * depth.detach()).square() + self.depth_mm**2)[..., None]
        shared = by_place @ (self.mm_per_pixel**2 * covariance.detach()) @ by_place.mT + depth_variance * by_depth @ by_depth.mT
        unknown = torch.zeros_like(depth) if self.knows_camera else depth.detach() / self.nearest_mm
        pinhole = (from_axis.detach().square().sum(-1, keepdim=True).sqrt() * unknown)[..., 0]
        return DotMotion(self.rest_mm, displacement, shared, seen, pinhole, self.height, self.width, self.mm_per_pixel)

    def px_of(self, displacement_mm: Tensor) -> Tensor:
        """Places (B, N, 2) px that see displaced dots (B, N, 3)."""
        axis = self.camera[:2]
        seen = (self.rest_mm + displacement_mm[..., :2] - axis) / (1.0 - displacement_mm[..., 2:] * self.camera[2]) + axis
        return seen / self.mm_per_pixel + self.middle_px


@lru_cache(maxsize=1)  # finding the dots takes longer than following them
def motion_of_unit(calibration: Calibration) -> SkinMotion | None:
    """The module of a calibrated unit; None where its skin has no dots that could be followed."""
    try:
        return None if calibration.printed is None else SkinMotion.from_calibration(calibration)
    except ValueError:
        return None


def check_last(value: object) -> None:
    """Raise unless it is a :class:`DotMotion`, or what a script gives in its place."""
    if not hasattr(value, "displacement_mm"):
        raise TypeError(f"last: expected a DotMotion, got {type(value).__name__}: what the module gave for the frame before")


def check_camera(value: object) -> tuple[float, float, float]:
    """Return (x, y, height) of a camera, mm, or raise; an infinite height means an orthographic camera."""
    if isinstance(value, tuple | list) and len(value) == 3 and value[2] == math.inf:
        value = (*value[:2], MOST_NUMBER)
    x, y, height = check_numbers("camera_mm", value, (3,))
    if height <= 0.0:
        raise ValueError(f"camera_mm: expected a camera above the skin, (x, y, height), got {value!r}")
    return x, y, height
