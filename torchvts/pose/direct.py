"""Pose from two depth frames: search over the plane, refinement on every pixel of the common contact, then ambiguity."""

import dataclasses
import math

import torch
from torch import Tensor

from ..core.checks import check_least
from ..core.geometry import check_rigid
from .alignment import Fit, agrees_enough, distinct, equally_good, is_trusted, rank, refine, score_poses
from .ambiguity import UNKNOWN_VARIANCE, Unknown, find_unknown, pose_covariance, turned_otherwise
from .relief import DepthFrame, Levels, levels
from .result import Registration, invert, turn_deg
from .search import search_plane

MOST_TURNS, MOST_AGAIN = 4, 16
"""Rotations with which shifts are searched again, and hypotheses that come of it, at most."""


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
        Padfield 2012 for the search; direct alignment as in Lucas, Kanade 1981 with Cauchy's loss.
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
    a, b = levels(source, mm_per_pixel, "source"), levels(target, mm_per_pixel, "target")
    sizes = [tuple(frame.depth_mm.shape[-2:]) for frame in (source, target)]
    if sizes[0] != sizes[1]:
        cause = "positions count from the image's middle, so a cropped frame lies elsewhere"
        raise ValueError(f"source: expected {sizes[1][0]} x {sizes[1][1]} like target, got {sizes[0][0]} x {sizes[0][1]}: {cause}")
    found = align(a, b, None if initial is None else check_rigid("initial", initial))
    others = [_refine_both_ways(a, b, pose[None])[0] for pose in found.alternatives]
    return dataclasses.replace(found, alternatives=others)


def align(a: Levels, b: Levels, start: Tensor | None) -> Registration:
    """Register two prepared frames, source ``a`` on target ``b``; tries ``start`` first. Alternatives are those of middle grids."""
    if start is not None:
        poses = refine(a.coarse, b.coarse, start[None], 6, 2.0)
        if is_trusted(score_poses(a.coarse, b.coarse, poses), 0):
            return _finish(a, b, poses)
    poses, score = search_plane(a.coarse, b.coarse)
    poses = poses[score > 0.4 * score[:1]]
    if len(poses) == 0:
        return _nothing("one of the contacts has no relief that could be compared")
    if start is not None:
        poses = torch.cat((start[None], poses))
    poses = _likely(a, b, refine(a.coarse, b.coarse, poses, 4, 4.0))
    again, _ = search_plane(a.coarse, b.coarse, MOST_AGAIN, _turns(poses))
    return _finish(a, b, _likely(a, b, torch.cat((poses, refine(a.coarse, b.coarse, again, 4, 4.0)))))


def _likely(a: Levels, b: Levels, poses: Tensor) -> Tensor:
    """Those of the poses that cost little more than the best one, best first."""
    fit = score_poses(a.coarse, b.coarse, poses)
    order = distinct(fit, a.coarse, 0.5)
    value = rank(fit)
    return poses[[k for k in order if value[k] < 2.0 * value[order[0]] + 0.1]]


def _turns(poses: Tensor) -> Tensor:
    """Rotations in the plane, rad, of the best poses, those that differ.

    They are better known than the steps of the first search; with them the right shift stands out of others that are nearly right.
    """
    angle = torch.atan2(poses[:, 1, 0], poses[:, 0, 0])
    kept: list[float] = []
    for turn in angle.tolist():
        if all(abs(math.remainder(turn - other, 2.0 * math.pi)) > math.radians(1.0) for other in kept):
            kept.append(turn)
    return torch.tensor(kept[:MOST_TURNS], dtype=torch.float32)


def symmetries(a: Levels) -> list[Tensor]:
    """Motions (4, 4) after which a frame looks much the same: where slopes err, a symmetric object does not look quite the same."""
    poses, score = search_plane(a.coarse, a.coarse)
    poses = refine(a.coarse, a.coarse, refine(a.coarse, a.coarse, poses[score > 0.4 * score[0]], 4, 4.0), 5)
    poses = torch.cat((torch.eye(4, dtype=torch.float64)[None], poses))
    fit = score_poses(a.coarse, a.coarse, poses)
    return [poses[k] for k in distinct(fit, a.coarse, 0.4)[1:] if is_trusted(fit, k)]


def _finish(a: Levels, b: Levels, poses: Tensor) -> Registration:
    """Refine the hypotheses level by level, keep those that fit equally well, and describe the best one."""
    poses = refine(a.coarse, b.coarse, poses, 5, 1.0)
    fit = score_poses(a.coarse, b.coarse, poses)
    kept = equally_good(fit, distinct(fit, a.coarse, 0.4))
    poses = refine(a.middle, b.middle, poses[kept], 3, 1.0)
    fit = score_poses(a.middle, b.middle, poses)
    kept = equally_good(fit, distinct(fit, a.middle, 0.4))
    best = _refine_both_ways(a, b, poses[kept[:1]])
    others = poses[kept[1:]]
    fit = score_poses(a.middle, b.middle, best)
    converged = is_trusted(fit, 0)
    unknown = Unknown(torch.zeros(6, 0, dtype=torch.float64), [])
    if converged:
        unknown = find_unknown(a.coarse, b.coarse, best, b.noise)
    rmse_mm, covariance = pose_covariance(a.fine, b.fine, best)
    if unknown.names:
        covariance = covariance + unknown.motions @ unknown.motions.T * UNKNOWN_VARIANCE
    alternatives = list(others) if converged else []
    if unknown.names:  # what differs by that alone is no other pose
        turns = [(T @ invert(best[0]))[:3, :3].numpy() for T in alternatives]
        alternatives = [alternatives[k] for k in turned_otherwise(turns, unknown.motions[:3].numpy(), unknown.names)]
    message = _message(fit, unknown.names, len(alternatives))
    fitness, overlap = float(fit.fitness[0]), float(fit.overlap[0])
    return Registration(best[0], rmse_mm, fitness, converged, message, covariance, unknown.names, alternatives, overlap)


def _nothing(reason: str) -> Registration:
    """No pose, of no certainty."""
    unknown = torch.eye(6, dtype=torch.float64) * UNKNOWN_VARIANCE
    return Registration(torch.eye(4, dtype=torch.float64), math.inf, 0.0, False, f"nothing fits: {reason}", unknown, [], [], 0.0)


def _refine_both_ways(a: Levels, b: Levels, pose: Tensor) -> Tensor:
    """The mean of the fine poses from source to target and back, so that neither frame is preferred."""
    forth = refine(a.fine, b.fine, pose, 12, 0.5)
    back = invert(refine(b.fine, a.fine, invert(pose), 12, 0.5))
    center = a.fine.points.double().mean(0)
    places = [T[0, :3, :3] @ center + T[0, :3, 3] for T in (forth, back)]
    if float((places[0] - places[1]).norm()) > 0.1 or float(turn_deg(forth @ invert(back))) > 1.0:
        return forth
    u, _, vh = torch.linalg.svd(forth[0, :3, :3] + back[0, :3, :3])
    mean = forth.clone()
    mean[0, :3, :3] = u @ vh
    mean[0, :3, 3] = 0.5 * (places[0] + places[1]) - u @ vh @ center
    return mean


def _message(fit: Fit, names: list[str], others: int) -> str:
    fitness, overlap = float(fit.fitness[0]), float(fit.overlap[0])
    agreement = f"{100 * fitness:.0f} % of the common contact agrees, which is {100 * overlap:.0f} % of the smaller one"
    if not is_trusted(fit, 0) and agrees_enough(fitness, overlap, 0.0):
        return f"nothing fits well: {agreement}, but all of it differs: different objects, or slopes that err by degrees"
    if not is_trusted(fit, 0):
        return f"nothing fits: {agreement}: different objects, or parts of one that hardly overlap"
    if names:
        agreement += f"; the surface slides on itself: {', '.join(names)} unknown"
    return agreement + (f"; {others} more poses fit as well: the object is symmetric" if others else "")
