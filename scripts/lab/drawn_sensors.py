"""Sensors drawn at random, with presses of balls to calibrate from and of other objects to score on, all with exact truth.

What is learned from balls must be scored on things that are no balls. The sensors hold what real ones have and no model of this
library describes: extended lights of mixed colours, stray light, vignetting, blur, JPEG, brightness that changes far from a
contact, a skin that is not quite Lambertian and that hangs free around a contact.
"""

import math
import random
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchvts.calibration import Press
from torchvts.core.blur import blur, gaussian_weights
from torchvts.core.checks import check_integer
from torchvts.core.geometry import pixel_grid_mm
from torchvts.model import Sensor
from torchvts.scenes import Scene, hanging_skin
from torchvts.scenes import objects as solids

from .faults import jpeg

SEEDS = tuple(range(8))
"""The sensors that evaluations draw."""

BALLS = 12
"""Balls of a sensor, to calibrate from."""

OBJECTS = ("hexagonal prism", "roof prism", "letters", "capsule", "key", "textured patch")
"""Objects of a sensor, to score on."""


class DrawnPress(NamedTuple):
    """One press on a drawn sensor.

    Attributes:
        name: of the object.
        image: (3, H, W) in [0, 1], R, G, B.
        scene: the truth: depth, gradient, normal and contact.
    """

    name: str
    image: Tensor
    scene: Scene


class _Optics(NamedTuple):
    """Lights and camera of a drawn sensor.

    Attributes:
        points_mm: (3, K, 3), K points of each of the three lights, in image axes and z.
        mix: (3, 3), how much of each light (column) each channel (row) sees; scales to image values.
        power: of the cosine of the incident light; 1 for a Lambertian skin.
        ambient: (3,), stray light that no contact changes.
        reflected: (3,), part of the light around a pixel that the skin gets again.
        far: (3, 6), relative change of brightness far from a contact per mm of its depth, quadratic in position.
        vignetting: relative loss of light in the corners.
        blur_px: standard deviation of the camera's blur.
        gamma: value = light^(1 / gamma).
        noise_std: of image values.
        quality: of JPEG.
    """

    points_mm: Tensor
    mix: Tensor
    power: float
    ambient: Tensor
    reflected: Tensor
    far: Tensor
    vignetting: float
    blur_px: float
    gamma: float
    noise_std: float
    quality: int


@dataclass(frozen=True, eq=False)
class DrawnSensor:
    """A sensor drawn at random. Images are rendered at first use and kept.

    Attributes:
        seed: of everything.
        sensor: size and pixel pitch, all that a calibration knows beside the images.
        optics: lights and camera.
        reach_mm: length over which the free skin comes back to zero, mm.
    """

    seed: int
    sensor: Sensor
    optics: _Optics
    reach_mm: float

    @cached_property
    def background(self) -> Tensor:
        """(3, H, W) in [0, 1], the image without contact."""
        depth = torch.zeros(1, 1, self.sensor.height, self.sensor.width)
        return self._images(hanging_skin(depth - 1.0, self.reach_mm, self.sensor.mm_per_pixel, 1), 1)[0]

    def press(self, height_mm: solids.Height, T_sensor_object: Tensor, name: str = "", seed: int = 0) -> DrawnPress:
        """Press an object.

        Args:
            height_mm: of the object, see :class:`torchvts.scenes.objects.Target`.
            T_sensor_object: its pose (4, 4), see :func:`torchvts.scenes.objects.pose`.
            name: kept with the press.
            seed: of the noise.
        Example:
            >>> from torchvts.scenes.objects import capsule, pose
            >>> pressed = drawn_sensor(0).press(capsule(), pose(press_mm=0.4), "capsule")
            >>> round(float(pressed.scene.depth_mm.max()), 2)
            0.4
        """
        sensor, pitch = self.sensor, self.sensor.mm_per_pixel
        with torch.inference_mode(False):  # slopes of objects are derivatives, also where a pipeline is being scored
            reached = solids.press(height_mm, T_sensor_object, sensor.height, sensor.width, pitch, fillet_mm=1e-4)
            scene = hanging_skin(torch.where(reached.contact, reached.depth_mm, -1.0), self.reach_mm, pitch)
            return DrawnPress(name, self._images(scene, seed)[0], scene)

    def ball(self, diameter_mm: float, depth_mm: float, at_mm: tuple[float, float], name: str = "", seed: int = 0) -> Press:
        """Press a ball; the press carries its exact label.

        Args:
            diameter_mm: of the ball.
            depth_mm: how far it is pressed in.
            at_mm: its center, x to the right and y down, mm.
            name: kept with the press.
            seed: of the noise.
        """
        pose = solids.pose(shift_mm=(at_mm[0], -at_mm[1]), press_mm=depth_mm)
        pressed = self.press(solids.sphere(0.5 * diameter_mm), pose, name, seed)
        sensor = self.sensor
        pitch = sensor.mm_per_pixel
        center_px = ((sensor.width - 1) / 2 + at_mm[0] / pitch, (sensor.height - 1) / 2 + at_mm[1] / pitch)
        radius_px = math.sqrt(float(pressed.scene.contact.sum()) / math.pi)
        return Press(pressed.image, diameter_mm, name, center_px, radius_px)

    @cached_property
    def balls(self) -> tuple[Press, ...]:
        """:data:`BALLS` presses of balls of two sizes, at places and depths drawn at random, with their exact labels."""
        draw = random.Random(1000 + self.seed)
        wide, high = (n * self.sensor.mm_per_pixel for n in (self.sensor.width, self.sensor.height))
        presses = []
        for k in range(BALLS):
            diameter = (0.28, 0.42)[k % 2] * min(wide, high)
            at = (draw.uniform(-0.3, 0.3) * wide, draw.uniform(-0.3, 0.3) * high)
            presses.append(self.ball(diameter, draw.uniform(0.08, 0.2) * diameter, at, f"ball {k}", 100 + k))
        return tuple(presses)

    @cached_property
    def objects(self) -> tuple[DrawnPress, ...]:
        """A press of each of :data:`OBJECTS`, in a pose drawn at random."""
        draw = random.Random(2000 + self.seed)
        wide, high = (n * self.sensor.mm_per_pixel for n in (self.sensor.width, self.sensor.height))
        presses = []
        for k, (name, shape) in enumerate(_shapes(min(wide, high), draw).items()):
            shift = (draw.uniform(-0.1, 0.1) * wide, draw.uniform(-0.1, 0.1) * high)
            pose = solids.pose(draw.uniform(0.0, 360.0), shift, draw.uniform(0.03, 0.055) * min(wide, high))
            presses.append(self.press(shape, pose, name, 200 + k))
        return tuple(presses)

    def _images(self, scene: Scene, seed: int) -> Tensor:
        """(1, 3, H, W) in [0, 1]: the camera image of a scene."""
        optics = self.optics
        direct = _direct(scene, optics)
        around = blur(direct, gaussian_weights(0.12 * self.sensor.width))
        light = direct + optics.reflected[:, None, None] * around + optics.ambient[:, None, None]
        x, y = pixel_grid_mm(self.sensor.height, self.sensor.width, 1.0)
        u, v = 2.0 * x / self.sensor.width, 2.0 * y / self.sensor.height
        basis = torch.stack([t.expand(self.sensor.height, self.sensor.width) for t in (u**0, u, v, u * u, u * v, v * v)])
        light = light * (1.0 + scene.depth_mm.max() * torch.tensordot(optics.far, basis, 1))
        light = light * (1.0 - optics.vignetting * 0.5 * (u * u + v * v))
        value = blur(light, gaussian_weights(optics.blur_px)).clamp(0.0, 1.0) ** (1.0 / optics.gamma)
        generator = torch.Generator().manual_seed(1000 * self.seed + seed)
        value = (value + optics.noise_std * torch.randn(value.shape, generator=generator)).clamp(0.0, 1.0)
        return jpeg(value, optics.quality)


@cache
def drawn_sensor(seed: int) -> DrawnSensor:
    """The sensor of a seed, 320 x 240 or 240 x 320 pixels.

    Args:
        seed: at least 0.
    Example:
        >>> unit = drawn_sensor(1)
        >>> unit.background.shape == (3, unit.sensor.height, unit.sensor.width), len(unit.objects)
        (True, 6)
    """
    check_integer("seed", seed, 0)
    draw = random.Random(seed)
    height, width = draw.choice([(240, 320), (320, 240)])
    long_mm = draw.uniform(15.0, 21.0)
    sensor = Sensor(f"drawn {seed}", height, width, long_mm / 320)
    return DrawnSensor(seed, sensor, _optics(draw, sensor), draw.uniform(0.03, 0.06) * 0.75 * long_mm)


def _optics(draw: random.Random, sensor: Sensor) -> _Optics:
    """Random optics whose background has its brightest values at about 0.7."""
    half = 0.5 * max(sensor.height, sensor.width) * sensor.mm_per_pixel
    gamma = draw.choice([1.0, 1.0, 1.8])
    first, mixed = draw.uniform(0.0, 360.0), draw.uniform(0.0, 0.2)
    lines = torch.stack([_line(draw, half, math.radians(first + 120.0 * k + draw.uniform(-20.0, 20.0))) for k in range(3)])
    mix = torch.eye(3) + mixed * (torch.ones(3, 3) - torch.eye(3))
    far = torch.tensor([[draw.uniform(-0.05, 0.05) for _ in range(6)] for _ in range(3)])
    optics = _Optics(
        points_mm=lines,
        mix=mix,
        power=draw.uniform(0.85, 1.2),
        ambient=torch.zeros(3),
        reflected=torch.tensor([draw.uniform(0.05, 0.3) for _ in range(3)]),
        far=far,
        vignetting=draw.uniform(0.1, 0.4),
        blur_px=draw.uniform(0.5, 1.2),
        gamma=gamma,
        noise_std=draw.uniform(0.002, 0.006),
        quality=draw.choice([90, 93, 95]),
    )
    flat = hanging_skin(torch.full((1, 1, sensor.height, sensor.width), -1.0), 1.0, sensor.mm_per_pixel, 1)
    light = _direct(flat, optics)[0]
    mean, top = light.mean(dim=(1, 2)), light.amax(dim=(1, 2))
    stray = torch.tensor([draw.uniform(0.02, 0.2) for _ in range(3)]) * mean
    scale = draw.uniform(0.6, 0.75) ** gamma / (top + stray + optics.reflected * mean)
    return optics._replace(mix=mix * scale[:, None], ambient=stray * scale)


def _line(draw: random.Random, half_mm: float, angle: float) -> Tensor:
    """(5, 3): points of a light, a line across the direction in which it stands."""
    away, high, long = draw.uniform(1.1, 1.6) * half_mm, draw.uniform(0.7, 1.4) * half_mm, draw.uniform(0.1, 0.8) * half_mm
    along = torch.linspace(-long, long, 5)
    x = away * math.cos(angle) - along * math.sin(angle)
    y = away * math.sin(angle) + along * math.cos(angle)
    return torch.stack((x, y, torch.full_like(x, high)), 1)


def _direct(scene: Scene, optics: _Optics) -> Tensor:
    """(1, 3, H, W): light that comes straight from the lights, linear."""
    height, width = scene.depth_mm.shape[2:]
    x, y = pixel_grid_mm(height, width, scene.mm_per_pixel)
    lights = []
    for points in optics.points_mm:
        total = torch.zeros(1, height, width)
        for px, py, pz in points.tolist():
            dx, dy, dz = px - x, py - y, pz - scene.depth_mm[:, 0]
            squared = dx * dx + dy * dy + dz * dz
            cosine = (scene.normal[:, 0] * dx + scene.normal[:, 1] * dy + scene.normal[:, 2] * dz) / squared.sqrt()
            total = total + cosine.clamp_min(0.0) ** optics.power / squared
        lights.append(total)
    return torch.einsum("cl,blhw->bchw", optics.mix, torch.stack(lights, 1))


def _shapes(short_mm: float, draw: random.Random) -> dict[str, solids.Height]:
    """The objects, about half as large as the short side of the image."""
    text = draw.choice(["VTS", "GEL", "XO", "AB"])
    shapes = (
        solids.bolt_head(0.45 * short_mm),
        solids.prism(draw.uniform(0.2, 0.45), 0.3 * short_mm),
        solids.stamp(text, (0.9 if len(text) == 2 else 0.75) * short_mm / len(text)),
        solids.capsule(draw.uniform(0.08, 0.16) * short_mm, 0.35 * short_mm),
        solids.key(),
        solids.textured_patch(40, 0.3 * short_mm, draw.randrange(1000)),
    )
    return dict(zip(OBJECTS, shapes, strict=True))
