"""How often errors lie within the bounds that confidence states: on random exact scenes, and on presses of balls."""

from collections.abc import Sequence
from pathlib import Path

import torch
from tqdm import tqdm

from ..calibration import Press
from ..core.geometry import normal_from_gradient
from ..model import Sensor
from ..pipeline import ConfidentOutput, ConfidentPipeline, bound_at
from ..pipeline.confidence import DEPTH_SPREAD
from . import rows as records
from .metrics import normal_angle_deg
from .presses import Training
from .random_scenes import random_frame
from .rows import Column, Row, error_column
from .score import Truth, ball_truth
from .sets import from_folder

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
"""Probabilities at which coverage is measured."""


def coverage(out: ConfidentOutput, truth: Truth, spread: float, name: str = "", shape: str = "") -> Row:
    """Percent of the pixels of a region whose errors are within their bounds; ``spread`` is that of :class:`Confidence`.

    Returns:
        A row of unit or press ``name`` and the shape that was pressed in, with the errors "normal 50%", "depth 50%" and so on.
    Raises:
        ValueError: an empty region.
    """
    if not bool(truth.region.any()):
        raise ValueError("region: expected at least one pixel, got none: no contact was found")
    normal = normal_from_gradient(truth.gradient)
    angle = normal_angle_deg(out.normal.to(normal.dtype), normal)[:, None]
    kinds = {
        "normal": (angle, out.normal_95_deg, spread),
        "depth": ((out.depth_mm - truth.depth_mm).abs(), out.depth_95_mm, DEPTH_SPREAD),
    }
    errors: dict[str, float | None] = {}
    for kind, (error, bound, width) in kinds.items():
        for level in LEVELS:
            within = (error <= bound_at(bound, level, width))[truth.region]
            errors[f"{kind} {level:.0%}"] = 100.0 * float(within.double().mean())
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


def of_presses(
    folder: str | Path, sensor: Sensor, *, learn: bool = True, mode: str = "precise", progress: bool = False
) -> list[Row]:
    """Coverage inside the contact of presses that the calibration has not seen.

    Labels give the place of a ball, not its depth, so only the relief is compared: depth and ball each less their own mean.

    Args:
        folder: presses in gs_sdk's layout, with labels.
        sensor: the sensor; its prior is used if it has one.
        learn: calibrate by the presses of the other folds; else by the background and the prior.
        mode: "fast", "precise" or "auto".
        progress: show a bar.
    Raises:
        ValueError: no press can be scored.
    """
    data, rows = from_folder(folder, sensor), []
    for fold in tqdm(data.folds, desc="presses", disable=not progress or None, leave=False):
        unit = Training(data.background, fold.learned if learn else (), sensor).calibration
        pipe = ConfidentPipeline.from_calibration(unit, mode)
        for target in fold.scored:
            if target.ball is not None:
                rows.append(of_press(pipe(target.image[None]), target.ball, sensor.mm_per_pixel, pipe.confidence.spread))
    return rows


def of_press(out: ConfidentOutput, press: Press, mm_per_pixel: float, spread: float) -> Row:
    """Coverage of one labelled press inside its contact; of the depth only the relief is compared."""
    ball = ball_truth(press, out.depth_mm.shape[2], out.depth_mm.shape[3], mm_per_pixel)
    offset = (out.depth_mm - ball.depth_mm)[ball.region].mean()
    return coverage(out, ball._replace(depth_mm=ball.depth_mm + offset), spread, press.name, "ball")


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
    return Row("coverage", "", name, errors, frames=len(rows))


COLUMNS = tuple(f"{kind} {level:.0%}" for kind in ("normal", "depth") for level in LEVELS)
"""Errors of the rows, and columns of their table."""


def table(rows: Sequence[Row]) -> str:
    """Markdown: percent of pixels within the bounds at each level, of normals and then of depths."""
    return records.table(rows, [Column("", lambda row: row.data), *(error_column(key, key, 1) for key in COLUMNS)])
