"""The first minute: a drawn sensor is calibrated by presses of a ball, and a key that rolls and shears over it becomes depth.

Writes film.webp (the camera's frames beside their depth) and press.png (its deepest frame), and prints how far depth is off. Where
the folder of real images is there (TORCHVTS_DATA, else ../shared/data), real.png is a ball on a GelSight Mini, by its prior.

python scripts/demo.py [--out out/demo]
"""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import LightSource
from PIL import Image
from tqdm import tqdm

import torchvts as vts
from lab.commands import main_of, parser_of
from lab.drawn_sensors import DrawnPress, drawn_sensor
from torchvts import viz
from torchvts.pipeline import DepthOutput
from torchvts.scenes import objects

SEED = 3
"""Of the sensor: extended lights, stray light, vignetting, blur, noise and JPEG, and a skin that hangs free around a contact."""

BALLS = 6
ZOOM = 1.5
"""Pixels of the film for each of the camera's."""


def main(argv: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/demo"))
    parser.add_argument("--frames", type=int, default=20, metavar="N", help="of the film (20)")
    arguments = parser.parse_args(argv)
    arguments.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)  # many small tensors: a second thread waits for a core where another process runs
    unit, start = drawn_sensor(SEED), time.perf_counter()
    presses = [vts.Press(ball.image, ball.ball_diameter_mm) for ball in unit.balls[:BALLS]]
    calibration = vts.calibrate(unit.background, unit.sensor, presses=presses)
    pipe = vts.DepthPipeline.from_calibration(calibration).freeze()
    film = [rolled(k / arguments.frames, k) for k in tqdm(range(arguments.frames), desc="drawing", leave=False, disable=None)]
    began = time.perf_counter()
    outputs = [pipe(press.image[None]) for press in film]
    frame_ms = 1e3 * (time.perf_counter() - began) / len(film)
    pitch, deepest = unit.sensor.mm_per_pixel, max(range(len(film)), key=lambda k: float(film[k].scene.depth_mm.max()))
    most_mm = float(outputs[deepest].depth_mm.max())
    pictures = [Image.fromarray(side_by_side(press, out, pitch, most_mm)) for press, out in zip(film, outputs)]
    options: dict[str, Any] = {"duration": 100, "loop": 0, "quality": 75}
    pictures[0].save(arguments.out / "film.webp", save_all=True, append_images=pictures[1:], **options)
    shown = outputs[deepest]
    figure = viz.depth_figure(shown.depth_mm, pitch, film[deepest].image, title="a key on a drawn sensor")
    viz.save_figure(figure, arguments.out / "press.png")
    errors = [float((out.depth_mm - press.scene.depth_mm).square().mean().sqrt()) for press, out in zip(film, outputs)]
    rms_um = 1e3 * sum(errors) / len(errors)
    print(calibration)
    print(f"{len(film)} frames, {frame_ms:.1f} ms each; deepest {most_mm:.2f} mm, off by {rms_um:.0f} um RMS")
    print(f"film.webp and press.png in {arguments.out}, after {time.perf_counter() - start:.0f} s")
    folder = Path(os.environ.get("TORCHVTS_DATA", "../shared/data")) / "gelsight_mini_a"
    if folder.is_dir():
        real(folder, arguments.out / "real.png")
    return 0


def real(folder: Path, picture: Path) -> None:
    """A ball pressed into a real sensor, calibrated by its background and the prior of its type."""
    background, presses = vts.read_presses(folder)
    sensor, middle = vts.Sensor.load("gelsight_mini"), [0.5 * size for size in (background.shape[2], background.shape[1])]
    press = min(presses, key=lambda one: math.dist(one.center_px or (0.0, 0.0), middle))  # most of the ball is in view
    pipe = vts.DepthPipeline.from_calibration(vts.calibrate(background, sensor)).freeze()
    out = pipe(press.image[None])
    title = f"a ball of {press.ball_diameter_mm:g} mm on a GelSight Mini, by its background alone"
    viz.save_figure(viz.depth_figure(out.depth_mm, sensor.mm_per_pixel, press.image, out.contact, title), picture)
    print(f"{picture}: {press.name} of {folder.name}, {float(out.depth_mm.max()):.2f} mm deep")


def rolled(share: float, seed: int) -> DrawnPress:
    """The key at a share of its way: it comes down, rolls and shears from side to side, and leaves."""
    way = 2.0 * math.pi * share
    pose = objects.pose(
        angle_deg=20.0 + 8.0 * math.sin(way),
        shift_mm=(1.2 * math.sin(way), 0.5 * math.cos(way)),
        press_mm=0.4 - 0.2 * math.cos(way),
        tilt_deg=(0.0, 1.5 * math.sin(way)),
    )
    return drawn_sensor(SEED).press(objects.key(), pose, "key", seed)


def side_by_side(press: DrawnPress, out: DepthOutput, pitch: float, most_mm: float) -> "np.ndarray[Any, Any]":
    """The camera's frame and its depth, lit from the top left, (H, W, 3) uint8."""
    colors, norm = viz.depth_colors(0.0, most_mm)
    depth = out.depth_mm[0, 0].numpy()
    shaded = LightSource(315, 40).shade(depth, colors, norm=norm, blend_mode="soft", vert_exag=1.5, dx=pitch, dy=pitch)[..., :3]
    both = np.concatenate((press.image.permute(1, 2, 0).numpy(), shaded), axis=1)
    picture = Image.fromarray(np.rint(255.0 * both.clip(0.0, 1.0)).astype(np.uint8))
    return np.asarray(picture.resize((round(ZOOM * picture.width), round(ZOOM * picture.height))))


if __name__ == "__main__":
    main_of(main)
