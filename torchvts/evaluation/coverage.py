"""How often errors lie within the bounds that confidence states: on random exact scenes, and on presses of balls."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..calibration import Press
from ..core.geometry import normal_from_gradient
from ..model import Sensor
from ..pipeline import ConfidentOutput, ConfidentPipeline, bound_at
from ..pipeline.confidence import DEPTH_SPREAD
from .metrics import normal_angle_deg
from .presses import Training
from .random_scenes import random_frame
from .rows import markdown
from .score import Truth, ball_truth
from .sets import from_folder

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
"""Probabilities at which coverage is measured."""


class Coverage(NamedTuple):
    """Shares of pixels whose errors are within their bounds.

    Attributes:
        name: name of the unit or of the press.
        shape: shape that was pressed in.
        normal: (5,), share of the normals at each of :data:`LEVELS`.
        depth: (5,), share of the depths at each of :data:`LEVELS`.
        normal_quartiles: (2, 5), lower and upper quartile over the frames of a mean; of one frame the share itself.
        depth_quartiles: (2, 5), the same of the depths.
    """

    name: str
    shape: str
    normal: Tensor
    depth: Tensor
    normal_quartiles: Tensor
    depth_quartiles: Tensor


def coverage(out: ConfidentOutput, truth: Truth, spread: float, name: str = "", shape: str = "") -> Coverage:
    """Shares of the pixels of a region whose errors are within their bounds; ``spread`` is that of :class:`Confidence`.

    Raises:
        ValueError: an empty region.
    """
    if not bool(truth.region.any()):
        raise ValueError("region: expected at least one pixel, got none: no contact was found")
    normal = normal_from_gradient(truth.gradient)
    angle = normal_angle_deg(out.normal.to(normal.dtype), normal)[:, None]
    error = (out.depth_mm - truth.depth_mm).abs()
    of_normal = [(angle <= bound_at(out.normal_95_deg, level, spread))[truth.region].double().mean() for level in LEVELS]
    of_depth = [(error <= bound_at(out.depth_95_mm, level, DEPTH_SPREAD))[truth.region].double().mean() for level in LEVELS]
    shares = torch.stack(of_normal), torch.stack(of_depth)
    return Coverage(name, shape, *shares, *(share.expand(2, -1) for share in shares))


def of_scenes(seeds: Sequence[int], unit: str | None = None, progress: bool = False) -> list[Coverage]:
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
) -> list[Coverage]:
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


def of_press(out: ConfidentOutput, press: Press, mm_per_pixel: float, spread: float) -> Coverage:
    """Coverage of one labelled press inside its contact; of the depth only the relief is compared."""
    ball = ball_truth(press, out.depth_mm.shape[2], out.depth_mm.shape[3], mm_per_pixel)
    offset = (out.depth_mm - ball.depth_mm)[ball.region].mean()
    return coverage(out, ball._replace(depth_mm=ball.depth_mm + offset), spread, press.name, "ball")


def mean(rows: Sequence[Coverage], name: str = "") -> Coverage:
    """Mean and quartiles over frames.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("rows: expected at least one frame, got none")
    frames = [torch.stack([row.normal for row in rows]), torch.stack([row.depth for row in rows])]
    quartiles = [shares.quantile(torch.tensor([0.25, 0.75], dtype=shares.dtype), 0) for shares in frames]
    return Coverage(name, "", *(shares.mean(0) for shares in frames), *quartiles)


def to_json(rows: Sequence[Coverage]) -> str:
    """Rows as a JSON list, one object each."""
    return json.dumps([{k: v.tolist() if isinstance(v, Tensor) else v for k, v in row._asdict().items()} for row in rows], indent=1)


def from_json(text: str) -> list[Coverage]:
    """The rows that :func:`to_json` wrote."""
    rows, names = json.loads(text), Coverage._fields[2:]
    return [Coverage(r["name"], r["shape"], *(torch.tensor(r[name], dtype=torch.float64) for name in names)) for r in rows]


def table(rows: Sequence[Coverage]) -> str:
    """Markdown: percent of pixels within the bounds at each level, of normals and then of depths."""
    levels = [f"{level:.0%}" for level in LEVELS]
    titles = ["", *(f"normal {v}" for v in levels), *(f"depth {v}" for v in levels)]
    return markdown(titles, [[row.name, *(f"{100.0 * float(v):.1f}" for v in (*row.normal, *row.depth))] for row in rows])
