"""Score methods on sets of data: each learns from presses without their labels, and is scored on frames that it has not seen.

The modes of the pipeline are what a user gets: ``calibrate``, then ``DepthPipeline.from_calibration``. The look-up table and the
network learn from the balls that this calibration located. A method that fails is a row with the reason.
"""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import Any

import torch
from tqdm import tqdm

from torchvts.core.tables import number
from torchvts.pipeline import DepthOutput
from torchvts.training.presses import Training

from . import rows as records
from .methods import METHODS, Built, Method
from .rows import Column, Row, error_column, mean, median
from .score import PressScore, score_press, score_surface
from .sets import DRAWN, DataSet, Fold, Target, load

COMPARED = tuple(name for name, method in METHODS.items() if method.from_presses is not None)
"""Names of the methods that sets can score."""

IN_TABLE = ("fast", "precise", "look-up table", "MLP")
"""The methods of the table over all sets."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Scores of methods on a set.

    Attributes:
        data: the set.
        rows: one row per method, see :func:`summary`.
        scores: one score per method and frame.
        shown: the frame of ``outputs``; None if there is none.
        outputs: result of each method on that frame.
    """

    data: DataSet
    rows: list[Row]
    scores: list[PressScore]
    shown: Target | None
    outputs: dict[str, DepthOutput]


def evaluate(data: DataSet, methods: Sequence[str] = (), *, bar: "tqdm[Any] | None" = None) -> Evaluation:
    """Score methods on a set.

    Args:
        data: the set.
        methods: names out of :data:`COMPARED`; empty for all that are possible. Methods of the set itself come last.
        bar: advanced by one for each fold and method.
    Returns:
        The scores. A method that fails has a row with the reason, and no errors.
    Raises:
        ValueError: an unknown method.
    Example:
        >>> from .sets import DataSet, Fold, Target
        >>> from torchvts.model import Sensor
        >>> target = Target("nothing", torch.full((3, 48, 64), 0.4))
        >>> data = DataSet("example", target.image, [Fold(Sensor("rig", 48, 64, 0.5), (), [target])], "")
        >>> evaluate(data, ["flat"]).rows[0].error("lowest_mm")
        0.0
    """
    scored = [target for target in data.folds[0].scored if target.truth is not None] or data.folds[0].scored
    shown = scored[len(scored) // 2] if scored else None
    of_methods = [_Record(method, data) for method in _choose(data, methods)]
    outputs: dict[str, DepthOutput] = {}
    for fold in data.folds:
        training = Training(data.background, fold.learned, fold.sensor)
        for record in of_methods:
            if bar is not None:
                bar.set_postfix_str(f"{data.name}, {record.method.name}")
            for target, out in record.score(fold, training):
                if target is shown:
                    outputs[record.method.name] = out
            if bar is not None:
                bar.update()
    scores = [score for record in of_methods for score in record.scores]
    return Evaluation(data, [record.row() for record in of_methods], scores, shown, outputs)


def evaluate_all(
    names: Sequence[str],
    folder: Path,
    methods: Sequence[str] = (),
    *,
    limit: int | None = None,
    own: tuple[Method, ...] = (),
    progress: bool = False,
) -> list[Evaluation]:
    """Score methods on several sets; a set that cannot be read is one row with the reason.

    Args:
        names: names out of :data:`lab.sets.SETS`.
        folder: folder of the real sets.
        methods: names out of :data:`COMPARED`; empty for :data:`IN_TABLE`.
        limit: use only so many presses of each ball.
        own: methods beside these, see :func:`lab.methods.own_methods`.
        progress: show a bar.
    Raises:
        ValueError: an unknown method.
    """
    done = []
    with tqdm(total=len(names), desc="evaluating", disable=not progress or None, leave=False) as bar:
        for name in names:
            bar.set_postfix_str(f"{name}, reading")
            try:
                data = load(name, folder, limit)
                data = dataclasses.replace(data, methods=(*data.methods, *own))
            except Exception as error:  # the other sets are still scored
                row = Row("presses", "", name, note=_reason(error))
                done.append(Evaluation(DataSet(name, torch.zeros(3, 1, 1), (), ""), [row], [], None, {}))
            else:
                fewer = len(IN_TABLE) if data.folds[0].learned else 2
                chosen = methods or IN_TABLE[:fewer]
                bar.total = (bar.total or 0) + len(data.folds) * (len(chosen) + len(data.methods)) - 1
                done.append(evaluate(data, chosen, bar=bar))
    return done


class _Record:
    """What became of one method on the folds of a set."""

    def __init__(self, method: Method, data: DataSet) -> None:
        self.method, self.data = method, data
        self.built: list[Built] = []
        self.scores: list[PressScore] = []
        self.failures: list[str] = []

    def score(self, fold: Fold, training: Training) -> Iterator[tuple[Target, DepthOutput]]:
        """Build the method from a fold, score it on the frames of the fold and yield its results; a failure is kept."""
        try:
            if self.method.learns or not self.built:
                self.built.append(self.method.learned(training))
            for target in fold.scored:
                with torch.inference_mode():
                    out = self.built[-1].reconstruct(target.image[None])
                self.scores.append(_score(target, out, fold.sensor.mm_per_pixel, self.method.name))
                yield target, out
        except Exception as error:  # one method or set that fails must not end a run over all
            self.failures.append(_reason(error))

    def row(self) -> Row:
        """Summary over all frames."""
        method, built, notes, errors = self.method, self.built, list(dict.fromkeys(self.failures)), summary(self.scores)
        if method.learns and (given := sum(len(fold.learned) for fold in self.data.folds)):
            errors |= {"used": float(sum(ready.used for ready in built)), "given": float(given)}
        return Row(
            kind="presses",
            method=method.name,
            data=self.data.name,
            errors=errors,
            parameters=max((ready.parameters for ready in built), default=None),
            frames=len(self.scores),
            ours=method.ours,
            seen=method.seen,
            note="; ".join([*notes, *dict.fromkeys(ready.note for ready in built if ready.note)]),
        )


def summary(scores: Sequence[PressScore]) -> dict[str, float | None]:
    """Means over frames; medians of the fitted sphere, the contact and the lowest depth, and the worst of these two."""
    columns = {name: [getattr(score, name) for score in scores] for name in _MEANS + _MEDIANS}
    errors = {name: mean(columns[name]) for name in _MEANS} | {name: median(columns[name]) for name in _MEDIANS}
    for name in ("iou", "lowest_mm"):
        errors[f"worst_{name}"] = min((value for value in columns[name] if value is not None), default=None)
    return errors


_MEANS = ("normal_deg", "depth_normal_deg", "relief_um", "tilt_um", "level_um", "depth_um")
_MEDIANS = ("radius_percent", "iou", "lowest_mm")


def _score(target: Target, out: DepthOutput, mm_per_pixel: float, method: str) -> PressScore:
    if target.ball is not None:
        return score_press(target.ball, out.depth_mm, out.normal, mm_per_pixel, method, out.contact)
    if target.truth is None:
        return PressScore(target.name, method, float(out.depth_mm.min()))
    return score_surface(target.truth, out.depth_mm, out.normal, mm_per_pixel, target.name, method, out.contact)


def _choose(data: DataSet, methods: Sequence[str]) -> list[Method]:
    for name in methods:
        if name not in COMPARED:
            raise ValueError(f"methods: expected some of {', '.join(repr(m) for m in COMPARED)}, got {name!r}")
    return [METHODS[name] for name in methods or COMPARED] + list(data.methods)


def _reason(error: Exception) -> str:
    """An error on one line, without the bar of tables."""
    kind = "" if isinstance(error, ValueError | FileNotFoundError) else f"{type(error).__name__}: "
    return kind + " ".join(str(error).replace("|", "/").split())


# tables


def _with_worst(title: str, name: str, digits: int) -> Column:
    def cell(row: Row) -> str:
        value, worst = row.error(name), row.error(f"worst_{name}")
        return "" if value is None else f"{number(value, digits)} ({number(worst, digits)})"

    return Column(f"{title}, median (worst)", cell)


def _used(row: Row) -> str:
    used, given = row.error("used"), row.error("given")
    return "" if used is None or given is None else f"{used:.0f} of {given:.0f}"


COLUMNS = (
    Column("data", lambda row: row.data),
    Column("method", lambda row: f"{row.method} (has seen these)" if row.seen else row.method),
    error_column("normals deg", "normal_deg", 2),
    error_column("of depth deg", "depth_normal_deg", 2),
    error_column("relief um", "relief_um", 1),
    error_column("without tilt um", "level_um", 1),
    error_column("depth um", "depth_um", 0),
    error_column("radius %", "radius_percent", 1),
    _with_worst("contact IoU", "iou", 2),
    Column("presses used", _used),
    _with_worst("lowest mm", "lowest_mm", 3),
    Column("frames", lambda row: str(row.frames)),
    Column("note", lambda row: shorten(row.note, 200, placeholder=" ...")),
)
"""Columns of the tables."""


def means_of_drawn(rows: Sequence[Row]) -> list[Row]:
    """For each method a row of the means over all drawn sensors."""
    drawn = [row for row in rows if row.data in DRAWN]
    means = []
    for method in dict.fromkeys(row.method for row in drawn):
        own = [row for row in drawn if row.method == method]
        names = dict.fromkeys(name for row in own for name in row.errors)
        errors = {name: mean(row.error(name) for row in own) for name in names}
        frames = sum(row.frames for row in own)
        means.append(dataclasses.replace(own[0], data=f"drawn, mean of {len(own)}", errors=errors, frames=frames, note=""))
    return means


def write_tables(evaluations: Sequence[Evaluation], out: Path, command: str) -> str:
    """Write table.md and scores.json; returns the Markdown."""
    rows = [dataclasses.replace(row, command=command) for evaluation in evaluations for row in evaluation.rows]
    rows += means_of_drawn(rows)
    text = "\n".join(
        [records.table(rows, COLUMNS), ""]
        + [f"* {e.data.name}: {shorten(e.data.how, 300, placeholder=' ...')}" for e in evaluations if e.data.how]
        + ["", "means over frames; medians of the radius of the sphere fitted to depth, of the contact and of the lowest depth"]
    )
    document = {
        "command": command,
        "how": {e.data.name: e.data.how for e in evaluations},
        "rows": [dataclasses.asdict(row) for row in rows],
        "scores": [dataclasses.asdict(score) | {"data": e.data.name} for e in evaluations for score in e.scores],
    }
    records.write_files(out, {"table.md": f"{text}\n\n`{command}`\n", "scores.json": json.dumps(document, indent=1) + "\n"})
    return text
