"""Score depth on random scenes where a light is blocked: by the slope of the skin, by a cast shadow, or by dirt.

python scripts/shadows.py [--scenes 40] [--seed 0]

Balls, capsules, cones and punches under three lights, 10 to 22 mm high and 20 to 32 mm from the axis; 320 x 240 pixels, 8 bits,
noise 0.001 to 0.006. The table gives the RMS depth error of mode precise divided by that of the plain inverse, which uses dark
channels like all others: the share of scenes with 0.2 or less, the geometric mean and the maximum. For cast shadows it also gives
the error divided by that of the same frame without shadows: median, 90 % quantile and maximum. Dirt is a disc on the contact that
is black in one channel. Scenes where less than 3 % of the contact is dark are skipped.
"""

import math
import random
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from tqdm import tqdm

from lab.commands import main_of, parser_of
from lab.faults import Conditions, photograph
from lab.metrics import depth_error
from torchvts import Calibration, DepthPipeline, PointLights, Sensor, scenes
from torchvts.core.tables import markdown

HEIGHT, WIDTH, MM_PER_PIXEL = 240, 320, 0.0625
SENSOR = Sensor("rig", HEIGHT, WIDTH, MM_PER_PIXEL, gamma=1.0)
SIZE = (HEIGHT, WIDTH, MM_PER_PIXEL)
SHAPES = ("ball", "capsule", "cone", "punch")


def random_lights(draw: random.Random) -> PointLights:
    out, high, turn = draw.uniform(20.0, 32.0), draw.uniform(10.0, 22.0), draw.uniform(0.0, 120.0)
    angles = [math.radians(turn + 120.0 * k) for k in range(3)]
    albedo = 0.2 * math.hypot(out, high) ** 3 / high  # a flat skin of value 0.2 in the middle
    return PointLights([[out * math.cos(a), out * math.sin(a), high] for a in angles], [albedo] * 3).requires_grad_(False)


def random_scene(shape: str, draw: random.Random) -> scenes.Scene:
    place = (draw.uniform(-2.0, 2.0), draw.uniform(-1.5, 1.5))
    if shape == "ball":
        radius = draw.uniform(4.0, 8.0)
        return scenes.sphere_press(radius, min(draw.uniform(0.8, 2.0), 0.45 * radius), place, *SIZE)
    if shape == "capsule":
        radius, press = draw.uniform(3.0, 6.0), draw.uniform(0.8, 1.6)
        return scenes.cylinder_press(radius, press, draw.uniform(6.0, 10.0), draw.uniform(0.0, 180.0), place, *SIZE)
    if shape == "cone":
        return scenes.cone_press(draw.uniform(40.0, 70.0), draw.uniform(0.8, 1.8), 0.5, place, *SIZE)
    radius, press, tilt = draw.uniform(2.5, 4.0), draw.uniform(0.6, 1.2), draw.uniform(0.0, 3.0)
    return scenes.punch_press(radius, press, tilt, draw.uniform(0.6, 1.2), *SIZE)


def with_dirt(image: Tensor, contact: Tensor, draw: random.Random) -> Tensor:
    """The image with a disc of 1 to 4 mm in diameter around a point of the contact, black in one channel."""
    places = torch.nonzero(contact[0, 0])
    row, column = places[draw.randrange(len(places))].tolist()
    radius, channel = draw.uniform(8.0, 30.0), draw.randrange(3)
    y, x = torch.arange(HEIGHT)[:, None] - row, torch.arange(WIDTH) - column
    image = image.clone()
    image[0, channel][x**2 + y**2 < radius**2] = 0.0
    return image


def rms_px(pipe: DepthPipeline, image: Tensor, scene: scenes.Scene) -> float:
    return depth_error(pipe(image).depth_mm, scene.depth_mm, MM_PER_PIXEL).rms_px


def errors(shape: str, kind: str, seed: int) -> tuple[float, float, float] | None:
    """RMS depth error in pixels: ours, of the plain inverse, and ours without cast shadow; None if too few pixels are dark."""
    draw = random.Random(f"{shape}, {kind}, {seed}")
    lights, scene, noise = random_lights(draw), random_scene(shape, draw), draw.uniform(0.001, 0.006)
    camera = Conditions(lights, noise_std=noise, bits=8)
    background = photograph(scenes.undeformed(scene), camera, 2 * seed)[0]
    image = without = photograph(scene, camera, 2 * seed + 1)
    if kind == "cast":
        image = photograph(scene, Conditions(lights, noise_std=noise, bits=8, shadows=True), 2 * seed + 1)
    elif kind == "dirt":
        image = with_dirt(image, scene.contact, draw)
    pipe = DepthPipeline.from_calibration(Calibration.from_lights(lights, SENSOR, background), "precise")
    if float((pipe.normals.shadowed.blocked(pipe.compensate(image)) & scene.contact).sum() / scene.contact.sum()) < 0.03:
        return None
    ours, undisturbed = rms_px(pipe, image, scene), rms_px(pipe, without, scene) if kind == "cast" else math.nan
    pipe.normals.shadowed.flat.zero_()
    return ours, rms_px(pipe, image, scene), undisturbed


def random_errors(shape: str, kind: str, count: int, seed: int) -> Iterator[tuple[float, float, float]]:
    while count:
        seed += 1
        found = errors(shape, kind, seed)
        if found is not None:
            count -= 1
            yield found


def cells(kind: str, shape: str, rows: Sequence[tuple[float, float, float]]) -> list[str]:
    """A line of the table."""
    ours, plain, undisturbed = torch.tensor(rows).unbind(1)
    share, ratio = ours / plain, ours / undisturbed
    beside = f"{ratio.median():.2f}, {ratio.quantile(0.9):.2f}, {ratio.max():.2f}" if kind == "cast" else ""
    good = float((share <= 0.2).float().mean())
    return [kind, shape, f"{good:.0%}", f"{share.log().mean().exp():.3f}", f"{share.max():.2f}", beside]


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--scenes", type=int, default=40, help="scenes of each shape and kind")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args(argv)
    if arguments.scenes < 1:
        parser.error(f"--scenes: expected at least 1, got {arguments.scenes}")
    lines = []
    with torch.no_grad(), tqdm(total=3 * len(SHAPES) * arguments.scenes, unit="scene", leave=False, disable=None) as bar:
        for kind in ("slope", "cast", "dirt"):
            for shape in SHAPES:
                rows = []
                for row in random_errors(shape, kind, arguments.scenes, arguments.seed):
                    rows.append(row)
                    bar.update()
                lines.append(cells(kind, shape, rows))
    print(
        markdown(["light blocked by", "shape", "0.2 or less", "mean", "worst", "over no cast shadow: median, 90 %, worst"], lines)
    )
    return 0


if __name__ == "__main__":
    main_of(main)
