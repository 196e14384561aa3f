"""What is timed, and how: a drawn unit, calls in turn, the machine in words."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchvts import Calibration, PointLights, Sensor
from torchvts.compiled import library
from torchvts.scenes import Scene, render, sphere_press

SIZES = ((120, 160), (240, 320), (480, 640), (960, 1280))
"""Rows and columns of the frames."""

CAMERA_S = 0.02
"""Between two frames of a camera of 50 frames a second."""

WARM_UP = 3
"""Calls that come before those that count."""


class Rig(NamedTuple):
    """A drawn unit: the calibration of its three known lights, an exact press of a ball, and its image (1, 3, H, W)."""

    calibration: Calibration
    scene: Scene
    image: Tensor


def rig(height: int, width: int) -> Rig:
    """The drawn unit: a ball of 10 mm radius pressed 1 mm into a field 40 mm wide, noise of 0.003 and 8 bits.

    Args:
        height: rows of the image.
        width: columns of the image.
    """
    pitch = 40.0 / width
    lights = PointLights([[24.6, 15.0, 34.0], [-25.4, 14.1, 33.0], [0.9, -29.1, 35.0]], [1000.0, 1000.0, 1000.0])
    scene = sphere_press(10.0, 1.0, height=height, width=width, mm_per_pixel=pitch)
    image = render(scene, lights, noise_std=0.003, bits=8).detach()
    return Rig(Calibration.from_lights(lights, Sensor("bench", height, width, pitch)), scene, image)


def in_turn(calls: Sequence[Callable[[], object]], rounds: int) -> list[list[float]]:
    """Time of several calls, one after the other in turn, so that each finds the caches as the one before left them.

    Args:
        calls: one alone is a tight loop; after a sleep it is a frame behind a camera.
        rounds: times that count of each call, after :data:`WARM_UP`.
    Returns:
        Times of each call, ms.
    Example:
        >>> [len(times) for times in in_turn([lambda: None, lambda: None], 4)]
        [4, 4]
    """
    found: list[list[float]] = [[] for _ in calls]
    with torch.inference_mode():
        for _ in range(rounds + WARM_UP):
            for call, times in zip(calls, found, strict=True):
                start = time.perf_counter()
                call()
                times.append(1000.0 * (time.perf_counter() - start))
    return [times[WARM_UP:] for times in found]


def machine() -> str:
    """Processor, cores, threads and torch in words, and whether the compiled kernels are there."""
    kernels = "compiled kernels" if library() is not None else "NO COMPILED KERNELS: PyTorch alone, 2 to 7 times as slow"
    allowed = f"{os.cpu_count()} cores, {torch.get_num_threads()} threads allowed"
    return f"{platform.machine()}, {allowed}, torch {torch.__version__}, {kernels}"
