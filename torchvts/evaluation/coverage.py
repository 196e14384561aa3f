"""How often errors lie within the bounds that :class:`Confidence` states: on random exact scenes, and on presses of balls."""

import dataclasses
import math
import random
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from ..calibration import CalibrationWarning, Press, calibrate, read_presses
from ..calibration.calibrate import by_presses
from ..core.checks import check_integer
from ..core.geometry import normal_from_gradient
from ..model.calibration import Calibration
from ..model.lights import PointLights
from ..model.report import PressRow
from ..model.sensor import Sensor
from ..pipeline import ConfidentOutput, ConfidentPipeline
from ..pipeline.confidence import DEPTH_SPREAD, bound_at
from ..scenes import scenes
from .metrics import normal_angle_deg
from .score import ball_truth

LEVELS = (0.5, 0.68, 0.8, 0.9, 0.95)
"""Probabilities that are looked at."""

SHAPES = ("sphere", "cylinder", "cone", "sine", "punch", "letters")
"""What is pressed in random scenes."""

UNITS = ("lights known", "lights known, background", "lights fitted", "presses")
"""How the units of random scenes are calibrated: the last by response fields from twelve balls."""


class Coverage(NamedTuple):
    """Shares of pixels within their bounds at each of :data:`LEVELS`, (5,) each, and what was looked at."""

    name: str
    shape: str
    normal: Tensor
    depth: Tensor


class RandomFrame(NamedTuple):
    """A frame of a random unit: how it was calibrated, what was pressed, its truth and its image."""

    unit: str
    shape: str
    calibration: Calibration
    mode: str
    scene: scenes.Scene
    image: Tensor


def coverage(
    out: ConfidentOutput, depth_mm: Tensor, normal: Tensor, region: Tensor, spread: float, name: str = "", shape: str = ""
) -> Coverage:
    """Shares of the pixels of a region whose errors are within their bounds.

    Args:
        out: of one frame or more. depth_mm, normal, region: the truth (B, 1, H, W), (B, 3, H, W), and where to look, bool.
        spread: ``Confidence.spread``. name, shape: kept.
    Raises:
        ValueError: an empty region.
    """
    if not bool(region.any()):
        raise ValueError("region: expected at least one pixel, got none: no contact was found")
    angle = normal_angle_deg(out.normal.to(normal.dtype), normal)[:, None]
    error = (out.depth_mm - depth_mm).abs()
    of_normal = [(angle <= bound_at(out.normal_95_deg, level, spread))[region].double().mean() for level in LEVELS]
    of_depth = [(error <= bound_at(out.depth_95_mm, level, DEPTH_SPREAD))[region].double().mean() for level in LEVELS]
    return Coverage(name, shape, torch.stack(of_normal), torch.stack(of_depth))


def random_frame(seed: int, unit: str | None = None, shape: str | None = None) -> RandomFrame:
    """A random sensor, its calibration and a frame: 8 bits, noise up to 1.5 %, lights, size and shape by chance.

    Args:
        seed: of everything. unit: one of :data:`UNITS`; None draws one of the first three. shape: one of :data:`SHAPES`, or None.
    Raises:
        ValueError: unknown unit or shape.
    Example:
        >>> frame = random_frame(1, "lights known", "sphere")
        >>> frame.image.shape[1], frame.mode in ("fast", "precise", "auto")
        (3, True)
    """
    draw = random.Random(seed)
    unit = draw.choice(UNITS[:3]) if unit is None else unit
    shape = draw.choice(SHAPES) if shape is None else shape
    if unit not in UNITS or shape not in SHAPES:
        raise ValueError(f"unit, shape: expected one of {UNITS} and one of {SHAPES}, got {unit!r} and {shape!r}")
    width = draw.choice([160, 160, 320])
    height, wide_mm = width * 3 // 4, draw.uniform(15.0, 40.0)
    sensor = Sensor("random", height, width, wide_mm / width)
    lights = _random_lights(draw, wide_mm)
    by_balls = unit == "presses"
    noise = draw.choice([0.002, 0.004, 0.008] if by_balls else [0.0, 0.002, 0.004, 0.008, 0.015])
    spots = scenes.skin_spots(height, width, seed=seed) if draw.random() < 0.3 and unit != UNITS[0] and not by_balls else None
    scene = _random_press(draw, shape, sensor)
    rest = scenes.render(scenes.undeformed(scene), lights, noise_std=noise, bits=8, spots=spots, seed=10 * seed + 1)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        if by_balls:
            calibration = _by_random_balls(draw, lights, sensor, rest, noise, seed)
        elif unit == "lights fitted":
            calibration = calibrate(rest, sensor)
        else:
            calibration = Calibration.from_lights(lights, sensor, None if unit == UNITS[0] else rest)
    mode = draw.choice(["fast", "precise", "precise", "auto"])
    image = scenes.render(scene, lights, noise_std=noise, bits=8, spots=spots, seed=10 * seed)
    return RandomFrame(unit, shape, calibration, mode, scene, image)


def of_scenes(seeds: Sequence[int], unit: str | None = None, progress: bool = False) -> list[Coverage]:
    """Coverage over the true and the found contact of random frames, one row a frame that has any.

    Args:
        seeds: one a frame. unit: as for :func:`random_frame`. progress: show a bar.
    """
    rows = []
    for seed in tqdm(seeds, desc=unit or "scenes", disable=not progress, leave=False):
        frame = random_frame(seed, unit)
        pipe = ConfidentPipeline.from_calibration(frame.calibration, frame.mode)
        with torch.inference_mode():
            out = pipe(frame.image)
        if int(out.contact.sum()) >= 20:
            region = out.contact | frame.scene.contact
            truth = (frame.scene.depth_mm, frame.scene.normal)
            rows.append(coverage(out, *truth, region, pipe.confidence.spread, frame.unit, frame.shape))
    return rows


def of_presses(
    folder: str | Path, sensor: Sensor, *, learn: bool = True, mode: str = "precise", folds: int = 5, progress: bool = False
) -> list[Coverage]:
    """Coverage on presses of balls that calibration has not seen, inside their contact, one row a press.

    Where the ball lies is labelled, how deep it went is not: of depth, its relief is judged, each less its own mean.

    Args:
        folder: presses in gs_sdk's layout, with labels. sensor: the sensor; with its prior, if it has one.
        learn: calibrate on the presses of the other folds; else on the background alone, by the prior.
        mode: of the pipeline. folds: parts of the cross-validation. progress: show a bar.
    Raises:
        ValueError: no press has a label to be judged by.
    """
    check_integer("folds", folds, 2)
    background, presses = read_presses(folder)
    bare = [dataclasses.replace(press, center_px=None, contact_radius_px=None) for press in presses]
    rows = []
    for fold in tqdm(range(folds), desc="presses", disable=not progress, leave=False):
        others = [press for k, press in enumerate(bare) if k % folds != fold] if learn else []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CalibrationWarning)
            calibration = calibrate(background, sensor, others)
        pipe = ConfidentPipeline.from_calibration(calibration, mode)
        for press in presses[fold::folds]:
            if press.center_px is None or press.contact_radius_px is None:
                continue
            rows.append(of_press(pipe(press.image[None]), press, sensor.mm_per_pixel, pipe.confidence.spread))
    if not rows:
        raise ValueError(f"folder: none of {len(presses)} presses has a center and a contact radius: nothing can be judged")
    return rows


def of_press(out: ConfidentOutput, press: Press, mm_per_pixel: float, spread: float) -> Coverage:
    """Coverage of one press inside its contact; of depth, of the relief.

    Args:
        out: the frame. press: with center and contact radius. mm_per_pixel: pitch, mm. spread: ``Confidence.spread``.
    """
    truth = ball_truth(press, out.depth_mm.shape[2], out.depth_mm.shape[3], mm_per_pixel)
    level = (out.depth_mm - truth.depth_mm)[truth.region].mean()
    ball = normal_from_gradient(truth.gradient)
    return coverage(out, truth.depth_mm + level, ball, truth.region, spread, press.name, "ball")


def mean(rows: Sequence[Coverage], name: str = "") -> Coverage:
    """Mean over frames.

    Raises:
        ValueError: no rows.
    """
    if not rows:
        raise ValueError("rows: expected at least one frame, got none")
    parts = [torch.stack(column).mean(0) for column in ([row.normal for row in rows], [row.depth for row in rows])]
    return Coverage(name, "", *parts)


def table(rows: Sequence[Coverage]) -> str:
    """Markdown: share of pixels within the bounds at each level, percent, normals and then depth."""
    levels = [f"{level:.0%}" for level in LEVELS]
    lines = [f"| | {' | '.join(f'normal {v}' for v in levels)} | {' | '.join(f'depth {v}' for v in levels)} |"]
    lines.append("|---" * (1 + 2 * len(levels)) + "|")
    for row in rows:
        shares = [f"{100.0 * float(v):.1f}" for v in (*row.normal, *row.depth)]
        lines.append(f"| {row.name} | {' | '.join(shares)} |")
    return "\n".join(lines)


def figure(curves: Sequence[Coverage], seed: int = 1) -> Figure:
    """Stated against found shares, and on one random scene the bound of the normal beside its error.

    Args:
        curves: means, a line each. seed: of the scene.
    """
    picture = Figure(figsize=(11.0, 7.2), layout="constrained", dpi=110)
    FigureCanvasAgg(picture)
    parts = picture.subfigures(2, 1, height_ratios=[1.15, 1.0], squeeze=False)
    above, below = parts[0, 0], parts[1, 0]
    for panel, what in zip(list(above.subplots(1, 2)), ("normal", "depth")):
        panel.fill_between([45, 100], [40, 95], [50, 105], color="0.9", label="within 5 points")
        panel.plot([45, 100], [45, 100], color="0.5", linewidth=1.0)
        for curve in curves:
            shares = (100.0 * (curve.normal if what == "normal" else curve.depth)).tolist()
            panel.plot([100.0 * level for level in LEVELS], shares, marker="o", markersize=4, label=curve.name)
        panel.set_xlim(47, 98)
        panel.set_ylim(30, 101)
        panel.set_xlabel("stated, % of pixels")
        panel.set_ylabel("found, % of pixels")
        panel.set_title(f"{what} within its bound")
        panel.grid(alpha=0.3)
    panel.legend(loc="lower right", fontsize=8)
    frame = random_frame(seed, "lights known, background", "letters")
    out = ConfidentPipeline.from_calibration(frame.calibration, "precise")(frame.image)
    angle = normal_angle_deg(out.normal, frame.scene.normal)
    depth_um = 1000.0 * (out.depth_mm - frame.scene.depth_mm).abs()[0, 0]
    maps: list[tuple[str, Tensor]] = [
        ("bound of the normal (95 %), deg", out.normal_95_deg[0, 0]),
        ("its error, deg", angle[0]),
        ("bound of the depth (95 %), um", 1000.0 * out.depth_95_mm[0, 0]),
        ("its error, um", depth_um),
    ]
    inside = (out.contact | frame.scene.contact)[0, 0]
    for k, (panel, (title, values)) in enumerate(zip(below.subplots(1, 4), maps)):
        most = float(maps[k - k % 2][1][inside].quantile(0.99))
        seen = torch.where(inside, values, torch.full_like(values, math.nan))
        drawn = panel.imshow(seen.numpy(), cmap="viridis", vmin=0.0, vmax=most)
        panel.set_title(title, fontsize=9)
        panel.set_xticks([]), panel.set_yticks([])
        below.colorbar(drawn, ax=panel, shrink=0.75, orientation="horizontal")
    return picture


def _random_lights(draw: random.Random, wide_mm: float) -> PointLights:
    radius, height = draw.uniform(0.45, 0.9) * wide_mm, draw.uniform(0.5, 1.2) * wide_mm
    first, level = draw.uniform(0.0, 120.0), draw.uniform(0.25, 0.55)
    rows = []
    for k in range(3):
        angle = math.radians(first + 120.0 * k + draw.uniform(-15.0, 15.0))
        rows.append([radius * math.cos(angle), radius * math.sin(angle), height * draw.uniform(0.9, 1.1)])
    position = torch.tensor(rows)
    return PointLights(position, level * position.norm(dim=1) ** 3 / position[:, 2]).requires_grad_(False)


def _random_press(draw: random.Random, shape: str, sensor: Sensor) -> scenes.Scene:
    size = (sensor.height, sensor.width, sensor.mm_per_pixel)
    wide, high = sensor.width * sensor.mm_per_pixel, sensor.height * sensor.mm_per_pixel
    if shape == "sphere":
        radius = draw.uniform(0.1, 0.4) * high
        at = (draw.uniform(-0.3, 0.3) * wide, draw.uniform(-0.3, 0.3) * high)
        return scenes.sphere_press(radius, draw.uniform(0.04, 0.25) * radius, at, *size)
    near = (draw.uniform(-0.1, 0.1) * wide, draw.uniform(-0.1, 0.1) * high)
    if shape == "cylinder":
        radius = draw.uniform(0.08, 0.2) * high
        press, length = draw.uniform(0.05, 0.25) * radius, draw.uniform(0.2, 0.6) * high
        return scenes.cylinder_press(radius, press, length, draw.uniform(0.0, 180.0), near, *size)
    if shape == "cone":
        angle = draw.uniform(60.0, 80.0)
        press = draw.uniform(0.12, 0.35) * high / math.tan(math.radians(angle))
        return scenes.cone_press(angle, press, draw.uniform(0.01, 0.05) * high, near, *size)
    if shape == "sine":
        period = draw.uniform(0.06, 0.2) * high
        return scenes.sine_press(draw.uniform(0.03, 0.1) * period, period, draw.uniform(0.2, 0.42) * high, *size)
    if shape == "punch":
        radius, press = draw.uniform(0.1, 0.3) * high, draw.uniform(0.01, 0.03) * high
        return scenes.punch_press(radius, press, draw.uniform(0.0, 4.0), draw.uniform(0.04, 0.1) * high, *size)
    press, letter = draw.uniform(0.008, 0.02) * high, draw.uniform(0.18, 0.3) * high
    stroke, bevel = draw.uniform(0.03, 0.05) * high, draw.uniform(0.02, 0.04) * high
    return scenes.letters_press(draw.choice(["VTS", "AB", "XO", "GEL"]), press, letter, stroke, bevel, *size)


def _by_random_balls(
    draw: random.Random, lights: PointLights, sensor: Sensor, rest: Tensor, noise: float, seed: int
) -> Calibration:
    """Response fields by twelve balls of two sizes, though point lights would be the better model."""
    presses = []
    for k in range(12):
        radius = draw.choice([0.15, 0.25]) * sensor.height * sensor.mm_per_pixel
        x, y = (draw.uniform(-0.35, 0.35) * n * sensor.mm_per_pixel for n in (sensor.width, sensor.height))
        size = (sensor.height, sensor.width, sensor.mm_per_pixel)
        ball = scenes.sphere_press(radius, draw.uniform(0.06, 0.2) * radius, (x, y), *size)
        image = scenes.render(ball, lights, noise_std=noise, bits=8, seed=100 * seed + k)[0]
        presses.append(Press(image, 2.0 * radius, f"ball {k}"))
    fit, contacts, unit = by_presses(rest, sensor, presses, None, False)
    told: list[PressRow] = [{"name": contact.name, "used": not contact.reason} for contact in contacts]
    return dataclasses.replace(
        unit, report={"model": "response", "source": "presses", "held_out_deg": fit.error_deg, "presses": told}
    )
