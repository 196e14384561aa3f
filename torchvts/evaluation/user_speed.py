"""Speed as a user meets it: frames as from a camera, beside a peer's and in tight loops; batches; what is paid once."""

import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..calibration import Press, calibrate, read_presses
from ..compiled import library
from ..model import Calibration, Sensor, gs_sdk
from ..normals import NormalFromMLP
from ..pipeline import DepthPipeline
from .latency import measure_latency
from .peers import peer_frame
from .rows import Size, markdown, number
from .speed import GS_SDK, SIZES, _rig, memory_mb

PACES = ("tight loop", "every 20 ms", "after the peer's frame")
"""What comes before each frame: the last one; sleep, as behind a camera; a frame of the peer, which takes the caches."""

MODES = ("fast", "precise")
BATCHES = (1, 4, 16, 64)
CAMERA_FRAMES = 600
OWN = "own choice"
"""Threads that the library chooses by itself."""


@dataclass(frozen=True)
class Paced:
    """Times of the frames of one method.

    Attributes:
        unit: "GelSight Mini" or "drawn rig".
        method: a mode, or the peer.
        size: of the frames, and how many in a call.
        pace: one of :data:`PACES`.
        threads: "own choice", or their number.
        median_ms: of a frame, ms.
        p90_ms: 90th percentile of a frame, ms.
        p99_ms: 99th, ms; None for fewer than 500 calls.
        calls: number of calls.
    """

    unit: str
    method: str
    size: Size
    pace: str
    threads: str
    median_ms: float
    p90_ms: float
    p99_ms: float | None
    calls: int


class Cost(NamedTuple):
    """What is paid once: its name, value and unit."""

    name: str
    value: float
    unit: str


class Unit(NamedTuple):
    """A unit at one size: its calibration, a frame (1, 3, H, W) with contact, and a frame of the peer; None without."""

    name: str
    calibration: Calibration
    image: Tensor
    peer: Callable[[], object] | None


def paced(call: Callable[[], object], before: Callable[[], object], calls: int) -> list[float]:
    """Time of each of so many calls, ms, something else before each; three to warm up."""
    times: list[float] = []
    with torch.inference_mode():
        for k in range(calls + 3):
            before()
            spent = _ms(call)
            if k >= 3:
                times.append(spent)
    return times


def summary(unit: str, method: str, size: Size, pace: str, threads: str, times: Sequence[float]) -> Paced:
    """The record of the times of calls; per frame where a call has several."""
    ordered = sorted(value / size.batch for value in times)
    p99 = ordered[int(0.99 * len(ordered))] if len(ordered) >= 500 else None
    return Paced(unit, method, size, pace, threads, statistics.median(ordered), ordered[int(0.9 * len(ordered))], p99, len(ordered))


def mini(data: Path, size: tuple[int, int]) -> Unit:
    """The GelSight Mini of the data, calibrated by its background and the sensor's prior; frames are scaled to the size."""
    folder = data / "gelsight_mini_a"
    background, presses = read_presses(folder)
    image = next(press.image for press in presses if press.contact_radius_px is not None)
    background, image = (_scaled(frame, size) for frame in (background, image))
    sensor = Sensor.load("gelsight_mini", height=size[0], width=size[1])
    network = NormalFromMLP.load(folder / "model" / "nnmodel.pth", background)
    return Unit("GelSight Mini", calibrate(background, sensor), image[None], peer_frame(network, background, image))


def drawn(size: tuple[int, int]) -> Unit:
    """A rig of three known lights, and a ball pressed 1 mm."""
    rig = _rig(*size, 1.0)
    flat = rig.calibration.model_image
    return Unit("drawn rig", rig.calibration, rig.image, peer_frame(NormalFromMLP(*size, flat), flat, rig.image[0]))


def _scaled(image: Tensor, size: tuple[int, int]) -> Tensor:
    return nn.functional.interpolate(image[None], size=size, mode="bilinear", antialias=True)[0].clamp(0.0, 1.0)


def frames(unit: Unit, calls: int, threads: str = OWN) -> Iterator[Paced]:
    """Every mode of a unit at every pace, and the peer."""
    size = Size(unit.image.shape[2], unit.image.shape[3])
    record = partial(summary, unit.name)
    for mode in MODES:
        call = partial(DepthPipeline.from_calibration(unit.calibration, mode).freeze(), unit.image)
        yield record(mode, size, PACES[0], threads, paced(call, lambda: None, calls))
        yield record(mode, size, PACES[1], threads, paced(call, partial(time.sleep, 0.02), calls))
        if unit.peer is not None:
            times, others = alternating(call, unit.peer, min(calls, 60))
            yield record(mode, size, PACES[2], threads, times)
            if mode == MODES[0]:
                yield record(GS_SDK, size, "after our frame", threads, others)


def alternating(call: Callable[[], object], peer: Callable[[], object], calls: int) -> tuple[list[float], list[float]]:
    """Times of both, one after the other in one process."""
    others: list[float] = []
    times = paced(call, lambda: others.append(_ms(peer)), calls)
    return times, others[-calls:]


def _ms(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return 1000.0 * (time.perf_counter() - start)


def batches(unit: Unit, calls: int) -> Iterator[Paced]:
    """Mode fast by batch, in a tight loop, in the threads that the library chooses."""
    pipe = DepthPipeline.from_calibration(unit.calibration).freeze()
    for count in BATCHES:
        images = unit.image.repeat(count, 1, 1, 1)
        size = Size(unit.image.shape[2], unit.image.shape[3], count)
        times = paced(partial(pipe, images), lambda: None, max(10, calls // count))
        yield summary(unit.name, MODES[0], size, PACES[0], OWN, times)


def costs(unit: Unit, presses: Sequence[Press], background: Tensor | None) -> Iterator[Cost]:
    """What stands before the first frame: import, calibration, the first frame; memory; and the delay behind a camera."""
    yield Cost("import torchvts, on top of torch's import", _import_s(), "s")
    if background is not None:
        sensor = Sensor.load("gelsight_mini", *background.shape[1:])  # a calibration's sensor has no prior any more
        yield Cost("calibrate by a background, with the sensor's prior", _ms(partial(calibrate, background, sensor)) / 1000.0, "s")
        bare = sensor.without_prior()
        fit = partial(calibrate, background, bare, presses=list(presses))
        yield Cost(f"calibrate by {len(presses)} presses, without prior", _ms(fit) / 1000.0, "s")

    def first_frame() -> None:
        DepthPipeline.from_calibration(unit.calibration).freeze()(unit.image)

    yield Cost("first frame: the pipeline made, and its first depth", _ms(first_frame) / 1000.0, "s")
    pipe = DepthPipeline.from_calibration(unit.calibration).freeze()
    yield Cost("largest memory of a frame's tensors", memory_mb(partial(pipe, unit.image)), "MB")
    background = unit.calibration.background.float().clamp(0.0, 1.0)
    pictures = [gs_sdk.image_to_bgr(image) for image in (background, unit.image[0])]
    found = measure_latency(unit.calibration, pictures, frames=CAMERA_FRAMES)
    for percent in (50.0, 95.0, 99.0):
        yield Cost(f"camera of 60 frames a second: frame to depth, {percent:.0f}th percentile", found.percentile(percent), "ms")
    yield Cost(f"camera of 60 frames a second: dropped of {found.arrived}", float(found.dropped), "frames")


def _import_s() -> float:
    """Median of five processes."""
    code = "import time, torch; start = time.perf_counter(); import torchvts; print(time.perf_counter() - start)"
    root = str(Path(__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", code]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True, env=environment) for _ in range(5)]
    return statistics.median(float(done.stdout) for done in runs)


class Measured(NamedTuple):
    """All of a run: frames of real sensors first, costs, and the machine in words."""

    frames: list[Paced]
    costs: list[Cost]
    machine: str


def run(data: Path | None, progress: Callable[[str], None], calls: int = 100, long: bool = False) -> Measured:
    """Measure everything.

    Args:
        data: folder with ``gelsight_mini_a``; None without: then the drawn rig alone.
        progress: called with the name of what is measured next.
        calls: number of calls of each row, at least 20.
        long: 10,000 frames, every 20 ms, of the first unit at 320x240 too, for the 99th percentile: seven minutes more.
    """
    makers: list[Callable[[tuple[int, int]], Unit]] = [drawn] if data is None else [partial(mini, data), drawn]
    rows: list[Paced] = []
    for maker in makers:
        for size in SIZES:
            unit = maker(size)
            progress(f"{unit.name}, {size[1]}x{size[0]}")
            rows += frames(unit, max(20, calls // (4 if size[0] > 480 else 1)))
            if size == SIZES[1]:
                rows += batches(unit, calls)
                rows += _in_one_thread(unit, calls)
    unit = makers[0](SIZES[1])
    if long:
        progress("10,000 frames, every 20 ms")
        for mode in MODES:
            call = partial(DepthPipeline.from_calibration(unit.calibration, mode).freeze(), unit.image)
            times = paced(call, partial(time.sleep, 0.02), 10_000)
            rows.append(summary(unit.name, mode, Size(*SIZES[1]), PACES[1], OWN, times))
    progress("calibration, first frame, delay behind a camera")
    background, presses = (None, []) if data is None else read_presses(data / "gelsight_mini_a")
    labelled = [press for press in presses if press.contact_radius_px is not None][:30]
    once = list(costs(unit, labelled, background))
    kernels = "compiled kernels" if library() is not None else "NO COMPILED KERNELS: PyTorch alone"
    cores, threads = os.cpu_count(), torch.get_num_threads()
    return Measured(
        rows, once, f"{platform.machine()}, {cores} cores, {threads} threads allowed, torch {torch.__version__}, {kernels}"
    )


def _in_one_thread(unit: Unit, calls: int) -> list[Paced]:
    """Rows of a user who allows torch one thread."""
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        return list(frames(unit, calls, "1"))
    finally:
        torch.set_num_threads(before)


def ratios(rows: Sequence[Paced]) -> list[str]:
    """Sentences: how many times as fast as the peer a mode is, frames alternating in one process."""
    peers = {(row.unit, row.size, row.threads): row.median_ms for row in rows if row.method == GS_SDK}
    lines = []
    for row in rows:
        peer = peers.get((row.unit, row.size, row.threads))
        if row.pace == PACES[2] and peer is not None:
            lines.append(
                f"{row.unit}, {row.size.width}x{row.size.height}, threads: {row.threads}: {row.method} {row.median_ms:.2f} ms, "
                f"{peer / row.median_ms:.1f} times as fast as {GS_SDK} ({peer:.1f} ms)"
            )
    return lines


def table(measured: Measured) -> str:
    """Everything in Markdown: a line for each unit, size, method and threads, its paces side by side; then what is paid once."""
    keys = dict.fromkeys((r.unit, r.size, r.method, r.threads) for r in measured.frames if r.method != GS_SDK)
    lines = []
    for unit, size, method, threads in keys:
        known = [r for r in measured.frames if (r.unit, r.size, r.method, r.threads) == (unit, size, method, threads)]
        cells = []
        for pace in PACES:
            of_pace = [row for row in known if row.pace == pace]
            best = max(of_pace, key=lambda row: row.calls, default=None)
            cells.append("" if best is None else f"{best.median_ms:.2f}, {best.p90_ms:.2f}" + _p99(best))
        batch = f", batch {size.batch}" if size.batch > 1 else ""
        tight = next((row for row in known if row.pace == PACES[0]), None)
        rate = number(None if tight is None else 1000.0 / tight.median_ms, 0)
        lines.append([unit, f"{size.width}x{size.height}{batch}", method, threads, *cells, rate])
    titles = [
        "unit",
        "size",
        "method",
        "threads",
        *(f"{pace}: ms, median, p90 (p99)" for pace in PACES),
        "frames/s in a tight loop",
    ]
    once = markdown(["what is paid once, or behind a camera", ""], [[c.name, f"{c.value:.3g} {c.unit}"] for c in measured.costs])
    return "\n".join([markdown(titles, lines), "", *ratios(measured.frames), "", once, "", measured.machine])


def _p99(row: Paced) -> str:
    return "" if row.p99_ms is None else f" ({row.p99_ms:.2f} of {row.calls})"
