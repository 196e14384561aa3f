"""Skins with printed dots that an object presses, drags and turns: images, and where every point of the skin went, in 3D."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..core.blur import blur, gaussian_weights
from ..core.checks import (
    check_camera_height,
    check_choice,
    check_float_tensor,
    check_least,
    check_numbers,
    check_positive,
    check_seed,
    check_size,
)
from ..core.geometry import gradient_of_depth, normal_from_gradient, pixel_grid_mm
from ..model.lights import PointLights, near_field_shading

FINE = 2
"""A pixel's dots are drawn on so many places a side."""

EDGE_PX = 0.25
"""Softness of a dot's edge, pixels."""

STEPS = 60
"""Most steps to the skin's point that a pixel sees."""


@dataclass(frozen=True)
class Drag:
    """A round object that presses, moves and turns, and the skin that follows it.

    Skin within the stuck part moves with the object; beyond, it slips, and comes back over ``reach_mm``. A press pushes skin
    outward.

    Args:
        center_mm: (x, y) of the object before it moves, image axes.
        radius_mm: of the contact.
        press_mm: depth in the middle.
        shift_mm: (x, y) that the object moves.
        turn_deg: that it turns, from x to y of the image.
        bulge_mm: largest outward displacement of the skin by the press alone.
        stuck: radius of the stuck part as a share of the contact's.
        reach_mm: over which the skin around comes back.
    Example:
        >>> Drag(shift_mm=(0.3, 0.0), press_mm=0.5).displacement_mm(torch.zeros(1, 2, dtype=torch.float64))[0, 0]
        tensor(0.3000, dtype=torch.float64)
    """

    center_mm: tuple[float, float] = (0.0, 0.0)
    radius_mm: float = 3.5
    press_mm: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0
    bulge_mm: float = 0.0
    stuck: float = 1.0
    reach_mm: float = 2.5

    def __post_init__(self) -> None:
        check_numbers("center_mm", self.center_mm, (2,)), check_numbers("shift_mm", self.shift_mm, (2,))
        check_positive("radius_mm", self.radius_mm), check_positive("reach_mm", self.reach_mm)
        check_least("turn_deg", self.turn_deg, -math.inf), check_least("bulge_mm", self.bulge_mm, -math.inf)
        check_least("press_mm", self.press_mm), check_least("stuck", self.stuck, 0.0, 1.0)

    def displacement_mm(self, points_mm: Tensor) -> Tensor:
        """Where points of the skin at rest (..., 2) went, (..., 3): x, y, and depth."""
        check_float_tensor("points_mm", points_mm)
        center = points_mm.new_tensor(self.center_mm)
        offset = points_mm - center
        r = offset.norm(dim=-1, keepdim=True)
        follows = 1.0 / (1.0 + ((r - self.stuck * self.radius_mm).clamp_min(0.0) / self.reach_mm) ** 2)
        width = 0.8 * self.radius_mm
        outward = self.bulge_mm * offset / width * torch.exp(0.5 - 0.5 * (r / width) ** 2)
        across = follows * self.object_mm(points_mm) + outward
        beside = (offset + across - center.new_tensor(self.shift_mm)).norm(dim=-1, keepdim=True)  # from the object's middle
        return torch.cat((across, self.press_mm / (1.0 + (beside / width) ** 4)), dim=-1)

    def object_mm(self, points_mm: Tensor) -> Tensor:
        """Where points of the object (..., 2) went, (..., 2)."""
        c, s = math.cos(math.radians(self.turn_deg)), math.sin(math.radians(self.turn_deg))
        offset = points_mm - points_mm.new_tensor(self.center_mm)
        return offset @ points_mm.new_tensor([[c, s], [-s, c]]) - offset + points_mm.new_tensor(self.shift_mm)


@dataclass(frozen=True)
class DottedSkin:
    """A skin with printed dots under three coloured lights and a camera.

    Args:
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch on the undeformed skin, mm.
        spacing_mm: distance of neighbouring dots.
        diameter_mm: of a dot.
        pattern: "square" or "hexagonal".
        shape: of a dot, "round", "square" or "ring".
        darkness: share of light that a dot takes in R, G, B.
        worn: scatter of dots about their pattern, in spacings.
        blur_px: of the lens.
        noise_std: of the image value.
        camera_height_mm: of a pinhole camera above the middle of the skin; infinite for an orthographic camera.
        seed: of the places and sizes of dots.
    Example:
        >>> skin = DottedSkin(60, 80, 0.25)
        >>> skin.image().shape, skin.dots_mm.shape
        (torch.Size([3, 60, 80]), torch.Size([130, 2]))
    """

    height: int = 240
    width: int = 320
    mm_per_pixel: float = 0.0634
    spacing_mm: float = 1.9
    diameter_mm: float = 0.634
    pattern: str = "square"
    shape: str = "round"
    darkness: tuple[float, float, float] = (0.75, 0.75, 0.75)
    worn: float = 0.03
    blur_px: float = 0.9
    noise_std: float = 1.5 / 255.0
    camera_height_mm: float = math.inf
    seed: int = 0

    def __post_init__(self) -> None:
        check_size(self.height, self.width, self.mm_per_pixel, 3)
        check_positive("diameter_mm", self.diameter_mm, check_positive("spacing_mm", self.spacing_mm))
        (
            check_choice("pattern", self.pattern, ("square", "hexagonal")),
            check_choice("shape", self.shape, ("round", "square", "ring")),
        )
        if not all(0.0 <= share < 1.0 for share in check_numbers("darkness", self.darkness, (3,))):
            raise ValueError(f"darkness: expected shares of light in [0, 1), got {self.darkness}")
        check_least("worn", self.worn, 0.0, 0.2), check_least("blur_px", self.blur_px), check_least("noise_std", self.noise_std)
        check_camera_height(self.camera_height_mm), check_seed("seed", self.seed)

    @property
    def lights(self) -> PointLights:
        """Three lights around the skin that give half of the range in its middle."""
        far = 1.2 * self.width * self.mm_per_pixel
        places = [[far * math.cos(a), far * math.sin(a), far] for a in (0.0, 2.0944, 4.1888)]
        bright = 0.5 * far**2 * 2.0**1.5
        return PointLights(places, [bright, 0.9 * bright, bright]).requires_grad_(False)

    @property
    def dots_mm(self) -> Tensor:
        """(N, 2) float64, places of all dots at rest, some of them out of view: row by row of the pattern."""
        return self._pattern()[0]

    def image(self, drag: Drag | None = None, seed: int = 0, left: Tensor | None = None) -> Tensor:
        """A frame (3, H, W) in [0, 1], of 8 bits.

        Args:
            drag: what the object does; None for the skin at rest.
            seed: of the noise.
            left: (N,) in [0, 1], what is left of each dot's darkness; None for all of it.
        """
        return self.with_noise(self.light(drag, left), seed)

    def with_noise(self, light: Tensor, seed: int = 0) -> Tensor:
        """The camera's image (3, H, W) of light (3, H, W)."""
        noise = torch.randn(light.shape, generator=torch.Generator().manual_seed(check_seed("seed", seed)), dtype=light.dtype)
        return ((light + self.noise_std * noise).clamp(0.0, 1.0) * 255.0).round().div(255.0).float()

    def light(self, drag: Drag | None = None, left: Tensor | None = None) -> Tensor:
        """(3, H, W) float64: what falls on the camera, without noise."""
        cover = nn.functional.avg_pool2d(self._cover(self.rest_mm(drag, FINE), left)[None, None], FINE)
        depth = self.depth_mm(drag)
        normal = normal_from_gradient(gradient_of_depth(depth, self.mm_per_pixel))
        light = near_field_shading(depth, normal, self.lights.double(), self.mm_per_pixel, self.camera_height_mm).clamp_min(0.0)
        light = light * (1.0 - cover * light.new_tensor(self.darkness).reshape(1, 3, 1, 1))
        return (blur(light, gaussian_weights(self.blur_px)) if self.blur_px else light)[0]

    def depth_mm(self, drag: Drag | None = None) -> Tensor:
        """(1, 1, H, W) float64, mm: depth of the skin that each pixel sees."""
        if drag is None:
            return torch.zeros(1, 1, self.height, self.width, dtype=torch.float64)
        return drag.displacement_mm(self.rest_mm(drag, 1))[None, None, :, :, 2]

    def seen_px(self, points_mm: Tensor) -> Tensor:
        """Pixels (..., 2), x and y, that see points (..., 3)."""
        middle = points_mm.new_tensor([(self.width - 1) / 2.0, (self.height - 1) / 2.0])
        return points_mm[..., :2] / (1.0 - points_mm[..., 2:] / self.camera_height_mm) / self.mm_per_pixel + middle

    def rest_mm(self, drag: Drag | None = None, fine: int = 1) -> Tensor:
        """(fine H, fine W, 2) float64: where the skin's points that pixels see lie at rest.

        Raises:
            ValueError: the drag folds the skin.
        """
        x, y = pixel_grid_mm(fine * self.height, fine * self.width, self.mm_per_pixel / fine, torch.float64)
        seen = torch.stack((x.expand(y.shape[0], -1), y.expand(-1, x.shape[1])), dim=-1)
        if drag is None:
            return seen
        eps, rest = 1e-4 * self.mm_per_pixel, seen
        for k in range(STEPS):
            missed = seen - self._seen_mm(drag, rest)
            if float(missed.abs().max()) < eps:
                return rest
            if k < 20:  # near enough for Newton's steps
                rest = rest + 0.7 * missed
                continue
            along = [(self._seen_mm(drag, rest + eps * rest.new_tensor(unit)) - seen + missed) / eps for unit in ((1, 0), (0, 1))]
            rest = rest + torch.linalg.solve(torch.stack(along, dim=-1), missed)
        raise ValueError(f"drag: expected skin that does not fold, got {drag}: move the object less, or give it a longer reach_mm")

    def _seen_mm(self, drag: Drag, rest: Tensor) -> Tensor:
        """Places on the undeformed skin behind which points at rest (..., 2) are seen."""
        moved = drag.displacement_mm(rest)
        return (rest + moved[..., :2]) / (1.0 - moved[..., 2:] / self.camera_height_mm)

    def _pattern(self) -> tuple[Tensor, Tensor, float]:
        """Places (N, 2) and half axes (N, 2) of dots, and the distance of rows."""
        draw = torch.Generator().manual_seed(self.seed)
        across = self.spacing_mm
        down = across * math.sqrt(0.75) if self.pattern == "hexagonal" else across
        columns, rows = self._counts(down)
        x = (torch.arange(columns, dtype=torch.float64) - (columns - 1) / 2.0) * across
        y = (torch.arange(rows, dtype=torch.float64) - (rows - 1) / 2.0) * down
        places = torch.stack((x.expand(rows, -1), y[:, None].expand(-1, columns)), dim=-1)
        if self.pattern == "hexagonal":
            places[1::2, :, 0] += 0.5 * across
        places = places.reshape(-1, 2)
        scatter = torch.randn(2, *places.shape, generator=draw, dtype=torch.float64)
        return places + self.worn * across * scatter[0], 0.5 * self.diameter_mm * (1.0 + 0.06 * scatter[1]), down

    def _counts(self, down: float) -> tuple[int, int]:
        """Columns and rows, with one beyond each border."""
        return (
            math.floor(self.width * self.mm_per_pixel / self.spacing_mm) + 3,
            math.floor(self.height * self.mm_per_pixel / down) + 3,
        )

    def _cover(self, rest: Tensor, left: Tensor | None) -> Tensor:
        """Share (h, w) of each place at rest (h, w, 2) that a dot covers."""
        places, half, down = self._pattern()
        columns, rows = self._counts(down)
        row = (rest[..., 1] / down + (rows - 1) / 2.0).round().clamp(0, rows - 1).long()
        odd = (row % 2).to(rest.dtype) * (0.5 if self.pattern == "hexagonal" else 0.0)
        column = (rest[..., 0] / self.spacing_mm - odd + (columns - 1) / 2.0).round().clamp(0, columns - 1).long()
        nearest = row * columns + column
        offset = (rest - places[nearest]) / half[nearest]
        r = offset.abs().amax(dim=-1) if self.shape == "square" else offset.norm(dim=-1)
        softness = EDGE_PX * self.mm_per_pixel / (0.5 * self.diameter_mm)
        cover = torch.sigmoid((1.0 - r) / softness)
        if self.shape == "ring":
            cover = cover * torch.sigmoid((r - 0.55) / softness)
        return cover if left is None else cover * left.to(cover.dtype)[nearest]
