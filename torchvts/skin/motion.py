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
from ..model.markers import find_dots
from .dot_motion import DotMotion
from .dots import DotTemplates

PEDESTAL = 0.25
"""Added to the light before its logarithm: dark pixels are all noise in a ratio."""

PATCH = 1.4
"""Half a dot's patch, in diameters, and at most half a spacing."""

COARSE_PATCH = 0.55
"""Half a patch of the first level, in spacings."""

FEWEST = 8
"""Dots that a skin has at least; fewer are dust."""

NEIGHBOURS = 24
"""A dot's neighbours: the two rings around it."""

REACH = 1.2
"""Of a neighbour's say, in spacings."""

AGREES = 0.3
"""A dot that differs by so many spacings from what its neighbours expect is another."""

ROUNDS = 12
"""Rings of dots that are found one after another where there is no frame before."""

STEPS = 5
"""By the templates' derivatives, at each level; then a frame's own derivatives settle the place in three."""

BEND = 0.1
"""Error of a dot whose skin bends, in units of how far its neighbours miss it times the square of diameter over spacing."""

NEAREST_CAMERA_MM = 20.0
"""Height of a camera above the skin where none is known, at least."""

DEPTH_SHARE, DEPTH_MM = 0.1, 0.01
"""Standard deviation of depth: a share of it, and so many mm."""


class SkinMotion(nn.Module):
    """Motion of the printed dots of a skin: images (B, 3, H, W) and their depth to a :class:`DotMotion`.

    A dot is looked for where the frame before had it. Without one, the dots that have hardly moved are found first, then, ring by
    ring, each near where its neighbours expect it; what is not joined to most of the dots in this way is not seen. Frames of a
    batch do not influence one another, and nothing is remembered between calls. Displacements are differentiable in the images
    and in depth.

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

    rest_px: Tensor
    camera: Tensor
    index: Tensor
    offset: Tensor
    reach: Tensor

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
        self.diameter_px, self.mm_per_pixel = (
            check_positive("diameter_px", diameter_px),
            check_positive("mm_per_pixel", mm_per_pixel),
        )
        self.height, self.width = background.shape[1], background.shape[2]
        check_float_tensor("dots_px", dots_px)
        if dots_px.dim() != 2 or dots_px.shape[1] != 2 or not bool(torch.isfinite(dots_px).all()):
            raise ValueError(f"dots_px: expected finite places (N, 2), got {tuple(dots_px.shape)}: find_dots gives them")
        rim = 0.5 * self.diameter_px
        most = dots_px.new_tensor([self.width - 1.0, self.height - 1.0]) - rim
        dots = dots_px[((dots_px > rim) & (dots_px < most)).all(dim=1)].to(background.dtype)
        if len(dots) < FEWEST:
            raise ValueError(
                f"background: expected a skin with at least {FEWEST} printed dots that lie wholly in view, got {len(dots)}: a skin "
                "without dots shows no motion that could be told from a change of light"
            )
        distance = torch.cdist(dots, dots).fill_diagonal_(math.inf)
        self.spacing_px = float(distance.amin(dim=1).median())
        near, index = distance.topk(min(NEIGHBOURS, len(dots) - 1), largest=False)
        apart = (dots[index] - dots[:, None]) / self.spacing_px
        self.knows_camera = camera_mm is not None
        x, y, height = (0.0, 0.0, math.inf) if camera_mm is None else check_camera(camera_mm)
        self.agrees, self.rounds, self.steps, self.settles, self.nearest_mm = AGREES, ROUNDS, STEPS, 2, NEAREST_CAMERA_MM
        self.bend, self.pedestal, self.depth_share, self.depth_mm = BEND, PEDESTAL, DEPTH_SHARE, DEPTH_MM
        for name, value in (
            ("rest_px", dots),
            ("camera", torch.tensor([x, y, 1.0 / height], dtype=torch.float64)),
            ("index", index),
            ("offset", torch.cat((torch.ones_like(apart[..., :1]), apart), dim=-1)),  # (N, K, 3)
            ("reach", torch.exp(-0.5 * (near / (REACH * self.spacing_px)).square())),
        ):
            self.register_buffer(name, value if value.dtype == torch.long else value.to(background.dtype))
        grey = self.log_light(background[None])
        half = min(PATCH * self.diameter_px, 0.5 * self.spacing_px)
        self.rim_px = 0.8 * half
        blur_px = max(self.diameter_px / 3.0, self.spacing_px / 5.0)
        cell = max(1, int(blur_px / 2.0))
        self.coarse = DotTemplates(grey, dots, COARSE_PATCH * self.spacing_px, cell, blur_px)
        self.fine = DotTemplates(grey, dots, half, max(1, int(self.diameter_px / 10.0)), 0.1 * self.diameter_px)

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

        Raises:
            ValueError: shapes that differ from the background's or from each other. TypeError: not floating point.
        """
        check_batch("images", images, 3)
        check_batch("depth_mm", depth_mm, 1)
        check_same_size("images", images, "the calibration", self.height, self.width)
        check_same_size("depth_mm", depth_mm, "images", self.height, self.width)
        check_same_count("depth_mm", depth_mm, "images", images.shape[0])
        if last is not None:
            if not torch.jit.is_scripting():
                check_last(last)
            check_same_count("last", last.displacement_mm, "images", images.shape[0])
            if last.displacement_mm.shape[1] != self.rest_px.shape[0]:
                raise ValueError(
                    f"last: expected the motion of {self.rest_px.shape[0]} dots, got {last.displacement_mm.shape[1]}: of another "
                    "unit?"
                )
        grey = self.log_light(images)
        coarse, fine = self.coarse.prepare(grey.detach()), self.fine.prepare(grey)
        place, seen = self.find(coarse, fine.detach(), last)
        warp = self.warp(place, seen)
        most_px = 0.3 * self.diameter_px
        for _ in range(self.settles):
            place = self.fine.settle(fine.detach(), place, warp, most_px).place
        settled = self.fine.settle(fine, place, warp, most_px)
        return self.in_mm(settled.place, settled.covariance + self.doubt(place, seen), seen & settled.there, depth_mm)

    def log_light(self, images: Tensor) -> Tensor:
        """(B, 1, H, W): mean of the channels' logarithms, in which light from opposite sides cancels."""
        return torch.log(images.clamp_min(0.0) + self.pedestal).mean(dim=1, keepdim=True)

    def find(self, coarse: Tensor, fine: Tensor, last: DotMotion | None) -> tuple[Tensor, Tensor]:
        """Places (B, N, 2) px of dots, and which are seen, (B, N) bool; others are where their neighbours expect them."""
        count = coarse.shape[0]
        start = self.rest_px[None].expand(count, -1, -1) if last is None else self.px_of(last.displacement_mm.detach())
        start = start.expand(count, -1, -1)
        place, seen = self.register(coarse, fine, start)
        seen = self.joined(place, seen) if last is None else self.consistent(place, start, seen)
        for _ in range(self.rounds if last is None else 1):
            expected, support = self.expected(place, start, seen)
            wanted = ~seen & (support > 1.0) & self.in_view(expected)
            if not bool(wanted.any()):
                break
            tried, there = self.register(coarse, fine, expected)
            near = (tried - expected).square().sum(-1).sqrt() < self.agrees * self.spacing_px
            gained = wanted & there & near
            if not bool(gained.any()):
                break
            place = torch.where(gained[..., None], tried, place)
            seen = self.consistent(place, start, seen | gained)
        return torch.where(seen[..., None], place, self.expected(place, start, seen)[0]), seen

    def register(self, coarse: Tensor, fine: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
        """Places of dots (B, N, 2) px from a start, and whether they are there."""
        place, _ = self.coarse.follow(coarse, start, self.steps, 0.35 * self.spacing_px)
        place, there = self.fine.follow(fine, place, self.steps, 0.3 * self.diameter_px)
        return place, there & self.in_view(place)

    def in_view(self, place: Tensor) -> Tensor:
        """Whether dots at places (B, N, 2) px are nearly wholly in view."""
        x, y, rim = place[..., 0], place[..., 1], self.rim_px
        return (x > rim) & (y > rim) & (x < float(self.width) - 1.0 - rim) & (y < float(self.height) - 1.0 - rim)

    def expected(self, place: Tensor, start: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Places (B, N, 2) px where the motion of seen neighbours from a start expects dots, and how many these are, (B, N)."""
        plane, support = self.plane(place - start, seen, 0.0)
        return start + plane[..., 0, :], support

    def warp(self, place: Tensor, seen: Tensor) -> Tensor:
        """(B, N, 2, 2): what the motion makes of the skin around each dot."""
        plane, _ = self.plane(place - self.rest_px, seen, 1.0)
        same = torch.eye(2, dtype=place.dtype, device=place.device)
        return same + (plane[..., 1:, :].mT / self.spacing_px).clamp(-0.6, 0.6)

    def plane(self, moved: Tensor, seen: Tensor, own: float) -> tuple[Tensor, Tensor]:
        """Plane (B, N, 3, 2) through the motions (B, N, 2) of seen neighbours, by spacings, and how many these are, (B, N)."""
        around = moved[:, self.index]  # (B, N, K, 2)
        weight = self.reach * seen[:, self.index].to(moved.dtype)
        columns = weight[..., None] * self.offset
        known = own * seen.to(moved.dtype)[..., None]
        ridge = torch.tensor([1e-6, 0.02, 0.02], dtype=moved.dtype, device=moved.device)
        ridge = ridge + known * torch.tensor([1.0, 0.0, 0.0], dtype=moved.dtype, device=moved.device)
        right = columns.mT @ around
        right = torch.cat((right[..., :1, :] + (known * moved)[..., None, :], right[..., 1:, :]), dim=-2)
        return torch.linalg.solve(columns.mT @ self.offset + torch.diag_embed(ridge), right), weight.sum(-1)

    def doubt(self, place: Tensor, seen: Tensor) -> Tensor:
        """Covariance (B, N, 2, 2) px^2 beside noise: of a seen dot what its bend hides, of another how its neighbours may err."""
        expected, support = self.expected(place, self.rest_px[None].expand_as(place), seen)
        miss = (place - expected).square().sum(-1)
        bend = (self.bend * self.diameter_px**2 / self.spacing_px**2) ** 2 * miss
        known = seen.to(place.dtype) * (support > 1.0).to(place.dtype)
        usual = (miss * known).sum(-1, keepdim=True) / known.sum(-1, keepdim=True).clamp_min(1.0)
        unknown = torch.where(support > 1.0, usual + (0.1 * self.spacing_px) ** 2, self.spacing_px**2)
        return torch.diag_embed(torch.where(seen, bend, unknown)[..., None].expand(-1, -1, 2))

    def consistent(self, place: Tensor, start: Tensor, seen: Tensor) -> Tensor:
        """Seen dots without those that contradict their neighbours or share a place with a better one, the worst first."""
        miss = torch.zeros_like(place[..., 0])
        for _ in range(self.rounds):
            expected, support = self.expected(place, start, seen)
            miss = (place - expected).square().sum(-1).sqrt() * (seen & (support > 1.0)).to(place.dtype)
            worst = miss >= miss[:, self.index].amax(-1)
            worst = worst & (miss > self.agrees * self.spacing_px)
            if not bool(worst.any()):
                break
            seen = seen & ~worst
        apart = torch.cdist(place, place) + self.spacing_px * torch.eye(place.shape[1], dtype=place.dtype, device=place.device)
        other = (apart < self.agrees * self.spacing_px) & seen[:, None] & (miss[:, None] <= miss[:, :, None])
        return seen & ~other.any(-1)

    def joined(self, place: Tensor, seen: Tensor) -> Tensor:
        """Seen dots that neighbours which agree with them join to most of the others."""
        moved = place - self.rest_px
        agree = (moved[:, self.index] - moved[:, :, None]).square().sum(-1).sqrt() < 1.5 * self.agrees * self.spacing_px
        beside = self.offset[..., 1:].square().sum(-1) < 1.6**2
        agree = agree & beside & seen[:, self.index] & seen[..., None]
        own = torch.arange(1, place.shape[1] + 1, device=place.device).expand(place.shape[0], -1)
        label = torch.where(seen, own, 0)
        for _ in range(place.shape[1]):
            before = label
            label = torch.maximum(label, torch.where(agree, label[:, self.index], 0).amax(-1))
            if bool((label == before).all()):
                break
        sizes = torch.zeros_like(place[..., 0]).scatter_add(1, (label - 1).clamp_min(0), seen.to(place.dtype))
        return seen & (label - 1 == sizes.argmax(dim=1, keepdim=True))

    def in_mm(self, place: Tensor, covariance: Tensor, seen: Tensor, depth_mm: Tensor) -> DotMotion:
        """The record of places (B, N, 2) px and their covariance: through the camera, with depth as the third coordinate."""
        size = torch.tensor([self.width - 1.0, self.height - 1.0], dtype=place.dtype, device=place.device)
        grid = (2.0 * place / size - 1.0)[:, :, None]
        maps = torch.cat((depth_mm, gradient_of_depth(depth_mm.detach(), self.mm_per_pixel)), dim=1).expand(len(place), -1, -1, -1)
        at = nn.functional.grid_sample(maps, grid, mode="bilinear", padding_mode="border", align_corners=True)[
            ..., 0
        ].mT  # (B, N, 3)
        depth, slope = at[..., :1], at[..., 1:].detach()
        axis = self.camera[:2]
        from_axis = (place - 0.5 * size) * self.mm_per_pixel - axis
        rest = (self.rest_px - 0.5 * size) * self.mm_per_pixel
        nearer = 1.0 - depth * self.camera[2]
        displacement = torch.cat((from_axis * nearer + axis - rest, depth), dim=-1)
        # derivatives by the place, mm of the image, and by depth
        by_depth = torch.cat((-from_axis * self.camera[2], torch.ones_like(depth)), dim=-1).detach()
        nearer = torch.cat((nearer, nearer, torch.zeros_like(depth)), dim=-1).detach()
        by_place = torch.diag_embed(nearer)[..., :2] + by_depth[..., None] * slope[..., None, :]
        depth_variance = (self.depth_share * depth.detach()).square() + self.depth_mm**2
        shared = by_place @ (self.mm_per_pixel**2 * covariance.detach()) @ by_place.mT
        shared = shared + depth_variance[..., None] * by_depth[..., None] * by_depth[..., None, :]
        unknown = torch.zeros_like(depth) if self.knows_camera else depth.detach() / self.nearest_mm
        pinhole = (from_axis.detach().square().sum(-1, keepdim=True).sqrt() * unknown)[..., 0]
        return DotMotion(rest, displacement, shared, seen, pinhole, self.height, self.width, self.mm_per_pixel)

    def px_of(self, displacement_mm: Tensor) -> Tensor:
        """Places (B, N, 2) px that see displaced dots (B, N, 3)."""
        size = torch.tensor([self.width - 1.0, self.height - 1.0], dtype=displacement_mm.dtype, device=displacement_mm.device)
        rest = (self.rest_px - 0.5 * size) * self.mm_per_pixel
        axis = self.camera[:2]
        seen = (rest + displacement_mm[..., :2] - axis) / (1.0 - displacement_mm[..., 2:] * self.camera[2]) + axis
        return seen / self.mm_per_pixel + 0.5 * size


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
