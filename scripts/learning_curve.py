"""How accurate a calibration is after 0, 1, 3, 5, ... presses or touches: a table and a picture.

python scripts/learning_curve.py ../shared/data/gelsight_mini_a --sensor gelsight_mini

The presses are given without labels. Those left out are scored; for those given, the centers and contact radii found are compared
with the labels. Touches are given by their images alone, so all presses except the one for the scale are scored. Where there is a
prior, it is fitted to the balls of all other diameters (with their labels), so it has not seen the ball that is scored.
"""

import argparse
import dataclasses
import math
import random
import statistics
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import torch
from tqdm import tqdm

import torchvts as vts
from torchvts.calibration import fit_prior
from torchvts.evaluation.score import PressScore, score_press
from torchvts.viz import save_figure

matplotlib.use("Agg")

FOLDS = 5
"""Folds of each ball's presses in the row that scores all of them: each press is left out once."""


class Scores(NamedTuple):
    """Scores of presses left out; distances of found centers and contact radii from the labels, pixels, of presses given."""

    left_out: list[PressScore]
    centers_px: list[float]
    radii_px: list[float]


class Row(NamedTuple):
    """One row of the table: what was given, how many, and the scores."""

    kind: str
    count: int
    scores: Scores


class Unit(NamedTuple):
    """The images: background, sensor without prior, all presses, those with labels."""

    background: torch.Tensor
    sensor: vts.Sensor
    presses: list[vts.Press]
    scored: list[vts.Press]


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="presses of balls of two or more diameters, in gs_sdk's layout")
    parser.add_argument("--sensor", required=True, help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--draws", type=int, default=4, help="choices of presses per row")
    parser.add_argument("--out", type=Path, default=Path("out/learning_curve"), help="folder for table.md and the picture")
    arguments = parser.parse_args(argv)
    background, presses = vts.read_presses(arguments.folder)
    scored = [press for press in presses if press.center_px is not None and press.contact_radius_px is not None]
    unit = Unit(background, vts.Sensor.load(arguments.sensor).without_prior(), presses, scored)
    with warnings.catch_warnings(), tqdm(desc="learning curve", leave=False) as bar:
        warnings.simplefilter("ignore", vts.CalibrationWarning)
        rows = [
            *rows_with_prior(unit, arguments.draws, bar),
            *rows_without_prior(unit, arguments.draws, bar),
            *rows_of_touches(unit, arguments.draws, bar),
        ]
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = table(rows)
    (arguments.out / "table.md").write_text(text + "\n")
    save_figure(figure(rows), arguments.out / "learning_curve.png")
    print(text)
    print(f"\nwrote {arguments.out}/table.md and learning_curve.png")
    return 0


def rows_with_prior(unit: Unit, count_of_draws: int, bar: "tqdm[None]") -> Iterator[Row]:
    """Presses of each ball, with a prior fitted to the other balls."""
    balls = sorted({press.ball_diameter_mm for press in unit.presses})
    if len(balls) < 2:
        return
    own = {ball: [press for press in unit.presses if press.ball_diameter_mm == ball] for ball in balls}
    sensors = {}
    for ball in balls:
        others = [press for press in unit.presses if press.ball_diameter_mm != ball]
        sensors[ball] = dataclasses.replace(unit.sensor, prior=fit_prior(unit.background, unit.sensor, others))
    folds = [(ball, [p for k, p in enumerate(own[ball]) if k % FOLDS != fold]) for ball in balls for fold in range(FOLDS)]
    usual = round(statistics.mean(len(draw) for _, draw in folds))
    kind = "presses, prior of another ball"
    jobs = [(kind, n, [(ball, d) for ball in balls for d in draws(own[ball], n, count_of_draws)]) for n in (0, 1, 3, 5, 10)]
    for name, count, pairs in [*jobs, (f"{kind}, {FOLDS}-fold", usual, folds)]:
        found = Scores([], [], [])
        for ball, draw in pairs:
            score(found, unit._replace(sensor=sensors[ball]), draw, [], left(unit.scored, draw, ball))
            bar.update()
        yield Row(name, count, found)


def rows_without_prior(unit: Unit, count_of_draws: int, bar: "tqdm[None]") -> Iterator[Row]:
    """Presses of all balls."""
    for count in (1, 2, 3, 5, 10, len(unit.presses) - len(unit.presses) // 5):
        found = Scores([], [], [])
        for draw in draws(unit.presses, count, count_of_draws):
            score(found, unit, draw, [], left(unit.scored, draw))
            bar.update()
        yield Row("presses, no prior", count, found)


def rows_of_touches(unit: Unit, count_of_draws: int, bar: "tqdm[None]") -> Iterator[Row]:
    """Presses used as touches, and one press for the scale."""
    for count in (1, 5, 10, min(30, len(unit.presses) - 1)):
        found = Scores([], [], [])
        for draw in draws(unit.presses, count, count_of_draws):
            one = random.Random(count).choice([press for press in unit.scored if press not in draw] or unit.scored)
            score(found, unit, [one], draw, left(unit.scored, [one]))
            bar.update()
        yield Row("touches, and one press for the scale", count, found)


def draws(presses: Sequence[vts.Press], count: int, number: int) -> list[list[vts.Press]]:
    """``number`` random choices of ``count`` presses, the same at every run; one if there is nothing to choose."""
    return [random.Random(seed).sample(list(presses), count) for seed in range(number if count else 1)]


def left(scored: Sequence[vts.Press], used: Sequence[vts.Press], ball: float | None = None) -> list[vts.Press]:
    names = {press.name for press in used}
    return [press for press in scored if press.name not in names and ball in (None, press.ball_diameter_mm)]


def score(
    found: Scores, unit: Unit, presses: Sequence[vts.Press], touches: Sequence[vts.Press], scored: Sequence[vts.Press]
) -> None:
    """Calibrate without the labels, and add the scores of other presses' precise depth to ``found``."""
    blind = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]
    calibration = vts.calibrate(unit.background, unit.sensor, blind, [press.image for press in touches])
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    for press in scored:
        with torch.inference_mode():
            out = pipe(press.image[None])
        found.left_out.append(score_press(press, out.depth_mm, out.normal, unit.sensor.mm_per_pixel))
    labels = {press.name: press for press in presses}
    for row in calibration.report.get("presses", []):
        press = labels[row["name"]]
        if row["used"] and press.center_px is not None and press.contact_radius_px is not None:
            found.centers_px.append(math.dist(row["center_px"], press.center_px))
            found.radii_px.append(abs(row["contact_radius_px"] - press.contact_radius_px))


def table(rows: Sequence[Row]) -> str:
    lines = [
        "| given | number | normals deg | relief um | of it tilt | radius %, median | scored | centers, radii found, px, median |",
        "|---" * 8 + "|",
    ]
    for kind, count, (scores, centers, radii) in rows:
        radius = statistics.median(s.radius_percent for s in scores if s.radius_percent is not None)
        angle, relief, tilt = (statistics.mean(of) for of in zip(*((s.normal_deg, s.relief_um, s.tilt_um) for s in scores)))
        found = f"{statistics.median(centers):.2f}, {statistics.median(radii):.2f}" if centers and "touches" not in kind else ""
        lines.append(f"| {kind} | {count} | {angle:.2f} | {relief:.1f} | {tilt:.1f} | {radius:.1f} | {len(scores)} | {found} |")
    return "\n".join(lines)


def figure(rows: Sequence[Row]) -> "matplotlib.figure.Figure":
    import matplotlib.pyplot as plt

    drawn, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
    for kind in dict.fromkeys(kind for kind, _, _ in rows):
        points = [(count, statistics.mean(s.normal_deg for s in found.left_out)) for k, count, found in rows if k == kind]
        axes.plot(*zip(*points), marker="o", label=kind)
    axes.set(xlabel="presses or touches", ylabel="mean angle of normals, deg", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    return drawn


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (OSError, ValueError, TypeError) as error:
        sys.exit(f"error: {error}")
