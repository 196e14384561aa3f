"""Pose through the whole chain: objects of known pose rendered, calibrated depth from the images, registration, errors."""

import itertools
import math
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..calibration import Press, calibrate
from ..model.calibration import Calibration
from ..model.lights import PointLights
from ..model.sensor import Sensor
from ..pipeline import DepthOutput, DepthPipeline
from ..pose import Registration, register_depth
from ..pose.result import invert, turn_deg
from ..scenes import objects
from ..scenes.scenes import render

GOAL_DEG, GOAL_MM = 1.0, 0.15
"""A pose within both counts as a success."""


@dataclass(frozen=True, eq=False)
class PoseCase:
    """Two presses of one object: its poses in both, the depth measured from their images, the pitch, mm."""

    T_sensor_source: Tensor
    T_sensor_target: Tensor
    source: DepthOutput
    target: DepthOutput
    mm_per_pixel: float


@dataclass(frozen=True, eq=False)
class PoseRow:
    """One object over many poses.

    Attributes:
        name: of the object. poses: number.
        deg, mm: errors of each pose modulo the object's symmetry; of the object's origin, where it lies in the target.
        seconds: of each registration. converged: how many. success: share within a degree and 0.15 mm.
        wrong: poses that came as converged, with nothing said to be unknown, and are off by more than that.
        named: share whose unknown directions are the true ones; None for objects that have none.
        notes: what registration refused, one line each.
    """

    name: str
    poses: int
    deg: list[float] = field(default_factory=list)
    mm: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    converged: int = 0
    success: float = 0.0
    wrong: int = 0
    named: float | None = None
    notes: list[str] = field(default_factory=list)


def rig(height: int = 240, width: int = 320, mm_per_pixel: float = 0.0625) -> tuple[PointLights, DepthPipeline]:
    """Three lights at 120 degrees over the sensor, and the precise pipeline that knows them."""
    angles = [math.radians(10.0 + 120.0 * k) for k in range(3)]
    position = [[31.0 * math.cos(a), 31.0 * math.sin(a), 40.0] for a in angles]
    lights = PointLights(position, [0.45 * math.hypot(31.0, 40.0) ** 3 / 40.0] * 3).requires_grad_(False)
    calibration = Calibration.from_lights(lights, Sensor("pose bench", height, width, mm_per_pixel))
    return lights, DepthPipeline.from_calibration(calibration, "precise")


def pose_case(
    target: objects.Target, seed: int, lights: PointLights, pipe: DepthPipeline, size: tuple[int, int], noise_std: float
) -> PoseCase:
    """A reference press near the middle, and one turned by any angle and moved by up to 4 mm; noisy, 8 bits.

    Both are 0.3 to 0.6 mm deep and tilted by up to 3 degrees; a plane, which touches only where it is tilted, by 2.8 to 3.
    """
    generator = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    flat = "translation along x" in target.free and "translation along y" in target.free
    presses = []
    for k in range(2):
        reach = 4.0 * math.sqrt(between(0.0, 1.0)) if k else between(0.0, 0.3)
        way, slant = between(0.0, 2.0 * math.pi), between(0.0, 2.0 * math.pi)
        tilt = between(2.8, 3.0) if flat else between(0.0, 3.0)
        depth = between(-0.1, 0.1) if flat else between(0.3, 0.6)
        T = objects.pose(
            between(0.0, 360.0) if k else 0.0,
            (reach * math.cos(way), reach * math.sin(way)),
            depth,
            (tilt * math.cos(slant), tilt * math.sin(slant)),
        )
        scene = objects.press(target.height_mm, T, size[0], size[1], pipe.mm_per_pixel)
        with torch.inference_mode():
            presses.append((T, pipe(render(scene, lights, noise_std=noise_std, bits=8, seed=2 * seed + k))))
    return PoseCase(presses[1][0], presses[0][0], presses[1][1], presses[0][1], pipe.mm_per_pixel)


def pose_error(found: Tensor, case: PoseCase, period_deg: float) -> tuple[float, float]:
    """Degrees and mm between a pose and the nearest of the true ones, the object being as good turned by its period."""
    errors = []
    for k in range(round(360.0 / period_deg)):
        truth = case.T_sensor_target @ objects.pose(k * period_deg, press_mm=0.0) @ invert(case.T_sensor_source)
        off = found @ invert(truth)
        middle = case.T_sensor_target[:3, 3]
        errors.append((float(turn_deg(off)), float((off[:3, :3] @ middle + off[:3, 3] - middle).norm())))
    return min(errors)


def run_poses(
    targets: dict[str, objects.Target],
    poses: int,
    *,
    size: tuple[int, int] = (240, 320),
    noise_std: float = 0.005,
    progress: Callable[[], object] = lambda: None,
    register: Callable[[PoseCase], Registration] = lambda case: register_depth(case.source, case.target, case.mm_per_pixel),
) -> tuple[list[PoseRow], dict[str, tuple[PoseCase, Registration]]]:
    """All objects in ``poses`` poses each; the rows, and the first pose of each for a picture. The field is 20 mm wide."""
    lights, pipe = rig(*size, 20.0 / size[1])
    rows: list[PoseRow] = []
    shown: dict[str, tuple[PoseCase, Registration]] = {}
    for name, target in targets.items():
        row = PoseRow(name, poses)
        named = good = wrong = converged = 0
        for seed in range(poses):
            case = pose_case(target, 1000 + seed, lights, pipe, size, noise_std)
            start = time.perf_counter()
            try:
                found = register(case)
            except ValueError as error:
                row.notes.append(f"pose {seed}: {error}")
                progress()
                continue
            row.seconds.append(time.perf_counter() - start)
            shown.setdefault(name, (case, found))
            deg, mm = pose_error(found.T_target_source, case, target.period_deg)
            row.deg.append(deg)
            row.mm.append(mm)
            within = deg <= GOAL_DEG and mm <= GOAL_MM
            converged += found.converged
            good += within and found.converged
            wrong += found.converged and not found.ambiguous and not within
            kinds = {kind for name_ in found.ambiguous for kind in target.free if name_.startswith(kind)}
            named += found.converged and kinds == set(target.free) and len(found.ambiguous) == max(len(target.free), target.freedom)
            progress()
        rows.append(
            PoseRow(
                name,
                poses,
                row.deg,
                row.mm,
                row.seconds,
                converged,
                good / poses,
                wrong,
                named / poses if target.free else None,
                row.notes,
            )
        )
    return rows, shown


def ball_pairs(
    background: Tensor, presses: Sequence[Press], sensor: Sensor, most: int = 100, progress: Callable[[], object] = lambda: None
) -> dict[str, int]:
    """What registration says of real presses of one ball against each other, of which it can know no rotation.

    Args:
        background: (3, H, W). presses: of balls. sensor: with a prior, by which the unit is calibrated, no press being used.
        most: pairs, evenly chosen of all with the same ball.
    Returns:
        Numbers of pairs: "pairs", "converged", and of these "named" (three rotations), "named in part", "not named".
    """
    pipe = DepthPipeline.from_calibration(calibrate(background, sensor), "precise")
    with torch.inference_mode():
        frames = [pipe(press.image[None]) for press in presses]
    pairs = [
        (i, j)
        for i, j in itertools.combinations(range(len(presses)), 2)
        if presses[i].ball_diameter_mm == presses[j].ball_diameter_mm
    ]
    counts = {"pairs": 0, "converged": 0, "named": 0, "named in part": 0, "not named": 0}
    for i, j in pairs[:: max(1, math.ceil(len(pairs) / most))]:
        counts["pairs"] += 1
        found = register_depth(frames[i], frames[j], sensor.mm_per_pixel)
        if found.converged:
            counts["converged"] += 1
            turns = sum(name.startswith("rotation") for name in found.ambiguous)
            counts["named" if turns == 3 else "named in part" if turns else "not named"] += 1
        progress()
    return counts


def pose_table(rows: list[PoseRow]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| object | poses | angle deg, median / 95 % | position mm, median / 95 % | within 1 deg and 0.15 mm "
        "| confident and wrong | unknown directions named | s, median |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        if row.named is None:
            angle = f"{_quantile(row.deg, 0.5):.3f} / {_quantile(row.deg, 0.95):.3f}"
            errors = f"{angle} | {_quantile(row.mm, 0.5):.4f} / {_quantile(row.mm, 0.95):.4f}"
            share, named = f"{100 * row.success:.0f} %", ""
        else:
            errors, share, named = " | ", "", f"{100 * row.named:.0f} %"
        lines.append(
            f"| {row.name} | {row.poses} | {errors} | {share} | {row.wrong} | {named} | {_quantile(row.seconds, 0.5):.2f} |"
        )
    return "\n".join(lines)


def machine() -> str:
    """What a time was measured on."""
    return f"{platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}"


def _quantile(values: list[float], share: float) -> float:
    return float(torch.tensor(values, dtype=torch.float64).quantile(share)) if values else math.nan
