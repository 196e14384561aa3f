"""A frame registered to a keyframe from poses that are nearly right, with what speaks for and against the result."""

import math
from typing import NamedTuple

import numpy as np

from .ambiguity import LEAST_INFORMATION, UNKNOWN_VARIANCE, free_directions, information_of_noise, name_directions, span
from .grids import Grids
from .height_errors import WHITE_MM, covariance_with_heights, height_sums
from .inverse import (
    LEAST_SLOPE_NOISE,
    SLOPE_NOISE,
    Score,
    Sums,
    bare_points,
    beside,
    moved_by,
    refine,
    score_pose,
    solve_step,
    step_between,
    sum_parts,
    sum_residuals,
)
from .keyframe import Keyframe
from .rigid import Array, moved_covariance
from .uncertainty import PARTS, covariance_of_slopes

MOST_STEPS = 30
"""Largest number of steps on the coarse grid, and with some pixels of the fine one."""

SMALL_MM, SMALLEST_MM = 0.02, 2e-3
"""Steps so small, at the contact, are the last ones on the coarse grid and on the fine one; where the very last step is larger than
the first of these, the pose is not settled."""

TRUSTED_DEG, TRUSTED_MM = 1.0, 0.15
"""A pose is trusted if three times its standard deviations are within these."""

LEAST_SHARE = 1e-4
"""Of all information: a direction of less has so much."""


class Followed(NamedTuple):
    """A frame registered to a keyframe.

    Attributes:
        pose: (4, 4), T_frame_keyframe.
        fine: sums over the fine grid.
        score: of the pose, on the coarse grid.
        free: (6, k), scaled twists that the common contact does not determine.
        names: of these motions, in the frame's axes.
        std_deg: standard deviation of the rotations that are known, degrees.
        std_mm: the same of the shifts, at the centre of the keyframe's contact, mm.
        settled: whether the last step was a small one.
        covariance: (6, 6) of a small motion after the pose, rad and mm.
    """

    pose: Array
    fine: Sums
    score: Score
    free: Array
    names: list[str]
    std_deg: float
    std_mm: float
    settled: bool
    covariance: Array

    @property
    def misfit(self) -> str:
        """Why the pose is none, in words; empty if the frames agree well enough on a large enough part, and show any motion."""
        if self.score.is_enough:
            return "the contact is too small: no motion of it is known" if self.free.shape[1] == 6 else ""
        return f"nothing fits: {self.score.share}: other objects, slopes that err by degrees, or parts that hardly overlap"

    @property
    def exact(self) -> bool:
        """Whether the pose is certain enough to be trusted."""
        return self.settled and 3.0 * self.std_deg <= TRUSTED_DEG and 3.0 * self.std_mm <= TRUSTED_MM


def follow(keyframe: Keyframe, frame: Grids, starts: list[Array]) -> Followed:
    """Register a frame to a keyframe from the most likely of several poses, and from the others if that leads nowhere.

    Motions that the contact does not determine keep their value in the first of the poses, the last one of the track.
    """

    def cost(start: Array) -> float:
        return sum_residuals(frame.coarse, keyframe.coarse, start, SLOPE_NOISE, score_only=True).cost

    tried: list[Followed] = []
    for start in sorted(starts, key=cost):
        tried.append(_follow_from(keyframe, frame, start, starts[0]))
        if not tried[-1].misfit:
            return tried[-1]
    return tried[0]


def _follow_from(keyframe: Keyframe, frame: Grids, start: Array, last: Array) -> Followed:
    """Refine one pose on the coarse grid, on some pixels, and on many of them, and score it; what is unknown stays as it was."""
    pose, coarse = refine(frame.coarse, keyframe.coarse, start, MOST_STEPS, 2.0 * SLOPE_NOISE, keyframe.held, SMALL_MM)
    unknown = _sliding(keyframe, coarse)
    pose = _kept(keyframe, unknown, last, pose)
    refined, some = refine(frame.fine, keyframe.some, pose, MOST_STEPS, SLOPE_NOISE, unknown, SMALLEST_MM)
    noise = max(LEAST_SLOPE_NOISE, 1.5 * some.slope_noise)
    fine, matrices, rights = sum_parts(frame.fine, keyframe.many, refined, noise, PARTS)
    unknown = unknown if fine.used else np.eye(6)  # led astray, to where nothing is in common
    by_slopes = solve_step(fine, unknown)
    scaled = covariance_of_slopes(fine, matrices, rights, keyframe.shared_error, unknown)
    step = by_slopes
    if unknown.shape[1] == 0:
        fine, both = _with_heights(fine, keyframe, frame, refined)
        step, scaled = solve_step(both), covariance_with_heights(fine, both, scaled)
    scaled[5, 5] += fine.depth_noise**2 + WHITE_MM**2
    pose, origin = _kept(keyframe, unknown, last, refined @ moved_by(keyframe.many, step)), keyframe.many.to_origin()
    return Followed(
        pose=pose,
        fine=fine,
        score=score_pose(frame.coarse, keyframe.coarse, keyframe.grids.coarse, bare_points(frame.coarse), pose),
        free=unknown,
        names=name_directions(np.vstack((pose[:3, :3] @ unknown[:3], pose[:3, :3] @ unknown[3:]))),
        std_deg=math.degrees(math.sqrt(float(np.diag(scaled)[:3] @ keyframe.many.units[:3] ** 2))),
        std_mm=math.sqrt(float(np.trace(scaled[3:, 3:]))),
        settled=float(np.linalg.norm(by_slopes)) < SMALL_MM,
        covariance=moved_covariance(pose, origin @ (scaled + unknown @ unknown.T * UNKNOWN_VARIANCE) @ origin.T),
    )


def _with_heights(fine: Sums, keyframe: Keyframe, frame: Grids, pose: Array) -> tuple[Sums, Sums]:
    """Sums of the last step: slopes, once for each coarse pixel; and heights beside, as their errors let them count."""
    matrix, right = height_sums(keyframe.heights, frame.fine, keyframe.some, pose)
    share = keyframe.coarse.number / keyframe.many.number
    slopes = fine._replace(matrix=share * fine.matrix, right=share * fine.right)
    return slopes, fine._replace(matrix=slopes.matrix + matrix, right=slopes.right + right)


def in_common(keyframe: Keyframe, frame: Grids, pose: Array) -> tuple[float, float]:
    """What a frame has in common with a keyframe under a pose (4, 4), T_frame_keyframe.

    Returns:
        The share of the smaller contact; and the variance of the pose that the pixels in common allow, in units of an error of
        slopes alike everywhere. A bolt head whose corners leave the image keeps most of its contact, and little of it shows its
        rotation.
    """
    sums = sum_residuals(frame.fine, keyframe.some, pose, SLOPE_NOISE)
    information = keyframe.known.T @ sums.matrix @ keyframe.known
    information += (LEAST_SHARE * float(np.trace(information)) + 1e-9) * np.eye(len(information))  # 0 where nothing is in common
    own = keyframe.grids.touching
    share = sums.used / keyframe.some.number * own / max(min(own, frame.touching), 1)
    return share, float(np.trace(np.linalg.inv(information)))


def _kept(keyframe: Keyframe, unknown: Array, last: Array, pose: Array) -> Array:
    """The pose (4, 4), moved by what is unknown to where that has its last value, as :func:`solve_step` has it: rotations first."""
    if unknown.shape[1] == 0:
        return pose
    kept: Array = last @ moved_by(keyframe.many, beside(unknown) @ step_between(keyframe.many, last, pose))
    return kept


def _sliding(keyframe: Keyframe, coarse: Sums) -> Array:
    """Motions under which the common contact slides on itself, by its information, and those that the keyframe may roll by."""
    information = coarse.matrix * ((coarse.noise / SLOPE_NOISE) ** 2 / max(coarse.used, 1))
    bias = information_of_noise(keyframe.resolution.noise, keyframe.grids.coarse.pitch)
    return span(np.hstack((free_directions(information, bias, LEAST_INFORMATION), keyframe.held)))
