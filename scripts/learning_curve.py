"""How accurate a calibration is after 0, 1, 3, 5, ... presses or touches: a table and a picture.

python scripts/learning_curve.py ../shared/data/gelsight_mini_a --sensor gelsight_mini

Presses carry no labels; those left out are scored, and those given by how far the centers and contact radii that were found for
them are from the labels. Touches are known by nothing but their images: all presses but the one for the scale are scored. Where a
prior takes part it is fitted on the balls of all other diameters (with their labels), so it has not seen the ball that is scored.
"""

import argparse
import dataclasses
import math
import random
import statistics
import sys
import warnings
from collections.abc import Sequence
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
"""Of each ball's presses, in the row that scores every one of them: each is left out once."""


class Scores(NamedTuple):
    """Of presses left out; and of those given, how far their centers and contact radii are from the labels, pixels."""

    left_out: list[PressScore]
    centers_px: list[float]
    radii_px: list[float]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="presses of balls of two or more diameters, in gs_sdk's layout")
    parser.add_argument("--sensor", required=True, help=f"YAML file, or one of {', '.join(vts.shipped_sensors())}")
    parser.add_argument("--draws", type=int, default=4, help="choices of presses per figure")
    parser.add_argument("--out", type=Path, default=Path("out/learning_curve"), help="folder for table.md and the picture")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", vts.CalibrationWarning)
    bare = vts.Sensor.load(arguments.sensor).without_prior()
    background, presses = vts.read_presses(arguments.folder)
    scored = [press for press in presses if press.center_px is not None and press.contact_radius_px is not None]
    rows: list[tuple[str, int, Scores]] = []
    balls = sorted({press.ball_diameter_mm for press in presses})
    own = {ball: [press for press in presses if press.ball_diameter_mm == ball] for ball in balls}
    with tqdm(desc="learning curve", leave=False) as bar:
        if len(balls) > 1:
            sensors = {}
            for ball in balls:
                others = [press for press in presses if press.ball_diameter_mm != ball]
                sensors[ball] = dataclasses.replace(bare, prior=fit_prior(background, bare, others))
            by_number = {n: [(ball, d) for ball in balls for d in draws(own[ball], n, arguments.draws)] for n in (0, 1, 3, 5, 10)}
            folds = [(ball, [p for k, p in enumerate(own[ball]) if k % FOLDS != fold]) for ball in balls for fold in range(FOLDS)]
            named = [("presses, prior of another ball", number, jobs) for number, jobs in by_number.items()]
            usual = round(statistics.mean(len(draw) for _, draw in folds))
            for kind, number, jobs in [*named, (f"presses, prior of another ball, {FOLDS}-fold", usual, folds)]:
                found = Scores([], [], [])
                for ball, draw in jobs:
                    score(found, background, sensors[ball], draw, [], left(scored, draw, ball))
                    bar.update()
                rows.append((kind, number, found))
        for count in (1, 2, 3, 5, 10, len(presses) - len(presses) // 5):
            found = Scores([], [], [])
            for draw in draws(presses, count, arguments.draws):
                score(found, background, bare, draw, [], left(scored, draw))
                bar.update()
            rows.append(("presses, no prior", count, found))
        for count in (1, 5, 10, min(30, len(presses) - 1)):
            found = Scores([], [], [])
            for draw in draws(presses, count, arguments.draws):
                one = random.Random(count).choice([press for press in scored if press not in draw] or scored)
                score(found, background, bare, [one], draw, left(scored, [one]))
                bar.update()
            rows.append(("touches, and one press for the scale", count, found))
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = table(rows)
    (arguments.out / "table.md").write_text(text + "\n")
    save_figure(figure(rows), arguments.out / "learning_curve.png")
    print(text)
    print(f"\nwrote {arguments.out}/table.md and learning_curve.png")
    return 0


def draws(presses: Sequence[vts.Press], count: int, number: int) -> list[list[vts.Press]]:
    """``number`` random choices of ``count`` presses, the same at every run; one if there is nothing to choose."""
    return [random.Random(seed).sample(list(presses), count) for seed in range(number if count else 1)]


def left(scored: Sequence[vts.Press], used: Sequence[vts.Press], ball: float | None = None) -> list[vts.Press]:
    names = {press.name for press in used}
    return [press for press in scored if press.name not in names and ball in (None, press.ball_diameter_mm)]


def score(
    found: Scores,
    background: torch.Tensor,
    sensor: vts.Sensor,
    presses: Sequence[vts.Press],
    touches: Sequence[vts.Press],
    judged: Sequence[vts.Press],
) -> None:
    """Calibrate with the labels forgotten, and add to what was found the scores of other presses' precise depth."""
    blind = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]
    calibration = vts.calibrate(background, sensor, blind, [press.image for press in touches])
    pipe = vts.DepthPipeline.from_calibration(calibration, "precise")
    for press in judged:
        with torch.inference_mode():
            out = pipe(press.image[None])
        found.left_out.append(score_press(press, out.depth_mm, out.normal, sensor.mm_per_pixel))
    labels = {press.name: press for press in presses}
    for told in calibration.report.get("presses", []):
        press = labels[told["name"]]
        if told["used"] and press.center_px is not None and press.contact_radius_px is not None:
            found.centers_px.append(math.dist(told["center_px"], press.center_px))
            found.radii_px.append(abs(told["contact_radius_px"] - press.contact_radius_px))


def table(rows: Sequence[tuple[str, int, Scores]]) -> str:
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


def figure(rows: Sequence[tuple[str, int, Scores]]) -> "matplotlib.figure.Figure":
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
