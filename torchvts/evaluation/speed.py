"""Speed and error of every method in the same run: on exact scenes, on a real sensor, for the stages of a frame."""

import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from ..calibration import Press, read_presses
from ..model import Calibration, PointLights, Sensor, gs_sdk
from ..normals import NormalFromMLP
from ..pipeline import MODES, DepthPipeline
from ..scenes import Scene, render, sphere_press, surface
from . import rows as records
from .gallery import roof, stamp
from .methods import METHODS, Built, Reconstruct, lookup_table, point_lights, shipped_prior
from .metrics import depth_error, normal_angle_deg
from .peers import GsSdkPipeline, installed_gs_sdk
from .presses import Training
from .rows import Column, Row, Size, Time, error_column, mean, number
from .score import score_press

SIZES = ((120, 160), (240, 320), (480, 640), (960, 1280))
PRESSES_MM = (1.0, 2.0)
GS_SDK = "gs_sdk's pipeline"

TIMED = ("fast", "precise", "auto", "fast, zero border", "fast, SciPy's DCT")
"""Methods that are timed on every exact scene."""

TIMED_ONCE = ("fast, PyTorch reference", "flat", "look-up table")
"""Methods that are timed on the scenes of the first press only."""

Errors = Mapping[str, float | None]


class Timing(NamedTuple):
    """Time of a call.

    Attributes:
        median: median, ms.
        iqr: interquartile range, ms.
    """

    median: float
    iqr: float


class Call(NamedTuple):
    """A call to time, and the other fields of its row.

    Attributes:
        call: what is timed.
        errors: errors of the same frames.
        batch: frames in the call.
        ours: whether it is a method of this library.
        seen: whether the method has learned from the very frames that it is scored on.
        parameters: number of parameters of the method.
        floor_ms: time of the memory traffic or of the FFT alone, ms.
        note: a remark.
    """

    call: Callable[[], object]
    errors: Errors | None = None
    batch: int = 1
    ours: bool = True
    seen: bool = False
    parameters: int | None = None
    floor_ms: float | None = None
    note: str = ""


def time_ms(call: Callable[[], object], repeats: int = 40, most_s: float = 2.0) -> Timing:
    """Time a call.

    Args:
        call: what is timed, after five calls to warm up.
        repeats: number of calls.
        most_s: bound on the time of all calls, s; there are at least five.
    Returns:
        Median and interquartile range.
    """
    for _ in range(5):
        call()
    times: list[float] = []
    start = time.perf_counter()
    while len(times) < 5 or (len(times) < repeats and time.perf_counter() - start < most_s):
        before = time.perf_counter()
        call()
        times.append(1000.0 * (time.perf_counter() - before))
    low, middle, high = statistics.quantiles(times, n=4)
    return Timing(middle, high - low)


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
    """Times calls; every row has the machine, the threads and the command.

    Args:
        command: the command as typed.
        progress: called with the name of what is measured next.
    """

    def __init__(self, command: str, progress: Callable[[str], None]) -> None:
        self.command, self.progress = command, progress
        self.machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"

    def row(self, kind: str, method: str, data: str, size: tuple[int, int], timed: Call) -> Row:
        """Time a call and make its row.

        Args:
            kind: kind of the row.
            method: name of the method.
            data: name of the data.
            size: rows and columns of the frame.
            timed: the call.
        """
        self.progress(f"{method}, {data or kind}, {size[1]}x{size[0]}")
        with torch.inference_mode():
            timing = time_ms(timed.call)
            held = memory_mb(timed.call)
        ms = timing.median / timed.batch
        threads = torch.get_num_threads()
        return Row(
            kind=kind,
            method=method,
            data=data,
            errors=timed.errors or {},
            size=Size(*size, timed.batch),
            time=Time(ms, timing.iqr / timed.batch, 1000.0 / ms, held, threads, self.machine, timed.floor_ms),
            parameters=timed.parameters,
            ours=timed.ours,
            seen=timed.seen,
            command=self.command,
            note=timed.note,
        )


def run(command: str, progress: Callable[[str], None], data: Path | None) -> list[Row]:
    """All rows: exact scenes, walls, stages, batches and threads, and a real sensor if there are data of one.

    Args:
        command: the command as typed.
        progress: called with the name of what is measured next.
        data: folder with ``gelsight_mini_a``; None without.
    """
    bench = Bench(command, progress)
    rows = [*_scenes(bench), *_walls(bench), *_stages(bench), *_scaling(bench)]
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
        shown = [row for row in rows if row.size == Size(height, width) and f"press {PRESSES_MM[0]:g} mm" in row.data]
        times = {row.method: ms(row) for row in shown if row.kind == "scene"}
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


def _size(row: Row) -> str:
    assert row.size is not None and row.time is not None
    batch = f", batch {row.size.batch}" if row.size.batch > 1 else ""
    threads = f", {row.time.threads} threads" if row.kind == "threads" else ""
    return f"{row.size.width}x{row.size.height}{batch}{threads}"


COLUMNS = (
    Column("method", lambda row: row.method),
    Column("data", lambda row: row.data),
    Column("size", _size),
    Column("ms, median (IQR)", lambda row: f"{row.time.ms_median:.2f} ({row.time.ms_iqr:.2f})" if row.time else ""),
    Column("frames/s", lambda row: f"{row.time.frames_per_second:.0f}" if row.time else ""),
    Column("MB", lambda row: number(row.time.memory_mb, 0) if row.time else ""),
    error_column("normals deg", "normal_deg", 3),
    error_column("RMS um", "rms_um", 3),
    error_column("largest px", "largest_px", 3),
    Column("floor ms", lambda row: number(row.time.floor_ms, 3) if row.time else ""),
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


def _on_scene(name: str, rig: _Rig) -> Call:
    """A method built for a rig, and its errors on the scene."""
    method = METHODS[name]
    built = method.calibrated(rig.calibration)
    with torch.inference_mode():
        found = built.reconstruct(rig.image)
    error = depth_error(found.depth_mm, rig.scene.depth_mm, rig.scene.mm_per_pixel)
    angle = float(normal_angle_deg(found.normal, rig.scene.normal, rig.scene.contact).mean())
    errors = {"normal_deg": angle, "rms_um": 1000.0 * error.rms_mm, "largest_px": error.max_px}
    return Call(partial(built.reconstruct, rig.image), errors, 1, method.ours, parameters=built.parameters, note=built.note)


def _scenes(bench: Bench) -> Iterator[Row]:
    for size in SIZES:
        for press_mm in PRESSES_MM:
            rig = _rig(*size, press_mm)
            data = f"sphere R 10 mm, press {press_mm:g} mm, noise 0.003"
            for name in TIMED if press_mm != PRESSES_MM[0] else TIMED + TIMED_ONCE:
                if METHODS[name].installed:
                    yield bench.row("scene", name, data, size, _on_scene(name, rig))
            if press_mm == PRESSES_MM[0] and find_spec("scipy") is not None and size[0] <= 480:
                flat = rig.calibration.model_image
                peer, pixels = GsSdkPipeline(NormalFromMLP(*size, flat), flat), gs_sdk.image_to_bgr(rig.image[0])
                call = Call(partial(peer, pixels), ours=False, note="its network untrained here: time only")
                yield bench.row("scene", GS_SDK, data, size, call)


def _walls(bench: Bench) -> Iterator[Row]:
    """Time and error on vertical walls: a roof with vertical ends, a stamp."""
    size = (240, 320)
    reliefs = {
        "roof, upright ends": roof(1.0, 0.4, 100.0, 9.0, 0.0, 0.0),
        "stamp, upright walls": stamp(3.5, 1.0, 100.0, 0.0, 0.0),
    }
    for data, relief in reliefs.items():
        calibration, ball, _ = _rig(*size, 1.0)
        assert calibration.lights is not None
        scene = surface(relief, *size, ball.mm_per_pixel)
        rig = _Rig(calibration, scene, render(scene, calibration.lights, noise_std=0.003, bits=8).detach())
        for name in ("precise", "precise, discontinuities"):
            yield bench.row("wall", name, data, size, _on_scene(name, rig))


# stages of a frame, batches and threads


def _fast(rig: _Rig) -> DepthPipeline:
    return DepthPipeline.from_calibration(rig.calibration, "fast")


def _stages(bench: Bench) -> Iterator[Row]:
    for size in ((240, 320), (480, 640)):
        rig = _rig(*size, 1.0)
        pipe, image = _fast(rig), rig.image
        with torch.inference_mode():
            deformed = pipe.deformed(pipe.compensate(image))
            gradient = pipe.gradient(pipe.normals(image)) * deformed
            depth = pipe.integrate(gradient)
        plane, spectrum = torch.rand(1, 1, *size), torch.fft.rfft2(torch.rand(1, 1, *size))
        with torch.inference_mode():
            read = time_ms(partial(torch.aminmax, image)).median
            copy = time_ms(partial(torch.add, image, 1.0)).median
            transform = time_ms(partial(torch.fft.rfft2, plane)).median
            transform += time_ms(partial(torch.fft.irfft2, spectrum, s=size)).median
        calls: dict[str, tuple[Callable[[], object], float, str]] = {
            "deformed": (partial(pipe.deformed, image), copy, "floor: one pass over the image"),
            "normals, eq. 9, whole frame": (partial(pipe.normals, image), 3.0 * copy, "floor: one pass for each light"),
            "normals, eq. 10, whole frame": (partial(pipe.normals, image, depth), 3.0 * copy, "the same floor"),
            "integrate, whole frame": (partial(pipe.integrate, gradient), transform, "floor: one real FFT and its inverse"),
            "check of values": (partial(torch.aminmax, image), read, "floor: itself"),
        }
        for name, (call, floor, note) in calls.items():
            yield bench.row("stage", name, "", size, Call(call, floor_ms=floor, note=note))


def _scaling(bench: Bench) -> Iterator[Row]:
    """Mode fast by batch size and by number of threads."""
    size = (240, 320)
    rig = _rig(*size, 1.0)
    pipe = _fast(rig)
    for batch in (1, 4, 16):
        yield bench.row("batch", "fast", "", size, Call(partial(pipe, rig.image.repeat(batch, 1, 1, 1)), batch=batch))
    before = torch.get_num_threads()
    try:
        for threads in range(1, before + 1):
            torch.set_num_threads(threads)
            for size in ((240, 320), (480, 640)):
                rig = _rig(*size, 1.0)
                yield bench.row("threads", "fast", "", size, Call(partial(_fast(rig), rig.image)))
    finally:
        torch.set_num_threads(before)


# a real sensor


def _sensor(bench: Bench, data: Path) -> Iterator[Row]:
    """Methods that learned from every other press of a GelSight Mini, scored on the rest."""
    folder, sensor = data / "gelsight_mini_a", Sensor.load("gelsight_mini")
    background, presses = read_presses(folder)
    labelled = [press for press in presses if press.contact_radius_px is not None]
    learned, scored = labelled[::2], labelled[1::2]
    size, name, image = (sensor.height, sensor.width), "GelSight Mini, balls", scored[0].image
    bench.progress("fitting the methods to presses of a GelSight Mini")
    for method, built, seen in _sensor_methods(Training(background, learned, sensor.without_prior()), sensor):
        errors = _ball_errors(built.reconstruct, scored, sensor.mm_per_pixel)
        ours = method != "look-up table"
        call = Call(partial(built.reconstruct, image[None]), errors, 1, ours, seen, built.parameters, note=built.note)
        yield bench.row("sensor", method, name, size, call)
    weights = folder / "model" / "nnmodel.pth"
    pixels = gs_sdk.image_to_bgr(image)
    if find_spec("scipy") is not None:
        peer = GsSdkPipeline(NormalFromMLP.load(weights, background), background)
        errors = _ball_errors(partial(peer.as_output, mm_per_pixel=sensor.mm_per_pixel), scored, sensor.mm_per_pixel)
        note = "its network, trained on these very presses; its steps by its published format"
        yield bench.row("sensor", GS_SDK, name, size, Call(partial(peer, pixels), errors, ours=False, seen=True, note=note))
    own = installed_gs_sdk(weights, gs_sdk.image_to_bgr(background), sensor.mm_per_pixel)
    if own is not None:
        yield bench.row("sensor", "gs_sdk, installed", name, size, Call(partial(own, pixels), ours=False, note="time only"))


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
