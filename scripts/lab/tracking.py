"""Accuracy of tracking through the whole chain: render an object that moves, measure depth, track, compare."""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchvts.core.geometry import gradient_of_depth, normal_from_gradient
from torchvts.core.tables import markdown
from torchvts.integration import poisson_dst
from torchvts.model import PointLights
from torchvts.pipeline import DepthOutput, FrozenPipeline
from torchvts.pose import PoseTracker, Registration
from torchvts.scenes import objects, render
from torchvts.skin import ZeroBackground

from .faults import gaussian_blur
from .motions import MOTIONS, Motion
from .pose_accuracy import GOAL_DEG, GOAL_MM, rig
from .rigid import invert, turn_deg
from .rows import Row

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


@dataclass(frozen=True, eq=False)
class Track:
    """An object that moves, as a sensor measures it: the poses T_sensor_object (4, 4), and the frames."""

    poses: list[Tensor]
    frames: list[DepthOutput]
    mm_per_pixel: float


EACH = ("deg", "mm", "ms", "ratio", "ratio_mm", "lost", "unnoticed", "uncertain", "wrong", "drift_deg")
"""Values of a track.

Of each frame that was not lost the rotation error, and the error of the position of the object's origin; of each frame its time.
Both errors over the standard deviations that the covariance states, where all motions are known. Numbers of the frames that were
lost; that must be lost and were not; whose pose is not called converged though the object is followed; that are confident, with no
motion or pose in question, and outside of the goal of the pose bench. The rotation error at the end, per 360 degrees of yaw.
"""


def track_row(name: str, motion: str, noise: str, seed: int = 1, sensor: int = 0, method: str = "PoseTracker") -> Row:
    """An empty row of one object under one motion and one noise.

    Args:
        name: of the object.
        motion: of the object.
        noise: of the images.
        seed: of the motion and of the noise of the images.
        sensor: seed of the errors of slopes; 0 where there are none.
        method: that tracks.
    """
    errors: dict[str, float | None] = {"sensor": float(sensor)}
    return Row("track", method, f"{name}, {motion}, {noise}", errors, seed=seed, each={key: [] for key in EACH})


def record(target: objects.Target, motion: Motion, image_std: float, seed: int, unit: tuple[PointLights, FrozenPipeline]) -> Track:
    """Render and measure an object that moves; 320 x 240, 8 bits.

    Args:
        target: the object.
        motion: its motion.
        image_std: standard deviation of the images' noise.
        seed: of motion and noise.
        unit: lights and pipeline, as of :func:`lab.pose_accuracy.rig`.
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


def follow_track(track: Track, motion: Motion, row: Row) -> Row:
    """Track all frames against the first one, and fill the row."""
    tracker, each = PoseTracker(track.frames[0], track.mm_per_pixel), row.each
    last_deg = math.nan
    for k in range(1, len(track.frames)):
        start = time.perf_counter()
        found = tracker(track.frames[k])
        each["ms"].append(1000.0 * (time.perf_counter() - start))
        if found.lost:
            each["lost"].append(k)
            continue
        last_deg, mm = tracking_error(found, track, k)
        each["deg"].append(last_deg)
        each["mm"].append(mm)
        if not found.ambiguous:
            std_deg, std_mm = _stated(found, track.poses[k][:3, 3])
            each["ratio"].append(last_deg / std_deg)
            each["ratio_mm"].append(mm / std_mm)
        if not found.converged:
            each["uncertain"].append(k)
        elif not found.ambiguous and not (last_deg <= GOAL_DEG and mm <= GOAL_MM):
            each["wrong"].append(k)
    each["unnoticed"] += sorted(set(motion.lost) - set(each["lost"]))
    turned = turn_deg(track.poses[-1] @ invert(track.poses[-2])) * (len(track.poses) - 1)
    each["drift_deg"].append(last_deg * 360.0 / max(float(turned), 1.0))
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
) -> Iterator[tuple[Row, Track]]:
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
                yield follow_track(track, MOTIONS[motion], track_row(name, motion, noise, seed, sensor)), track


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


def follow_by_normalflow(track: Track, peer: NormalFlow, row: Row) -> Row:
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
            row.each["lost"].append(k)
            continue
        finally:
            row.each["ms"].append(1000.0 * (time.perf_counter() - start))
        found = torch.from_numpy(np.array(pose, dtype=np.float64))
        found[:3, 3] *= 1000.0
        deg, mm = _error_of(to_points @ found @ to_points, track, k)
        row.each["deg"].append(deg)
        row.each["mm"].append(mm)
    return row


def tracking_table(rows: Sequence[Row]) -> str:
    """A line for each object, motion and noise, as Markdown.

    Medians of a track have three figures: the least, the middle and the most of the tracks. The rest is the worst, or the sum.
    """
    titles = ["object", "motion", "noise", "tracks", "angle deg, median of a track", "angle deg, worst"]
    titles += ["position mm, median of a track", "position mm, worst", "error / stated, angle", "error / stated, position"]
    titles += ["drift deg per 360", "lost frames", "lost, not noticed", "uncertain", "confident and wrong", "ms, median"]
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row.method, row.data), []).append(row)
    lines = []
    for (method, data), tracks in groups.items():
        name, motion, noise = data.split(", ")
        of = {key: [row.each[key] for row in tracks] for key in EACH}
        line = [name if method == "PoseTracker" else f"{name}, {method}", motion, noise, str(len(tracks))]
        line += [_spread(of["deg"], 3), _worst(of["deg"], 3), _spread(of["mm"], 4), _worst(of["mm"], 4)]
        line += [_spread(of["ratio"], 2), _spread(of["ratio_mm"], 2), _worst(of["drift_deg"], 3) if motion == "full turn" else ""]
        line += [str(sum(map(len, of[key]))) for key in ("lost", "unnoticed", "uncertain", "wrong")]
        lines.append([*line, _spread(of["ms"], 1)])
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
