"""Frames as a user runs them, what is paid before the first, and exported files beside the library."""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

import torchvts
from torchvts import export
from torchvts.calibration import Press, calibrate, read_presses
from torchvts.core.tables import markdown, number
from torchvts.model import Calibration, Sensor
from torchvts.normals import NormalFromMLP
from torchvts.pipeline import DepthPipeline

from .peers import peer_frame
from .rows import Row, Size, Time
from .speed import GS_SDK, PACES, Progress, ms, size_text, time_of
from .timing import CAMERA_S, SIZES, in_turn, machine, rig

USED = ("fast", "precise")
"""Modes of frames as a user runs them."""

BATCHES = (1, 4, 16, 64)


class Unit(NamedTuple):
    """A unit at one size: its calibration, a frame (1, 3, H, W) with contact, and a frame of the peer; None without."""

    name: str
    calibration: Calibration
    image: Tensor
    peer: Callable[[], object] | None


def mini(data: Path, size: tuple[int, int]) -> Unit:
    """The GelSight Mini of the data, calibrated by its background and the sensor's prior; frames are scaled to the size."""
    folder = data / "gelsight_mini_a"
    background, presses = read_presses(folder)
    image = next(press.image for press in presses if press.contact_radius_px is not None)
    background, image = (
        nn.functional.interpolate(frame[None], size=size, mode="bilinear", antialias=True)[0].clamp(0.0, 1.0)
        for frame in (background, image)
    )
    sensor = Sensor.load("gelsight_mini", height=size[0], width=size[1])
    network = NormalFromMLP.load(folder / "model" / "nnmodel.pth", background)
    return Unit("GelSight Mini", calibrate(background, sensor), image[None], peer_frame(network, background, image))


def drawn(size: tuple[int, int]) -> Unit:
    """A rig of three known lights, and a ball pressed 1 mm."""
    unit = rig(*size)
    flat = unit.calibration.model_image
    return Unit("drawn rig", unit.calibration, unit.image, peer_frame(NormalFromMLP(*size, flat), flat, unit.image[0]))


def frames(unit: Unit, calls: int) -> Iterator[Row]:
    """Every mode of a unit at every pace, and the peer, in the threads that torch has now."""
    size = Size(unit.image.shape[2], unit.image.shape[3])
    for mode in USED:
        row = Row("frame", mode, unit.name, size=size)
        call = partial(DepthPipeline.from_calibration(unit.calibration, mode).freeze(), unit.image)
        yield replace(row, time=time_of(in_turn([call], calls)[0]))
        yield replace(row, time=time_of(in_turn([partial(time.sleep, CAMERA_S), call], calls)[1], PACES[1]))
        if unit.peer is not None:
            theirs, times = in_turn([unit.peer, call], min(calls, 60))
            yield replace(row, time=time_of(times, PACES[2]))
            if mode == USED[0]:
                yield replace(row, method=GS_SDK, ours=False, time=time_of(theirs, "after our frame"))


def batches(unit: Unit, calls: int) -> Iterator[Row]:
    """Mode fast by batch, in a tight loop."""
    pipe = DepthPipeline.from_calibration(unit.calibration).freeze()
    for count in BATCHES:
        times = in_turn([partial(pipe, unit.image.repeat(count, 1, 1, 1))], max(10, calls // count))[0]
        size = Size(unit.image.shape[2], unit.image.shape[3], count)
        yield Row("frame", USED[0], unit.name, size=size, time=time_of(times, frames=count))


def costs(unit: Unit, presses: Sequence[Press], background: Tensor | None) -> Iterator[Row]:
    """What stands before the first frame: import, calibration, the first frame.

    The error "value" of a row is what ``method`` names, in the unit ``data``.
    """

    def cost(name: str, value: float, data: str) -> Row:
        return Row("cost", name, data, {"value": value})

    yield cost("import torchvts, on top of torch's import", _import_s(), "s")
    if background is not None:
        sensor = Sensor.load("gelsight_mini", *background.shape[1:])  # a calibration's sensor has no prior any more
        yield cost("calibrate by a background, with the sensor's prior", _s(partial(calibrate, background, sensor)), "s")
        fit = partial(calibrate, background, sensor.without_prior(), presses=list(presses))
        yield cost(f"calibrate by {len(presses)} presses, without prior", _s(fit), "s")

    def first_frame() -> None:
        DepthPipeline.from_calibration(unit.calibration).freeze()(unit.image)

    yield cost("first frame: the pipeline made, and its first depth", _s(first_frame), "s")


def _s(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _import_s() -> float:
    """Median of five processes."""
    code = "import time, torch; start = time.perf_counter(); import torchvts; print(time.perf_counter() - start)"
    root = str(Path(torchvts.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-c", code]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True, env=environment) for _ in range(5)]
    return statistics.median(float(done.stdout) for done in runs)


def as_user(progress: Progress, data: Path | None, calls: int = 100) -> list[Row]:
    """Frames of all units, sizes, paces and threads, then costs.

    Args:
        progress: called with the name of what is measured next.
        data: folder with ``gelsight_mini_a``; None without: then the drawn rig alone.
        calls: number of calls of each row, at least 20.
    """
    makers: list[Callable[[tuple[int, int]], Unit]] = [drawn] if data is None else [partial(mini, data), drawn]
    rows: list[Row] = []
    allowed = torch.get_num_threads()
    for maker in makers:
        for size in SIZES:
            unit = maker(size)
            progress(f"{unit.name}, {size[1]}x{size[0]}")
            rows += frames(unit, max(20, calls // (4 if size[0] > 480 else 1)))
            if size == SIZES[1]:
                rows += batches(unit, calls)
            if size == SIZES[1] and allowed > 1:  # a user who allows torch one thread
                torch.set_num_threads(1)
                rows += frames(unit, calls)
                torch.set_num_threads(allowed)
    unit = makers[0](SIZES[1])
    progress("calibration, first frame")
    background, presses = (None, []) if data is None else read_presses(data / "gelsight_mini_a")
    return rows + list(costs(unit, [press for press in presses if press.contact_radius_px is not None][:30], background))


def _threads(row: Row) -> str:
    """Threads in words: one, or what the library chooses of those that torch may use."""
    return "1" if row.time is not None and row.time.threads == 1 else "own choice"


def ratios(rows: Sequence[Row]) -> list[str]:
    """Sentences: how many times as fast as the peer a mode is, frames alternating in one process."""
    peers = {(row.data, row.size, _threads(row)): ms(row) for row in rows if row.method == GS_SDK}
    lines = []
    for row in rows:
        peer = peers.get((row.data, row.size, _threads(row)))
        if row.time is not None and row.time.pace == PACES[2] and peer is not None:
            lines.append(
                f"{row.data}, {size_text(row.size)}, threads: {_threads(row)}: {row.method} {ms(row):.2f} ms, "
                f"{peer / ms(row):.1f} times as fast as {GS_SDK} ({peer:.1f} ms)"
            )
    return lines


def user_table(rows: Sequence[Row]) -> str:
    """Everything in Markdown: a line for each unit, size, method and threads, its paces side by side; then what is paid once."""
    own = [row for row in rows if row.kind == "frame" and row.method != GS_SDK]
    groups: dict[tuple[str, str, str, str], dict[str, Time]] = {}
    for row in own:
        known = groups.setdefault((row.data, size_text(row.size), row.method, _threads(row)), {})
        if row.time is not None:
            known.setdefault(row.time.pace, row.time)
    lines = []
    for key, times in groups.items():
        cells = [_cell(times.get(pace)) for pace in PACES]
        lines.append([*key, *cells, number(1000.0 / times[PACES[0]].ms_median if PACES[0] in times else None, 0)])
    titles = ["unit", "size", "method", "threads", *(f"{pace}: ms, median, p90" for pace in PACES)]
    paid = [[row.method, f"{row.errors['value']:.3g} {row.data}"] for row in rows if row.kind == "cost"]
    once = markdown(["what is paid once", ""], paid)
    return "\n".join([markdown([*titles, "frames/s in a tight loop"], lines), "", *ratios(rows), "", once, "", machine()])


def _cell(time: Time | None) -> str:
    return "" if time is None else f"{time.ms_median:.2f}, {time.ms_p90:.2f}"


# exported files


def export_table(unit: Unit, calls: int) -> str:
    """Median ms of a frame in the library and in a file of TorchScript, in turn in one process."""
    lines = []
    for mode in USED:
        pipe = DepthPipeline.from_calibration(unit.calibration, mode)
        with tempfile.TemporaryDirectory() as folder:
            file = torch.jit.load(export.export_torchscript(pipe, Path(folder) / "pipeline.pt"))  # type: ignore[no-untyped-call]
            every = in_turn([partial(pipe.freeze(), unit.image), partial(file, unit.image)], calls)
        own, other = map(statistics.median, every)
        lines.append([mode, f"{own:.2f}", f"{other:.2f}, {other / own:.1f} times"])
    return markdown(["mode", "library", "torchscript"], lines)
