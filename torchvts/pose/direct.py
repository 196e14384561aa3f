"""Pose from two depth frames: search over the plane, the aligner, and all other poses that fit as well."""

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.linalg import inv
from torch import Tensor

from ..core.checks import check_least
from ..core.geometry import check_rigid
from .ambiguity import motions_of, unknown_motions
from .follow import Followed, follow
from .grids import DepthFrame, Grids, checked_grids, resolution_of, surface_of
from .inverse import SLOPE_NOISE, Points, Score, bare_points, center_and_units, points_of, refine, score_pose
from .keyframe import Keyframe, make_keyframe
from .result import Registration
from .rigid import Array, distance_mm, orthonormal, rotation_vector
from .search import SAME_MM, search_plane

MOST_TURNS, MOST_AGAIN = 4, 16
"""Rotations with which shifts are searched again, and hypotheses that come of it, at most."""

MOST_TRIED = 72
"""So many starts are tried for equal poses at most."""

EQUAL, EQUAL_COST = 2.3, 0.008
"""Poses are equal whose costs on the fine grid are within so many times the least one, or so much more. A bolt head turned by 10
to 30 degrees, of which hardly more than the outline says so, has 3 times that or more; where slopes err by 3 degrees its equal
poses have up to 2.2."""


OTHERWISE_DEG = 20.0
"""Two poses are different ones if known rotations between them are larger."""


def register_depth(source: DepthFrame, target: DepthFrame, mm_per_pixel: float, *, initial: Tensor | None = None) -> Registration:
    """Pose of a pressed object in one frame relative to another frame of it, from all pixels of both contacts.

    First, slopes are correlated over all rotations and shifts in the plane. Then the best hypotheses are refined on coarse grids
    and scored in both directions, and the best one, and all that fit equally well, are refined on the fine grid: slopes and
    depths of the common contact, six degrees of freedom. Parts that are pressed deeper in one frame than in the other, or lie
    outside of one image, are ignored.

    Args:
        source: one frame, a :class:`torchvts.DepthOutput` or any object with its depth_mm, gradient and contact.
        target: the reference frame, likewise.
        mm_per_pixel: pitch of both, mm.
        initial: T_target_source (4, 4) to start from, such as the pose of the previous frame; if it leads to a good fit, no
            search follows: of a symmetric object ``alternatives`` is then empty, and the start has chosen among its equal poses.
    Returns:
        The registration. ``converged`` is False if nothing fits; ``ambiguous`` and ``alternatives`` list what the contact does
        not determine.
    Raises:
        TypeError: no DepthOutput.
        ValueError: not one frame, sizes that differ, values not finite, a contact of a few pixels, or ``initial`` is no rigid
            motion.
    Source:
        Padfield 2012 for the search; the aligner is that of :class:`torchvts.PoseTracker`.
    Example:
        >>> import math
        >>> from torchvts.scenes import objects
        >>> frame = objects.press(objects.stamp("T"), objects.pose(0.0), 96, 128, 0.125)
        >>> moved = objects.press(objects.stamp("T"), objects.pose(30.0, (1.0, -0.5)), 96, 128, 0.125)
        >>> reg = register_depth(moved, frame, 0.125)
        >>> reg.converged, round(math.degrees(math.acos(float(reg.T_target_source[0, 0]))), 1)
        (True, 30.0)
    """
    mm_per_pixel = check_least("mm_per_pixel", mm_per_pixel, 1e-6, 1e3)  # a nanometre, a metre
    moving, fixed = (surface_of(frame, name, with_skin=True) for frame, name in ((source, "source"), (target, "target")))
    keyframe = make_keyframe(moving, mm_per_pixel, "source")
    resolution = resolution_of(fixed, mm_per_pixel, "target")
    frame = checked_grids(fixed, mm_per_pixel, resolution, "target")
    sizes = [tuple(surface.depth_mm.shape[-2:]) for surface in (moving, fixed)]
    if sizes[0] != sizes[1]:
        cause = "positions count from the image's middle, so a cropped frame lies elsewhere"
        raise ValueError(f"source: expected {sizes[1][0]} x {sizes[1][1]} like target, got {sizes[0][0]} x {sizes[0][1]}: {cause}")
    starts = [] if initial is None else [check_rigid("initial", initial).numpy()]
    if starts and not (near := follow(keyframe, frame, starts)).misfit:
        return _registration([near])
    starts += likely_poses(keyframe, frame) or [np.eye(4)]  # without relief no pose is more likely than another
    found = equal_poses(keyframe, frame, starts) or [follow(keyframe, frame, starts[:1])]
    row, column = frame.coarse.pixels()
    own = points_of(frame.coarse, row, column, *center_and_units(frame.coarse.points(row, column)))
    unknown = unknown_motions(frame.coarse, own, resolution.noise)  # of real balls one frame in eight seems to show a rotation
    if not found[0].misfit and unknown.shape[1] > found[0].free.shape[1]:
        held = motions_of(keyframe.many, unknown, own, inv(found[0].pose))
        found = equal_poses(replace(keyframe, held=held), frame, [one.pose for one in found]) or found
    return _registration(found)


def _registration(found: list[Followed]) -> Registration:
    """The best pose, with the others that are equal to it."""
    best, poses = found[0], [torch.from_numpy(orthonormal(one.pose)) for one in found]
    names, covariance = [] if best.misfit else best.names, torch.from_numpy(best.covariance)
    message = best.misfit or best.score.share
    if names:
        message += f"; the surface slides on itself: {', '.join(names)} unknown"
    if len(poses) > 1:
        message += f"; {len(poses) - 1} more poses fit as well: the object is symmetric"
    fitness, overlap, _ = best.score
    return Registration(poses[0], best.fine.depth_noise, fitness, not best.misfit, message, covariance, names, poses[1:], overlap)


def likely_poses(keyframe: Keyframe, frame: Grids) -> list[Array]:
    """Poses (4, 4), T_frame_keyframe, that fit equally well on the coarse grid, best first."""
    own = bare_points(frame.coarse)
    poses, score = search_plane(keyframe.grids.coarse, frame.coarse)
    likely = _refined(keyframe, frame, own, list(poses[score > 0.4 * score[:1]].numpy()), 4)
    if not likely:
        return []
    again, _ = search_plane(keyframe.grids.coarse, frame.coarse, MOST_AGAIN, _turns([pose for pose, _ in likely]))
    likely = _refined(keyframe, frame, own, [*(pose for pose, _ in likely), *again.numpy()], 8)
    least, most = likely[0][1].overlap, 1.5 * likely[0][1].cost + 0.01
    return [likely[0][0], *(pose for pose, score in likely[1:] if score.cost < most and score.overlap > 0.7 * least)]


def _refined(keyframe: Keyframe, frame: Grids, own: Points, poses: list[Array], steps: int) -> list[tuple[Array, Score]]:
    """Those of the poses that, refined on the coarse grid, cost little more than the best one, without doubles, best first."""
    refined = [refine(frame.coarse, keyframe.coarse, pose, steps, 4.0 * SLOPE_NOISE)[0] for pose in poses]
    scored = [(pose, score_pose(frame.coarse, keyframe.coarse, keyframe.grids.coarse, own, pose)) for pose in refined]
    scored.sort(key=lambda one: _rank(one[1]))
    kept: list[tuple[Array, Score]] = []
    for pose, score in scored:
        if _rank(score) >= 2.0 * _rank(scored[0][1]) + 0.1:
            break
        if all(distance_mm(keyframe.spread, pose, other) > SAME_MM for other, _ in kept):
            kept.append((pose, score))
    return kept


def _rank(score: Score) -> float:
    """The cost with a surcharge for little overlap, which agrees by chance."""
    return score.cost + 0.5 * max(0.5 - score.overlap, 0.0)


def _turns(poses: list[Array]) -> Tensor:
    """Rotations in the plane, rad, of the best poses, those that differ.

    They are better known than the steps of the first search; with them the right shift stands out of others that are nearly right.
    """
    kept: list[float] = []
    for pose in poses:
        turn = math.atan2(pose[1, 0], pose[0, 0])
        if all(abs(math.remainder(turn - other, 2.0 * math.pi)) > math.radians(1.0) for other in kept):
            kept.append(turn)
    return torch.tensor(kept[:MOST_TURNS], dtype=torch.float32)


def symmetries(keyframe: Keyframe) -> list[Array]:
    """Motions (4, 4) after which a frame looks much the same: where slopes err, a symmetric object does not look quite the same."""
    poses, score = search_plane(keyframe.grids.coarse, keyframe.grids.coarse)
    starts = list(poses[score > 0.4 * score[:1]].numpy())
    found = _refined(keyframe, keyframe.grids, bare_points(keyframe.grids.coarse), [np.eye(4), *starts], 9)
    return [pose for pose, score in found if score.is_enough and distance_mm(keyframe.spread, pose, np.eye(4)) > SAME_MM]


def equal_poses(keyframe: Keyframe, frame: Grids, starts: list[Array], motions: Sequence[Array] = ()) -> list[Followed]:
    """All poses that fit equally well, from some starts on, best first; none if nothing fits.

    The motions between them are symmetries of the object, and so are the products of these, which are tried too: where slopes
    err, a search finds a few of the twelve poses of a gear, or one. Which of them fits best is then chance.

    Args:
        keyframe: the reference.
        frame: the new frame.
        starts: poses (4, 4), T_frame_keyframe.
        motions: (4, 4), symmetries of the keyframe, if they are known. Of a symmetric object that is tilted otherwise than the
            reference other pixels touch: the fine grid counts them, so a pose beside such a motion is compared on the coarse one.
    """
    found: list[Followed] = []
    tried: list[Array] = []
    waiting = deque(starts)

    def is_new(pose: Array, others: list[Array]) -> bool:
        return all(distance_mm(keyframe.spread, pose, other) >= SAME_MM for other in others)

    while waiting and len(tried) < MOST_TRIED:
        start = waiting.popleft()
        if not is_new(start, tried):
            continue
        tried.append(start)
        one = follow(keyframe, frame, [start])
        known = [other.pose for other in found]
        if one.misfit or not is_new(one.pose, known):
            continue
        found.append(one)
        if one.names:  # products of symmetries would differ by what is unknown: only what turns it otherwise is another pose
            poses = [*(one.pose @ motion for motion in motions), *waiting]
            others = [follow(keyframe, frame, [poses[k]]) for k in turned_otherwise(poses, one)]
            others = [other for other in others if not other.misfit and is_new(other.pose, known)]
            found += [others[k] for k in turned_otherwise([other.pose for other in others], one)]
            break
        if not known:
            waiting.extend(one.pose @ motion for motion in motions)
        first = (known or [one.pose])[0]
        waiting.extend(
            a @ inv(first) @ b for a, b in itertools.product([*known, one.pose], repeat=2) if a is one.pose or b is one.pose
        )
    if not found:
        return []
    found.sort(key=lambda one: one.fine.cost)
    best = found[0]

    def is_equal(one: Followed) -> bool:
        motion = inv(best.pose) @ one.pose
        return _equals(one.fine.cost, best.fine.cost) or (
            _equals(one.score.cost, best.score.cost) and not is_new(motion, list(motions))
        )

    return [one for one in found if is_equal(one)]


def turned_otherwise(poses: list[Array], one: Followed) -> list[int]:
    """Which of some poses are others than ``one``, and than those before, though some rotations are unknown.

    A capsule may have rolled, which is unknown, and may also point the other way.
    """
    rotations = sum(name.startswith("rotation") for name in one.names)  # a large ball that rolls mostly shifts: sizes say little
    axes = np.linalg.svd(one.free[:3], full_matrices=False)[0][:, :rotations]
    kept: list[int] = []
    for k, pose in enumerate(poses):
        between = [rotation_vector(other[:3, :3].T @ pose[:3, :3]) for other in (one.pose, *(poses[j] for j in kept))]
        if min(np.linalg.norm(turn - axes @ (axes.T @ turn)) for turn in between) > math.radians(OTHERWISE_DEG):
            kept.append(k)
    return kept


def _equals(cost: float, least: float) -> bool:
    return cost < max(EQUAL * least, least + EQUAL_COST)
