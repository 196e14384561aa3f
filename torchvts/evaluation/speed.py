"""Speed and error of every method in one table: rows for a chart of one against the other."""

import dataclasses
import importlib
import json
import os
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..accelerated import reference_only
from ..calibration import CalibrationWarning, Press, calibrate, read_presses
from ..compensate import Compensate
from ..core.geometry import normal_from_gradient
from ..integration import AdaptiveIntegration, PoissonDST, divergence
from ..model import gs_sdk
from ..model.calibration import Calibration
from ..model.lights import PointLights
from ..model.sensor import Sensor
from ..normals import NormalFromLookup, NormalFromMLP
from ..pipeline import MODES, DepthPipeline
from ..scenes.scenes import Scene, render, sphere_press, surface
from .gallery import roof, stamp
from .metrics import depth_error, normal_angle_deg
from .score import Training, score_press, training_pixels

SIZES = ((120, 160), (240, 320), (480, 640), (960, 1280))
PRESSES_MM = (1.0, 2.0)


@dataclass(frozen=True)
class Row:
    """One measurement; errors are those of the very frames that were timed, None where there is nothing to compare with.

    Attributes:
        kind: "scene" (exact truth), "cliff" (the same, with walls), "sensor" (balls on a real sensor), "stage" (part of a frame),
            "batch", "threads".
        method, data: names. ours: whether it is this library's, and not a peer's.
        height, width: pixels. batch, threads: as said. machine: kind, cores, torch.
        ms_median, ms_iqr: of one frame, milliseconds. frames_per_second: by the median.
        memory_mb: most that one call holds beside its inputs.
        normal_deg, rms_um, largest_px: mean angle between normals; RMS and largest error of depth.
        floor_ms: what the memory traffic or the FFT of a stage takes by itself.
        command: what made the row. note: what there is to say.
    """

    kind: str
    method: str
    data: str
    ours: bool
    height: int
    width: int
    batch: int
    threads: int
    machine: str
    ms_median: float
    ms_iqr: float
    frames_per_second: float
    memory_mb: float | None
    normal_deg: float | None
    rms_um: float | None
    largest_px: float | None
    floor_ms: float | None
    command: str
    note: str = ""


@dataclass(frozen=True)
class Timing:
    """Median and interquartile range of the time of a call, ms."""

    median: float
    iqr: float


def time_ms(call: Callable[[], object], repeats: int = 40, most_s: float = 2.0) -> Timing:
    """Time a call: five to warm up, then ``repeats`` or as many as fit into ``most_s`` seconds, at least five."""
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
    """Most memory of tensors that a call holds at any moment, MB, by the allocator's own record."""
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
    """Measures; every row carries machine, threads and command.

    Args:
        command: what was typed. progress: called with what is measured next.
    """

    def __init__(self, command: str, progress: Callable[[str], None]) -> None:
        self.command, self.progress = command, progress
        self.machine = f"{platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}"

    def row(
        self,
        kind: str,
        method: str,
        data: str,
        size: Sequence[int],
        call: Callable[[], object],
        *,
        ours: bool = True,
        batch: int = 1,
        errors: tuple[float | None, float | None, float | None] = (None, None, None),
        floor_ms: float | None = None,
        note: str = "",
    ) -> Row:
        """Time a call and make its row."""
        self.progress(f"{method}, {data or kind}, {size[1]}x{size[0]}")
        with torch.inference_mode():
            timing = time_ms(call)
            held = memory_mb(call)
        ms = timing.median / batch
        return Row(
            kind, method, data, ours, size[0], size[1], batch, torch.get_num_threads(), self.machine, ms, timing.iqr / batch,
            1000.0 / ms, held, *errors, floor_ms, self.command, note,
        )  # fmt: skip


def run(command: str, progress: Callable[[str], None], data: Path | None) -> list[Row]:
    """All rows: exact scenes, a real sensor if ``data`` holds it, stages with their floors, batches and threads."""
    bench = Bench(command, progress)
    rows = [*_scenes(bench), *_cliffs(bench), *_stages(bench), *_scaling(bench)]
    if data is not None and (data / "gelsight_mini_a").is_dir():
        rows += list(_sensor(bench, data))
    return rows


def peer_ratios(rows: Sequence[Row]) -> list[str]:
    """How many times faster than gs_sdk's pipeline the fast frame is, and how many times slower precise, by size."""
    lines = []
    for height, width in SIZES:
        shown = [row for row in rows if (row.height, row.width) == (height, width) and f"press {PRESSES_MM[0]:g} mm" in row.data]
        times = {row.method: row.ms_median for row in shown if row.kind == "scene"}
        peer = next((ms for method, ms in times.items() if method.startswith("gs_sdk")), None)
        if peer is not None and "fast" in times:
            slower = times["precise"] / times["fast"]
            lines.append(
                f"{width}x{height}: fast {times['fast']:.2f} ms, {peer / times['fast']:.1f} times as fast as gs_sdk's pipeline "
                f"({peer:.1f} ms); precise takes {slower:.2f} times as long"
            )
    return lines


def front(rows: Sequence[Row], error: str) -> list[Row]:
    """The rows that no other beats in both time and ``error`` ("rms_um", "normal_deg"), by rising time."""
    known = sorted((row for row in rows if getattr(row, error) is not None), key=lambda row: (row.ms_median, getattr(row, error)))
    best: list[Row] = []
    for row in known:
        if not best or getattr(row, error) < getattr(best[-1], error):
            best.append(row)
    return best


def table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| method | data | size | ms, median (IQR) | frames/s | MB | normals deg | RMS um | largest px | floor ms | |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        errors = " | ".join(f"{v:.3f}" if v is not None else "" for v in (row.normal_deg, row.rms_um, row.largest_px, row.floor_ms))
        batch = f", batch {row.batch}" if row.batch > 1 else ""
        threads = f", {row.threads} threads" if row.kind == "threads" else ""
        held = "" if row.memory_mb is None else f"{row.memory_mb:.0f}"
        speed = f"{row.width}x{row.height}{batch}{threads} | {row.ms_median:.2f} ({row.ms_iqr:.2f}) | {row.frames_per_second:.0f}"
        lines.append(f"| {row.method} | {row.data} | {speed} | {held} | {errors} | {row.note} |")
    return "\n".join(lines)


def to_json(rows: Sequence[Row]) -> str:
    """The rows as JSON, one object each."""
    return json.dumps([asdict(row) for row in rows], indent=1)


# exact scenes


def _rig(height: int, width: int, press_mm: float) -> tuple[Calibration, Tensor, Scene]:
    pitch = 40.0 / width
    lights = PointLights([[24.6, 15.0, 34.0], [-25.4, 14.1, 33.0], [0.9, -29.1, 35.0]], [1000.0, 1000.0, 1000.0])
    scene = sphere_press(10.0, press_mm, height=height, width=width, mm_per_pixel=pitch)
    image = render(scene, lights, noise_std=0.003, bits=8).detach()
    return Calibration.from_lights(lights, Sensor("bench", height, width, pitch)), image, scene


def _scenes(bench: Bench) -> Iterator[Row]:
    for height, width in SIZES:
        for press_mm in PRESSES_MM:
            calibration, image, scene = _rig(height, width, press_mm)
            data = f"sphere R 10 mm, press {press_mm:g} mm, noise 0.003"
            size = (height, width)
            pipes = {mode: DepthPipeline.from_calibration(calibration, mode) for mode in MODES}
            solvers: dict[str, nn.Module] = {"zero border (DST)": PoissonDST(scene.mm_per_pixel)}
            if find_spec("scipy") is not None:
                solvers["SciPy's DCT"] = _PoissonSciPy(scene.mm_per_pixel)
            for name, solver in solvers.items():
                pipes[f"fast, {name}"] = DepthPipeline.from_calibration(calibration, integrate=solver)
            for method, pipe in pipes.items():
                with torch.inference_mode():
                    found = pipe(image)
                errors = _errors(found.depth_mm, found.normal, scene)
                yield bench.row("scene", method, data, size, partial(pipe, image), ours="SciPy" not in method, errors=errors)
            if press_mm == PRESSES_MM[0]:
                fast = reference_only()(partial(pipes["fast"], image))
                errors = _errors(fast().depth_mm, fast().normal, scene)
                yield bench.row(
                    "scene", "fast, tensor operators", data, size, fast, ours=True, errors=errors, note="no compiled loops"
                )
                flat = torch.zeros_like(scene.depth_mm)
                upright = normal_from_gradient(torch.cat((flat, flat), dim=1))
                yield bench.row(
                    "scene", "flat", data, size, partial(torch.zeros_like, scene.depth_mm), ours=False,
                    errors=_errors(flat, upright, scene), note="what errors are worth",
                )  # fmt: skip
                yield from _lookup_on_scenes(bench, calibration, image, scene, data)
                if find_spec("scipy") is not None and height <= 480:
                    peer = _GsSdkPipeline(NormalFromMLP(height, width, calibration.model_image), calibration.model_image)
                    pixels = gs_sdk.image_to_bgr(image[0])
                    note = "its network untrained here: time only"
                    yield bench.row("scene", "gs_sdk's pipeline", data, size, partial(peer, pixels), ours=False, note=note)


def _lookup_on_scenes(bench: Bench, calibration: Calibration, image: Tensor, scene: Scene, data: str) -> Iterator[Row]:
    """The look-up table, filled by other balls on the same rig."""
    assert calibration.lights is not None
    height, width, pitch = calibration.sensor.height, calibration.sensor.width, calibration.sensor.mm_per_pixel
    values, slopes = [], []
    for x, y in ((-5.0, -4.0), (5.0, 3.0), (0.0, 0.0)):
        ball = sphere_press(8.0, 1.2, (x, y), height=height, width=width, mm_per_pixel=pitch)
        seen = (render(ball, calibration.lights).detach() - calibration.model_image)[0]
        inside = ball.contact[0, 0]
        values.append(seen[:, inside].t())
        slopes.append(ball.gradient[0][:, inside].t())
    block = NormalFromLookup.fit(calibration.model_image, torch.cat(values), torch.cat(slopes))
    pipe = DepthPipeline.from_calibration(calibration, normals=block)
    with torch.inference_mode():
        found = pipe(image)
    errors = _errors(found.depth_mm, found.normal, scene)
    yield bench.row("scene", "look-up table", data, (height, width), partial(pipe, image), ours=False, errors=errors)


def _errors(depth_mm: Tensor, normal: Tensor, scene: Scene) -> tuple[float, float, float]:
    error = depth_error(depth_mm, scene.depth_mm, scene.mm_per_pixel)
    return float(normal_angle_deg(normal, scene.normal, scene.contact).mean()), 1000.0 * error.rms_mm, error.max_px


def _cliffs(bench: Bench) -> Iterator[Row]:
    """What each robust variant costs and gains on walls: a roof with upright ends, a stamp."""
    height, width = 240, 320
    reliefs = {"roof, upright ends": roof(1.0, 0.4, 100.0, 9.0, 0.0, 0.0), "stamp, upright walls": stamp(3.5, 1.0, 100.0, 0.0, 0.0)}
    for name, relief in reliefs.items():
        calibration, _, ball = _rig(height, width, 1.0)
        assert calibration.lights is not None
        pitch = ball.mm_per_pixel
        scene = surface(relief, height, width, pitch)
        image = render(scene, calibration.lights, noise_std=0.003, bits=8).detach()
        pipes = {
            "precise": DepthPipeline.from_calibration(calibration, "precise"),
            "precise, cliffs": DepthPipeline.from_calibration(calibration, "precise", integrate=AdaptiveIntegration(pitch)),
        }
        for method, pipe in pipes.items():
            with torch.inference_mode():
                found = pipe(image)
            errors = _errors(found.depth_mm, found.normal, scene)
            yield bench.row("cliff", method, name, (height, width), partial(pipe, image), errors=errors)


# parts of a frame, and how cost grows


def _stages(bench: Bench) -> Iterator[Row]:
    for height, width in ((240, 320), (480, 640)):
        calibration, image, _ = _rig(height, width, 1.0)
        pipe = DepthPipeline.from_calibration(calibration, "fast")
        with torch.inference_mode():
            contact = pipe.contact(pipe.compensate(image))
            gradient = pipe.gradient(pipe.normals(image)) * contact
            depth = pipe.integrate(gradient)
        plane, spectrum = torch.rand(1, 1, height, width), torch.fft.rfft2(torch.rand(1, 1, height, width))
        with torch.inference_mode():
            read = time_ms(partial(torch.aminmax, image)).median
            copy = time_ms(partial(torch.add, image, 1.0)).median
            transform = time_ms(partial(torch.fft.rfft2, plane)).median
            transform += time_ms(partial(torch.fft.irfft2, spectrum, s=(height, width))).median
        calls: dict[str, tuple[Callable[[], object], float, str]] = {
            "contact": (partial(pipe.contact, image), copy, "floor: one pass over the image"),
            "normals, eq. 9, whole frame": (partial(pipe.normals, image), 3.0 * copy, "floor: a pass for each light's column"),
            "normals, eq. 10, whole frame": (partial(pipe.normals, image, depth), 3.0 * copy, "the same floor"),
            "integrate, whole frame": (partial(pipe.integrate, gradient), transform, "floor: one real FFT there and one back"),
            "check of values": (partial(torch.aminmax, image), read, "its own floor"),
        }
        for name, (call, floor, note) in calls.items():
            yield bench.row("stage", name, "", (height, width), call, floor_ms=floor, note=note)


def _scaling(bench: Bench) -> Iterator[Row]:
    calibration, image, _ = _rig(240, 320, 1.0)
    pipe = DepthPipeline.from_calibration(calibration, "fast")
    for batch in (1, 4, 16):
        call = partial(pipe, image.repeat(batch, 1, 1, 1))
        yield bench.row("batch", "fast", "", (240, 320), call, batch=batch)
    before = torch.get_num_threads()
    try:
        for threads in range(1, before + 1):
            torch.set_num_threads(threads)
            for height, width in ((240, 320), (480, 640)):
                calibration, image, _ = _rig(height, width, 1.0)
                pipe = DepthPipeline.from_calibration(calibration, "fast")
                yield bench.row("threads", "fast", "", (height, width), partial(pipe, image))
    finally:
        torch.set_num_threads(before)


# a real sensor


def _sensor(bench: Bench, data: Path) -> Iterator[Row]:
    """Methods fitted on every other press of a GelSight Mini, judged on the rest."""
    background, presses = read_presses(data / "gelsight_mini_a")
    labelled = [press for press in presses if press.contact_radius_px is not None]
    learn, judge = labelled[::2], labelled[1::2]
    sensor = Sensor.load("gelsight_mini")
    bench.progress("fitting the methods to presses of a GelSight Mini")
    training = Training(background, learn, sensor)
    size = (sensor.height, sensor.width)
    for method, pipe, ours, note in _sensor_pipes(training, background, sensor, data):
        yield bench.row(
            "sensor", method, "GelSight Mini, balls", size, partial(pipe, judge[0].image[None]), ours=ours,
            errors=_ball_errors(pipe, judge, sensor.mm_per_pixel), note=note,
        )  # fmt: skip
    weights = data / "gelsight_mini_a" / "model" / "nnmodel.pth"
    pixels, rest = gs_sdk.image_to_bgr(judge[0].image), gs_sdk.image_to_bgr(background)
    if find_spec("scipy") is not None:
        peer = _GsSdkPipeline(NormalFromMLP.load(weights, background), background)
        errors = _ball_errors(peer.as_output, judge, sensor.mm_per_pixel)
        note = "its network, trained on these very presses; its steps by its published format"
        yield bench.row(
            "sensor", "gs_sdk's pipeline", "GelSight Mini, balls", size, partial(peer, pixels), ours=False, errors=errors, note=note
        )
    own = _installed_gs_sdk(weights, rest, sensor.mm_per_pixel)
    if own is not None:
        yield bench.row(
            "sensor", "gs_sdk, installed", "GelSight Mini, balls", size, partial(own, pixels), ours=False, note="time only"
        )


def _sensor_pipes(
    training: Training, background: Tensor, sensor: Sensor, data: Path
) -> Iterator[tuple[str, Callable[[Tensor], Any], bool, str]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        lights = calibrate(background, dataclasses.replace(sensor.without_prior(), blur_px=1.0))
        prior = calibrate(background, sensor)
    fitted = training.calibration
    for mode in MODES:
        numbers = fitted.report["candidates"]
        yield f"response, {mode}", DepthPipeline.from_calibration(fitted, mode), True, f"of {len(numbers)} candidates"
    for degree, products in ((0, -1), (2, -1)):
        small = training.of_family(degree, products)
        yield f"response linear {degree}, fast", DepthPipeline.from_calibration(small, "fast"), True, ""
    yield "prior that has seen them, precise", DepthPipeline.from_calibration(prior, "precise"), True, "has seen these presses"
    yield "point lights, precise", DepthPipeline.from_calibration(lights, "precise"), True, "from the background alone"
    compensate = Compensate.from_calibration(fitted)
    value, _, slope, _ = training_pixels(compensate, training.located, sensor.mm_per_pixel)
    block = NormalFromLookup.fit(torch.ones_like(background), value - 1.0, slope)
    yield "look-up table", DepthPipeline.from_calibration(fitted, normals=block), False, ""


def _ball_errors(pipe: Callable[[Tensor], Any], presses: Sequence[Press], pitch: float) -> tuple[float, float, None]:
    scores = []
    with torch.inference_mode():
        for press in presses:
            found = pipe(press.image[None])
            scores.append(score_press(press, found.depth_mm, found.normal, pitch))
    count = len(scores)
    return sum(s.normal_deg for s in scores) / count, sum(s.relief_um for s in scores) / count, None


# peers


class _PoissonSciPy(nn.Module):
    """The free border of :class:`PoissonBackground` by SciPy's cosine transform."""

    def __init__(self, mm_per_pixel: float) -> None:
        super().__init__()
        self.mm_per_pixel = mm_per_pixel

    def forward(self, gradient: Tensor) -> Tensor:
        depth = _scipy_solve(divergence(gradient)[0, 0].numpy()) * self.mm_per_pixel
        rest = (gradient == 0).all(dim=1)[0]
        found = torch.from_numpy(depth)
        return (found - found[rest].mean())[None, None]


def _scipy_solve(right: "np.ndarray[Any, Any]") -> "np.ndarray[Any, Any]":
    from scipy import fft

    spectrum = fft.dctn(right, type=2)
    wave = [np.cos(np.pi * np.arange(n) / n) for n in right.shape]
    value = (2.0 * wave[0][:, None] + 2.0 * wave[1][None, :] - 4.0).astype(right.dtype)
    value[0, 0] = 1.0
    spectrum[0, 0] = 0.0
    solved: np.ndarray[Any, Any] = fft.idctn(spectrum / value, type=2)
    return solved


class _GsSdkPipeline:
    """A frame in the shape of gs_sdk's: its network at every pixel, SciPy's DCT in double precision, a mask by color and height.

    By its published formats (network, gradients, height map) and what its documentation tells of the steps; none of its code.
    """

    def __init__(self, network: NormalFromMLP, background: Tensor) -> None:
        self.network = network.eval()
        self.background = gs_sdk.image_to_bgr(background).astype(np.int16)
        with torch.inference_mode():
            self.rest = self.network.gradient_px(background[None])

    def __call__(self, pixels: "np.ndarray[Any, Any]") -> tuple[Any, Any, Any]:
        """B, G, R uint8 (H, W, 3) to gradients (2, H, W), height map in pixels, and mask."""
        import cv2

        with torch.inference_mode():
            gradient = (self.network.gradient_px(gs_sdk.image_from_bgr(pixels)[None]) - self.rest)[0].double()
        height = _scipy_solve(divergence(gradient[None])[0, 0].numpy())
        change = np.abs(pixels.astype(np.int16) - self.background).max(axis=2)
        mask = ((change > 15) & (height < -0.2)).astype(np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        return gradient.numpy(), height, mask

    def as_output(self, images: Tensor) -> Any:
        """As a pipeline would give it; the pitch cancels in gradients, the height map's is that of a GelSight Mini."""
        gradient, height, _ = self(gs_sdk.image_to_bgr(images[0]))
        pitch = Sensor.load("gelsight_mini").mm_per_pixel
        slope = -torch.from_numpy(gradient)[None]
        return _Output(-pitch * torch.from_numpy(height)[None, None], normal_from_gradient(slope))


@dataclass(frozen=True)
class _Output:
    depth_mm: Tensor
    normal: Tensor


def _installed_gs_sdk(weights: Path, background: "np.ndarray[Any, Any]", pitch: float) -> Callable[[Any], object] | None:
    """gs_sdk's own frame, if the user has it installed (not on PyPI: the package of that name there is another one)."""
    try:
        reconstructor = importlib.import_module("gs_sdk.gs_reconstruct").Reconstructor(str(weights))
        reconstructor.load_bg(background)
    except ImportError:
        return None
    return lambda pixels: reconstructor.get_surface_info(pixels, pitch)
