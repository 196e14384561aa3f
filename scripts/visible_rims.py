"""How far the hand labels of gelsight_pale are from the bright rims of its contacts, and the errors of depth against both.

python scripts/visible_rims.py ../shared/data --out out/rims

Where the skin leaves the ball it shows a bright line. The circle along it is found without any model of slopes, so it is a second
measurement of the centres: beside those of the labels, and those that `calibrate` finds without labels.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from tqdm import tqdm

import torchvts as vts
from lab import sets
from lab.commands import main_of, parser_of
from lab.rims import visible_rim
from lab.score import label, score_press
from torchvts.training.presses import quiet_calibrate, without_labels
from torchvts.viz import new_figure, save_figure

LEAST = 4
"""Presses that two halves need."""

SHOWN, HALF_PX = 8, 60
"""Presses in the picture, and half the side of each panel."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("data", type=Path, help="folder of the data that holds gelsight_pale")
    parser.add_argument("--out", type=Path, default=Path("out/rims"), help="folder of the picture")
    parser.add_argument("--limit", type=int, help="use only so many presses")
    arguments = parser.parse_args(argv)
    if not (arguments.data / "gelsight_pale").is_dir():
        raise FileNotFoundError(f"data: expected a folder that holds gelsight_pale, got {arguments.data}")
    if arguments.limit is not None and arguments.limit < LEAST:
        raise ValueError(f"--limit: expected at least {LEAST} presses, half of which are learned from, got {arguments.limit}")
    data = sets.load("gelsight_pale", arguments.data, arguments.limit)
    labelled = {target.name: target.ball for fold in data.folds for target in fold.scored if target.ball is not None}
    by_rim = {}
    for name, press in tqdm(labelled.items(), desc="rims", disable=None, leave=False):
        rim = visible_rim(press.image, data.background, *label(press))
        by_rim[name] = dataclasses.replace(press, center_px=rim.center_px, contact_radius_px=rim.radius_px)
    truths = {"hand labels": labelled, "rims": by_rim}
    bare = {name: without_labels(press) for name, press in labelled.items()}
    units = {
        learned: [
            quiet_calibrate(data.background, fold.sensor, [given[press.name] for press in fold.learned]) for fold in data.folds
        ]
        for learned, given in {"no labels": bare, **truths}.items()
    }
    located = {row["name"]: row["center_px"] for unit in units["no labels"] for row in unit.report["presses"] if row["used"]}
    print(_away("hand labels", {name: press.center_px for name, press in labelled.items()}, by_rim))
    print(_away("centres by calibrate without labels", located, by_rim))
    print(
        "\n| learned from | mode | truth | normals deg | relief um | without tilt um | radius % | contact IoU |\n"
        + "|---" * 8
        + "|"
    )
    for learned, calibrated in units.items():
        for mode in ("fast", "precise"):
            for name, truth in truths.items():
                scores = [
                    _score(unit, mode, target, truth[target.name])
                    for unit, fold in zip(calibrated, data.folds)
                    for target in fold.scored
                ]
                normal, relief, level = np.mean(scores, 0)[:3]
                radius, iou = np.median(scores, 0)[3:]
                print(f"| {learned} | {mode} | {name} | {normal:.2f} | {relief:.1f} | {level:.1f} | {radius:.1f} | {iou:.2f} |")
    arguments.out.mkdir(parents=True, exist_ok=True)
    picture = arguments.out / "rims.png"
    save_figure(_picture(list(labelled.values())[:: max(1, len(labelled) // SHOWN)][:SHOWN], by_rim), picture)
    print(f"\n{picture}")
    return 0


def _away(name: str, places: Mapping[str, Sequence[float]], by_rim: Mapping[str, vts.Press]) -> str:
    away = np.array([np.subtract(place, by_rim[press].center_px) for press, place in places.items()])
    (x, y), (spread_x, spread_y) = away.mean(0), away.std(0)
    return (
        f"{name}: ({x:.1f}, {y:.1f}) px from the rims in the mean, spread ({spread_x:.1f}, {spread_y:.1f}) px, {len(away)} presses"
    )


def _score(unit: vts.Calibration, mode: str, target: sets.Target, press: vts.Press) -> list[float]:
    with torch.inference_mode():
        out = vts.DepthPipeline.from_calibration(unit, mode)(target.image[None])
    score = score_press(press, out.depth_mm, out.normal, unit.sensor.mm_per_pixel, contact=out.contact)
    values = (score.normal_deg, score.relief_um, score.level_um, score.radius_percent, score.iou)
    return [math.nan if value is None else value for value in values]


def _picture(presses: Sequence[vts.Press], by_rim: Mapping[str, vts.Press]) -> Figure:
    """Each press as it is, and below it with both circles."""
    figure = new_figure(1.6 * len(presses), 3.5)
    panels = figure.subplots(2, len(presses), squeeze=False)
    for press, (plain, drawn) in zip(presses, panels.T):
        x, y = press.center_px
        for axes in (plain, drawn):
            axes.imshow(press.image.permute(1, 2, 0).numpy())
            axes.set(xlim=(x - HALF_PX, x + HALF_PX), ylim=(y + HALF_PX, y - HALF_PX), xticks=[], yticks=[])
        for circle, colour in ((press, "black"), (by_rim[press.name], "white")):
            drawn.add_patch(Circle(circle.center_px, circle.contact_radius_px, fill=False, color=colour))
        plain.set_title(press.name, fontsize=8)
    panels[1, 0].set_ylabel("labels black, rims white", fontsize=7)
    return figure


if __name__ == "__main__":
    main_of(main)
