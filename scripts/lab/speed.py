"""Speed: methods with their errors, frames as a user runs them, what is paid once, and exported files."""

import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from torchvts.calibration import Press, read_presses
from torchvts.model import Sensor
from torchvts.normals import NormalFromMLP
from torchvts.pipeline import MODES, DepthOutput
from torchvts.scenes import Scene

from . import rows as records
from .methods import METHODS, Built, Reconstruct, lookup_table, point_lights, shipped_prior
from .metrics import depth_error, normal_angle_deg
from .peers import GsSdkPipeline, peer_frame
from .rows import Column, Row, Size, Time, error_column, mean
from .score import score_press
from .timing import SIZES, in_turn, machine, rig
from .training import Training

GS_SDK = "gs_sdk's pipeline"

TIMED = (
    "fast", "precise", "fast, zero border", "fast, PyTorch reference", "flat", "look-up table",
)  # fmt: skip
"""Methods that are timed on exact scenes."""

PACES = ("tight loop", "every 20 ms", "after the peer's frame")
"""What comes before each frame: the last one; sleep, as behind a camera; a frame of the peer, which takes the caches."""

Errors = Mapping[str, float | None]
Progress = Callable[[str], None]


def time_of(times: Sequence[float], pace: str = PACES[0], frames: int = 1) -> Time:
    """The record of the times of calls, ms, each of so many frames."""
    ordered = sorted(value / frames for value in times)
    low, middle, high = statistics.quantiles(ordered, n=4)
    p90 = ordered[int(0.9 * len(ordered))]
    return Time(middle, high - low, p90, len(ordered), torch.get_num_threads(), machine(), pace)


def ms(row: Row) -> float:
    """Median time of a row's frame, ms."""
    if row.time is None:
        raise ValueError(f"row: expected one with a time, got '{row.method}' on '{row.data}' without")
    return row.time.ms_median


# every method with its errors


def methods(progress: Progress, data: Path | None) -> list[Row]:
    """All methods: on exact scenes, and on a real sensor if ``data`` is a folder with ``gelsight_mini_a``."""
    rows = _scenes() if data is None else (row for part in (_scenes(), _sensor(data)) for row in part)
    done = []
    for row, call in rows:
        progress(f"{row.method}, {row.data}")
        done.append(replace(row, time=time_of(in_turn([call], 40)[0])))
    return done


Timed = Iterator[tuple[Row, Callable[[], object]]]
"""Rows with their errors, and the frame that is timed."""


def _scenes() -> Timed:
    data = "sphere R 10 mm, press 1 mm, noise 0.003"
    for height, width in SIZES:
        unit, size = rig(height, width), Size(height, width)
        for method in (METHODS[name] for name in TIMED):
            built = method.calibrated(unit.calibration)
            call = partial(built.reconstruct, unit.image)
            row = Row("scene", method.name, data, _errors(call, unit.scene), size, ours=method.ours, note=built.note)
            yield replace(row, parameters=built.parameters), call
        flat = unit.calibration.model_image
        peer = peer_frame(NormalFromMLP(height, width, flat), flat, unit.image[0])
        if peer is not None:
            yield Row("scene", GS_SDK, data, size=size, ours=False, note="its network untrained here: time only"), peer


def _errors(call: Callable[[], DepthOutput], scene: Scene) -> Errors:
    """Errors of a frame of an exact scene."""
    with torch.inference_mode():
        found = call()
    error = depth_error(found.depth_mm, scene.depth_mm, scene.mm_per_pixel)
    angle = float(normal_angle_deg(found.normal, scene.normal, scene.contact).mean())
    return {"normal_deg": angle, "rms_um": 1000.0 * error.rms_mm, "largest_px": error.max_px}


def _sensor(data: Path) -> Timed:
    """Methods that learned from every other press of a GelSight Mini, scored on the rest."""
    folder, sensor = data / "gelsight_mini_a", Sensor.load("gelsight_mini")
    background, presses = read_presses(folder)
    labelled = [press for press in presses if press.contact_radius_px is not None]
    learned, scored = labelled[::2], labelled[1::2]
    size, name, image = Size(sensor.height, sensor.width), "GelSight Mini, balls", scored[0].image
    for method, built, seen in _sensor_methods(Training(background, learned, sensor.without_prior()), sensor):
        errors = _ball_errors(built.reconstruct, scored, sensor.mm_per_pixel)
        row = Row("sensor", method, name, errors, size, ours=method != "look-up table", seen=seen, note=built.note)
        yield replace(row, parameters=built.parameters), partial(built.reconstruct, image[None])
    network = NormalFromMLP.load(folder / "model" / "nnmodel.pth", background)
    peer = peer_frame(network, background, image)
    if peer is not None:
        whole = partial(GsSdkPipeline(network, background).as_output, mm_per_pixel=sensor.mm_per_pixel)
        errors = _ball_errors(whole, scored, sensor.mm_per_pixel)
        note = "its network, trained on these very presses; its steps by its published format"
        yield Row("sensor", GS_SDK, name, errors, size, ours=False, seen=True, note=note), peer


def _sensor_methods(training: Training, sensor: Sensor) -> Iterator[tuple[str, Built, bool]]:
    """Name, method, and whether it has learned from the presses that are scored."""
    fitted = training.calibration
    for mode in MODES:
        yield f"response, {mode}", METHODS[mode].calibrated(fitted), False
    yield "prior that has seen them, precise", shipped_prior(training, sensor), True
    yield "point lights, precise", point_lights(training), False
    yield "look-up table", lookup_table(training), False


def _ball_errors(reconstruct: Reconstruct, presses: Sequence[Press], mm_per_pixel: float) -> Errors:
    with torch.inference_mode():
        found = [(press, reconstruct(press.image[None])) for press in presses]
    scores = [score_press(press, out.depth_mm, out.normal, mm_per_pixel) for press, out in found]
    return {"normal_deg": mean(s.normal_deg for s in scores), "rms_um": mean(s.relief_um for s in scores)}


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
    Column("size", lambda row: size_text(row.size)),
    Column("ms, median (IQR)", lambda row: f"{row.time.ms_median:.2f} ({row.time.ms_iqr:.2f})" if row.time else ""),
    Column("frames/s", lambda row: f"{1000.0 / ms(row):.0f}" if row.time else ""),
    error_column("normals deg", "normal_deg", 3),
    error_column("RMS um", "rms_um", 3),
    error_column("largest px", "largest_px", 3),
    Column("", lambda row: row.note),
)
"""Columns of the table of methods."""


def size_text(size: Size | None) -> str:
    return "" if size is None else f"{size.width}x{size.height}" + (f", batch {size.batch}" if size.batch > 1 else "")


def methods_table(rows: Sequence[Row]) -> str:
    """The table of methods, and the machine."""
    return "\n".join([records.table(rows, COLUMNS), "", f"{machine()}, float32"])
