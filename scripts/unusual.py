"""Calibrate drawn sensors beyond the usual, or by unusual presses, and measure other objects: a table, and its figures as JSON.

python scripts/unusual.py --out out/unusual
python scripts/unusual.py --cases "tiny balls" "reach times 3" --seeds 100
"""

import dataclasses
import json
import math
import random
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm import tqdm

from lab.commands import main_of, parser_of
from lab.drawn_sensors import DrawnPress, DrawnSensor, drawn_sensor
from lab.rows import write_files
from torchvts import ConfidentPipeline, Press, Sensor, calibrate
from torchvts.core.tables import markdown
from torchvts.model.report import warnings_of
from torchvts.scenes import objects

PRESSES = 5
SEEDS = (100, 101, 102)

Change = Callable[[DrawnSensor], DrawnSensor]


def usual(unit: DrawnSensor) -> DrawnSensor:
    return dataclasses.replace(unit)


def optics(**factors: float) -> Change:
    """Optics with numbers times factors."""

    def change(unit: DrawnSensor) -> DrawnSensor:
        changed = {name: getattr(unit.optics, name) * factor for name, factor in factors.items()}
        return dataclasses.replace(unit, optics=unit.optics._replace(**changed))

    return change


def reach(factor: float) -> Change:
    return lambda unit: dataclasses.replace(unit, reach_mm=factor * unit.reach_mm)


def lights(factor: float) -> Change:
    """Lights so many times as high."""
    stretch = torch.tensor([1.0, 1.0, factor])
    return lambda unit: dataclasses.replace(unit, optics=unit.optics._replace(points_mm=unit.optics.points_mm * stretch))


def mixed(unit: DrawnSensor) -> DrawnSensor:
    """Lights of nearly one colour."""
    mix = unit.optics.mix
    return dataclasses.replace(unit, optics=unit.optics._replace(mix=0.35 * mix + 0.65 * mix.mean(1, keepdim=True)))


def size(height: int, width: int) -> Change:
    """Images of another size of as large a skin."""

    def change(unit: DrawnSensor) -> DrawnSensor:
        pitch = max(unit.sensor.height, unit.sensor.width) * unit.sensor.mm_per_pixel / max(height, width)
        return dataclasses.replace(unit, sensor=Sensor(unit.sensor.name, height, width, pitch))

    return change


CASES: dict[str, Change] = {
    "usual": usual,
    "reach times 0.2": reach(0.2),
    "reach times 3": reach(3.0),
    "lights 0.4 times as high": lights(0.4),
    "lights 2.5 times as high": lights(2.5),
    "lights of nearly one colour": mixed,
    "light times 0.15": optics(mix=0.15, ambient=0.15),
    "stray light times 4": optics(ambient=4.0),
    "scattered light times 3": optics(reflected=3.0),
    "change far from a contact times 4": optics(far=4.0),
    "blur times 3": optics(blur_px=3.0),
    "noise times 6": optics(noise_std=6.0),
    "96 x 128 pixels": size(96, 128),
    "600 x 800 pixels": size(600, 800),
    "120 x 400 pixels": size(120, 400),
}
"""Name, and what a sensor has that drawn sensors have not."""

BALLS = {
    "tiny balls": ((0.08, 0.1), (0.1, 0.3)),
    "large balls": ((1.5, 2.5), (0.01, 0.03)),
    "shallow presses": ((0.28, 0.42), (0.02, 0.04)),
    "deep presses": ((0.28, 0.42), (0.35, 0.48)),
}
"""Name, diameters of balls as shares of the image's shorter side, and depths as shares of the diameter, from and to."""


COINS = {f"coins over {share:.0%} of the view": share for share in (0.4, 0.5, 0.6)}
"""Name, and the share of the skin on which a flat round face lies."""


def coin(unit: DrawnSensor, share: float) -> DrawnPress:
    """A coin in the middle of the view, pressed in by 4 % of the image's shorter side."""
    wide, high = (n * unit.sensor.mm_per_pixel for n in (unit.sensor.width, unit.sensor.height))
    radius_mm = math.sqrt(share * wide * high / math.pi)

    def height_mm(x: Tensor, y: Tensor) -> Tensor:
        return -30.0 * (torch.hypot(x, y) - radius_mm).clamp_min(0.0)

    return unit.press(height_mm, objects.pose(press_mm=0.04 * min(wide, high)), "coin", 300)


def presses_of(unit: DrawnSensor, name: str, seed: int) -> list[Press]:
    """Five presses without labels."""
    chance = random.Random(seed)
    if name not in BALLS:
        presses = chance.sample(unit.balls, PRESSES)
    else:
        diameters, depths = BALLS[name]
        wide, high = (n * unit.sensor.mm_per_pixel for n in (unit.sensor.width, unit.sensor.height))
        presses = []
        for k in range(PRESSES):
            diameter = diameters[k % 2] * min(wide, high)
            at = (chance.uniform(-0.3, 0.3) * wide, chance.uniform(-0.3, 0.3) * high)
            presses.append(unit.ball(diameter, chance.uniform(*depths) * diameter, at, f"ball {k}", 100 + k))
    return [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]


class Found(NamedTuple):
    """Means over the objects of one sensor, in their contacts, depths as shares of each object's; none where it was refused."""

    case: str
    seed: int
    doubts: list[str]
    figures: dict[str, float]


def measured(name: str, seed: int) -> Found:
    """What a calibration of the drawn sensor of a seed gives."""
    unit = CASES.get(name, usual)(drawn_sensor(seed))
    try:
        calibration = calibrate(unit.background, unit.sensor, presses_of(unit, name, seed))
    except ValueError as error:
        return Found(name, seed, [str(error)], {})
    pipe, rows = ConfidentPipeline.from_calibration(calibration, "fast"), []
    for pressed in [coin(unit, COINS[name])] if name in COINS else unit.objects:
        with torch.no_grad():
            out = pipe(pressed.image[None])
        true, inside = pressed.scene, pressed.scene.contact
        angle = torch.rad2deg(torch.acos((out.normal * true.normal).sum(1, keepdim=True).clamp(-1.0, 1.0)))[inside]
        off, deepest = (out.depth_mm - true.depth_mm)[inside], true.depth_mm.max()
        within = (angle <= out.normal_95_deg[inside], off.abs() <= out.depth_95_mm[inside])
        relief = (off - off.mean()).square().mean().sqrt()
        one = (angle.mean(), off.mean() / deepest, relief / deepest, *(some.float().mean() for some in within))
        rows.append([*map(float, one), float(out.frame_confidence)])
    names = ("normal_deg", "depth", "relief", "normal_within", "depth_within", "confidence")
    figures = dict(zip(names, torch.tensor(rows).mean(0).tolist(), strict=True))
    return Found(name, seed, warnings_of(calibration.report), figures)


def row_of(name: str, found: Sequence[Found]) -> list[str]:
    """Means over the sensors that were not refused; depth: the least and the most."""
    made = [one for one in found if one.figures]
    refused, doubted = len(found) - len(made), sum(bool(one.doubts) for one in made)
    said = ", ".join([f"{refused} refused"] * bool(refused) + [f"{doubted} of {len(made)}"] * bool(doubted))
    if not made:
        return [name, *["-"] * 6, said]
    mean = {key: sum(one.figures[key] for one in made) / len(made) for key in made[0].figures}
    depths = sorted(one.figures["depth"] for one in made)
    within = (f"{mean['normal_within']:.0%}", f"{mean['depth_within']:.0%}")
    figures = (f"{mean['normal_deg']:.1f}", f"{depths[0]:+.0%} to {depths[-1]:+.0%}", f"{mean['relief']:.0%}", *within)
    return [name, *figures, f"{mean['confidence']:.2f}", said]


def main(argv: Sequence[str] | None = None) -> int:
    names = (*CASES, *BALLS, *COINS)
    parser = parser_of(__doc__)
    parser.add_argument("--cases", nargs="+", default=names, choices=names, metavar="CASE", help=f"of {', '.join(names)}")
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS, metavar="SEED", help="of the drawn sensors")
    parser.add_argument("--out", type=Path, default=Path("out/unusual"), help="for table.md and figures.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    every = [(name, seed) for name in arguments.cases for seed in arguments.seeds]
    found = [measured(*one) for one in tqdm(every, unit="sensor", disable=None)]
    head = ("unusual", "normals, deg", "depth off", "relief off", "normals within", "depth within", "confidence", "doubted")
    text = markdown(head, [row_of(name, [one for one in found if one.case == name]) for name in arguments.cases])
    command = shlex.join(["python", "scripts/unusual.py", *(argv or sys.argv[1:])])
    figures = json.dumps([one._asdict() for one in found], indent=1)
    write_files(arguments.out, {"table.md": f"{text}\n\n`{command}`\n", "figures.json": figures + "\n"})
    print(f"{text}\n\ntable.md and figures.json in {arguments.out}")
    return 0


if __name__ == "__main__":
    main_of(main)
