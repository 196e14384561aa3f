"""Where each method breaks: methods are measured at every severity of the gallery's corruptions, until a limit is exceeded."""

import json
import math
import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any, Literal

import torch

from torchvts.core.tables import markdown

from .gallery import CORRUPTIONS, Case, Corruption
from .methods import METHODS
from .metrics import depth_error, mask_iou, normal_angle_deg
from .rows import Row

SWEPT = (
    "flat", "fast", "precise", "precise, shadows", "fast, zero border", "precise, plain inverse", "precise, blur 1 px",
    "precise, discontinuities", "precise, pinhole",
)  # fmt: skip
"""Names of the methods that are measured."""

NORMAL_LIMIT_DEG = 3.0
DEPTH_LIMIT = 0.05
LEAST_PRESS_MM = 0.1
MASK_LIMIT = 0.5
LIMITS = (
    f"A method breaks where, in the true contact, its mean normal error exceeds {NORMAL_LIMIT_DEG:g} degrees, or its RMS depth "
    f"error exceeds {DEPTH_LIMIT:.0%} of the press (of {LEAST_PRESS_MM:g} mm for a smaller press), or where it raises an error; "
    f"the contact mask breaks where its overlap with the true one (IoU) is below {MASK_LIMIT:g}. Without contact "
    "the whole image counts."
)
"""The limits as a sentence."""

MASK = "contact mask"
"""Stands among the methods in lists of breaking points: the mask is scored by itself, on the rows of "fast"."""

WORST = 10.0
"""Largest error in units of its limit; a method that raises an error has it. So one seed cannot outweigh all others."""

TOLERANCE = 0.15
"""Share of the interval between two severities by which a breaking point may move before a test reports it."""

ON_PAGE = ("fast", MASK, "precise")
"""Methods that have a column on the page."""

CLEARLY = 0.05
"""Share of all severities by which an option must hold longer to be named on the page."""

At = float | Literal["never", "always"]


@dataclass(frozen=True)
class Breaking:
    """Where a method breaks under a corruption.

    Attributes:
        method: name.
        corruption: name.
        unit: of the severity.
        at: severity, by linear interpolation; "never" if no severity breaks it, "always" if the first one does.
        tolerance: how far ``at`` may move.
        between: the last severity before the break and the first after it; for "never" the last severity, for "always" the first.
        held: share of the severities before the break, counted as evenly spaced.
        note: the first error or warning under this corruption.
    """

    method: str
    corruption: str
    unit: str
    at: At
    tolerance: float
    between: tuple[float, ...]
    held: float
    note: str = ""

    @property
    def text(self) -> str:
        """``at`` as text."""
        return self.at if isinstance(self.at, str) else f"{self.at:.3g}"


def depth_share(row: Row) -> float | None:
    """RMS depth error relative to the press; None where the method failed."""
    rms_um, press_um = row.error("rms_um"), row.error("press_um")
    return None if rms_um is None or press_um is None else rms_um / max(press_um, 1000.0 * LEAST_PRESS_MM)


def limits(row: Row) -> float:
    """The larger error in units of its limit, at most :data:`WORST`; above 1 the method is broken."""
    share, normal_deg = depth_share(row), row.error("normal_deg")
    if share is None or normal_deg is None:
        return WORST
    return min(WORST, max(normal_deg / NORMAL_LIMIT_DEG, share / DEPTH_LIMIT))


def mask_limits(row: Row) -> float:
    """What the mask misses in units of its limit."""
    iou = row.error("iou")
    return WORST if iou is None else (1.0 - iou) / (1.0 - MASK_LIMIT)


def measure(method: str, corruption: str, severity: float, seed: int, case: Case) -> Row:
    """Measure a method on a case; an error that the method raises is its result.

    Errors of the row are those inside the true contact, or over the whole image where there is none: "normal_deg" (mean angle
    between normals), "rms_um" and "largest_px" (depth), "iou" (mask), "press_um" (true depth of the press).

    Example:
        >>> from lab.gallery import undisturbed
        >>> round(measure("fast", "noise", 0.002, 0, undisturbed()).error("normal_deg"), 1)
        0.6
    """
    truth = case.truth
    region = truth.contact if bool(truth.contact.any()) else torch.ones_like(truth.contact)
    errors: dict[str, float | None] = {"press_um": 1000.0 * float(truth.depth_mm.max())}
    parameters = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with torch.no_grad():
                built = METHODS[method].calibrated(case.calibration)
                parameters = built.parameters
                found = built.reconstruct(case.image)
        except Exception as failure:
            note = f"{type(failure).__name__}: {failure}"
            return Row("corruption", method, corruption, errors, severity=severity, seed=seed, note=note)
    angle = float(normal_angle_deg(found.normal, truth.normal, region).mean())
    error = depth_error(found.depth_mm, truth.depth_mm, truth.mm_per_pixel, region)
    note = f"{caught[0].category.__name__}: {caught[0].message}" if caught else ""
    if math.isfinite(angle) and math.isfinite(error.rms_mm):
        iou = mask_iou(found.contact, truth.contact)
        errors |= {"normal_deg": angle, "rms_um": 1000.0 * error.rms_mm, "largest_px": error.max_px, "iou": iou}
    else:
        note = "the result is not finite"
    return Row("corruption", method, corruption, errors, parameters=parameters, severity=severity, seed=seed, note=note)


# a sweep over methods, corruptions, severities and seeds


def sweep(
    methods: Sequence[str] = SWEPT,
    corruptions: Sequence[str] = tuple(CORRUPTIONS),
    seeds: int = 3,
    workers: int = 0,
    progress: Callable[[], object] = lambda: None,
) -> list[Row]:
    """Measure every method at every severity of every corruption, by corruption, severity, seed and method.

    ``progress`` is called for each row; without workers this process does the work.
    """
    jobs = [
        ((name, severity, seed), methods)
        for name in corruptions
        for severity in CORRUPTIONS[name].severities
        for seed in range(seeds)
    ]
    found: list[Row] = []
    with _pool(workers) as map_jobs:
        for rows in map_jobs(_measure_all, jobs):
            found += rows
            for _ in rows:
                progress()
    return found


def _measure_all(job: tuple[tuple[str, float, int], Sequence[str]]) -> list[Row]:
    """Some methods on one case, which is made once."""
    (corruption, severity, seed), methods = job
    case = CORRUPTIONS[corruption].make(severity, seed)
    return [measure(method, corruption, severity, seed, case) for method in methods]


@contextmanager
def _pool(workers: int) -> Iterator[Callable[..., Iterable[list[Row]]]]:
    """``map``, over processes of one thread each, or in this process without workers."""
    if workers == 0:
        yield map
        return
    context = multiprocessing.get_context("spawn")  # torch's threads do not survive a fork
    with ProcessPoolExecutor(workers, context, torch.set_num_threads, (1,)) as pool:
        yield pool.map


# breaking points


def breaking_points(rows: Sequence[Row]) -> list[Breaking]:
    """Where each method breaks under each corruption, and where the mask of "fast" does.

    Errors in units of their limits are averaged over seeds, and interpolated linearly between severities.
    """
    found = []
    for corruption in (CORRUPTIONS[name] for name in dict.fromkeys(row.data for row in rows)):
        here = [row for row in rows if row.data == corruption.name]
        for method in dict.fromkeys(row.method for row in here):
            own = [row for row in here if row.method == method]
            found.append(breaking_point(method, corruption, own, limits))
            if method == "fast":
                found.append(breaking_point(MASK, corruption, own, mask_limits))
    return found


def breaking_point(method: str, corruption: Corruption, rows: Sequence[Row], error: Callable[[Row], float]) -> Breaking:
    """Severity where ``error``, in units of its limit, first exceeds 1 in the rows of one method.

    Severities without rows are skipped, so the two around a known breaking point are enough to find it again.
    """
    note = next((row.note for row in rows if row.note), "")
    means = []
    for severity in corruption.severities:
        values = [error(row) for row in rows if row.severity == severity]
        if values:
            means.append((severity, sum(values) / len(values)))
    steps = len(corruption.severities) - 1
    first, last = means[0], means[-1]
    if first[1] > 1.0:
        return Breaking(method, corruption.name, corruption.unit, "always", 0.0, (first[0],), 0.0, note)
    for (good, below), (bad, above) in pairwise(means):
        if above > 1.0:
            part = (1.0 - below) / (above - below)
            held = (corruption.severities.index(good) + part) / steps
            at = good + part * (bad - good)
            return Breaking(method, corruption.name, corruption.unit, at, TOLERANCE * abs(bad - good), (good, bad), held, note)
    return Breaking(method, corruption.name, corruption.unit, "never", 0.0, (last[0],), 1.0, note)


def table(points: Sequence[Breaking]) -> str:
    """Breaking points as a Markdown table: a line for each corruption, a column for each method."""
    methods = list(dict.fromkeys(point.method for point in points))
    lines = []
    for name in dict.fromkeys(point.corruption for point in points):
        cells = {point.method: point.text for point in points if point.corruption == name}
        lines.append([in_words(CORRUPTIONS[name])] + [cells.get(method, "not measured") for method in methods])
    return markdown(["corruption", *methods], lines)


def page_table(points: Sequence[Breaking]) -> str:
    """The same for a page: columns of ``ON_PAGE``, and by name the options of precise that hold clearly longer than it."""
    lines = []
    for name in dict.fromkeys(point.corruption for point in points):
        found = {point.method: point for point in points if point.corruption == name}
        options = [found[method] for method in found if method.startswith("precise, ")]
        longer = [point for point in options if point.held > found["precise"].held + CLEARLY]
        texts = [f"{point.method.removeprefix('precise, ')} {point.text}" for point in longer]
        lines.append([in_words(CORRUPTIONS[name]), *(found[method].text for method in ON_PAGE), "; ".join(texts)])
    return markdown(["corruption", *ON_PAGE, "options that hold longer"], lines)


def in_words(corruption: Corruption) -> str:
    """Name, unit and range of a corruption."""
    return f"{corruption.name}, {corruption.severities[0]:g} to {corruption.severities[-1]:g} {corruption.unit}".rstrip()


def points_to_json(points: Iterable[Breaking], command: str, seeds: int) -> str:
    """Breaking points as one JSON document, one object a line, numbers to six digits."""
    rounded = ({key: float(f"{x:.6g}") if isinstance(x, float) else x for key, x in asdict(point).items()} for point in points)
    lines = ",\n".join("  " + json.dumps(point) for point in rounded)
    head = {"command": command, "limits": LIMITS, "seeds": seeds}
    body = ",\n".join(f" {json.dumps(key)}: {json.dumps(value)}" for key, value in head.items())
    return f'{{\n{body},\n "points": [\n{lines}\n ]\n}}\n'


def points_from_json(text: str) -> tuple[list[Breaking], int]:
    """The breaking points and the number of seeds that :func:`points_to_json` wrote."""
    document: dict[str, Any] = json.loads(text)
    points = [Breaking(**(point | {"between": tuple(point["between"])})) for point in document["points"]]
    return points, int(document["seeds"])


def updated_page(page: str, points: Sequence[Breaking]) -> str:
    """The page with a new table of breaking points after ``<!-- breaking points -->``.

    Raises:
        ValueError: the page has no such line.
    """
    head, mark, rest = page.partition("<!-- breaking points -->\n\n")
    if not mark:
        raise ValueError("page: expected a line <!-- breaking points --> and an empty one after it, got none")
    return head + mark + page_table(points) + rest[rest.index("\n\n") :]
