"""Ambiguity: the motions under which a surface slides on itself, their names, and the covariance of a pose."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from .alignment import CUT, DEPTH_NOISE_MM, SLOPE_NOISE, linearise, twist_units
from .relief import Relief, slopes_of_planes
from .result import invert, motion
from .rigid import Array, rotation_vector

SINE_OF_AXIS = 0.3
"""Sine of the angle to the z axis up to which a direction is called z, and of that to the skin up to which it has an angle."""

LEAST_INFORMATION = 0.05
"""Squared change of slope, in units of its noise, per squared mm of motion, below which a motion is unknown: 0.013 a mm."""

DEEP = 0.6
"""Share of the largest depth above which the skin certainly lies on the object."""

ROLLS = (0.5, 0.25, 0.125, 0.0625)
"""Shares of the contact's radius by which a motion is tried. The deep part of a ball on a GelSight Mini, rolled by 0.35 of the
radius, fits worse by 0.00 to 0.03 of slope where frames disagree by 0.03 to 0.06; moved in the three other ways by 0.14 and more.
A thin rod is so long that only the small shares of that radius leave it where it touches."""

COMPARED = 0.3
"""Share of the deep part's pixels that must still touch after a motion that is tried: of a rod a few pixels wide a third does."""

TURNED = (3.0, 5.0, 5.0, 5.0)
"""How many times the rise of the mean squared residual the mean square must be by which normals turn, for each share of the radius.
By half of the radius real balls have 4 to 5; by the small shares thin rods, capsules and balls have 10 and more,
a roof or a screw thread 3 to 5."""

ALIKE_PIXELS = 25.0
"""Number of pixels over which slope errors are alike; with it the covariance predicts the errors measured on rendered scenes."""

UNKNOWN_VARIANCE = 100.0
"""Variance of a motion that the surface does not determine, mm^2."""


OTHERWISE_DEG = 20.0
"""Two poses are different ones if known rotations between them are larger."""


class Unknown(NamedTuple):
    """Motions that the contact does not determine.

    Attributes:
        motions: (6, k), columns, about the target's origin, rad and mm.
        names: one per motion.
    """

    motions: Tensor
    names: list[str]


def find_unknown(source: Relief, target: Relief, pose: Tensor, noise: float) -> Unknown:
    """Find the motions of a pose (1, 4, 4) that the contact does not determine, on the coarse grids, which are least noisy.

    Two tests: whether slopes and heights of the whole contact change with a motion; and, where the contact is a single hill,
    whether its deep part rolls on itself: its normals turn by more than the frames disagree, and it still fits no worse. The deep
    part lies on the object; the skin around a ball moves with the contact, not with the ball, and hides that the ball can roll. Of
    a thin rod a pixel covers so much of the bend that derivatives are wrong: only the second test finds that it can roll.

    Args:
        source: the relief that is moved.
        target: the relief that stays.
        pose: (1, 4, 4) float64.
        noise: of the target's slopes.
    """
    points, slopes = target.points, target.slopes
    back = invert(pose)[0].float()
    _, inside, _, _ = source.sample((points @ back[:3, :3].T + back[:3, 3])[:, :2])
    bent = target._replace(field=field_with_fitted_curvature(target))
    bias = information_of_noise(noise, target.pitch)
    if int(inside.sum()) < 6:
        return Unknown(torch.zeros(6, 0, dtype=torch.float64), [])
    common = target._replace(points=points[inside], slopes=slopes[inside])
    center, units = common.points.double().mean(0), twist_units(common)
    free, shifts = free_directions(_information(common, bent, center, units), bias, LEAST_INFORMATION)
    moved = _about_origin(free, center, units)
    deep = inside & (points[:, 2] > DEEP * points[:, 2].max())
    if int(deep.sum()) >= 6 and _is_one_hill(target):
        common = target._replace(points=points[deep], slopes=slopes[deep])
        center, units = common.points.double().mean(0), twist_units(common)
        motions = torch.linalg.eigh(_information(common, bent, center, units)).eigenvectors
        rolls = motions[:, _rolls(source, target, pose, _Trial(common.slopes, center, units, motions))]
        slides = torch.cat((torch.zeros_like(shifts), shifts))  # of the whole contact; a rod rolls and slides
        rolls = torch.from_numpy(span(torch.cat((slides, rolls - slides @ (slides.T @ rolls)), dim=1).numpy()))
        if rolls.shape[1] > free.shape[1]:
            free, moved = rolls, _about_origin(rolls, center, units)
    return Unknown(moved, name_directions(moved, shifts))


def span(columns: Array) -> Array:
    """Orthonormal columns that span some columns (n, k) of length about 1; what is shorter than 0.5 beside the others is noise."""
    u, sizes, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, : len(sizes)][:, sizes > 0.5]


def _about_origin(motions: Tensor, center: Tensor, units: Tensor) -> Tensor:
    """Scaled twists (6, k) about a center, in rad and mm about the origin: rotations become rotations and shifts."""
    moved = units[:, None] * motions
    moved[3:] = moved[3:] - torch.linalg.cross(moved[:3], center[:, None].expand_as(moved[:3]), dim=0)
    return moved


def turned_otherwise(turns: list[Array], unknown: Array, names: list[str]) -> list[int]:
    """Which rotations lead to another pose than no rotation, or than those before, though some rotations are unknown.

    A capsule may have rolled, which is unknown, and may also point the other way.

    Args:
        turns: (3, 3) each.
        unknown: (3, k), the rotations of k unknown motions, as :class:`Unknown` and ``Followed.free`` have them.
        names: of these motions.
    Example:
        >>> half, roll = np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, -1.0, -1.0])
        >>> turned_otherwise([roll, half, half @ roll], np.eye(3)[:, :1], ["rotation about x"])
        [1]
    """
    rotations = sum(name.startswith("rotation") for name in names)  # a large ball that rolls mostly shifts, so sizes say little
    axes = np.linalg.svd(unknown, full_matrices=False)[0][:, :rotations]
    kept: list[int] = []
    for k, turn in enumerate(turns):
        between = [rotation_vector(other.T @ turn) for other in (np.eye(3), *(turns[j] for j in kept))]
        known = [float(np.linalg.norm(one - axes @ (axes.T @ one))) for one in between]
        if min(known) > math.radians(OTHERWISE_DEG):
            kept.append(k)
    return kept


def information_of_noise(noise: float, pitch: float) -> Tensor:
    """(6, 6), the information of a pixel that the noise of slopes alone causes, through planes fitted to 3 x 3 of them."""
    bend = 1.5 / 6.0 * (noise / pitch / SLOPE_NOISE) ** 2
    return torch.diag(bend * torch.tensor([0.1, 0.1, 1.0, 1.0, 1.0, 0.1], dtype=torch.float64))


def free_directions(information: Tensor, bias: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Motions about which a surface holds hardly any information.

    Args:
        information: (6, 6), mean over the contact's pixels of J^T J in units of the noise; rotations in units of the contact's
            size, shifts in mm, so that all six are lengths.
        bias: (6, 6), the part of it that noise alone causes.
        least: information below which a direction counts as unknown, 1/mm^2.
    Returns:
        Orthonormal columns: all free motions (6, k), and those that are pure shifts (3, m).
    """
    return _below(information, bias, least), _below(information[3:, 3:], bias[3:, 3:], least)


def _below(information: Tensor, bias: Tensor, least: float) -> Tensor:
    values, vectors = torch.linalg.eigh(information)
    noise = ((vectors.T @ bias) * vectors.T).sum(1)
    free: Tensor = vectors[:, values < least + 3.0 * noise]
    return free


def name_directions(free: Tensor, shifts: Tensor) -> list[str]:
    """Names of the motions that :func:`free_directions` found.

    Example:
        >>> name_directions(torch.eye(6)[:, 2:5], torch.eye(3)[:, :2])
        ['translation along x', 'translation along y', 'rotation about z']
        >>> name_directions(torch.eye(6)[:, :3], torch.zeros(3, 0))
        ['rotation about x', 'rotation about y', 'rotation about z']
        >>> slide = torch.tensor([[0.0, 0.0, 0.0, 0.8, 0.6, 0.0]]).T
        >>> name_directions(slide, slide[3:])
        ['translation along 37 degrees']
    """
    names = []
    count = min(shifts.shape[1], free.shape[1])
    if count == 1:
        names.append(f"translation along {_line(shifts[:, 0])}")
    elif count > 1:
        inside = np.linalg.norm(shifts.numpy(), axis=1).tolist()  # how much of x, y, z lies in the space of shifts
        names += [f"translation along {'xyz'[k]}" for k in sorted(sorted(range(3), key=lambda k: -inside[k])[:count])]
    turns = min(free.shape[1] - count, 3)
    if turns == 3:
        return names + [f"rotation about {axis}" for axis in "xyz"]
    axes = np.linalg.svd(free[:3].numpy(), full_matrices=False)[0]  # the axes of the free rotations, largest first
    return names + [f"rotation about {_line(axes[:, k])}" for k in range(turns)]


def _line(direction: Tensor | Array) -> str:
    """A line by its name: x, y, z, its angle in the plane of the skin, or its direction.

    Example:
        >>> _line(np.array([0.0, 1.0, 0.0])), _line(np.array([0.4, 0.0, 0.9]))
        ('y', '(0.40, 0.00, 0.90)')
    """
    x, y, z = direction.tolist()
    if math.hypot(x, y) < SINE_OF_AXIS * abs(z) / math.sqrt(1 - SINE_OF_AXIS**2):
        return "z"
    if abs(z) > SINE_OF_AXIS:
        return f"({x:.2f}, {y:.2f}, {z:.2f})"
    angle = round(math.degrees(math.atan2(y, x))) % 180
    if min(angle, 180 - angle) <= 2:
        return "x"
    return "y" if abs(angle - 90) <= 2 else f"{angle} degrees"


def _is_one_hill(relief: Relief) -> bool:
    """Whether no path from the contact's deep part climbs by more than a tenth of the depth: there is no second hill."""
    depth = torch.where(relief.inside, relief.field[0], 0.0)[None, None]
    highest = float(depth.amax())
    reached, before = torch.where(depth > DEEP * highest, depth, 0.0), torch.zeros_like(depth)
    while not torch.equal(reached, before):
        before, reached = reached, torch.minimum(max_pool2d(reached, 3, 1, 1), depth)
    return float((depth - reached).amax()) < 0.1 * highest


def _information(common: Relief, target: Relief, center: Tensor, units: Tensor) -> Tensor:
    """(6, 6), mean over pixels of J^T J in units of the noise, for motions of ``common`` on the target about ``center``."""
    lin = linearise(common, target, torch.eye(4, dtype=torch.float64)[None], center[None, None])
    slope_by = (lin.slope_by_twist[0].double() * units / SLOPE_NOISE).flatten(0, 1)
    height_by = lin.height_by_twist[0].double() * units / (5.0 * DEPTH_NOISE_MM)
    information: Tensor = (slope_by.T @ slope_by + height_by.T @ height_by) / len(common.points)
    return information


class _Trial(NamedTuple):
    """Motions (6, K), columns, to try on the deep part: its slopes (N, 2), its centre (3,), and the motions' units (6,)."""

    slopes: Tensor
    center: Tensor
    units: Tensor
    motions: Tensor


def _rolls(source: Relief, target: Relief, pose: Tensor, trial: _Trial) -> Tensor:
    """Which motions turn the deep part's normals and leave its fit unchanged, by steps of some length; bool (K,)."""
    deep = source.points[:, 2] > DEEP * source.points[:, 2].max()
    source = source._replace(points=source.points[deep], slopes=source.slopes[deep])
    steps = torch.tensor(ROLLS, dtype=torch.float64)[:, None] / float(trial.units[0])  # (R, 1), mm: shares of the contact's radius
    twists = (trial.motions * trial.units[:, None]).T
    signed = torch.stack((steps, -steps))[..., None] * twists  # (2, R, K, 6)
    poses = torch.cat((pose, motion(signed.flatten(0, 2), trial.center) @ pose))
    lin = linearise(source, target, poses, torch.zeros(1, 1, 3, dtype=torch.float64))
    squared = lin.slope.square().sum(-1) + (lin.height * (SLOPE_NOISE / (5.0 * DEPTH_NOISE_MM))).square()
    squared = squared.clamp_max((CUT * SLOPE_NOISE) ** 2)
    tried = squared[1:].reshape(*signed.shape[:3], -1)  # (2, R, K, N)
    compared = (lin.counts[1:].reshape(tried.shape) & lin.counts[0]).double()
    count = compared.sum(-1)
    rise = (((tried - squared[0]) * compared).sum(-1) / count.clamp_min(1.0)).amax(0)
    p, q = trial.slopes.double().T
    turn = torch.stack((torch.stack((p * q, -(1 + p * p), -q), -1), torch.stack((1 + q * q, -p * q, p), -1)), 1)  # (N, 2, 3)
    turned = (turn @ twists[:, :3].T).square().sum(1).mean(0) * steps**2
    noise = 2.0 * max(float(squared[0][lin.counts[0]].mean()), SLOPE_NOISE**2)
    whole = count.amin(0) > COMPARED * int(lin.counts[0].sum())
    times = torch.tensor(TURNED, dtype=torch.float64)[:, None]
    return (whole & (rise < noise) & (turned > (times * rise).clamp_min(noise))).any(0)


def field_with_fitted_curvature(relief: Relief) -> Tensor:
    """The field with second derivatives from planes through the slopes of 3 x 3 pixels inside: the skin bends beyond the rim."""
    (p_x, p_y), (q_x, q_y) = slopes_of_planes(relief.field[1:3], relief.inside, relief.pitch)
    return torch.cat((relief.field[:3], torch.stack((p_x, 0.5 * (p_y + q_x), q_y))))


def pose_covariance(source: Relief, target: Relief, pose: Tensor) -> tuple[float, Tensor]:
    """RMS distance along the normal over the pixels that agree, mm, and the covariance (6, 6) about the target's origin."""
    center = torch.zeros(1, 1, 3, dtype=torch.float64)
    lin = linearise(source, target, pose, center)
    squared = (lin.slope.square().sum(-1) / SLOPE_NOISE**2 + (lin.height / DEPTH_NOISE_MM) ** 2)[0]
    agrees = lin.counts[0] & (squared < CUT**2)
    if int(agrees.sum()) < 6:
        return math.inf, torch.diag(torch.tensor([1.0] * 3 + [100.0] * 3, dtype=torch.float64))
    upright = 1.0 / torch.sqrt(1.0 + source.slopes[agrees].square().sum(1))
    rmse_mm = float((lin.height[0][agrees] * upright).square().mean().sqrt())
    slope_noise = float(lin.slope[0][agrees].square().mean().sqrt())
    depth_noise = float(lin.height[0][agrees].square().mean().sqrt())
    slope_by = (lin.slope_by_twist[0][agrees].double() / max(slope_noise, 1e-4)).flatten(0, 1)
    # depth errors are alike over the whole contact: all its pixels together count as four
    height_by = lin.height_by_twist[0][agrees].double() / max(depth_noise, 1e-4) * math.sqrt(4.0 / int(agrees.sum()))
    information = slope_by.T @ slope_by / ALIKE_PIXELS + height_by.T @ height_by
    information = information + torch.diag(torch.tensor([1.0] * 3 + [0.01] * 3, dtype=torch.float64))
    return rmse_mm, torch.linalg.inv(information)
