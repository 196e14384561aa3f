"""Accuracy of pose through the whole chain: render objects of known pose, measure depth, register, compare."""

import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchvts.calibration import Press, calibrate
from torchvts.core.tables import markdown
from torchvts.model import Calibration, PointLights, Sensor
from torchvts.pipeline import DepthOutput, DepthPipeline, FrozenPipeline
from torchvts.pose import Registration, register_depth
from torchvts.scenes import objects, render

from .faults import ring_lights
from .rigid import invert, turn_deg
from .rows import Row

GOAL_DEG, GOAL_MM = 1.0, 0.15
"""A pose within both limits is a success."""


@dataclass(frozen=True, eq=False)
class PoseCase:
    """Two presses of one object.

    Attributes:
        T_sensor_source: pose of the object in the first press, (4, 4).
        T_sensor_target: pose of the object in the second press, (4, 4).
        source: depth measured in the first press.
        target: depth measured in the second press.
        mm_per_pixel: pixel pitch, mm.
    """

    T_sensor_source: Tensor
    T_sensor_target: Tensor
    source: DepthOutput
    target: DepthOutput
    mm_per_pixel: float


def rig(height: int = 240, width: int = 320, mm_per_pixel: float = 0.0625) -> tuple[PointLights, FrozenPipeline]:
    """Three lights at 120 degrees over the sensor, and the frozen pipeline of this unit in mode precise.

    Args:
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch, mm.
    """
    lights = ring_lights(31.0, 40.0)
    calibration = Calibration.from_lights(lights, Sensor("pose bench", height, width, mm_per_pixel))
    return lights, DepthPipeline.from_calibration(calibration, "precise").freeze()


def pose_case(
    target: objects.Target, seed: int, lights: PointLights, pipe: FrozenPipeline, size: tuple[int, int], noise_std: float
) -> PoseCase:
    """A reference press near the middle, and a second one turned by any angle and moved by up to 4 mm.

    Both are 0.3 to 0.6 mm deep and tilted by up to 3 degrees; a plane, which touches only where it is tilted, by 2.8 to 3. The
    seed is that of both poses and of the noise; images have 8 bits.
    """
    generator = torch.Generator().manual_seed(seed)
    presses = []
    for k in range(2):
        T = _random_pose(target, generator, moved=k == 1)
        scene = objects.press(target.height_mm, T, size[0], size[1], pipe.mm_per_pixel)
        with torch.inference_mode():
            presses.append((T, pipe(render(scene, lights, noise_std=noise_std, bits=8, seed=2 * seed + k))))
    return PoseCase(presses[1][0], presses[0][0], presses[1][1], presses[0][1], pipe.mm_per_pixel)


def _random_pose(target: objects.Target, generator: torch.Generator, moved: bool) -> Tensor:
    def between(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    flat = "translation along x" in target.free and "translation along y" in target.free
    reach = 4.0 * math.sqrt(between(0.0, 1.0)) if moved else between(0.0, 0.3)
    way, slant = between(0.0, 2.0 * math.pi), between(0.0, 2.0 * math.pi)
    tilt = between(2.8, 3.0) if flat else between(0.0, 3.0)
    depth = between(-0.1, 0.1) if flat else between(0.3, 0.6)
    return objects.pose(
        between(0.0, 360.0) if moved else 0.0,
        (reach * math.cos(way), reach * math.sin(way)),
        depth,
        (tilt * math.cos(slant), tilt * math.sin(slant)),
    )


def pose_error(found: Tensor, case: PoseCase, period_deg: float) -> tuple[float, float]:
    """Degrees and mm between a pose and the nearest true pose of an object that looks the same after a turn by its period."""
    errors = []
    for k in range(round(360.0 / period_deg)):
        truth = case.T_sensor_target @ objects.pose(k * period_deg, press_mm=0.0) @ invert(case.T_sensor_source)
        off = found @ invert(truth)
        middle = case.T_sensor_target[:3, 3]
        errors.append((float(turn_deg(off)), float((off[:3, :3] @ middle + off[:3, 3] - middle).norm())))
    return min(errors)


Register = Callable[[PoseCase], Registration]


def by_depth(case: PoseCase) -> Registration:
    """Register the two depth maps."""
    return register_depth(case.source, case.target, case.mm_per_pixel)


def run_poses(
    targets: dict[str, objects.Target],
    poses: int,
    *,
    size: tuple[int, int] = (240, 320),
    noise_std: float = 0.005,
    progress: Callable[[], object] = lambda: None,
    register: Register = by_depth,
) -> tuple[list[Row], dict[str, tuple[PoseCase, Registration]]]:
    """Register all objects, by name, in a number of poses each; the field is 20 mm wide, images have 8 bits.

    ``progress`` is called for each pose.

    Returns:
        A row for each object, and its first pose for a picture. Errors of a row: the number of registrations that are "converged",
        of these "within" the goal, and "wrong" (outside of it, though no direction is reported as unknown); for objects that have
        unknown directions, "named": where the true ones are reported. Each registration: "deg" and "mm" to the nearest true pose,
        "s"; those that were refused are in the note.
    """
    lights, pipe = rig(*size, 20.0 / size[1])
    rows: list[Row] = []
    shown: dict[str, tuple[PoseCase, Registration]] = {}
    for name, target in targets.items():
        counts = dict.fromkeys(("converged", "within", "wrong", *(("named",) if target.free else ())), 0.0)
        each: dict[str, list[float]] = {"deg": [], "mm": [], "s": []}
        refused = []
        for seed in range(poses):
            case = pose_case(target, 1000 + seed, lights, pipe, size, noise_std)
            start = time.perf_counter()
            try:
                found = register(case)
            except ValueError as error:
                refused.append(f"pose {seed}: {error}")
            else:
                each["s"].append(time.perf_counter() - start)
                _count(found, case, target, counts, each)
                shown.setdefault(name, (case, found))
            progress()
        rows.append(Row("pose", "registration", name, counts, frames=poses, note="; ".join(refused), each=each))
    return rows, shown


def _count(
    found: Registration, case: PoseCase, target: objects.Target, counts: dict[str, float], each: dict[str, list[float]]
) -> None:
    """Compare a registration with the truth."""
    deg, mm = pose_error(found.T_target_source, case, target.period_deg)
    each["deg"].append(deg)
    each["mm"].append(mm)
    if not found.converged:
        return
    within = deg <= GOAL_DEG and mm <= GOAL_MM
    counts["converged"] += 1
    counts["within"] += within
    counts["wrong"] += not within and not found.ambiguous
    if "named" in counts:
        kinds = {kind for name in found.ambiguous for kind in target.free if name.startswith(kind)}
        counts["named"] += kinds == set(target.free) and len(found.ambiguous) == max(len(target.free), target.freedom)


def ball_pairs(
    background: Tensor, presses: Sequence[Press], sensor: Sensor, most: int = 100, progress: Callable[[], object] = lambda: None
) -> dict[str, int]:
    """Register real presses of the same ball with each other: no rotation of a ball can be determined.

    The unit is calibrated by its background (3, H, W) and the sensor's prior, without the presses. At most ``most`` pairs are
    registered, evenly chosen; ``progress`` is called for each.

    Returns:
        Counts: "pairs", "converged", and of these "named" (three rotations reported), "named in part", "not named".
    """
    pipe = DepthPipeline.from_calibration(calibrate(background, sensor), "precise").freeze()
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


def pose_table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table."""
    titles = ["object", "poses", "angle deg, median / 95 %", "position mm, median / 95 %", "within 1 deg and 0.15 mm"]
    titles += ["confident and wrong", "unknown directions named", "s, median"]
    lines = []
    for row in rows:
        named, within = row.error("named"), row.error("within") or 0.0
        if named is None:
            angle = f"{_quantile(row.each['deg'], 0.5):.3f} / {_quantile(row.each['deg'], 0.95):.3f}"
            place = f"{_quantile(row.each['mm'], 0.5):.4f} / {_quantile(row.each['mm'], 0.95):.4f}"
            errors = [angle, place, f"{100 * within / row.frames:.0f} %", f"{row.errors['wrong']:.0f}", ""]
        else:
            errors = ["", "", "", f"{row.errors['wrong']:.0f}", f"{100 * named / row.frames:.0f} %"]
        lines.append([row.data, str(row.frames), *errors, f"{_quantile(row.each['s'], 0.5):.2f}"])
    return markdown(titles, lines)


def _quantile(values: list[float], share: float) -> float:
    return float(torch.tensor(values, dtype=torch.float64).quantile(share)) if values else math.nan
