"""Score your own presses of balls, each by a calibration that has not seen it: angle of normals, relief, radius.

FOLDER has gs_sdk's layout (catalog.csv, background.png, N/gelsight.png); true centers and contact radii come from label.npz or
labels.csv, otherwise from calibration. Files are written after every fold, so what was measured stays where the command is stopped.

example:
  torchvts evaluate presses/ --sensor my_sensor.yaml --out out/evaluate
"""

import argparse
import csv
import io
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from ..calibration import Press, read_presses
from ..core.checks import check_image, check_integer
from ..core.files import make_folder, write_atomically
from ..core.geometry import angles_deg, normal_from_gradient
from ..core.tables import markdown
from ..model import Sensor
from ..pipeline import DepthOutput, DepthPipeline
from ..training.balls import ball_truth, fit_sphere
from ..training.presses import Training, with_centers
from .options import add_out, add_sensor, cut_frames, load_sensor
from .parser import UsageError

USAGE = "FOLDER --sensor NAME [--folds N] [--out FOLDER]"

MODES = ("fast", "precise")
LEAST_PX = 10
"""A press whose contact, less the rim, has fewer pixels is not scored."""


class Score(NamedTuple):
    """Errors of one press inside its contact.

    Attributes:
        press: its name.
        mode: of the pipeline.
        normal_deg: mean angle of the normals to those of the ball, degrees.
        relief_um: RMS difference of depth and ball, each less its mean, micrometres.
        radius_percent: error of the radius of the sphere that fits the depth, percent.
    """

    press: str
    mode: str
    normal_deg: float
    relief_um: float
    radius_percent: float


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the subcommand."""
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="presses of balls")
    add_sensor(parser)
    parser.add_argument("--folds", type=int, default=5, metavar="N", help="parts of the presses: each is scored by the others (5)")
    add_out(parser, "for table.md and presses.csv (out/evaluate)", "out/evaluate")


def run(arguments: argparse.Namespace) -> int:
    """Score, write the table after every fold, and print it at the end or where it is stopped."""
    if arguments.sensor is None:
        raise UsageError("expected --sensor")
    sensor = load_sensor(arguments.sensor)
    background, presses = cut_frames(*read_presses(arguments.folder), sensor)
    check_image("background", background, sensor.height, sensor.width, sensor.name)
    folds = check_integer("--folds", arguments.folds, 2)
    if folds > len(presses):
        raise ValueError(f"--folds: expected at most the number of presses, {len(presses)}, got {folds}")
    labelled = sum(press.center_px is not None for press in presses)
    if labelled < len(presses):
        print(f"finding the centers of {len(presses) - labelled} presses that have no label", file=sys.stderr, flush=True)
    known = {press.name: press for press in with_centers(background, sensor, presses) if _scorable(press, sensor)}
    if not known:
        raise ValueError(f"folder: none of {len(presses)} presses has a contact that can be scored: label them, or press deeper")
    left = [press.name for press in presses if press.name not in known]
    if left:
        print(f"not scored: {', '.join(left)}: no clean ball is found: torchvts calibrate says why", file=sys.stderr)
    make_folder(arguments.out)
    scores: list[Score] = []
    reasons: list[str] = []
    text = ""
    try:
        for fold in tqdm(range(folds), desc="folds", leave=False, disable=None):
            try:
                scores += _fold(background, sensor, presses, known, fold, folds)
            except ValueError as error:  # the other folds are still scored
                reasons.append(f"fold {fold + 1}: {' '.join(str(error).split())}")
            how = "a wrong mm_per_pixel, or diameters that are all wrong by one factor, are not seen by these figures\n"
            how += f"{len(presses)} presses, {labelled} labelled; fold {fold + 1} of {folds}, each scored by all others"
            text = "\n".join([_table(scores), "", how, *reasons])
            _write(arguments.out, text, scores)
            if not sys.stderr.isatty():
                print(f"fold {fold + 1} of {folds}: {len(scores) // len(MODES)} presses scored", file=sys.stderr, flush=True)
    finally:
        if scores:
            print(f"{text}\n\ntable.md and presses.csv in {arguments.out}")
    if not scores:
        raise ValueError(reasons[0])
    return 0


def _scorable(press: Press, sensor: Sensor) -> bool:
    return int(ball_truth(press, sensor.height, sensor.width, sensor.mm_per_pixel).region.sum()) >= LEAST_PX


def _fold(
    background: Tensor, sensor: Sensor, presses: Sequence[Press], known: dict[str, Press], fold: int, folds: int
) -> list[Score]:
    """Scores of press ``fold``, ``fold + folds`` and so on, by a calibration from all others without their labels."""
    unit = Training(background, [press for k, press in enumerate(presses) if k % folds != fold], sensor).calibration
    pipes = {mode: DepthPipeline.from_calibration(unit, mode).freeze() for mode in MODES}
    scores = []
    for press in (known[press.name] for press in presses[fold::folds] if press.name in known):
        for mode, pipe in pipes.items():
            with torch.inference_mode():
                out = pipe(press.image[None])
            scores.append(score(press, out, sensor.mm_per_pixel, mode))
    return scores


def score(press: Press, out: DepthOutput, mm_per_pixel: float, mode: str) -> Score:
    """Compare a frame with the ball that was pressed.

    Args:
        press: with center and contact radius.
        out: result of the pipeline on its image.
        mm_per_pixel: pixel pitch, mm.
        mode: of the pipeline, kept with the score.
    """
    truth = ball_truth(press, out.depth_mm.shape[2], out.depth_mm.shape[3], mm_per_pixel)
    region, depth = truth.region, out.depth_mm.double()
    angle = angles_deg(out.normal.double(), normal_from_gradient(truth.gradient))[region[:, 0]]
    relief = (depth - truth.depth_mm)[region].std(correction=0)
    radius = fit_sphere(depth, mm_per_pixel, region).radius_mm / (0.5 * press.ball_diameter_mm)
    return Score(press.name, mode, float(angle.mean()), 1000.0 * float(relief), 100.0 * abs(radius - 1.0))


def _table(scores: Sequence[Score]) -> str:
    """A line for each mode: means of angle and relief, the median of the radius."""
    lines = []
    for mode in MODES:
        own = [row for row in scores if row.mode == mode]
        if own:
            angle, relief = (statistics.mean(values) for values in zip(*[(row.normal_deg, row.relief_um) for row in own]))
            radius = statistics.median(row.radius_percent for row in own)
            lines.append([mode, f"{angle:.2f}", f"{relief:.1f}", f"{radius:.1f}", str(len(own))])
    return markdown(["mode", "normals deg", "relief um", "radius %, median", "presses"], lines)


def _write(folder: Path, text: str, scores: Sequence[Score]) -> None:
    cells = io.StringIO()
    table = csv.writer(cells, lineterminator="\n")
    table.writerow(Score._fields)
    table.writerows(scores)
    for name, content in (("table.md", text + "\n"), ("presses.csv", cells.getvalue())):
        with write_atomically(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8")
