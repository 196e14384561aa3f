"""Cross-validation of methods on presses of balls of known size.

Methods learn from presses without their labels: calibration by response fields finds the balls itself, and the look-up table and
the network learn from the balls that it found. All share one contact mask and one integrator.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..calibration import Press, read_presses
from ..core.checks import check_image, check_integer
from ..model import Sensor
from ..pipeline import DepthOutput
from . import rows as records
from .methods import METHODS, Built, Method, given_network, network
from .presses import Training
from .rows import Column, Row, error_column, mean, median
from .score import PressScore, label, score_press

GIVEN_NETWORK = "given network"
"""Name of the network that was trained before."""

COMPARED = tuple(name for name, method in METHODS.items() if method.from_presses is not None)
"""Names of the methods that presses can score."""

COLUMNS = (
    Column("method", lambda row: row.method),
    Column("parameters", lambda row: str(row.parameters)),
    error_column("normal deg", "normal_deg", 2),
    error_column("relief um", "relief_um", 1),
    error_column("of it tilt", "tilt_um", 1),
    error_column("radius %", "radius_percent", 1, "none"),
    error_column("center px", "center_px", 2, "none"),
    error_column("apex um", "apex_um", 0, "none"),
    Column("worst press", lambda row: f"{row.worst} ({row.errors['worst_deg']:.1f} deg)"),
    Column("note", lambda row: row.note),
)
"""Columns of :func:`table`."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of methods on a folder.

    Attributes:
        rows: one row per method: means over presses, medians for the fitted sphere, the mean absolute error of the apex.
        scores: one score per method and press.
        not_scored: names of the presses without a contact radius.
        how: what was held out, and the source of the true centres.
        shown: the press of ``outputs``.
        outputs: result of each method on that press.
        mm_per_pixel: pixel pitch, mm.
    """

    rows: list[Row]
    scores: list[PressScore]
    not_scored: list[str]
    how: str
    shown: Press
    outputs: dict[str, DepthOutput]
    mm_per_pixel: float

    def of(self, method: str) -> list[PressScore]:
        """Scores of one method."""
        return [score for score in self.scores if score.method == method]


class _Data(NamedTuple):
    """Presses to learn from and presses to score."""

    background: Tensor
    presses: list[Press]
    scored_background: Tensor
    scored: list[Press]


class _Fold(NamedTuple):
    """Presses to learn from, and the presses that they score."""

    training: Training
    held_out: list[Press]


def evaluate(
    folder: str | Path,
    sensor: Sensor,
    methods: Sequence[str] = (),
    *,
    folds: int = 5,
    test: str | Path | None = None,
    network_path: str | Path | None = None,
    limit: int | None = None,
    seed: int = 0,
    progress: bool = False,
) -> Evaluation:
    """Score methods on a folder of ball presses.

    Cross-validation: press i is in fold i % folds, and is scored by what was learned from the presses of the other folds.

    Args:
        folder: presses in gs_sdk's layout.
        sensor: the sensor.
        methods: names out of :data:`COMPARED`; empty for all that are possible.
        folds: parts of the cross-validation; with 1 the presses that were learned from are scored.
        test: a second folder, to be scored by what all presses of the first taught; there is no cross-validation then.
        network_path: file of a trained network that is to be scored too.
        limit: use only so many presses, spread over the catalog.
        seed: seed of the network that is trained.
        progress: show a bar.
    Returns:
        The scores.
    Raises:
        ValueError: unknown method, a prior that the sensor does not have, too few presses, or none that can be scored.
        FileNotFoundError: no such folder or file.
    """
    chosen = _choose(methods, sensor, network_path, seed)
    check_integer("folds", folds, 1)
    data = _read(folder, test, limit)
    if test is None and folds > len(data.presses):
        raise ValueError(f"folds: expected at most the number of presses, {len(data.presses)}, got {folds}")
    for image in (data.background, data.scored_background):
        check_image("background", image, sensor.height, sensor.width, sensor.name)
    whole = Training(data.background, data.presses, sensor)
    truth, source = _with_truth(data.scored, whole if test is None else Training(data.scored_background, data.scored, sensor))
    if not truth:
        raise ValueError(f"folder: none of {len(data.scored)} presses has a contact radius: nothing can be scored")
    parts, split = _split(data, whole, 0 if test is not None else folds)
    run = _Run(truth, _nearest_to_median(list(truth.values()), sensor), data.scored_background, sensor)
    with tqdm(total=len(parts) * len(chosen), desc="evaluating", disable=not progress, leave=False) as bar:
        for part in parts:
            for method in chosen:
                bar.set_postfix(method=method.name)
                run.score(part, method)
                bar.update()
    order = list(truth)
    scores = [s for m in chosen for s in sorted(run.scores[m.name], key=lambda score: order.index(score.press))]
    how = f"{split}, learned without labels; scored by {source}"
    return Evaluation(
        [_row(m.name, Path(test or folder).name, run.built[m.name], [s for s in scores if s.method == m.name]) for m in chosen],
        scores,
        [press.name for press in data.scored if press.name not in truth],
        how,
        run.shown,
        run.outputs,
        sensor.mm_per_pixel,
    )


class _Run:
    """Builds methods, and keeps their scores and what they make of the shown press."""

    def __init__(self, truth: dict[str, Press], shown: Press, background: Tensor, sensor: Sensor) -> None:
        self.truth, self.shown, self.background, self.sensor = truth, shown, background, sensor
        self.built: dict[str, list[Built]] = {}
        self.scores: dict[str, list[PressScore]] = {}
        self.outputs: dict[str, DepthOutput] = {}

    def score(self, fold: _Fold, method: Method) -> None:
        """Build a method from a fold and score it on the presses that were held out."""
        built, scores = self.built.setdefault(method.name, []), self.scores.setdefault(method.name, [])
        assert method.from_presses is not None
        built.append(built[0] if built and not method.learns else method.from_presses(fold.training, self.background, self.sensor))
        for press in fold.held_out:
            if press.name not in self.truth:
                continue
            with torch.inference_mode():
                out = built[-1].reconstruct(press.image[None])
            scores.append(score_press(self.truth[press.name], out.depth_mm, out.normal, self.sensor.mm_per_pixel, method.name))
            if press.name == self.shown.name:
                self.outputs[method.name] = out


def _choose(methods: Sequence[str], sensor: Sensor, network_path: str | Path | None, seed: int) -> list[Method]:
    for name in methods:
        if name not in COMPARED:
            raise ValueError(f"methods: expected some of {', '.join(repr(m) for m in COMPARED)}, got {name!r}")
        if METHODS[name].needs_prior and sensor.prior is None:
            raise ValueError(f"methods: {name!r} needs a prior, sensor '{sensor.name}' has none: scripts/fit_prior.py fits one")
    possible = [METHODS[name] for name in methods or COMPARED if sensor.prior is not None or not METHODS[name].needs_prior]
    seeded = partial(network, seed=seed)
    chosen = [dataclasses.replace(m, from_presses=seeded) if m.name == "MLP" else m for m in possible]
    if network_path is not None:
        chosen.append(Method(GIVEN_NETWORK, from_presses=partial(given_network, path=network_path), learns=False))
    return chosen


def _read(folder: str | Path, test: str | Path | None, limit: int | None) -> _Data:
    background, presses = read_presses(folder)
    if limit is not None:
        presses = _spread(presses, check_integer("limit", limit, 1))
    if test is None:
        return _Data(background, presses, background, presses)
    scored_background, scored = read_presses(test)
    return _Data(background, presses, scored_background, scored if limit is None else _spread(scored, limit))


def _spread(presses: list[Press], limit: int) -> list[Press]:
    """``limit`` presses at equal steps of the catalog, which lists one ball after the other."""
    count = min(limit, len(presses))
    return [presses[k * len(presses) // count] for k in range(count)]


def _split(data: _Data, whole: Training, folds: int) -> tuple[list[_Fold], str]:
    """The folds, and the same in words; 0 folds for presses of a second folder."""
    count = len(data.presses)
    if folds == 0:
        return [_Fold(whole, data.scored)], f"{count} presses learned from"
    if folds == 1:
        return [_Fold(whole, data.scored)], f"all {count} presses learned from and scored"
    parts = []
    for fold in range(folds):
        others = [press for i, press in enumerate(data.presses) if i % folds != fold]
        parts.append(_Fold(Training(data.background, others, whole.sensor), data.presses[fold::folds]))
    return parts, f"{folds}-fold cross-validation over {count} presses"


def _with_truth(presses: list[Press], training: Training) -> tuple[dict[str, Press], str]:
    """Presses that can be scored, by name: labelled ones, and without a label those that ``calibrate`` locates; and the source."""
    unlabelled = {press.name for press in presses if press.center_px is None}
    truth = {press.name: press for press in presses if press.center_px is not None and press.contact_radius_px is not None}
    if unlabelled:
        truth |= {press.name: press for press in training.located if press.name in unlabelled}
    counts = {"labels": len(presses) - len(unlabelled), "calibrate, which saw all presses": len(unlabelled)}
    how = "centers from " + " and ".join(f"{source} ({count})" for source, count in counts.items() if count)
    return {press.name: truth[press.name] for press in presses if press.name in truth}, how


def _nearest_to_median(presses: list[Press], sensor: Sensor) -> Press:
    """The press whose distance from the middle of the image is the median, so that the picture is typical."""
    x, y = (sensor.width - 1) / 2, (sensor.height - 1) / 2
    ordered = sorted(presses, key=lambda press: math.hypot(label(press)[0][0] - x, label(press)[0][1] - y))
    return ordered[len(ordered) // 2]


def _row(method: str, data: str, built: list[Built], scores: list[PressScore]) -> Row:
    """Summary of a method over all presses."""
    worst = max(scores, key=lambda score: score.normal_deg)
    errors = {
        "normal_deg": mean(score.normal_deg for score in scores),
        "relief_um": mean(score.relief_um for score in scores),
        "tilt_um": mean(score.tilt_um for score in scores),
        "radius_percent": median(score.radius_percent for score in scores),
        "center_px": median(score.center_px for score in scores),
        "apex_um": mean(None if score.apex_um is None else abs(score.apex_um) for score in scores),
        "worst_deg": worst.normal_deg,
    }
    return Row(
        kind="presses",
        method=method,
        data=data,
        errors=errors,
        parameters=max(ready.parameters for ready in built),
        frames=len(scores),
        worst=worst.press,
        ours=method in METHODS and METHODS[method].ours,
        note="; ".join(dict.fromkeys(ready.note for ready in built if ready.note)),
    )


def table(evaluation: Evaluation) -> str:
    """The rows as a Markdown table."""
    return records.table(evaluation.rows, COLUMNS)


def to_json(evaluation: Evaluation, command: str) -> str:
    """One JSON document: the command, how it was measured, the rows, and the score of each method on each press."""
    document: dict[str, Any] = {
        "command": command,
        "how": evaluation.how,
        "rows": [dataclasses.asdict(dataclasses.replace(row, command=command)) for row in evaluation.rows],
        "scores": [dataclasses.asdict(score) for score in evaluation.scores],
    }
    return json.dumps(document, indent=1)
