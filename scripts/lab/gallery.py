"""Hard scenes with exact truth: one corruption each, in steps of severity. docs/where_methods_fail.md says what happens in each.

The rig is small and quick: 160 x 120 pixels of 0.125 mm, three lights 40 mm away, 50 degrees above the skin and 120 degrees apart,
noise of 0.002 and 8 bits. Its calibration has the true lights and one background image, so a method fails only because of
the corruption. Unless the corruption changes the shape, a ball of radius 6 mm is pressed in by 1 mm, near the middle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchvts.core.geometry import pixel_grid_mm
from torchvts.model.calibration import Calibration
from torchvts.model.lights import PointLights
from torchvts.model.sensor import Sensor
from torchvts.scenes import Scene, skin_spots, smooth_step, surface, surface_at, undeformed

from .faults import Conditions, photograph, ring_lights

HEIGHT, WIDTH, MM_PER_PIXEL = 120, 160, 0.125
RADIUS_MM, PRESS_MM = 6.0, 1.0
LIGHT_DISTANCE_MM, ELEVATION_DEG, SPACING_DEG = 40.0, 50.0, 120.0

Relief = Callable[[Tensor, Tensor], Tensor]
"""Depth in mm as a function of x and y in mm; negative where there is no contact."""


class Case(NamedTuple):
    """One hard scene.

    Attributes:
        calibration: calibration that the user has.
        background: (3, H, W), the image that it was made from.
        image: (1, 3, H, W), the frame to reconstruct.
        truth: what each pixel of the frame sees; its contact is where the object touches the skin.
    """

    calibration: Calibration
    background: Tensor
    image: Tensor
    truth: Scene


@dataclass(frozen=True)
class Corruption:
    """One way to make a scene harder.

    Attributes:
        name: key in :data:`CORRUPTIONS`.
        unit: unit of the severity.
        severities: rising or falling; no method fails at the first, most fail at the last.
        make: makes a case from a severity, which may lie between those, and a seed of noise and place.
    """

    name: str
    unit: str
    severities: tuple[float, ...]
    make: Callable[[float, int], Case]


def rig_lights(elevation_deg: float = ELEVATION_DEG, spacing_deg: float = SPACING_DEG) -> PointLights:
    """Lights that give a flat skin the value 0.45, or less if they stand lower: then slopes that face them are brighter."""
    elevation = math.radians(elevation_deg)
    level = 0.45 * min(1.0, math.sin(elevation) / math.sin(math.radians(ELEVATION_DEG)))
    out, up = LIGHT_DISTANCE_MM * math.cos(elevation), LIGHT_DISTANCE_MM * math.sin(elevation)
    return ring_lights(out, up, level=level, spacing_deg=spacing_deg)


LIGHTS = rig_lights()
USUAL = Conditions(LIGHTS, noise_std=0.002, bits=8)
SENSOR = Sensor("gallery", HEIGHT, WIDTH, MM_PER_PIXEL, gamma=1.0)


def undisturbed(seed: int = 0) -> Case:
    """The case without corruption.

    Example:
        >>> case = undisturbed()
        >>> case.image.shape, round(float(case.truth.depth_mm.max()), 2)
        (torch.Size([1, 3, 120, 160]), 1.0)
    """
    return _case(_scene(_press(seed)), seed)


# shapes


def ball(radius_mm: float, press_mm: float, x_mm: float, y_mm: float) -> Relief:
    """A ball; beyond its equator the height stays constant."""
    return lambda x, y: torch.sqrt((radius_mm**2 - (x - x_mm) ** 2 - (y - y_mm) ** 2).clamp_min(1e-12)) - (radius_mm - press_mm)


def stamp(radius_mm: float, press_mm: float, slope: float, x_mm: float, y_mm: float) -> Relief:
    """A flat round stamp with a smooth flank: at half height its radius is ``radius_mm``, and its largest slope is ``slope``."""
    width = 1.875 * press_mm / slope

    def depth(x: Tensor, y: Tensor) -> Tensor:
        r = torch.sqrt((x - x_mm) ** 2 + (y - y_mm) ** 2 + 1e-18)
        return press_mm * (1.0 - smooth_step((r - radius_mm) / width + 0.5))

    return depth


def roof(press_mm: float, slope: float, end_slope: float, length_mm: float, x_mm: float, y_mm: float) -> Relief:
    """Two planes that meet in a ridge along x, turned by 20 degrees; the slope of its ends is ``end_slope``."""
    c, s = math.cos(math.radians(20.0)), math.sin(math.radians(20.0))

    def depth(x: Tensor, y: Tensor) -> Tensor:
        along, across = c * (x - x_mm) + s * (y - y_mm), c * (y - y_mm) - s * (x - x_mm)
        return torch.minimum(press_mm - slope * across.abs(), end_slope * (0.5 * length_mm - along.abs()))

    return depth


def _place(seed: int) -> tuple[float, float]:
    x, y = (1.6 * torch.rand(2, generator=torch.Generator().manual_seed(1000 + seed)) - 0.8).tolist()
    return x, y


def _press(seed: int, press_mm: float = PRESS_MM, radius_mm: float = RADIUS_MM) -> Relief:
    return ball(radius_mm, press_mm, *_place(seed))


def _scene(relief: Relief, mm_per_pixel: float = MM_PER_PIXEL) -> Scene:
    return surface(relief, HEIGHT, WIDTH, mm_per_pixel)


# cases


def _case(
    scene: Scene, seed: int, at_calibration: Conditions = USUAL, now: Conditions | None = None,
    lights: PointLights = LIGHTS, sensor: Sensor = SENSOR,
) -> Case:  # fmt: skip
    """Photograph the background ``at_calibration`` and the frame ``now``; the user knows ``lights`` and ``sensor``."""
    background = photograph(undeformed(scene), at_calibration, 2 * seed)[0]
    image = photograph(scene, now or at_calibration, 2 * seed + 1)
    return Case(Calibration.from_lights(lights, sensor, background), background, image, scene)


def _always(conditions: Callable[[float], Conditions]) -> Callable[[float, int], Case]:
    """A fault that is present at calibration too, and that the calibration does not model."""
    return lambda severity, seed: _case(_scene(_press(seed)), seed, conditions(severity))


def _since(change: Callable[[float, int], Conditions]) -> Callable[[float, int], Case]:
    """A fault that appears after calibration."""
    return lambda severity, seed: _case(_scene(_press(seed)), seed, USUAL, change(severity, seed))


def _shaped(relief: Callable[[float, int], Relief]) -> Callable[[float, int], Case]:
    """Another shape."""
    return lambda severity, seed: _case(_scene(relief(severity, seed)), seed)


def _lit(lights_at: Callable[[float], PointLights], shadows: bool = False) -> Callable[[float, int], Case]:
    """Other lights, which the user knows."""

    def make(severity: float, seed: int) -> Case:
        lights = lights_at(severity)
        return _case(_scene(_press(seed)), seed, replace(USUAL, lights=lights, shadows=shadows), lights=lights)

    return make


def _lowered(severity: float) -> PointLights:
    return rig_lights(ELEVATION_DEG - severity)


def _specks(severity: float, seed: int) -> Conditions:
    factor = skin_spots(HEIGHT, WIDTH, round(severity), round(severity), seed)
    dead = factor == 0.0
    return replace(USUAL, albedo=torch.where(dead, 1.0, factor), dead=dead)


def _worn(severity: float, seed: int) -> Conditions:
    """Smooth stains, darker by up to twice ``severity``: three quarters in all channels alike, one quarter in each alone."""
    generator = torch.Generator().manual_seed(2000 + seed)
    x, y = pixel_grid_mm(HEIGHT, WIDTH, MM_PER_PIXEL)
    patterns = []
    for _ in range(4):  # of unit amplitude and periods of 5 to 20 mm
        pattern = torch.zeros(HEIGHT, WIDTH)
        for draw in torch.rand(6, 3, generator=generator):
            wave, angle = 2.0 * math.pi / (5.0 + 15.0 * float(draw[0])), 2.0 * math.pi * float(draw[1])
            pattern += torch.sin(wave * (x * math.cos(angle) + y * math.sin(angle)) + 2.0 * math.pi * float(draw[2]))
        patterns.append(pattern / pattern.abs().max())
    stain = 0.75 * patterns[3] + 0.25 * torch.stack(patterns[:3])
    return replace(USUAL, albedo=(1.0 - severity * (1.0 + stain)).clamp_min(0.0)[None])


def _dimmed(severity: float, seed: int) -> Conditions:
    return replace(USUAL, light_level=tuple(1.0 - severity if k == seed % 3 else 1.0 for k in range(3)))


def _lost(severity: float, seed: int) -> Conditions:
    level = [min(1.0, max(0.0, 1.0 - severity + k)) for k in range(3)]
    return replace(USUAL, light_level=tuple(level[(k + seed) % 3] for k in range(3)))


def _moved(severity: float, seed: int) -> Conditions:
    position = LIGHTS.position_mm.clone()
    angle = math.radians(10.0 + SPACING_DEG * (seed % 3) + 90.0)  # sideways, around the middle
    position[seed % 3] += severity * torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    return replace(USUAL, lights=PointLights(position, LIGHTS.albedo))


def _distorted(severity: float, seed: int) -> Case:
    """Pixels see the skin at r (1 - k (r / R)^2), R reaching the corner: barrel distortion, with and without contact."""
    x, y = _grid()
    factor = 1.0 - severity * (x**2 + y**2) / float(x.max() ** 2 + y.max() ** 2)
    at_mm = (x * factor, y * factor)
    scene = surface_at(_press(seed), *at_mm, MM_PER_PIXEL)
    background = photograph(undeformed(scene), USUAL, 2 * seed, at_mm)[0]
    image = photograph(scene, USUAL, 2 * seed + 1, at_mm)
    return Case(Calibration.from_lights(LIGHTS, SENSOR, background), background, image, scene)


def _perspective(severity: float, seed: int) -> Case:
    """A pinhole above the middle that sees the undeformed skin as an even grid; severity is half its horizontal angle of view.

    The report of the calibration contains its height.
    """
    if severity == 0.0:
        return undisturbed(seed)
    height_mm = 0.5 * WIDTH * MM_PER_PIXEL / math.tan(math.radians(severity))
    scene = surface(_press(seed), HEIGHT, WIDTH, MM_PER_PIXEL, camera_height_mm=height_mm)
    case = _case(scene, seed)
    report = case.calibration.report | {"camera_height_mm": height_mm}
    return case._replace(calibration=replace(case.calibration, report=report))


def _grid() -> tuple[Tensor, Tensor]:
    x, y = pixel_grid_mm(HEIGHT, WIDTH, MM_PER_PIXEL, torch.float64)
    return x.expand(HEIGHT, WIDTH), y.expand(HEIGHT, WIDTH)


def _marked(severity: float, seed: int) -> Case:
    """Dots every 2.5 mm that keep 30 % of the light; under the ball they move outward by up to 0.25 mm."""
    scene = _scene(_press(seed))
    center_x, center_y = _place(seed)
    x, y = _grid()
    away_x, away_y = x - center_x, y - center_y
    pull = 0.25 * torch.exp(-(away_x**2 + away_y**2) / 18.0) / 3.0  # mm per mm from the ball's middle
    undeformed_dots, pressed_dots = (
        _dots(x - moved * pull * away_x, y - moved * pull * away_y, severity) if severity else None for moved in (0.0, 1.0)
    )
    sensor = replace(SENSOR, markers=True)
    return _case(scene, seed, replace(USUAL, albedo=undeformed_dots), replace(USUAL, albedo=pressed_dots), sensor=sensor)


def _dots(x: Tensor, y: Tensor, diameter_mm: float) -> Tensor:
    away = torch.sqrt((torch.remainder(x, 2.5) - 1.25) ** 2 + (torch.remainder(y, 2.5) - 1.25) ** 2)
    cover = ((0.5 * diameter_mm - away) / MM_PER_PIXEL + 0.5).clamp(0.0, 1.0)  # a rim one pixel wide
    return (1.0 - 0.7 * cover)[None, None]


def _two(severity: float, seed: int) -> Relief:
    x, y = _place(seed)
    half_distance = 0.5 * (2.0 * math.sqrt(4.0**2 - 3.4**2) - severity)  # rims of balls of 4 mm, 0.6 mm deep
    one, other = (ball(4.0, 0.6, x + side * half_distance, y + side * 0.3) for side in (-1.0, 1.0))
    return lambda x, y: torch.maximum(one(x, y), other(x, y))


def _faint(severity: float, seed: int) -> Relief:
    return _press(seed, severity) if severity else lambda x, y: 0.0 * x * y - 1.0


def _sagging(severity: float, seed: int) -> Case:
    """Where the skin leaves the ball, depth falls off as exp(-r / severity), without a kink."""
    x_mm, y_mm = _place(seed)
    cap = ball(RADIUS_MM, PRESS_MM, 0.0, 0.0)
    low, high = 0.0, math.sqrt(RADIUS_MM**2 - (RADIUS_MM - PRESS_MM) ** 2)
    for _ in range(60):  # depth = slope * severity where the skin leaves the ball
        leaves = 0.5 * (low + high)
        depth = math.sqrt(RADIUS_MM**2 - leaves**2) - (RADIUS_MM - PRESS_MM)
        falls_short = depth < severity * leaves / math.sqrt(RADIUS_MM**2 - leaves**2)
        low, high = (low, leaves) if falls_short else (leaves, high)
    if severity == 0.0:
        return undisturbed(seed)

    def relief(x: Tensor, y: Tensor) -> Tensor:
        r = torch.sqrt((x - x_mm) ** 2 + (y - y_mm) ** 2 + 1e-18)
        transition = depth * torch.exp(-(r - leaves) / severity)
        return torch.where(r < leaves, cap(r.clamp_max(leaves), torch.zeros_like(r)), transition)

    scene = _scene(relief)
    x, y = _grid()
    touched = ((x - x_mm) ** 2 + (y - y_mm) ** 2 < leaves**2)[None, None]
    return _case(scene._replace(contact=touched), seed)


# fmt: off
CORRUPTIONS: dict[str, Corruption] = {
    corruption.name: corruption
    for corruption in (
        # shape
        Corruption("deeper press", "mm", (1.0, 1.5, 2.0, 3.0, 4.0, 5.0), _shaped(lambda s, seed: _press(seed, s))),
        Corruption("steep walls", "mm/mm", (0.5, 1.0, 2.0, 4.0, 8.0, 30.0),
            _shaped(lambda s, seed: stamp(3.5, PRESS_MM, s, *_place(seed)))),
        Corruption("cut ends", "mm/mm", (0.4, 0.8, 1.5, 3.0, 8.0, 100.0),
            _shaped(lambda s, seed: roof(PRESS_MM, 0.4, s, 9.0, *_place(seed)))),
        Corruption("cut by the border", "mm", (0.0, 5.0, 7.0, 8.0, 9.0, 10.0, 11.5),
            _shaped(lambda s, seed: ball(RADIUS_MM, PRESS_MM, s, _place(seed)[1]))),
        Corruption("covers the image", "mm", (0.1, 0.3, 0.6, 1.0, 1.5, 2.2), _shaped(lambda s, seed: _press(seed, s, 40.0))),
        Corruption("two contacts", "mm", (-2.0, -0.5, 0.0, 0.5, 1.5, 3.0), _shaped(_two)),
        Corruption("faint contact", "mm", (1.0, 0.3, 0.1, 0.05, 0.02, 0.01, 0.0), _shaped(_faint)),
        Corruption("gel sag", "mm", (0.0, 0.25, 0.5, 1.0, 2.0, 4.0), _sagging),
        # light
        Corruption("attached shadows", "deg", (0.0, 10.0, 20.0, 30.0, 35.0, 40.0, 45.0), _lit(_lowered)),
        Corruption("cast shadows", "deg", (0.0, 10.0, 20.0, 30.0, 35.0, 40.0, 45.0), _lit(_lowered, shadows=True)),
        Corruption("specular", "", (0.0, 0.05, 0.1, 0.2, 0.5, 1.0), _always(lambda s: replace(USUAL, specular=s))),
        Corruption("inter-reflection", "share", (0.0, 0.05, 0.1, 0.2, 0.4, 0.7), _always(lambda s: replace(USUAL, bounce=s))),
        Corruption("ambient light", "share", (0.0, 0.02, 0.05, 0.1, 0.2, 0.5), _always(lambda s: replace(USUAL, ambient=s))),
        Corruption("a channel dims", "share", (0.0, 0.01, 0.02, 0.05, 0.1, 0.2), _since(_dimmed)),
        Corruption("dead lights", "lights", (0.0, 0.3, 0.6, 1.0, 1.5, 2.0), _since(_lost)),
        Corruption("a light moves", "mm", (0.0, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0), _since(_moved)),
        Corruption("lights close together", "deg", (0.0, 40.0, 80.0, 100.0, 110.0, 116.0),
            _lit(lambda s: rig_lights(spacing_deg=SPACING_DEG - s))),
        # skin
        Corruption("albedo drift", "share", (0.0, 0.01, 0.02, 0.05, 0.1, 0.3), _since(_worn)),
        Corruption("spots and dead pixels", "of each", (0.0, 10.0, 30.0, 100.0, 300.0, 1000.0), _since(_specks)),
        Corruption("markers", "mm", (0.0, 0.4, 0.7, 1.0, 1.4, 1.8), _marked),
        # lens
        Corruption("defocus", "px", (0.0, 0.7, 1.5, 3.0, 6.0, 12.0), _always(lambda s: replace(USUAL, blur_px=s))),
        Corruption("motion blur", "px", (0.0, 2.0, 5.0, 10.0, 20.0, 40.0), _since(lambda s, seed: replace(USUAL, motion_px=s))),
        Corruption("vignetting", "share", (0.0, 0.1, 0.3, 0.5, 0.7, 0.9), _always(lambda s: replace(USUAL, vignetting=s))),
        Corruption("lens distortion", "share", (0.0, 0.05, 0.1, 0.2, 0.35, 0.5), _distorted),
        Corruption("perspective", "deg", (0.0, 5.0, 10.0, 20.0, 30.0, 45.0), _perspective),
        Corruption("wrong pitch", "share", (0.0, 0.01, 0.02, 0.05, 0.1, 0.2),
            lambda s, seed: _case(_scene(_press(seed), MM_PER_PIXEL * (1.0 + s)), seed)),
        # sensor
        Corruption("saturation", "times", (1.0, 1.3, 1.6, 2.0, 2.5, 3.0),
            _lit(lambda s: PointLights(LIGHTS.position_mm, LIGHTS.albedo * s))),
        Corruption("black crush", "value", (0.0, 0.02, 0.05, 0.1, 0.2, 0.4), _always(lambda s: replace(USUAL, black=s))),
        Corruption("wrong gamma", "exponent", (1.0, 1.05, 1.1, 1.2, 1.4, 1.8, 2.2), _always(lambda s: replace(USUAL, gamma=s))),
        Corruption("channel order", "share", (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0), _always(lambda s: replace(USUAL, crosstalk=s))),
        Corruption("noise", "value", (0.002, 0.005, 0.01, 0.02, 0.05, 0.1), _always(lambda s: replace(USUAL, noise_std=s))),
        Corruption("few bits", "bits", (12.0, 8.0, 6.0, 5.0, 4.0, 3.0, 2.0), _always(lambda s: replace(USUAL, bits=round(s)))),
        Corruption("JPEG", "quality", (100.0, 95.0, 85.0, 70.0, 50.0, 30.0, 10.0),
            _always(lambda s: replace(USUAL, jpeg_quality=round(s)))),
    )
}
# fmt: on
"""Every corruption by name."""
