"""A frame registered to a keyframe from poses that are nearly right, with what speaks for and against the result."""

import math
from typing import NamedTuple

import numpy as np
import torch

from .alignment import SLOPE_NOISE, agrees_enough
from .ambiguity import ALIKE_PIXELS, LEAST_INFORMATION, UNKNOWN_VARIANCE, free_directions, name_directions, span
from .height_errors import ERROR, height_sums
from .inverse import (
    LEAST_NOISE,
    ROTATION_FIRST,
    Field,
    Pixels,
    Sums,
    moved_by,
    refine,
    solve_step,
    step_between,
    sum_parts,
    sum_residuals,
)
from .jackknife import jackknife
from .keyframe import PARTS, Grids, Keyframe
from .rigid import Array, adjoint, cross, inverted

COARSE_STEPS, SOME_STEPS = 15, 30
"""Largest number of steps on the coarse grid, and with some pixels of the fine one."""

COARSE_STEP_MM, SOME_STEP_MM = 0.02, 2e-3
"""Steps so small, at the contact, are the last ones."""

HEIGHT_OFFSET_MM = 0.02
"""Error of all heights of a contact alike, which its frames cannot show: the relief of a real GelSight Mini errs by so much."""

LAST_STEP_MM = 0.03
"""A last step of more than this, at the contact, is not the end of the way."""

TRUSTED_DEG, TRUSTED_MM = 1.0, 0.15
"""A pose is trusted if three times its standard deviations are within these."""

UNSEEN = math.sqrt(2.0 / (5 * (PARTS - 1)))
"""Standard deviation, as a share, of the variance that so many parts show in the five motions that slopes show."""

MOST_STD_DEG, MOST_STD_MM = 1.0, 0.15
"""Standard deviations of a motion, as a turn and as a shift, above which it is called unknown."""

LEAST_SLOPE_NOISE = 1e-3
"""Slopes of pixels err by so much at least."""

LEAST_SHARE = 1e-4
"""Of all information: a direction of less has so much."""


class Followed(NamedTuple):
    """A frame registered to a keyframe.

    Attributes:
        pose: (4, 4), T_frame_keyframe.
        fine: sums over the fine grid.
        fitness: share of the pixels compared, in both directions, that agree.
        overlap: share of the smaller contact that was compared.
        cost: mean truncated residual, 0 to 1.
        free: (6, k), scaled twists that the common contact does not determine.
        names: of these motions, in the frame's axes.
        std_deg: standard deviation of the rotations that are known, degrees.
        std_mm: the same of the shifts, at the centre of the keyframe's contact, mm.
        settled: whether the last step was a small one.
        covariance: (6, 6) of a small motion after the pose, rad and mm.
        common: what :func:`in_common` says of the pose.
    """

    pose: Array
    fine: Sums
    fitness: float
    overlap: float
    cost: float
    free: Array
    names: list[str]
    std_deg: float
    std_mm: float
    settled: bool
    covariance: Array
    common: tuple[float, float]

    @property
    def agrees(self) -> bool:
        """Whether the frames agree well enough on a large enough part, and show any motion."""
        return self.free.shape[1] < 6 and agrees_enough(self.fitness, self.overlap, self.cost)

    @property
    def exact(self) -> bool:
        """Whether the pose is certain enough to be trusted."""
        return self.settled and 3.0 * self.std_deg <= TRUSTED_DEG and 3.0 * self.std_mm <= TRUSTED_MM


def follow(keyframe: Keyframe, frame: Grids, starts: list[Array]) -> Followed:
    """Register a frame to a keyframe from the most likely of several poses, and from the others if that leads nowhere.

    Motions that the contact does not determine keep their value in the first of the poses, the last one of the track.
    """
    best, first = _follow_best(keyframe, frame, starts, starts[0])
    if not first.agrees:
        for start in starts[:best] + starts[best + 1 :]:
            _, other = _follow_best(keyframe, frame, [start], starts[0])
            if other.agrees:
                return other
    return first


def _follow_best(keyframe: Keyframe, frame: Grids, starts: list[Array], last: Array) -> tuple[int, Followed]:
    """Register a frame from the best of several poses: which one that was, and what was found."""
    costs = [sum_residuals(frame.coarse, keyframe.coarse, start, SLOPE_NOISE, score_only=True).cost for start in starts]
    best = costs.index(min(costs))
    return best, _follow_from(keyframe, frame, starts[best], last)


def _follow_from(keyframe: Keyframe, frame: Grids, start: Array, last: Array) -> Followed:
    """Refine one pose on the coarse grid, on some pixels, and on many of them, and score it; what is unknown stays as it was."""
    pose, coarse = refine(frame.coarse, keyframe.coarse, start, COARSE_STEPS, 2.0 * SLOPE_NOISE, keyframe.held, COARSE_STEP_MM)
    unknown = _sliding(keyframe, coarse)
    pose = _kept(keyframe, unknown, last, pose)
    refined, some = refine(frame.fine, keyframe.some, pose, SOME_STEPS, SLOPE_NOISE, unknown.motions, SOME_STEP_MM)
    vague = _vague(keyframe, some)
    if vague.motions.shape[1] > 0:
        unknown = _joined(unknown, vague)
        pose = _kept(keyframe, unknown, last, pose)
        refined, some = refine(frame.fine, keyframe.some, pose, SOME_STEPS, SLOPE_NOISE, unknown.motions, SOME_STEP_MM)
    noise = max(LEAST_NOISE, 1.5 * some.slope_noise)
    fine, matrices, rights = sum_parts(frame.fine, keyframe.many, refined, noise, PARTS)
    by_slopes = solve_step(fine, unknown.motions)
    scaled = _covariance(fine, jackknife(matrices, rights, _others(unknown.motions)), keyframe.shared_error, unknown.motions)
    step = by_slopes
    if unknown.motions.shape[1] == 0:
        fine, both = _with_heights(fine, keyframe, frame, refined)
        step, scaled = solve_step(both), _covariance_of_both(fine, both, scaled)
    scaled[5, 5] += fine.depth_noise**2 + HEIGHT_OFFSET_MM**2
    pose = _kept(keyframe, unknown, last, refined @ moved_by(keyframe.many, step))
    forth = sum_residuals(frame.coarse, keyframe.coarse, pose, SLOPE_NOISE, score_only=True)
    pixels = _pixels(frame.coarse)
    back = sum_residuals(keyframe.grids.coarse, pixels, inverted(pose), SLOPE_NOISE, score_only=True)
    fitness, overlap, cost = _score(keyframe, pixels.number, forth, back)
    return Followed(
        pose=pose,
        fine=fine,
        fitness=fitness,
        overlap=overlap,
        cost=cost,
        free=unknown.motions,
        names=_names(unknown, pose),
        std_deg=math.degrees(math.sqrt(float(np.diag(scaled)[:3] @ keyframe.many.units[:3] ** 2))),
        std_mm=math.sqrt(float(np.trace(scaled[3:, 3:]))),
        settled=float(np.linalg.norm(by_slopes)) < LAST_STEP_MM,
        covariance=_after(keyframe.many, pose, scaled + unknown.motions @ unknown.motions.T * UNKNOWN_VARIANCE),
        common=in_common(keyframe, frame, pose),
    )


def _score(keyframe: Keyframe, pixels: int, forth: Sums, back: Sums) -> tuple[float, float, float]:
    """Fitness, overlap and cost of a frame with so many coarse pixels, from scores of the keyframe's pixels and of its own."""
    compared = max(forth.compared + back.compared, 1.0)
    fitness = (forth.fitness * forth.compared + back.fitness * back.compared) / compared
    overlap = max(forth.compared / keyframe.coarse.number, back.compared / max(pixels, 1))
    return fitness, overlap, (forth.cost * forth.compared + back.cost * back.compared) / compared


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
    return _share(keyframe, frame, sums.used), float(np.trace(np.linalg.inv(information)))


def _share(keyframe: Keyframe, frame: Grids, used: int) -> float:
    """Of the smaller contact, where so many of some pixels of the keyframe are in common."""
    return used / keyframe.some.number * keyframe.touching / max(min(keyframe.touching, frame.touching), 1)


def _pixels(field: Field) -> Pixels:
    """The pixels of a coarse field that lie on the object, without derivatives."""
    channels = field.channels.numpy()
    row, column = np.nonzero(channels[..., 3] > 0.999)
    columns = np.empty((5, len(row)), np.float32)
    columns[0], columns[1] = field.x0 + column * field.pitch, field.y0 - row * field.pitch
    columns[2:] = channels[row, column, :3].T
    return Pixels(torch.from_numpy(columns), np.zeros(3), np.ones(6))


class _Unknown(NamedTuple):
    """Scaled twists (6, k) that are not determined, and those among them that are pure shifts (3, m); orthonormal columns."""

    motions: Array
    shifts: Array


def _kept(keyframe: Keyframe, unknown: _Unknown, last: Array, pose: Array) -> Array:
    """The pose (4, 4), moved by what is unknown to where that has its last value, as :func:`solve_step` has it: rotations first."""
    motions = unknown.motions
    if motions.shape[1] == 0:
        return pose
    step = step_between(keyframe.many, last, pose)
    damping = motions.T * ROTATION_FIRST
    kept: Array = last @ moved_by(keyframe.many, step - motions @ np.linalg.solve(damping @ motions, damping @ step))
    return kept


def _sliding(keyframe: Keyframe, coarse: Sums) -> _Unknown:
    """Motions under which the common contact slides on itself, by its information, and those that the keyframe may roll by."""
    information = coarse.matrix * ((coarse.noise / SLOPE_NOISE) ** 2 / max(coarse.used, 1))
    found = _Unknown(np.zeros((6, 0)), np.zeros((3, 0)))
    if np.linalg.eigvalsh(information)[0] < LEAST_INFORMATION + 3.0 * keyframe.most_bias:  # else no direction has less
        free, shifts = free_directions(torch.from_numpy(information), keyframe.bias, LEAST_INFORMATION)
        found = _Unknown(free.numpy(), shifts.numpy())
    return _joined(found, _Unknown(keyframe.held, found.shifts)) if keyframe.held.shape[1] > 0 else found


def _wanted(keyframe: Keyframe) -> Array:
    """The largest standard deviations of scaled twists (6,) that are known."""
    return np.concatenate((math.radians(MOST_STD_DEG) / keyframe.some.units[:3], np.full(3, MOST_STD_MM)))


def _alike(keyframe: Keyframe) -> float:
    """Of some pixels so many err alike."""
    return max(1.0, ALIKE_PIXELS * keyframe.some.number / keyframe.touching)


def _vague(keyframe: Keyframe, some: Sums) -> _Unknown:
    """Motions whose standard deviation is too large, because the common contact is small or faint."""
    wanted, ratio = _wanted(keyframe), max(some.slope_noise, LEAST_SLOPE_NOISE) / some.noise
    matrix = some.matrix * wanted[:, None] * wanted / (_alike(keyframe) * ratio**2)
    if np.linalg.eigvalsh(matrix)[0] >= 1.0:  # 1 where the standard deviation is as wanted
        return _Unknown(np.zeros((6, 0)), np.zeros((3, 0)))

    def below(part: Array, scale: Array) -> Array:
        precision, directions = np.linalg.eigh(part)
        return np.linalg.qr(directions[:, precision < 1.0] * scale[:, None])[0]

    return _Unknown(below(matrix, wanted), below(matrix[3:, 3:], wanted[3:]))


def _joined(one: _Unknown, other: _Unknown) -> _Unknown:
    """All motions that are in one or the other."""
    return _Unknown(span(np.hstack((one.motions, other.motions))), span(np.hstack((one.shifts, other.shifts))))


def _names(unknown: _Unknown, pose: Array) -> list[str]:
    """Names of the motions in the frame's axes."""
    if unknown.motions.shape[1] == 0:
        return []
    turn = pose[:3, :3]
    turned = np.vstack((turn @ unknown.motions[:3], turn @ unknown.motions[3:]))
    return name_directions(torch.from_numpy(turned), torch.from_numpy(turn @ unknown.shifts))


def _others(motions: Array) -> Array:
    """Orthonormal columns (6, 6 - k) beside those of motions (6, k)."""
    return np.linalg.qr(motions, mode="complete")[0][:, motions.shape[1] :] if motions.shape[1] else np.eye(6)


def _covariance(fine: Sums, by_parts: Array, shared_error: float, free: Array) -> Array:
    """Covariance of the scaled twist that slopes ask for: the noise of pixels, and what is alike in many of them.

    What parts of the contact disagree by beyond the noise of pixels is alike over wide areas, and parts have much of it in common.
    Where they disagree by no more than that noise, a smooth error may still be as large as it can be without being seen.
    """
    beside = np.eye(6) - free @ free.T
    matrix = beside @ fine.matrix @ beside
    matrix[5, :] = matrix[:, 5] = 0.0  # heights have a weight of their own
    information, directions = np.linalg.eigh(matrix)
    known = information > 1e-9 * information[-1]
    noise = (directions[:, known] / information[known]) @ directions[:, known].T * (fine.slope_noise / fine.noise) ** 2
    alike = 1.0 - float(np.trace(noise)) / max(float(np.trace(by_parts[:5, :5])), 1e-30)
    scaled: Array = noise + shared_error * (max(0.0, alike) * by_parts + UNSEEN * noise)
    return scaled


def _covariance_of_both(slopes: Sums, both: Sums, by_slopes: Array) -> Array:
    """Covariance of the scaled twist that slopes and heights ask for, from that of the slopes alone.

    Heights err as :mod:`.height_errors` has it, by as much less or more as the slopes of the two frames differ less or more.
    """
    spread = np.linalg.inv(both.matrix + 1e-9 * float(np.trace(both.matrix)) * np.eye(6))
    share = spread @ slopes.matrix
    size = 0.5 * (slopes.slope_noise / ERROR) ** 2
    scaled: Array = share @ by_slopes @ share.T + size * spread @ (both.matrix - slopes.matrix) @ spread
    return scaled


def _after(pixels: Pixels, pose: Array, scaled: Array) -> Array:
    """Covariance of a small motion after the pose, from that of a scaled twist before it."""
    to_origin = np.diag(pixels.units)
    to_origin[3:, :3] = cross(pixels.center) @ to_origin[:3, :3]
    after = adjoint(pose) @ to_origin
    covariance: Array = after @ scaled @ after.T
    return covariance
