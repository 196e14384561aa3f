"""Speed and error of every method in the same run: on exact scenes, and on a real sensor."""

import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import Press, read_presses
from ..model import Calibration, PointLights, Sensor
from ..normals import NormalFromMLP
from ..pipeline import MODES, DepthOutput
from ..scenes import Scene, render, sphere_press
from . import rows as records
from .methods import METHODS, Built, Reconstruct, lookup_table, point_lights, shipped_prior
from .metrics import depth_error, normal_angle_deg
from .peers import GsSdkPipeline, peer_frame
from .presses import Training
from .rows import Column, Row, Size, Time, error_column, mean, number
from .score import score_press

SIZES = ((120, 160), (240, 320), (480, 640), (960, 1280))
GS_SDK = "gs_sdk's pipeline"

TIMED = (
    "fast", "precise", "auto", "fast, zero border", "fast, SciPy's DCT", "fast, PyTorch reference", "flat", "look-up table",
)  # fmt: skip
"""Methods that are timed on exact scenes."""

Errors = Mapping[str, float | None]


def time_ms(call: Callable[[], object]) -> tuple[float, float]:
    """Median and interquartile range of the time of a call, ms: 40 times or for two seconds, after five to warm up."""
    for _ in range(5):
        call()
    times: list[float] = []
    start = time.perf_counter()
    while len(times) < 5 or (len(times) < 40 and time.perf_counter() - start < 2.0):
        before = time.perf_counter()
        call()
        times.append(1000.0 * (time.perf_counter() - before))
    low, middle, high = statistics.quantiles(times, n=4)
    return middle, high - low


def memory_mb(call: Callable[[], object]) -> float:
    """Largest memory of tensors that a call holds at any moment, MB, by the record of the allocator."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
            call()
    held = most = 0
    for event in profile.profiler.kineto_results.events():
        if event.name() == "[memory]":
            held += event.nbytes()
            most = max(most, held)
    return most / 1e6


class Bench:
    """Times calls; every row has the machine, the threads and the command. ``progress`` gets the name of what is measured next."""

    def __init__(self, command: str, progress: Callable[[str], None]) -> None:
        self.command, self.progress = command, progress
        self.machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"

    def timed(self, row: Row, call: Callable[[], object]) -> Row:
        """The row with time and memory of a call that computes one frame of its size."""
        size = row.size
        self.progress(f"{row.method}, {row.data}, {size.width}x{size.height}" if size else row.method)
        with torch.inference_mode():
            median, iqr = time_ms(call)
            held = memory_mb(call)
        time = Time(median, iqr, 1000.0 / median, held, torch.get_num_threads(), self.machine)
        return replace(row, time=time, command=self.command)


def run(command: str, progress: Callable[[str], None], data: Path | None) -> list[Row]:
    """All rows: exact scenes, and a real sensor if ``data`` is a folder with ``gelsight_mini_a``."""
    bench = Bench(command, progress)
    rows = list(_scenes(bench))
    if data is not None and (data / "gelsight_mini_a").is_dir():
        rows += list(_sensor(bench, data))
    return rows


def ms(row: Row) -> float:
    """Median time of a row's frame, ms."""
    if row.time is None:
        raise ValueError(f"row: expected one with a time, got '{row.method}' on '{row.data}' without")
    return row.time.ms_median


def peer_ratios(rows: Sequence[Row]) -> list[str]:
    """Sentences by size: the fast frame compared with gs_sdk's pipeline, and precise compared with fast."""
    lines = []
    for height, width in SIZES:
        times = {row.method: ms(row) for row in rows if row.kind == "scene" and row.size == Size(height, width)}
        peer = times.get(GS_SDK)
        if peer is not None and "fast" in times:
            slower = times["precise"] / times["fast"]
            lines.append(
                f"{width}x{height}: fast {times['fast']:.2f} ms, {peer / times['fast']:.1f} times as fast as gs_sdk's pipeline "
                f"({peer:.1f} ms); precise takes {slower:.2f} times as long"
            )
    return lines


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """The Pareto front of time and of an error ("rms_um", "normal_deg"), by rising time, of what has not seen the frames before."""
    known = sorted((ms(row), value, k) for k, row in enumerate(rows) if not row.seen and (value := row.error(error)) is not None)
    best: list[Row] = []
    least = float("inf")
    for _, value, k in known:
        if value < least:
            best.append(rows[k])
            least = value
    return best


COLUMNS = (
    Column("method", lambda row: row.method),
    Column("data", lambda row: row.data),
    Column("size", lambda row: f"{row.size.width}x{row.size.height}" if row.size else ""),
    Column("ms, median (IQR)", lambda row: f"{row.time.ms_median:.2f} ({row.time.ms_iqr:.2f})" if row.time else ""),
    Column("frames/s", lambda row: f"{row.time.frames_per_second:.0f}" if row.time else ""),
    Column("MB", lambda row: number(row.time.memory_mb, 0) if row.time else ""),
    error_column("normals deg", "normal_deg", 3),
    error_column("RMS um", "rms_um", 3),
    error_column("largest px", "largest_px", 3),
    Column("", lambda row: row.note),
)
"""Columns of :func:`table`."""


def table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    return records.table(rows, COLUMNS)


# exact scenes


class _Rig(NamedTuple):
    """A unit of known lights, an exact press, and its image."""

    calibration: Calibration
    scene: Scene
    image: Tensor


def _rig(height: int, width: int, press_mm: float) -> _Rig:
    pitch = 40.0 / width
    lights = PointLights([[24.6, 15.0, 34.0], [-25.4, 14.1, 33.0], [0.9, -29.1, 35.0]], [1000.0, 1000.0, 1000.0])
    scene = sphere_press(10.0, press_mm, height=height, width=width, mm_per_pixel=pitch)
    image = render(scene, lights, noise_std=0.003, bits=8).detach()
    return _Rig(Calibration.from_lights(lights, Sensor("bench", height, width, pitch)), scene, image)


def _scenes(bench: Bench) -> Iterator[Row]:
    data = "sphere R 10 mm, press 1 mm, noise 0.003"
    for height, width in SIZES:
        rig, size = _rig(height, width, 1.0), Size(height, width)
        for method in (METHODS[name] for name in TIMED):
            if method.installed:
                built = method.calibrated(rig.calibration)
                call = partial(built.reconstruct, rig.image)
                row = Row("scene", method.name, data, _errors(call, rig.scene), size, ours=method.ours, note=built.note)
                yield bench.timed(replace(row, parameters=built.parameters), call)
        flat = rig.calibration.model_image
        peer = peer_frame(NormalFromMLP(height, width, flat), flat, rig.image[0])
        if peer is not None:
            row = Row("scene", GS_SDK, data, size=size, ours=False, note="its network untrained here: time only")
            yield bench.timed(row, peer)


def _errors(call: Callable[[], DepthOutput], scene: Scene) -> Errors:
    """Errors of a frame of an exact scene."""
    with torch.inference_mode():
        found = call()
    error = depth_error(found.depth_mm, scene.depth_mm, scene.mm_per_pixel)
    angle = float(normal_angle_deg(found.normal, scene.normal, scene.contact).mean())
    return {"normal_deg": angle, "rms_um": 1000.0 * error.rms_mm, "largest_px": error.max_px}


# a real sensor


def _sensor(bench: Bench, data: Path) -> Iterator[Row]:
    """Methods that learned from every other press of a GelSight Mini, scored on the rest."""
    folder, sensor = data / "gelsight_mini_a", Sensor.load("gelsight_mini")
    background, presses = read_presses(folder)
    labelled = [press for press in presses if press.contact_radius_px is not None]
    learned, scored = labelled[::2], labelled[1::2]
    size, name, image = Size(sensor.height, sensor.width), "GelSight Mini, balls", scored[0].image
    bench.progress("fitting the methods to presses of a GelSight Mini")
    for method, built, seen in _sensor_methods(Training(background, learned, sensor.without_prior()), sensor):
        errors = _ball_errors(built.reconstruct, scored, sensor.mm_per_pixel)
        row = Row("sensor", method, name, errors, size, ours=method != "look-up table", seen=seen, note=built.note)
        yield bench.timed(replace(row, parameters=built.parameters), partial(built.reconstruct, image[None]))
    network = NormalFromMLP.load(folder / "model" / "nnmodel.pth", background)
    peer = peer_frame(network, background, image)
    if peer is not None:
        whole = partial(GsSdkPipeline(network, background).as_output, mm_per_pixel=sensor.mm_per_pixel)
        errors = _ball_errors(whole, scored, sensor.mm_per_pixel)
        note = "its network, trained on these very presses; its steps by its published format"
        row = Row("sensor", GS_SDK, name, errors, size, ours=False, seen=True, note=note)
        yield bench.timed(row, peer)


def _sensor_methods(training: Training, sensor: Sensor) -> Iterator[tuple[str, Built, bool]]:
    """Name, method, and whether it has learned from the presses that are scored."""
    fitted = training.calibration
    candidates = f"of {len(fitted.report['candidates'])} candidates"
    for mode in MODES:
        yield f"response, {mode}", METHODS[mode].calibrated(fitted)._replace(note=candidates), False
    for degree in (0, 2):
        yield f"response linear {degree}, fast", METHODS["fast"].calibrated(training.of_family(degree, -1)), False
    yield "prior that has seen them, precise", shipped_prior(training, sensor), True
    yield "point lights, precise", point_lights(training), False
    yield "look-up table", lookup_table(training), False


def _ball_errors(reconstruct: Reconstruct, presses: Sequence[Press], mm_per_pixel: float) -> Errors:
    with torch.inference_mode():
        found = [(press, reconstruct(press.image[None])) for press in presses]
    scores = [score_press(press, out.depth_mm, out.normal, mm_per_pixel) for press, out in found]
    return {"normal_deg": mean(s.normal_deg for s in scores), "rms_um": mean(s.relief_um for s in scores)}
