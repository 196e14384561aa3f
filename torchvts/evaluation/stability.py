"""Where each method breaks: every dial of the gallery turned up, and the severity at which a limit is passed."""

import hashlib
import json
import math
import multiprocessing
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from ..core import __version__
from ..core.files import write_atomically
from ..core.geometry import normal_from_gradient
from ..integration import AdaptiveIntegration, PerspectiveIntegration, PoissonDST
from ..model.calibration import Calibration
from ..normals import NormalFromIntensity
from ..pipeline import DepthOutput, DepthPipeline
from .gallery import DIALS, Case, Dial
from .metrics import depth_error, mask_iou, normal_angle_deg

Method = Callable[[Tensor], DepthOutput]

NORMAL_LIMIT_DEG = 3.0
DEPTH_LIMIT = 0.05
LEAST_PRESS_MM = 0.1
MASK_LIMIT = 0.5
LIMITS = (
    f"A method breaks where, in the true contact, its normals are {NORMAL_LIMIT_DEG:g} degrees off in the mean, or its depth by "
    f"{DEPTH_LIMIT:.0%} of the press (RMS; of {LEAST_PRESS_MM:g} mm where the press is less), or where it raises an error; the "
    f"contact mask breaks where its overlap with the true one (IoU) is below {MASK_LIMIT:g}. Without contact "
    "the whole image counts."
)
"""The limits in words, as they are printed."""

MASK = "contact mask"
"""Stands among the methods where breaking points are told: the mask is judged by itself, on the rows of "fast"."""

WORST = 10.0
"""An error of so many limits is as bad as any: what raises an error has it, and one seed cannot weigh more."""

TOLERANCE = 0.15
"""By how much of the interval between two severities a breaking point may move before a test calls it moved."""

At = float | Literal["never", "always"]


def _flat(calibration: Calibration) -> Method:
    """Nothing is there: what errors are worth."""

    def method(image: Tensor) -> DepthOutput:
        zero = torch.zeros_like(image)
        return DepthOutput(zero[:, :1], zero[:, :2], normal_from_gradient(zero[:, :2]), torch.zeros_like(zero[:, :1]).bool())

    return method


def _plain_inverse(calibration: Calibration) -> Method:
    """Eq. 10 at every pixel: no channel is ever called dark or full."""
    sensor, lights = calibration.sensor, calibration.lights
    if lights is None:
        raise ValueError("calibration: expected one by lights, got response fields")
    size = (sensor.height, sensor.width)
    normals = NormalFromIntensity(lights, *size, sensor.mm_per_pixel, noise_std=torch.zeros(3), inverse=calibration.inverse)
    return DepthPipeline.from_calibration(calibration, "precise", normals=normals)


def _blurred(calibration: Calibration) -> Method:
    """Images blurred by a pixel before anything is made of them, as ``Sensor(blur_px=1)`` asks for."""
    blurred = replace(calibration, sensor=replace(calibration.sensor, blur_px=1.0))
    return DepthPipeline.from_calibration(blurred, "precise")


def _pinhole(calibration: Calibration) -> Method:
    """Normals and integral of a pinhole camera, where the calibration's report tells how high it stands; else as precise."""
    height_mm = calibration.report.get("camera_height_mm", math.inf)
    if math.isinf(height_mm):
        return DepthPipeline.from_calibration(calibration, "precise")
    normals = NormalFromIntensity.from_calibration(calibration, height_mm)
    integrate = PerspectiveIntegration(calibration.sensor.mm_per_pixel, height_mm)
    return DepthPipeline.from_calibration(calibration, "precise", normals=normals, integrate=integrate)


METHODS: dict[str, Callable[[Calibration], Method]] = {
    "flat": _flat,
    "fast": lambda c: DepthPipeline.from_calibration(c, "fast"),
    "precise": lambda c: DepthPipeline.from_calibration(c, "precise"),
    "auto": lambda c: DepthPipeline.from_calibration(c, "auto"),
    "fast, zero border": lambda c: DepthPipeline.from_calibration(c, "fast", integrate=PoissonDST(c.sensor.mm_per_pixel)),
    "precise, plain inverse": _plain_inverse,
    "precise, blur 1 px": _blurred,
    "precise, cliffs": lambda c: DepthPipeline.from_calibration(c, "precise", integrate=AdaptiveIntegration(c.sensor.mm_per_pixel)),
    "precise, pinhole": _pinhole,
}
"""Every method by name: from a calibration to what reconstructs an image."""


@dataclass(frozen=True)
class Row:
    """One method on one case; the errors are None where it failed, and ``note`` says how.

    Attributes:
        method, dial, severity, seed: what was measured.
        normal_deg: mean angle between normals. rms_um: of depth. press_um: true peak. largest_px: largest error of depth. iou: of
            the mask. All in the true contact, in the whole image where there is none.
        warned: whether the method, or what made it, warned. note: the error or warning.
    """

    method: str
    dial: str
    severity: float
    seed: int
    normal_deg: float | None
    rms_um: float | None
    press_um: float
    largest_px: float | None
    iou: float | None
    warned: bool = False
    note: str = ""

    @property
    def depth_share(self) -> float | None:
        """RMS of depth, relative to the press."""
        return None if self.rms_um is None else self.rms_um / max(self.press_um, 1000.0 * LEAST_PRESS_MM)

    @property
    def limits(self) -> float:
        """The larger error in units of its limit, at most :data:`WORST`; above 1 is broken."""
        share = self.depth_share
        if share is None or self.normal_deg is None:
            return WORST
        return min(WORST, max(self.normal_deg / NORMAL_LIMIT_DEG, share / DEPTH_LIMIT))

    @property
    def mask_limits(self) -> float:
        """What the mask misses in units of its limit."""
        return WORST if self.iou is None else (1.0 - self.iou) / (1.0 - MASK_LIMIT)


@dataclass(frozen=True)
class Breaking:
    """Where a method breaks on a dial.

    Attributes:
        at: severity, by linear interpolation; "never" on the whole dial, or "always". tolerance: how far ``at`` may move.
        between: the last severity that holds and the first that does not; of "never" the last of the dial, of "always" the first.
        held: part of the dial before the break, its severities counted as evenly spaced.
        note: the first error or warning on this dial, if there was any.
    """

    method: str
    dial: str
    unit: str
    at: At
    tolerance: float
    between: tuple[float, ...]
    held: float
    note: str = ""


def measure(method: str, dial: str, severity: float, seed: int, case: Case) -> Row:
    """One row: an error that a method raises is its result, not the end.

    Example:
        >>> from torchvts.evaluation.gallery import undisturbed
        >>> round(measure("fast", "noise", 0.002, 0, undisturbed()).normal_deg, 1)
        0.6
    """
    truth = case.truth
    region = truth.contact if bool(truth.contact.any()) else torch.ones_like(truth.contact)
    press_um = 1000.0 * float(truth.depth_mm.max())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with torch.no_grad():
                found = METHODS[method](case.calibration)(case.image)
        except Exception as failure:
            note = f"{type(failure).__name__}: {failure}"
            return Row(method, dial, severity, seed, None, None, press_um, None, None, bool(caught), note)
    note = f"{caught[0].category.__name__}: {caught[0].message}" if caught else ""
    angle = float(normal_angle_deg(found.normal, truth.normal, region).mean())
    error = depth_error(found.depth_mm, truth.depth_mm, truth.mm_per_pixel, region)
    if not (math.isfinite(angle) and math.isfinite(error.rms_mm)):
        return Row(method, dial, severity, seed, None, None, press_um, None, None, bool(caught), "the result is not finite")
    iou = mask_iou(found.contact, truth.contact)
    return Row(method, dial, severity, seed, angle, 1000.0 * error.rms_mm, press_um, error.max_px, iou, bool(caught), note)


def sweep(
    path: str | Path,
    methods: Sequence[str] = tuple(METHODS),
    dials: Sequence[str] = tuple(DIALS),
    seeds: int = 3,
    workers: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> list[Row]:
    """Measure every method on every dial, and keep each row in a file of JSON lines, from which a later call goes on.

    The first line of the file tells of which state of this package the rows are; rows of another state are refused.

    Args:
        path: the file, made if missing. methods, dials: names. seeds: 0 up to this are measured.
        workers: processes; 0 for none beside this one. progress: called for each row.
    Returns:
        The rows asked for, by dial, severity, seed and method.
    Raises:
        ValueError: an unknown name, or a file of another state of the package, or that is none of this function's.
    """
    path = Path(path)
    for name, values, known in (("methods", methods, METHODS), ("dials", dials, DIALS)):
        if unknown := [value for value in values if value not in known]:
            raise ValueError(f"{name}: expected some of {', '.join(known)}, got {unknown[0]!r}")
    kept = _read(path)
    asked = [(dial, severity, seed) for dial in dials for severity in DIALS[dial].severities for seed in range(seeds)]
    jobs = [(place, [method for method in methods if (method, *place) not in kept]) for place in asked]
    for _ in range(len(asked) * len(methods) - sum(len(missing) for _, missing in jobs)):
        progress()
    jobs = [job for job in jobs if job[1]]
    with path.open("a", encoding="utf-8") as stream, _pool(workers) as map_jobs:
        for rows in map_jobs(_measure_all, jobs):
            stream.write("".join(json.dumps(asdict(row)) + "\n" for row in rows))
            stream.flush()
            for row in rows:
                kept[row.method, row.dial, row.severity, row.seed] = row
                progress()
    return [kept[(method, *place)] for place in asked for method in methods]


def _measure_all(job: tuple[tuple[str, float, int], list[str]]) -> list[Row]:
    """Some methods on one case, which is made once."""
    (dial, severity, seed), methods = job
    case = DIALS[dial].make(severity, seed)
    return [measure(method, dial, severity, seed, case) for method in methods]


@contextmanager
def _pool(workers: int) -> Iterator[Callable[..., Iterable[list[Row]]]]:
    """``map``, over processes of one thread each, or in this one if there are to be none."""
    if workers == 0:
        yield map
        return
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(workers, context, torch.set_num_threads, (1,)) as pool:
        yield pool.map


def fingerprint() -> str:
    """Of the package's sources: rows of another state must not be mixed with new ones."""
    digest = hashlib.sha256(f"{__version__} {torch.__version__}".encode())
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def _read(path: Path) -> dict[tuple[str, str, float, int], Row]:
    """What a file holds, by what was measured; a line that was cut when a run was killed is taken out of it."""
    head = json.dumps({"stability": fingerprint()}) + "\n"
    if not path.is_file() or path.stat().st_size == 0:
        with write_atomically(path) as temporary:
            temporary.write_text(head, encoding="utf-8")
        return {}
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    lines = whole.splitlines(keepends=True)
    if not lines or lines[0] != head:
        what = "of another state of this package" if lines and lines[0].startswith('{"stability"') else "not a file of rows"
        raise ValueError(f"{path}: {what}: give another file, or remove it to begin anew")
    if len(whole) < len(text):
        with path.open("r+", encoding="utf-8") as stream:
            stream.truncate(len(whole.encode()))
            os.fsync(stream.fileno())
    rows = [Row(**json.loads(line)) for line in lines[1:]]
    return {(row.method, row.dial, row.severity, row.seed): row for row in rows}


def breaking_points(rows: Sequence[Row]) -> list[Breaking]:
    """Where each method breaks on each dial, and where the mask does, which is judged on the rows of "fast".

    Errors in units of their limits are averaged over seeds; between two severities they are taken as linear.
    """
    found = []
    for dial in (DIALS[name] for name in dict.fromkeys(row.dial for row in rows)):
        here = [row for row in rows if row.dial == dial.name]
        for method in dict.fromkeys(row.method for row in here):
            own = [row for row in here if row.method == method]
            found.append(breaking_point(method, dial, own, lambda row: row.limits))
            if method == "fast":
                found.append(breaking_point(MASK, dial, own, lambda row: row.mask_limits))
    return found


def breaking_point(method: str, dial: Dial, rows: Sequence[Row], error: Callable[[Row], float]) -> Breaking:
    """Of one method's rows on one dial, where ``error``, in units of its limit, first passes 1.

    Severities without rows are passed over, so two around a kept breaking point are enough to find it again.
    """
    note = next((row.note for row in rows if row.note), "")
    means = []
    for severity in dial.severities:
        values = [error(row) for row in rows if row.severity == severity]
        if values:
            means.append((severity, sum(values) / len(values)))
    steps = len(dial.severities) - 1
    first, last = means[0], means[-1]
    if first[1] > 1.0:
        return Breaking(method, dial.name, dial.unit, "always", 0.0, (first[0],), 0.0, note)
    for (good, below), (bad, above) in pairwise(means):
        if above > 1.0:
            part = (1.0 - below) / (above - below)
            held = (dial.severities.index(good) + part) / steps
            at = good + part * (bad - good)
            return Breaking(method, dial.name, dial.unit, at, TOLERANCE * abs(bad - good), (good, bad), held, note)
    return Breaking(method, dial.name, dial.unit, "never", 0.0, (last[0],), 1.0, note)


def table(points: Sequence[Breaking]) -> str:
    """Breaking points as a Markdown table: a line for each dial, a column for each method."""
    methods = list(dict.fromkeys(point.method for point in points))
    lines = ["| dial | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
    for dial in dict.fromkeys(point.dial for point in points):
        cells = {point.method: point for point in points if point.dial == dial}
        texts = [_told(cells[method]) if method in cells else "not measured" for method in methods]
        lines.append(f"| {in_words(DIALS[dial])} | " + " | ".join(texts) + " |")
    return "\n".join(lines)


def row_table(rows: Sequence[Row]) -> str:
    """Rows as a Markdown table, seeds averaged; a method that failed keeps its note."""
    lines = ["| dial | severity | method | normals deg | depth RMS um | largest px | IoU | limits | |", "|---" * 9 + "|"]
    groups: dict[tuple[str, float, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.dial, row.severity, row.method), []).append(row)
    for (dial, severity, method), group in groups.items():
        good = [row for row in group if row.normal_deg is not None]
        figures = [
            f"{sum(float(getattr(row, name)) for row in good) / len(good):.{digits}f}" if good else "failed"
            for name, digits in (("normal_deg", 2), ("rms_um", 1), ("largest_px", 2), ("iou", 2))
        ]
        limits = f"{sum(row.limits for row in group) / len(group):.2f}"
        note = next((row.note for row in group if row.note), "")
        failed = len(group) - len(good)
        note = f"{failed} of {len(group)} failed: {note}" if failed else note
        lines.append(f"| {dial} | {severity:g} | {method} | {' | '.join(figures)} | {limits} | {note} |")
    return "\n".join(lines)


def in_words(dial: Dial) -> str:
    """Name, unit and range of a dial."""
    return f"{dial.name}, {dial.severities[0]:g} to {dial.severities[-1]:g} {dial.unit}".rstrip()


def _told(point: Breaking) -> str:
    return point.at if isinstance(point.at, str) else f"{point.at:.3g}"


def to_json(points: Iterable[Breaking], command: str, seeds: int) -> str:
    """Breaking points as one JSON document, one object a line."""
    lines = ",\n".join("  " + json.dumps(asdict(point)) for point in points)
    head = {"command": command, "limits": LIMITS, "seeds": seeds}
    body = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
    return f'{{\n{body},\n "points": [\n{lines}\n ]\n}}\n'


def from_json(text: str) -> tuple[list[Breaking], int]:
    """What :func:`to_json` wrote: breaking points and seeds."""
    document: dict[str, Any] = json.loads(text)
    points = [Breaking(**(point | {"between": tuple(point["between"])})) for point in document["points"]]
    return points, int(document["seeds"])


def told_in(page: str, points: Sequence[Breaking]) -> str:
    """A page whose lines after ``<!-- dial: name -->`` tell where the methods break on that dial, "flat" left out.

    Raises:
        ValueError: the page names a dial that does not exist or was not measured.
    """
    lines = page.split("\n")
    for k, line in enumerate(lines):
        if line.startswith("<!-- dial: ") and line.endswith(" -->"):
            name = line[len("<!-- dial: ") : -len(" -->")]
            here = [point for point in points if point.dial == name and point.method != "flat"]
            if not here:
                raise ValueError(f"page: {line}: no such dial was measured")
            lines[k + 1] = _sentence(here)
    return "\n".join(lines)


def _sentence(points: Sequence[Breaking]) -> str:
    groups: dict[str, list[str]] = {}
    for point in sorted(points, key=lambda point: point.held):
        groups.setdefault(_told(point), []).append(f"*{point.method}*")
    unit = f" {points[0].unit}" if points[0].unit else ""
    told = [f"broken from the start: {', '.join(groups.pop('always'))}"] if "always" in groups else []
    holding = groups.pop("never", [])
    told += [f"breaks at {at}{unit}: {', '.join(names)}" for at, names in groups.items()]
    told += [f"holds to the end: {', '.join(holding)}"] if holding else []
    text = "; ".join(told)
    return text[:1].upper() + text[1:] + "."
