"""Measure how many frames a second this machine makes: a drawn sensor, by size, mode and batch; print the table.

In a tight loop one frame follows the other; every 20 ms, as behind a camera, caches have gone cold and a frame takes longer.

example:
  torchvts bench --threads 2
"""

import argparse
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..compiled import library
from ..core.checks import check_integer
from ..core.tables import markdown
from ..model import Calibration, PointLights, Sensor
from ..pipeline import DepthPipeline
from ..scenes import Scene, render, sphere_press

USAGE = "[--threads N] [--calls N]"

SIZES = ((120, 160), (240, 320), (480, 640), (960, 1280))
"""Rows and columns of the frames."""

MODES = ("fast", "precise")
BATCH, BATCHED = 16, SIZES[1]
"""Frames in one call in the row of a batch, and their size."""

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), metavar="N", help="all cores if not given")
    parser.add_argument("--calls", type=int, default=100, metavar="N", help="frames that are timed of each row (100)")


def run(arguments: argparse.Namespace) -> int:
    """Measure, and print the table."""
    calls = check_integer("--calls", arguments.calls, 1)
    torch.set_num_threads(check_integer("--threads", arguments.threads, 1))
    lines = []
    with tqdm(measure(calls), total=len(MODES) * len(SIZES) + 1, unit="row", leave=False, disable=None) as rows:
        for line in rows:
            lines.append(line)
            if not sys.stderr.isatty():
                print(f"measured: {line[0]}, {line[1]}", file=sys.stderr)
    print(markdown(["size", "mode", "tight loop: ms, median, 90 %", "frames/s", "every 20 ms: ms, median, 90 %"], lines))
    print(f"\na drawn sensor of three lights, from an image to a DepthOutput\n{machine()}")
    return 0


def measure(calls: int) -> Iterator[list[str]]:
    """A line of the table for each size and mode, and for a batch; of large frames a quarter of the calls."""
    for height, width in SIZES:
        unit = rig(height, width)
        for mode in MODES:
            frame = partial(DepthPipeline.from_calibration(unit.calibration, mode).freeze(), unit.image)
            rounds = max(1, calls // (4 if height > 480 else 1))
            tight = in_turn([frame], rounds)[0]
            behind = in_turn([partial(time.sleep, CAMERA_S), frame], rounds)[1]
            yield [f"{width}x{height}", mode, _cell(tight), f"{1000.0 / statistics.median(tight):.0f}", _cell(behind)]
        if (height, width) == BATCHED:
            batch = partial(DepthPipeline.from_calibration(unit.calibration).freeze(), unit.image.repeat(BATCH, 1, 1, 1))
            times = [value / BATCH for value in in_turn([batch], max(1, calls // BATCH))[0]]
            yield [f"{width}x{height}, batch {BATCH}", "fast", _cell(times), f"{1000.0 / statistics.median(times):.0f}", ""]


def _cell(times: list[float]) -> str:
    return f"{statistics.median(times):.2f}, {sorted(times)[int(0.9 * len(times))]:.2f}"
