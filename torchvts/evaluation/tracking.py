"""Accuracy of tracking through the whole chain: render an object that moves, measure depth, track, compare."""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from ..core.geometry import gradient_of_depth, normal_from_gradient
from ..integration import poisson_dst
from ..model import PointLights
from ..pipeline import DepthOutput, FrozenPipeline
from ..pose import PoseTracker, Registration, register_depth
from ..pose.result import invert, turn_deg
from ..scenes import objects, render
from ..skin import ZeroBackground
from ..viz import new_figure
from .faults import gaussian_blur
from .pose_accuracy import GOAL_DEG, GOAL_MM, rig
from .rows import markdown

Array = np.ndarray[Any, Any]

OBJECTS = ("key", "textured patch", "tool handle", "gear", "bottle cap", "bolt head")
"""The six objects of the tracking bench."""

WAVES, WAVES_SLOPE, FINE_SHARE, FINE_MM = 96, 0.4, 0.3, 0.14
"""Of the slope errors of real sensors: number of waves drawn, length over slopes, and share and length (mm) of fine waves."""


class Noise(NamedTuple):
    """What is wrong with the frames of a track.

    Attributes:
        image_std: standard deviation of the image.
        slopes_deg: root mean square error of the slopes, degrees.
        waves_mm: length over which errors of slopes are alike.
    """

    image_std: float
    slopes_deg: float = 0.0
    waves_mm: float = 2.5


NOISES = {
    "noise 0.002": Noise(0.002),
    "noise 0.005": Noise(0.005),
    "slopes off by 3 degrees": Noise(0.005, 3.0),
    "slopes off by 3 degrees, long waves": Noise(0.005, 3.0, 4.5),
}
"""Noises of the bench: waves as balls on real sensors show them, and as wide contacts of drawn sensors do."""


@dataclass(frozen=True)
class Motion:
    """How an object moves.

    Attributes:
        frames: number of frames, the reference among them.
        pose: T_sensor_object (4, 4) of a frame, from its number and a seed.
        lost: frames that must be reported as lost.
        again: frames that are the one before once more, as of a camera that stands still for a while.
    """

    frames: int
    pose: Callable[[int, int], Tensor]
    lost: tuple[int, ...] = ()
    again: tuple[int, ...] = ()


def _phases(seed: int) -> list[float]:
    return (2.0 * math.pi * torch.rand(5, generator=torch.Generator().manual_seed(seed))).tolist()


def _sweep(turn_deg: float, frames: int, shift_mm: float = 1.0, tilt_deg: float = 2.5) -> Callable[[int, int], Tensor]:
    """Yaw at an even rate, with shifts and tilts of such amplitudes on the way."""

    def pose(k: int, seed: int) -> Tensor:
        a, b, c, d, e = _phases(seed)
        s = 2.0 * math.pi * k / (frames - 1)
        shift = (shift_mm * (math.sin(s + a) - math.sin(a)), shift_mm * (math.sin(1.5 * s + b) - math.sin(b)))
        tilt = (tilt_deg * math.sin(2.0 * s + c), tilt_deg * math.cos(1.5 * s + d))
        return objects.pose(turn_deg * k / (frames - 1), shift, 0.45 + 0.1 * math.sin(s + e), tilt)

    return pose


def _partial(k: int, seed: int) -> Tensor:
    """From the middle to beyond the edge of the image and back, tilted so that a part of the object touches."""
    a, b = _phases(seed)[:2]
    out = 7.0 * math.sin(math.pi * k / 39)
    return objects.pose(1.0 * k, (out * math.cos(a), out * math.sin(a)), 0.4, (3.5 * math.sin(b + 0.1 * k), 3.5 * math.cos(b)))


def _slip(k: int, seed: int) -> Tensor:
    """Still, then 0.5 mm and 2 degrees from frame to frame for six frames, then still."""
    a = _phases(seed)[0]
    gone = float(min(max(k - 8, 0), 6))
    return objects.pose(2.0 * gone, (0.5 * gone * math.cos(a), 0.5 * gone * math.sin(a)), 0.45, (1.0, 0.5))


def _lift_off(k: int, seed: int) -> Tensor:
    """Lifted off in five frames, away for four, put back elsewhere in five."""
    a = _phases(seed)[0]
    deep = 0.5 - 0.2 * min(max(k - 4, 0), max(18 - k, 0), 5)
    back = k >= 11
    return objects.pose(25.0 * back, (1.5 * math.cos(a) * back, 1.5 * math.sin(a) * back), deep)


def _jump(k: int, seed: int) -> Tensor:
    """Slow, then 3 mm and 40 degrees at once, then slow."""
    a, jumped = _phases(seed)[0], float(k >= 10)
    return objects.pose(0.5 * k + 40.0 * jumped, (3.0 * jumped * math.cos(a), 3.0 * jumped * math.sin(a)), 0.45, (1.0, 1.0))


_AGAIN = (1, 2, 3, *range(14, 24))


def _paused(k: int, seed: int) -> Tensor:
    """As slow, but for frames that come again: three after the reference, and ten later on."""
    return _sweep(90.0, 40)(k - sum(frame <= k for frame in _AGAIN), seed)


MOTIONS = {
    "slow": Motion(40, _sweep(90.0, 40)),
    "fast": Motion(14, _sweep(90.0, 14)),
    "full turn": Motion(120, _sweep(360.0, 120)),
    "partial contact": Motion(40, _partial),
    "slip": Motion(20, _slip),
    "lift-off": Motion(24, _lift_off, (9, 10, 11, 12, 13)),
    "jump": Motion(20, _jump, (10,)),
    "paused": Motion(34, _paused, again=_AGAIN),
}


@dataclass(frozen=True, eq=False)
class Track:
    """An object that moves, as a sensor measures it: the poses T_sensor_object (4, 4), and the frames."""

    poses: list[Tensor]
    frames: list[DepthOutput]
    mm_per_pixel: float


@dataclass
class TrackRow:
    """One object under one motion and one noise.

    Attributes:
        name: of the object.
        motion: of the object.
        noise: of the images.
        deg: rotation error of each frame that was not lost, degrees.
        mm: error of the position of the object's origin, mm.
        ms: time of each frame, ms.
        lost: numbers of the frames that were lost.
        unnoticed: frames that must be lost and were not.
        uncertain: frames whose pose is not called converged though the object is followed.
        wrong: frames that are confident, with no motion or pose in question, and outside of the goal of the pose bench.
        drift_deg: rotation error at the end, per 360 degrees of yaw.
        seed: of the motion and of the noise of the images.
        sensor: seed of the errors of slopes; 0 where there are none.
        ratio: rotation errors over the standard deviations that the covariance states, where all motions are known.
        ratio_mm: the same of the position of the object's origin.
    """

    name: str
    motion: str
    noise: str
    deg: list[float] = field(default_factory=list)
    mm: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    unnoticed: list[int] = field(default_factory=list)
    uncertain: list[int] = field(default_factory=list)
    wrong: list[int] = field(default_factory=list)
    drift_deg: float = math.nan
    seed: int = 1
    sensor: int = 0
    ratio: list[float] = field(default_factory=list)
    ratio_mm: list[float] = field(default_factory=list)


def record(target: objects.Target, motion: Motion, image_std: float, seed: int, unit: tuple[PointLights, FrozenPipeline]) -> Track:
    """Render and measure an object that moves; 320 x 240, 8 bits.

    Args:
        target: the object.
        motion: its motion.
        image_std: standard deviation of the images' noise.
        seed: of motion and noise.
        unit: lights and pipeline, as of :func:`torchvts.evaluation.pose_accuracy.rig`.
    """
    lights, pipe = unit
    poses = [motion.pose(k, seed) for k in range(motion.frames)]
    frames: list[DepthOutput] = []
    for k, pose in enumerate(poses):
        if k in motion.again:
            frames.append(frames[-1])
            continue
        scene = objects.press(target.height_mm, pose, 240, 320, pipe.mm_per_pixel)
        with torch.inference_mode():
            frame = pipe(render(scene, lights, noise_std=image_std, bits=8, seed=1000 * seed + k))
        frames.append(frame)
    return Track(poses, frames, pipe.mm_per_pixel)


def with_wrong_slopes(track: Track, noise: Noise, sensor: int) -> Track:
    """The track as a unit measures it whose slopes err, by :class:`WrongSlopes`; frames that come again err as before."""
    unit = WrongSlopes(track.frames[0], noise, sensor, track.mm_per_pixel)
    numbers = [next(k for k, other in enumerate(track.frames) if other is frame) for frame in track.frames]
    return Track(track.poses, [unit(track.frames[k], k) for k in numbers], track.mm_per_pixel)


class WrongSlopes:
    """A unit whose calibration errs: frames with wrong slopes, and the depth that these have.

    The error has the covariances that held-out presses of balls on two GelSight Minis and a DIGIT have (docs/tracking.md): most of
    it is one smooth random function of place and slope, the same in all frames; :data:`FINE_SHARE` of its square has fine waves
    that differ from frame to frame. Undeformed skin stays zero, as pipelines hold it.

    Args:
        reference: the frame in whose contact the root mean square error is as asked.
        noise: what is asked.
        seed: of the unit.
        mm_per_pixel: pixel pitch, mm.
    Source:
        random Fourier features: Rahimi, Recht, NIPS 2007.
    """

    def __init__(self, reference: DepthOutput, noise: Noise, seed: int, mm_per_pixel: float) -> None:
        generator = torch.Generator().manual_seed(seed + 77)
        lengths = torch.tensor([noise.waves_mm, noise.waves_mm, WAVES_SLOPE, WAVES_SLOPE])
        self._frequency = torch.randn(WAVES, 4, generator=generator) / lengths
        self._phase = 2.0 * math.pi * torch.rand(WAVES, generator=generator)
        self._size = math.sqrt(2.0 * (1.0 - FINE_SHARE) / WAVES) * torch.randn(2, WAVES, generator=generator)
        self._seed, self._pitch, self._scale = seed, mm_per_pixel, 1.0
        error = self._error(reference, 0)[0].square().sum(1, keepdim=True)[reference.contact]
        self._scale = math.tan(math.radians(noise.slopes_deg)) / max(float(error.mean().sqrt()), 1e-6)

    def __call__(self, frame: DepthOutput, number: int) -> DepthOutput:
        """The frame of such a number, 0 for the reference, as the unit measures it."""
        error, depth = self._error(frame, number)
        gradient = frame.gradient + error
        return frame._replace(gradient=gradient, depth_mm=frame.depth_mm + depth, normal=normal_from_gradient(gradient))

    def _error(self, frame: DepthOutput, number: int) -> tuple[Tensor, Tensor]:
        """Errors of slopes (1, 2, H, W) and depth (1, 1, H, W), as pipelines make them: of depth, zero on undeformed skin."""
        generator = torch.Generator().manual_seed(100003 * self._seed + number)
        fine = gaussian_blur(torch.randn(frame.gradient.shape, generator=generator), FINE_MM / self._pitch)
        raw = (math.sqrt(FINE_SHARE) / float(fine.std())) * fine * frame.deformed
        row, column = torch.nonzero(frame.deformed[0, 0], as_tuple=True)
        place = self._pitch * torch.stack((column, row), 1)
        at = torch.cat((place, frame.gradient[0, :, row, column].T), 1)  # (N, 4)
        raw[0, :, row, column] += self._size @ torch.cos(at @ self._frequency.T + self._phase).T
        small = 0.03 * poisson_dst(raw, self._pitch)  # too small to move where skin is undeformed
        zero, weight = ZeroBackground(self._pitch), frame.deformed.to(small.dtype)
        depth = zero(frame.depth_mm + small, weight) - zero(frame.depth_mm, weight)
        return self._scale * gradient_of_depth(depth, self._pitch) * frame.deformed, self._scale * depth


def follow_track(track: Track, motion: Motion, row: TrackRow) -> TrackRow:
    """Track all frames against the first one, and fill the row."""
    tracker = PoseTracker(track.frames[0], track.mm_per_pixel)
    for k in range(1, len(track.frames)):
        start = time.perf_counter()
        found = tracker(track.frames[k])
        row.ms.append(1000.0 * (time.perf_counter() - start))
        if found.lost:
            row.lost.append(k)
            continue
        deg, mm = tracking_error(found, track, k)
        row.deg.append(deg)
        row.mm.append(mm)
        if not found.ambiguous:
            std_deg, std_mm = _stated(found, track.poses[k][:3, 3])
            row.ratio.append(deg / std_deg)
            row.ratio_mm.append(mm / std_mm)
        within = deg <= GOAL_DEG and mm <= GOAL_MM
        if not found.converged:
            row.uncertain.append(k)
        elif not found.ambiguous and not within:
            row.wrong.append(k)
        row.drift_deg = deg
    row.unnoticed = sorted(set(motion.lost) - set(row.lost))
    turned = turn_deg(track.poses[-1] @ invert(track.poses[-2])) * (len(track.poses) - 1)
    row.drift_deg *= 360.0 / max(float(turned), 1.0)
    return row


def tracking_error(found: Registration, track: Track, k: int) -> tuple[float, float]:
    """Degrees and mm of the pose, or of the nearest one that it calls equally good."""
    return min(_error_of(T, track, k) for T in (found.T_target_source, *found.alternatives))


def _error_of(T_target_source: Tensor, track: Track, k: int) -> tuple[float, float]:
    truth, middle = track.poses[k] @ invert(track.poses[0]), track.poses[k][:3, 3]
    off = T_target_source @ invert(truth)
    return float(turn_deg(off)), float((off[:3, :3] @ middle + off[:3, 3] - middle).norm())


def _stated(found: Registration, place: Tensor) -> tuple[float, float]:
    """Standard deviations of the rotation, degrees, and of a place (3,), mm, by the covariance."""
    x, y, z = place.tolist()
    by = torch.tensor([[0.0, z, -y, 1.0, 0.0, 0.0], [-z, 0.0, x, 0.0, 1.0, 0.0], [y, -x, 0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    turn, shift = found.covariance[:3, :3], by @ found.covariance @ by.T
    return math.degrees(math.sqrt(float(turn.trace()))), math.sqrt(float(shift.trace()))


def run_tracking(
    names: Sequence[str] = OBJECTS,
    motions: Sequence[str] = tuple(MOTIONS),
    noises: Sequence[str] = tuple(NOISES),
    seeds: Sequence[int] = (1,),
    sensors: Sequence[int] = (1,),
) -> Iterator[tuple[TrackRow, Track]]:
    """Track objects under all motions and noises, one row after the other.

    Args:
        names: of objects.
        motions: of :data:`MOTIONS`.
        noises: of :data:`NOISES`.
        seeds: of motions and noise of the images.
        sensors: seeds of the errors of slopes, for each noise that has such errors.
    Raises:
        ValueError: an unknown object.
    """
    unit, targets = rig(), {**objects.TARGETS, **objects.FREE_TARGETS}
    for name in names:
        if name not in targets:
            raise ValueError(f"names: expected some of {', '.join(targets)}, got {name!r}")
    for name, motion, seed in itertools.product(names, motions, seeds):
        target = targets[name]
        recorded: dict[float, Track] = {}
        for noise in noises:
            image_std = NOISES[noise].image_std
            if image_std not in recorded:
                recorded[image_std] = record(target, MOTIONS[motion], image_std, seed, unit)
            for sensor in sensors if NOISES[noise].slopes_deg > 0.0 else (0,):
                track = with_wrong_slopes(recorded[image_std], NOISES[noise], sensor) if sensor else recorded[image_std]
                yield follow_track(track, MOTIONS[motion], TrackRow(name, motion, noise, seed=seed, sensor=sensor)), track


def register_each(track: Track) -> tuple[list[float], list[float], list[float]]:
    """Degrees, mm and ms of :func:`register_depth` on the same frames, each against the first."""
    results = []
    for k in range(1, len(track.frames)):
        start = time.perf_counter()
        try:
            found = register_depth(track.frames[0], track.frames[k], track.mm_per_pixel)
        except ValueError:  # no contact
            continue
        results.append((*tracking_error(found, track, k), 1000.0 * (time.perf_counter() - start)))
    deg, mm, ms = zip(*results, strict=True)
    return list(deg), list(mm), list(ms)


class NormalFlow(NamedTuple):
    """NormalFlow's own code.

    Attributes:
        frame: its class ``Frame`` of gradient (H, W, 2) and height (H, W), pixels, and contact (H, W); it erodes the contact.
        register: its function ``normalflow``.
        lost: the error by which that says that the object is lost.
    """

    frame: Callable[[Array, Array, Array], Any]
    register: Callable[..., Array]
    lost: type[Exception]


def follow_by_normalflow(track: Track, peer: NormalFlow, row: TrackRow) -> TrackRow:
    """Track all frames against the first one by NormalFlow, the last pose as start, with its own thresholds, and fill the row.

    Its axes: x right, y down, z away from the camera; shifts in metres. Only the registration is timed, not its ``Frame``.
    """
    to_points = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))  # y up, z towards the camera
    frames = [
        peer.frame(
            (-frame.gradient[0]).permute(1, 2, 0).contiguous().numpy(),
            (-frame.depth_mm[0, 0] / track.mm_per_pixel).numpy(),
            frame.contact[0, 0].numpy(),
        )
        for frame in track.frames
    ]
    first, pose = frames[0], np.eye(4, dtype=np.float32)
    for k, frame in enumerate(frames[1:], 1):
        maps = (first.N, first.C, first.H, first.L, frame.N, frame.C, frame.H, frame.L)
        start = time.perf_counter()
        try:
            pose = peer.register(*maps, pose, track.mm_per_pixel)
        except peer.lost:
            row.lost.append(k)
            continue
        finally:
            row.ms.append(1000.0 * (time.perf_counter() - start))
        found = torch.from_numpy(np.array(pose, dtype=np.float64))
        found[:3, 3] *= 1000.0
        deg, mm = _error_of(to_points @ found @ to_points, track, k)
        row.deg.append(deg)
        row.mm.append(mm)
    return row


def tracking_table(rows: Sequence[TrackRow]) -> str:
    """A line for each object, motion and noise, as Markdown.

    Medians of a track have three figures: the least, the middle and the most of the tracks. The rest is the worst, or the sum.
    """
    titles = ["object", "motion", "noise", "tracks", "angle deg, median of a track", "angle deg, worst"]
    titles += ["position mm, median of a track", "position mm, worst", "error / stated, angle", "error / stated, position"]
    titles += ["drift deg per 360", "lost frames", "lost, not noticed", "uncertain", "confident and wrong", "ms, median"]
    groups: dict[tuple[str, str, str], list[TrackRow]] = {}
    for row in rows:
        groups.setdefault((row.name, row.motion, row.noise), []).append(row)
    lines = []
    for key, tracks in groups.items():
        deg, mm = [row.deg for row in tracks], [row.mm for row in tracks]
        drift = f"{max(row.drift_deg for row in tracks):.3f}" if key[1] == "full turn" else ""
        counts = [(row.lost, row.unnoticed, row.uncertain, row.wrong) for row in tracks]
        line = [*key, str(len(tracks)), _spread(deg, 3), _worst(deg, 3), _spread(mm, 4), _worst(mm, 4)]
        line += [_spread([row.ratio for row in tracks], 2), _spread([row.ratio_mm for row in tracks], 2), drift]
        line += [str(sum(map(len, frames))) for frames in zip(*counts, strict=True)]
        lines.append([*line, _spread([row.ms for row in tracks], 1)])
    return markdown(titles, lines)


def _spread(tracks: Sequence[Sequence[float]], digits: int) -> str:
    """The least, the middle and the largest of the medians of tracks; one alone if there is one track."""
    medians = [_median(values) for values in tracks]
    three = [min(medians), _median(medians), max(medians)] if len(medians) > 1 else medians
    return ", ".join(f"{value:.{digits}f}" for value in three)


def _worst(tracks: Sequence[Sequence[float]], digits: int) -> str:
    return f"{max((value for values in tracks for value in values), default=math.nan):.{digits}f}"


def _median(values: Sequence[float]) -> float:
    return float(torch.tensor(values, dtype=torch.float64).median()) if values else math.nan


def tracking_figure(beside: Sequence[tuple[TrackRow, tuple[list[float], list[float], list[float]]]]) -> Figure:
    """Error against time: each object tracked, and registered frame by frame by :func:`register_each`."""
    figure = new_figure(7.0, 4.6)
    axes = figure.add_subplot()
    markers = "os^DvP*X"
    for (row, registered), marker in zip(beside, markers * len(beside)):
        for colour, deg, ms in (("#1b6ca8", row.deg, row.ms), ("#d1495b", registered[0], registered[2])):
            axes.scatter(_median(ms), _median(deg), c=colour, marker=marker, s=60, label=row.name if colour == "#1b6ca8" else None)
    axes.set(xscale="log", yscale="log", xlabel="time of a frame, ms", ylabel="rotation error, degrees, median")
    axes.set_title("blue: PoseTracker, red: register_depth, each frame against the first")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    return figure
