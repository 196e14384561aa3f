"""How often errors lie within the bounds that confidence states: on random exact scenes, drawn sensors and real sets."""

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from torchvts.core.geometry import normal_from_gradient
from torchvts.pipeline import ConfidentOutput, ConfidentPipeline, bound_at
from torchvts.pipeline.confidence import DEPTH_SPREAD
from torchvts.scenes import objects as solids
from torchvts.training.balls import Truth

from . import rows as records
from .drawn_sensors import DrawnPress, drawn_sensor
from .metrics import normal_angle_deg
from .random_scenes import random_frame
from .rows import Column, Row, error_column
from .sets import Target, load, truth_of
from .training import Training

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
"""Probabilities at which coverage is measured."""


def coverage(out: ConfidentOutput, truth: Truth, spread: float, name: str = "", shape: str = "", relief: bool = False) -> Row:
    """Percent of the pixels of a region whose errors are within their bounds; ``spread`` is that of :class:`Confidence`.

    Returns:
        A row of unit or press ``name`` and the shape that was pressed in, with the errors "normal 50%", "depth 50%" and so on,
        "deg" (mean angle), "stated" (mean angle that the bounds state over the actual one), "confidence" of the frame, and "sure,
        and wrong": 100 where that is above 80 and fewer than 60 % of the normals lie within their 95 % bounds. ``relief``
        compares depth less its mean.
    Raises:
        ValueError: an empty region.
    """
    region = truth.region
    if not bool(region.any()):
        raise ValueError("region: expected at least one pixel, got none: no contact was found")
    angle = normal_angle_deg(out.normal.double(), normal_from_gradient(truth.gradient.double()))[:, None][region]
    depth = (out.depth_mm - truth.depth_mm)[region]
    depth = (depth - depth.mean() if relief else depth).abs()
    errors: dict[str, float | None] = {"deg": float(angle.mean())}
    bounds = {"normal": (angle, out.normal_95_deg[region], spread), "depth": (depth, out.depth_95_mm[region], DEPTH_SPREAD)}
    for kind, (error, bound, width) in bounds.items():
        for level in LEVELS:
            errors[f"{kind} {level:.0%}"] = 100.0 * float((error <= bound_at(bound, level, width)).double().mean())
    sure = float(out.frame_confidence)
    errors |= {"confidence": 100.0 * sure, "sure, and wrong": 100.0 * float(sure > 0.8 and (errors["normal 95%"] or 0.0) < 60.0)}
    per_bound = math.gamma(1.0 + 0.5 * spread) / math.log(20.0) ** (0.5 * spread)  # the mean of the distribution of bound_at
    errors["stated"] = per_bound * float(bounds["normal"][1].mean()) / float(angle.mean())
    return Row("coverage", shape, name, errors)


def of_scenes(seeds: Sequence[int], unit: str | None = None, progress: bool = False) -> list[Row]:
    """Coverage over the true and the found contact of the :func:`random_frame` of each seed: a row for each with contact."""
    rows = []
    for seed in tqdm(seeds, desc=unit or "scenes", disable=not progress or None, leave=False):
        frame = random_frame(seed, unit)
        pipe = ConfidentPipeline.from_calibration(frame.calibration, frame.mode)
        with torch.inference_mode():
            out = pipe(frame.image)
        if int(out.contact.sum()) >= 20:
            truth = Truth(frame.scene.depth_mm, frame.scene.gradient, out.contact | frame.scene.contact)
            rows.append(coverage(out, truth, pipe.confidence.spread, frame.unit, frame.shape))
    return rows


def mean(rows: Sequence[Row], name: str = "") -> Row:
    """Means over frames, and their quartiles as errors "normal 50%, lower quartile" and so on.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("rows: expected at least one frame, got none")
    errors: dict[str, float | None] = {}
    for key in COLUMNS:
        shares = torch.tensor([row.errors[key] for row in rows], dtype=torch.float64)
        low, high = shares.quantile(torch.tensor([0.25, 0.75], dtype=torch.float64)).tolist()
        errors |= {key: float(shares.mean()), f"{key}, lower quartile": low, f"{key}, upper quartile": high}
    for key in ("confidence", "sure, and wrong"):
        errors[key] = sum(row.errors[key] or 0.0 for row in rows) / len(rows)
    degrees = [row.errors["deg"] or 0.0 for row in rows]
    errors["deg"] = sum(degrees) / len(rows)
    # of sums: a frame that is nearly exact has no meaningful ratio
    errors["stated"] = sum((row.errors["stated"] or 0.0) * deg for row, deg in zip(rows, degrees)) / sum(degrees)
    return Row("coverage", "", name, errors, frames=len(rows))


COLUMNS = tuple(f"{kind} {level:.0%}" for kind in ("normal", "depth") for level in LEVELS)
"""Errors of the rows, and columns of their table."""


def table(rows: Sequence[Row]) -> str:
    """Markdown: percent of pixels within the bounds at each level, of normals and then of depths."""
    return records.table(rows, [Column("", lambda row: row.data), *(error_column(key, key, 1) for key in COLUMNS)])


# ---- drawn sensors and real ones, inside and outside of the range of the presses ------------------------------------------------

RANGES = {"gentle, shallow": (0.35, 0.04), "gentle, deep": (0.35, 0.1), "steep, shallow": (1.0, 0.04), "steep, deep": (1.0, 0.1)}
"""Slope and depth, in shorter sides of the image, of the cones and prisms pressed into drawn sensors. Their balls are presses of
slopes up to about 0.7 and of depths up to 0.06 to 0.08."""


def of_drawn(seed: int, mode: str = "precise") -> list[Row]:
    """Coverage on a drawn sensor that is calibrated by its balls: a row for each object that is no ball, and for balls."""
    unit, draw = drawn_sensor(seed), random.Random(5000 + seed)
    pipe = ConfidentPipeline.from_calibration(Training(unit.background, unit.balls, unit.sensor).calibration, mode)
    wide, high = (n * unit.sensor.mm_per_pixel for n in (unit.sensor.width, unit.sensor.height))
    short = min(wide, high)
    objects = [("balls in range", solids.sphere(radius * short), 0.3 * radius * short) for radius in (0.14, 0.21)]
    objects += [
        ("balls twice as deep", solids.sphere(radius * short), depth * short) for radius, depth in ((0.28, 0.13), (0.35, 0.168))
    ]
    for name, (slope, depth) in RANGES.items():
        objects.append((f"cone, {name}", _cone(slope), depth * short))
        objects.append((f"prism, {name}", solids.prism(slope, 0.3 * short), depth * short))
    rows = []
    for number, (shape, height, depth) in enumerate(objects):
        shift = (draw.uniform(-0.12, 0.12) * wide, draw.uniform(-0.12, 0.12) * high)
        pressed = unit.press(height, solids.pose(draw.uniform(0.0, 360.0), shift, depth), shape, 300 + number)
        rows.append(_row_of(pipe, pressed, shape))
    return rows + [_row_of(pipe, pressed, pressed.name) for pressed in unit.objects]


def _row_of(pipe: ConfidentPipeline, pressed: DrawnPress, shape: str) -> Row:
    with torch.inference_mode():
        out = pipe(pressed.image[None])
    return coverage(out, truth_of(pressed.scene), pipe.confidence.spread, "drawn sensors", shape)


def _cone(slope: float) -> solids.Height:
    return lambda u, v: -slope * torch.sqrt(u * u + v * v + 1e-8)


COUNTS = (0, 1, 2, 3, 5, 8, 12)
"""Presses that real sets are calibrated by; 0 where there is a prior."""

SCORED = 5
"""Presses that are scored of each calibration."""

CAMERAS: dict[str, Callable[[Tensor], Tensor]] = {
    "gamma 0.7": lambda image: image**0.7,
    "gamma 1.5": lambda image: image**1.5,
    "saturation 0.5": lambda image: 0.5 * (image + image.mean(0, keepdim=True)),
    "saturation 0.7": lambda image: 0.7 * image + 0.3 * image.mean(0, keepdim=True),
    "gain 0.6": lambda image: 0.6 * image,
    "gain 2.5": lambda image: (2.5 * image).clamp(0.0, 1.0),
    "R and B swapped": lambda image: image[[2, 1, 0]],
    "no R": lambda image: image * torch.tensor([0.0, 1.0, 1.0]).reshape(3, 1, 1),
}
"""Cameras that are not as at calibration; two frames by five presses, or by the prior, are seen by each."""


def of_set(name: str, data: Path, mode: str = "precise") -> list[Row]:
    """Coverage on a real set that is calibrated by a few of its presses, drawn at random, without labels: without a prior, and with
    one that has not seen the presses that are scored."""
    loaded, draw, rows = load(name, data), random.Random(7), []
    learned = {press.name: press for fold in loaded.folds for press in fold.learned}
    by_prior = {id(fold.sensor.prior): fold.sensor for fold in loaded.folds}
    for sensor in [loaded.folds[0].sensor.without_prior(), *(one for one in by_prior.values() if one.prior is not None)]:
        folds = [fold for fold in loaded.folds if sensor.prior is None or fold.sensor.prior is sensor.prior]
        names = sorted({press.name for fold in folds for press in fold.learned})
        targets = [t for fold in folds for t in fold.scored if t.truth is not None and bool(t.truth.region.any())]
        for count in COUNTS:
            if count > max(0, len(names) - 2) or (count == 0 and sensor.prior is None):
                continue
            some = draw.sample(names, count)
            unit = Training(loaded.background, [learned[one] for one in some], sensor).calibration
            pipe = ConfidentPipeline.from_calibration(unit, mode)
            rest = [target for target in targets if target.name not in some]
            rest = draw.sample(rest, min(SCORED, len(rest)))
            title = f"{count} presses{', prior' if sensor.prior is not None else ''}"
            rows += [_row_of_target(pipe, target, target.image, name, title) for target in rest]
            if count in (0, 5):
                seen = [(target, kind, change(target.image)) for kind, change in CAMERAS.items() for target in rest[:2]]
                rows += [_row_of_target(pipe, target, image, "another camera", kind) for target, kind, image in seen]
    return rows


def _row_of_target(pipe: ConfidentPipeline, target: Target, image: Tensor, title: str, shape: str) -> Row:
    assert target.truth is not None
    with torch.inference_mode():
        out = pipe(image[None])
    return coverage(out, target.truth, pipe.confidence.spread, title, shape, relief=target.ball is not None)


def range_table(rows: Sequence[Row]) -> str:
    """Markdown: a row for each unit and shape, means over frames."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.data, row.method), []).append(row)
    columns = [Column("", lambda row: row.data), Column("object", lambda row: row.method), error_column("deg", "deg", 2)]
    columns += [error_column(f"{kind}s within 95 %", f"{kind} 95%", 1) for kind in ("normal", "depth")]
    means = [replace(mean(some, data), method=shape) for (data, shape), some in groups.items()]
    columns += [error_column("stated / actual", "stated", 2)]
    columns += [error_column("confidence %", "confidence", 0), error_column("sure and wrong, % of frames", "sure, and wrong", 1)]
    return records.table(means, columns)
