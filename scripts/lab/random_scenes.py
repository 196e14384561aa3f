"""Random frames with exact truth: units, presses and noise are drawn at random, to test what confidence states."""

import math
import random
import warnings
from typing import NamedTuple

import torch
from torch import Tensor

from torchvts import scenes
from torchvts.calibration import CalibrationWarning, Press, by_presses, calibrate
from torchvts.model import Calibration, PointLights, Sensor

SHAPES = ("sphere", "cylinder", "cone", "sine", "punch", "letters")
"""Shapes that are pressed in."""

UNITS = ("lights known", "lights known, background", "lights fitted", "presses")
"""How the units are calibrated: the last by response fields from twelve balls."""


class RandomFrame(NamedTuple):
    """A frame of a random unit.

    Attributes:
        unit: one of :data:`UNITS`.
        shape: one of :data:`SHAPES`.
        calibration: the calibrated unit.
        mode: mode of the pipeline.
        scene: the truth.
        image: (1, 3, H, W), the frame.
    """

    unit: str
    shape: str
    calibration: Calibration
    mode: str
    scene: scenes.Scene
    image: Tensor


class _Camera(NamedTuple):
    """A random sensor under random lights."""

    sensor: Sensor
    lights: PointLights
    noise_std: float
    spots: Tensor | None

    def photograph(self, scene: scenes.Scene, seed: int) -> Tensor:
        return scenes.render(scene, self.lights, noise_std=self.noise_std, bits=8, spots=self.spots, seed=seed)


def random_frame(seed: int, unit: str | None = None, shape: str | None = None) -> RandomFrame:
    """A random sensor, its calibration and a frame: 8 bits, noise up to 1.5 %, random lights, size and shape.

    Args:
        seed: of everything.
        unit: one of :data:`UNITS`; None draws one of the first three.
        shape: one of :data:`SHAPES`; None draws one.
    Raises:
        ValueError: unknown unit or shape.
    Example:
        >>> frame = random_frame(1, "lights known", "sphere")
        >>> frame.image.shape[1], frame.mode in ("fast", "precise")
        (3, True)
    """
    draw = random.Random(seed)
    unit = draw.choice(UNITS[:3]) if unit is None else unit
    shape = draw.choice(SHAPES) if shape is None else shape
    if unit not in UNITS or shape not in SHAPES:
        raise ValueError(f"unit, shape: expected one of {UNITS} and one of {SHAPES}, got {unit!r} and {shape!r}")
    camera = _random_camera(draw, unit, seed)
    scene = _random_press(draw, shape, camera.sensor)
    background = camera.photograph(scenes.undeformed(scene), 10 * seed + 1)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        if unit == "presses":
            calibration = _by_random_balls(draw, camera, background, seed)
        elif unit == "lights fitted":
            calibration = calibrate(background, camera.sensor)
        else:
            calibration = Calibration.from_lights(camera.lights, camera.sensor, None if unit == UNITS[0] else background)
    mode = draw.choice(["fast", "precise", "precise"])
    return RandomFrame(unit, shape, calibration, mode, scene, camera.photograph(scene, 10 * seed))


def _random_camera(draw: random.Random, unit: str, seed: int) -> _Camera:
    width = draw.choice([160, 160, 320])
    height, wide_mm = width * 3 // 4, draw.uniform(15.0, 40.0)
    sensor = Sensor("random", height, width, wide_mm / width)
    lights = _random_lights(draw, wide_mm)
    by_balls = unit == "presses"
    noise = draw.choice([0.002, 0.004, 0.008] if by_balls else [0.0, 0.002, 0.004, 0.008, 0.015])
    spots = scenes.skin_spots(height, width, seed=seed) if draw.random() < 0.3 and unit != UNITS[0] and not by_balls else None
    return _Camera(sensor, lights, noise, spots)


def _random_lights(draw: random.Random, wide_mm: float) -> PointLights:
    radius, height = draw.uniform(0.45, 0.9) * wide_mm, draw.uniform(0.5, 1.2) * wide_mm
    first, level = draw.uniform(0.0, 120.0), draw.uniform(0.25, 0.55)
    rows = []
    for k in range(3):
        angle = math.radians(first + 120.0 * k + draw.uniform(-15.0, 15.0))
        rows.append([radius * math.cos(angle), radius * math.sin(angle), height * draw.uniform(0.9, 1.1)])
    position = torch.tensor(rows)
    return PointLights(position, level * position.norm(dim=1) ** 3 / position[:, 2]).requires_grad_(False)


def _random_press(draw: random.Random, shape: str, sensor: Sensor) -> scenes.Scene:
    size = (sensor.height, sensor.width, sensor.mm_per_pixel)
    wide, high = sensor.width * sensor.mm_per_pixel, sensor.height * sensor.mm_per_pixel
    if shape == "sphere":
        radius = draw.uniform(0.1, 0.4) * high
        at = (draw.uniform(-0.3, 0.3) * wide, draw.uniform(-0.3, 0.3) * high)
        return scenes.sphere_press(radius, draw.uniform(0.04, 0.25) * radius, at, *size)
    near = (draw.uniform(-0.1, 0.1) * wide, draw.uniform(-0.1, 0.1) * high)
    if shape == "cylinder":
        radius = draw.uniform(0.08, 0.2) * high
        press, length = draw.uniform(0.05, 0.25) * radius, draw.uniform(0.2, 0.6) * high
        return scenes.surface(scenes.cylinder_depth(radius, press, length, draw.uniform(0.0, 180.0), near), *size)
    if shape == "cone":
        angle = draw.uniform(60.0, 80.0)
        press = draw.uniform(0.12, 0.35) * high / math.tan(math.radians(angle))
        return scenes.surface(scenes.cone_depth(angle, press, draw.uniform(0.01, 0.05) * high, near), *size)
    if shape == "sine":
        period = draw.uniform(0.06, 0.2) * high
        return scenes.surface(scenes.sine_depth(draw.uniform(0.03, 0.1) * period, period, draw.uniform(0.2, 0.42) * high), *size)
    if shape == "punch":
        radius, press = draw.uniform(0.1, 0.3) * high, draw.uniform(0.01, 0.03) * high
        return scenes.surface(scenes.punch_depth(radius, press, draw.uniform(0.0, 4.0), draw.uniform(0.04, 0.1) * high), *size)
    press, letter = draw.uniform(0.008, 0.02) * high, draw.uniform(0.18, 0.3) * high
    stroke, bevel = draw.uniform(0.03, 0.05) * high, draw.uniform(0.02, 0.04) * high
    return scenes.surface(scenes.letters_depth(draw.choice(["VTS", "AB", "XO", "GEL"]), press, letter, stroke, bevel), *size)


def _by_random_balls(draw: random.Random, camera: _Camera, background: Tensor, seed: int) -> Calibration:
    """Calibration by response fields from twelve balls of two sizes, although point lights would be the better model."""
    sensor, presses = camera.sensor, []
    size = (sensor.height, sensor.width, sensor.mm_per_pixel)
    for k in range(12):
        radius = draw.choice([0.15, 0.25]) * sensor.height * sensor.mm_per_pixel
        x, y = (draw.uniform(-0.35, 0.35) * n * sensor.mm_per_pixel for n in (sensor.width, sensor.height))
        ball = scenes.sphere_press(radius, draw.uniform(0.06, 0.2) * radius, (x, y), *size)
        presses.append(Press(camera.photograph(ball, 100 * seed + k)[0], 2.0 * radius, f"ball {k}"))
    return by_presses(background, sensor, presses, None)[0]
