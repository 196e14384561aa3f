"""Speed and error of every method in one table: rows for a chart of one against the other."""

import json
import os
import platform
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial

import torch
from torch import Tensor

from .core.sensor import Sensor
from .metrics import depth_error, normal_angle_deg
from .pipeline import MODES, DepthPipeline
from .record import Calibration
from .scenes import Scene, render, sphere_press
from .shading import PointLights


@dataclass(frozen=True)
class Row:
    """One measurement; errors are those of the very frame that was timed."""

    method: str
    scene: str
    height: int
    width: int
    threads: int
    machine: str
    ms_median: float
    ms_iqr: float
    normal_deg: float | None
    rms_um: float | None
    largest_px: float | None
    command: str


def time_ms(call: Callable[[], object], repeats: int = 30) -> tuple[float, float]:
    """Median and interquartile range of the time of a call in ms, after five that warm up."""
    for _ in range(5):
        call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(1000.0 * (time.perf_counter() - start))
    low, middle, high = statistics.quantiles(times, n=4)
    return middle, high - low


def frame_memory_mb() -> float:
    """Growth of this process's peak memory by building a 640 x 480 pipeline and running one frame, MB; call it first."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    calibration, image, _ = _scene(480, 640, 1.0)
    pipe = DepthPipeline.from_calibration(calibration, "fast")
    with torch.inference_mode():
        pipe(image)
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0


def run(command: str, progress: Callable[[str], None]) -> list[Row]:
    """Time every mode at several sizes, and the stages of one frame at 640 x 480."""
    machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"
    rows = []
    for height, width in ((240, 320), (480, 640), (960, 1280)):
        for press_mm in (1.0, 2.0):
            calibration, image, scene = _scene(height, width, press_mm)
            for mode in MODES:
                progress(f"{mode} {height}x{width}")
                pipe = DepthPipeline.from_calibration(calibration, mode)
                with torch.inference_mode():
                    result = pipe(image)
                    median, iqr = time_ms(partial(pipe, image), 30 if height < 960 else 10)
                error = depth_error(result.depth_mm, scene.depth_mm, scene.mm_per_pixel)
                angle = float(normal_angle_deg(result.normal, scene.normal, scene.contact).mean())
                name = f"sphere R 10 mm, press {press_mm:g} mm, noise 0.003"
                rows.append(
                    Row(
                        mode,
                        name,
                        height,
                        width,
                        torch.get_num_threads(),
                        machine,
                        median,
                        iqr,
                        angle,
                        1000 * error.rms_mm,
                        error.max_px,
                        command,
                    )
                )
    calibration, image, _ = _scene(480, 640, 1.0)
    for stage, call in _stages(calibration, image).items():
        progress(stage)
        with torch.inference_mode():
            median, iqr = time_ms(call)
        rows.append(Row(f"stage: {stage}", "", 480, 640, torch.get_num_threads(), machine, median, iqr, None, None, None, command))
    return rows


def table(rows: list[Row]) -> str:
    """The rows as a Markdown table."""
    lines = ["| method | scene | size | ms, median (IQR) | normals deg | RMS um | largest px |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        errors = [f"{v:.3f}" if v is not None else "" for v in (row.normal_deg, row.rms_um, row.largest_px)]
        speed = f"{row.width}x{row.height} | {row.ms_median:.2f} ({row.ms_iqr:.2f})"
        lines.append(f"| {row.method} | {row.scene} | {speed} | {' | '.join(errors)} |")
    return "\n".join(lines)


def to_json(rows: list[Row]) -> str:
    """The rows as JSON, one object each."""
    return json.dumps([asdict(row) for row in rows], indent=1)


def _scene(height: int, width: int, press_mm: float) -> tuple[Calibration, Tensor, Scene]:
    pitch = 40.0 / width
    lights = PointLights([[24.6, 15.0, 34.0], [-25.4, 14.1, 33.0], [0.9, -29.1, 35.0]], [1000.0, 1000.0, 1000.0])
    scene = sphere_press(10.0, press_mm, height=height, width=width, mm_per_pixel=pitch)
    image = render(scene, lights, noise_std=0.003, bits=8).detach()
    return Calibration.from_lights(lights, Sensor("bench", height, width, pitch)), image, scene


def _stages(calibration: Calibration, image: Tensor) -> dict[str, Callable[[], object]]:
    pipe = DepthPipeline.from_calibration(calibration, "fast")
    with torch.inference_mode():
        compensated = pipe.compensate(image)
        contact = pipe.contact(compensated)
        normal = pipe.normals(compensated)
        gradient = pipe.gradient(normal) * contact
        depth = pipe.integrate(gradient)
    return {
        "compensate": lambda: pipe.compensate(image),
        "contact": lambda: pipe.contact(compensated),
        "normals, eq. 9": lambda: pipe.normals(compensated),
        "normals, eq. 10": lambda: pipe.normals(compensated, depth),
        "gradient": lambda: pipe.gradient(normal) * contact,
        "integrate": lambda: pipe.integrate(gradient),
    }
