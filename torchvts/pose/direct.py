"""Pose from two depth frames: all turns and shifts first, then every pixel of the common contact, then what cannot be known."""

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, unfold

from ..core.checks import check_positive
from .ambiguity import free_directions, name_directions
from .relief import Frame, Levels, Relief, levels
from .result import Registration, invert, motion, turn_deg
from .search import search_plane

SLOPE_NOISE = 0.06
"""Disagreement of slopes that counts as noise, mm per mm: calibrated sensors err by 2 to 3 degrees, exact ones by less."""

DEPTH_NOISE_MM = 0.03
"""The same for depth when poses are judged: what integration and a skirt add."""

DEPTH_DRIFT_MM = 0.5
"""The same when poses are refined: errors of integrated depth are alike over the whole contact and would tilt it. From 0.02 to
0.5 mm, with the slopes' at 0.03: rotation error of a stamp 0.23 to 0.05 degrees, of a gear 0.13 to 0.01."""

CUT = 4.0
"""A pixel that disagrees by more than so many noises is an outlier."""

LEAST_INFORMATION = 0.05
"""Squared change of slope in units of its noise per squared mm of motion, below which a motion is called unknown: 0.013 a mm."""

DEEP, ROLL = 0.6, 0.5
"""Share of the largest depth above which the skin lies on the object for sure, not on its skirt; and share of the contact's
radius by which a motion is tried. A ball's deep part on a GelSight Mini, rolled by 0.35 of it, fits worse by 0.00 to 0.03 of slope
where frames disagree by 0.03 to 0.06; moved in the three other ways by 0.14 and more."""

ALIKE_PIXELS = 25.0
"""Errors of slope are alike over so many pixels; with it the covariance foretells the errors measured on rendered scenes."""

UNKNOWN_VARIANCE = 100.0
"""Of a motion that the surface does not show, mm^2."""

LEAST_FITNESS, LEAST_OVERLAP, MOST_COST = 0.85, 0.3, 0.25
"""What a pose must reach to be trusted."""

SMALL_FITNESS, SMALL_OVERLAP = 0.955, 0.2
"""What it must reach where less than LEAST_OVERLAP is in common. Of 144 pairs of different objects none then converges."""


class Fit(NamedTuple):
    """Hypotheses (K, 4, 4), their cost (K,), 0 to 1, shares (K,) of pixels that agree, and of the smaller contact compared."""

    poses: Tensor
    cost: Tensor
    fitness: Tensor
    overlap: Tensor


class Linear(NamedTuple):
    """Residuals of all source pixels under K poses: slopes (K, N, 2), heights (K, N), which count (K, N), derivatives."""

    slope: Tensor
    height: Tensor
    counts: Tensor
    slope_by_twist: Tensor  # (K, N, 2, 6)
    height_by_twist: Tensor  # (K, N, 6)


def linearise(source: Relief, target: Relief, poses: Tensor, center: Tensor) -> Linear:
    """Residuals target - moved source, and their derivatives by a twist about ``center`` after each pose."""
    rotation, shift = poses[:, :3, :3].float(), poses[:, :3, 3].float()
    moved = source.points @ rotation.transpose(1, 2) + shift[:, None]  # (K, N, 3)
    normal = torch.cat((-source.slopes, torch.ones_like(source.slopes[:, :1])), 1) @ rotation.transpose(1, 2)
    upright = normal[..., 2].clamp_min(0.05)
    p, q = -normal[..., 0] / upright, -normal[..., 1] / upright
    field, inside, _, _ = target.sample(moved[..., :2])
    z, p_t, q_t, z_xx, z_xy, z_yy = field
    x, y, h = (moved - center.float()).unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    # how the point's x, y, z answer to (w_x, w_y, w_z, t_x, t_y, t_z)
    dx = torch.stack((zero, h, -y, one, zero, zero), -1)
    dy = torch.stack((-h, zero, x, zero, one, zero), -1)
    dz = torch.stack((y, -x, zero, zero, zero, one), -1)
    height_by = p_t[..., None] * dx + q_t[..., None] * dy - dz
    dp = torch.stack((p * q, -(1 + p * p), -q, zero, zero, zero), -1)
    dq = torch.stack((1 + q * q, -p * q, p, zero, zero, zero), -1)
    slope_by = torch.stack(
        (z_xx[..., None] * dx + z_xy[..., None] * dy - dp, z_xy[..., None] * dx + z_yy[..., None] * dy - dq), dim=-2
    )
    counts = inside & (moved[..., 2] > 0.02)
    return Linear(torch.stack((p_t - p, q_t - q), -1), z - moved[..., 2], counts, slope_by, height_by)


def refine(source: Relief, target: Relief, poses: Tensor, steps: int, wide: float = 1.0) -> Tensor:
    """Gauss-Newton with Cauchy's weights on slopes and heights of the common contact, all hypotheses at once.

    Args:
        source, target: of the same level. poses: (K, 4, 4) float64. steps: at most.
        wide: factor on the noise of slopes at the first step; it halves every step down to one half.
    Returns:
        Poses (K, 4, 4).
    """
    center = middle_of(source, poses)
    units = _units(source)
    for _ in range(steps):
        normal_matrix, right = _normal_equations(linearise(source, target, poses, center[:, None]), SLOPE_NOISE * wide)
        scaled = normal_matrix * units[:, None] * units
        diagonal = scaled.diagonal(dim1=1, dim2=2)
        damped = scaled + torch.diag_embed(1e-3 * diagonal + 1e-6 * diagonal.amax(1, keepdim=True) + 1e-9)
        twist = -torch.linalg.solve(damped, (right * units)[..., None])[..., 0]
        size = twist.norm(dim=1, keepdim=True)
        twist = twist * (0.6 / size.clamp_min(0.6))
        poses = motion(twist * units, center) @ poses
        if wide <= 0.5 and float(size.max()) < 5e-5:
            break
        wide = max(0.5, 0.5 * wide)
    return poses


def middle_of(source: Relief, poses: Tensor) -> Tensor:
    """(K, 3), where the middle of the source's contact comes to lie."""
    return poses[:, :3, :3] @ source.points.double().mean(0) + poses[:, :3, 3]


def _units(source: Relief) -> Tensor:
    """Turns as lengths: what a motion of 1 mm at the contact's radius is in rad; shifts in mm."""
    return torch.tensor([1.0 / _length(source)] * 3 + [1.0] * 3, dtype=torch.float64)


def _normal_equations(lin: Linear, slope_noise: float) -> tuple[Tensor, Tensor]:
    r_s, r_h = lin.slope / slope_noise, lin.height / DEPTH_DRIFT_MM
    weight = lin.counts / (1.0 + (r_s.square().sum(-1) + r_h.square()) / 4.0)
    root = weight.sqrt()
    j = torch.cat((lin.slope_by_twist / slope_noise, lin.height_by_twist[..., None, :] / DEPTH_DRIFT_MM), -2)  # (K, N, 3, 6)
    j = (j * root[..., None, None]).flatten(1, 2)
    r = (torch.cat((r_s, r_h[..., None]), -1) * root[..., None]).flatten(1, 2)
    across = j.transpose(1, 2)
    return (across @ j).double(), (across @ r[..., None])[..., 0].double()


def judge(source: Relief, target: Relief, poses: Tensor) -> Fit:
    """How well each pose explains both frames, both ways: what should touch and does not counts against it."""
    forth, back = _one_way(source, target, poses), _one_way(target, source, invert(poses))
    bad, good, counted = (a + b for a, b in zip(forth, back, strict=True))
    cost = (bad / counted.clamp_min(1.0)).double()
    overlap = torch.maximum(forth[2] / max(len(source.points), 1), back[2] / max(len(target.points), 1)).double()
    return Fit(poses, cost, (good / counted.clamp_min(1.0)).double(), overlap)


def _one_way(source: Relief, target: Relief, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    rotation, shift = poses[:, :3, :3].float(), poses[:, :3, 3].float()
    moved = source.points @ rotation.transpose(1, 2) + shift[:, None]
    normal = torch.cat((-source.slopes, torch.ones_like(source.slopes[:, :1])), 1) @ rotation.transpose(1, 2)
    slope = -normal[..., :2] / normal[..., 2:].clamp_min(0.05)
    field, inside, near, seen = target.sample(moved[..., :2])
    expected = seen & (moved[..., 2] > 0.06)
    error = ((field[1] - slope[..., 0]) ** 2 + (field[2] - slope[..., 1]) ** 2) / SLOPE_NOISE**2
    error = error + ((field[0] - moved[..., 2]) / DEPTH_NOISE_MM) ** 2
    error = torch.where(inside, (error / CUT**2).clamp_max(1.0), (~near).to(error.dtype))
    counted = expected & (inside | ~near)
    bad = (error * counted).sum(1)
    good = ((error < 1.0) & counted).sum(1).to(error.dtype)
    return bad, good, counted.sum(1).to(error.dtype)


def _length(relief: Relief) -> float:
    """Root mean square radius of a contact, mm: a turn by a radian moves it by so much."""
    return max(float((relief.points[:, :2] - relief.points[:, :2].mean(0)).square().sum(1).mean().sqrt()), relief.pitch)


def distinct(fit: Fit, source: Relief, apart_mm: float) -> list[int]:
    """Indices of the poses, best first, without those that move the contact to nearly the same place as a better one."""
    probe = source.points[:: max(1, len(source.points) // 64)].double()
    places = probe @ fit.poses[:, :3, :3].transpose(1, 2) + fit.poses[:, :3, 3][:, None]
    kept: list[int] = []
    for k in torch.argsort(ranked(fit)).tolist():
        if all(float((places[k] - places[other]).square().sum(1).mean().sqrt()) > apart_mm for other in kept):
            kept.append(k)
    return kept


def ranked(fit: Fit) -> Tensor:
    """Cost (K,), with a surcharge where next to nothing is compared: little overlap agrees by chance."""
    return fit.cost + 0.5 * (0.5 - fit.overlap).clamp_min(0.0)


def register_depth(source: Frame, target: Frame, mm_per_pixel: float, *, initial: Tensor | None = None) -> Registration:
    """Pose of what is pressed in one frame relative to another frame of it, from all pixels of both contacts.

    First every turn and shift in the plane at once, by correlating slopes; then the best hypotheses are refined on coarse grids
    and judged both ways, and the best of all on the fine grid: slopes and depths of the common contact, six degrees of freedom.
    What is pressed deeper in one frame than in the other, or lies outside of one image, is left out of account.

    Args:
        source, target: one frame each, a :class:`torchvts.DepthOutput` or anything with its depth_mm, gradient and contact.
        mm_per_pixel: pitch of both, mm.
        initial: T_target_source (4, 4) to start from, as the last frame of a sequence; if it leads to a good fit, nothing else is
            searched.
    Returns:
        The registration. ``converged`` is False if nothing fits; ``ambiguous`` and ``alternatives`` say what the contact does not
        tell.
    Raises:
        ValueError: not one frame, sizes that differ, values not finite, next to no contact, or ``initial`` no rigid motion.
    Source:
        Padfield 2012 for the search; direct alignment as in Lucas, Kanade 1981 with Cauchy's loss; this project's choice of slopes
        before depth.
    Example:
        >>> from torchvts import objects
        >>> frame = objects.press(objects.stamp("T"), objects.pose(0.0), 96, 128, 0.125)
        >>> moved = objects.press(objects.stamp("T"), objects.pose(30.0, (1.0, -0.5)), 96, 128, 0.125)
        >>> reg = register_depth(moved, frame, 0.125)
        >>> reg.converged, round(math.degrees(math.acos(float(reg.T_target_source[0, 0]))), 1)
        (True, 30.0)
    """
    check_positive("mm_per_pixel", mm_per_pixel)
    a, b = levels(source, mm_per_pixel, "source"), levels(target, mm_per_pixel, "target")
    sizes = [tuple(frame.depth_mm.shape[-2:]) for frame in (source, target)]
    if sizes[0] != sizes[1]:
        cause = "positions count from the image's middle, so a cropped frame lies elsewhere"
        raise ValueError(f"source: expected {sizes[1][0]} x {sizes[1][1]} like target, got {sizes[0][0]} x {sizes[0][1]}: {cause}")
    return align(a, b, None if initial is None else rigid("initial", initial))


def align(a: Levels, b: Levels, start: Tensor | None) -> Registration:
    """What :func:`register_depth` does, on frames made ready: source ``a``, target ``b``."""
    if start is not None:
        poses = refine(a.coarse, b.coarse, start[None], 6, 2.0)
        if trusted(judge(a.coarse, b.coarse, poses), 0):
            return _finish(a, b, poses)
    poses, score = search_plane(a.coarse, b.coarse)
    poses = poses[score > 0.4 * score[0]]
    if start is not None:
        poses = torch.cat((start[None], poses))
    poses = refine(a.coarse, b.coarse, poses, 4, 4.0)
    fit = judge(a.coarse, b.coarse, poses)
    order = distinct(fit, a.coarse, 0.5)
    value = ranked(fit)
    return _finish(a, b, poses[[k for k in order if value[k] < 2.0 * value[order[0]] + 0.1]])


def _finish(a: Levels, b: Levels, poses: Tensor) -> Registration:
    poses = refine(a.coarse, b.coarse, poses, 5, 1.0)
    fit = judge(a.coarse, b.coarse, poses)
    kept = _as_good(fit, distinct(fit, a.coarse, 0.4))
    poses = refine(a.middle, b.middle, poses[kept], 3, 1.0)
    fit = judge(a.middle, b.middle, poses)
    kept = _as_good(fit, distinct(fit, a.middle, 0.4))
    best = _between(a, b, poses[kept[:1]])
    others = poses[kept[1:]]
    fit = judge(a.middle, b.middle, best)
    converged = trusted(fit, 0)
    free, names = _unknown(a.coarse, b.coarse, best, b.noise) if converged else (torch.zeros(6, 0, dtype=torch.float64), [])
    rmse_mm, covariance = _spread(a.fine, b.fine, best)
    covariance = covariance + free @ free.T * UNKNOWN_VARIANCE if names else covariance
    alternatives = list(others) if converged and not names else []
    message = _message(fit, names, len(alternatives))
    fitness, overlap = float(fit.fitness[0]), float(fit.overlap[0])
    return Registration(best[0], rmse_mm, fitness, converged, message, covariance, names, alternatives, overlap)


def _between(a: Levels, b: Levels, pose: Tensor) -> Tensor:
    """The fine pose, from source to target and back, and the mean of both: so that neither frame is preferred."""
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


def _as_good(fit: Fit, order: list[int]) -> list[int]:
    """Those of ``order`` that fit as well as its first, within what model errors differ by."""
    first = order[0]
    most = 1.5 * float(fit.cost[first]) + 0.01
    return [k for k in order if k == first or (float(fit.cost[k]) < most and fit.overlap[k] > 0.7 * fit.overlap[first])]


def trusted(fit: Fit, k: int) -> bool:
    """Whether a hypothesis agrees well enough, on enough of the contact."""
    # a small common part must agree nearly everywhere
    fitness = LEAST_FITNESS if fit.overlap[k] >= LEAST_OVERLAP else SMALL_FITNESS
    return bool(fit.fitness[k] >= fitness and fit.overlap[k] >= SMALL_OVERLAP and fit.cost[k] <= MOST_COST)


def _message(fit: Fit, names: list[str], others: int) -> str:
    fitness, overlap = float(fit.fitness[0]), float(fit.overlap[0])
    seen = f"{100 * fitness:.0f} % of the common contact agrees, which is {100 * overlap:.0f} % of the smaller one"
    if not trusted(fit, 0):
        return f"nothing fits: {seen}: different objects, or parts of one that hardly overlap"
    if names:
        return f"{seen}; the surface slides on itself: {', '.join(names)} unknown"
    return seen + (f"; {others} more poses fit as well: the object is symmetric" if others else "")


def _unknown(source: Relief, target: Relief, pose: Tensor, noise: float) -> tuple[Tensor, list[str]]:
    """Motions (6, k) about the target's origin that the contact does not show, and names; by the coarse, least noisy grid.

    Two questions. Do the whole contact's slopes and heights answer to a motion at all? And, of a contact that is a single hill,
    does its deep part roll on itself: do its normals turn by more than what frames disagree by, and yet fit the other frame no
    worse? That part lies on the object for sure; the skin around a ball moves with the contact, not with the ball, and would make
    a rolling ball look fixed.
    """
    points, slopes = target.points, target.slopes
    back = invert(pose)[0].float()
    _, inside, _, _ = source.sample((points @ back[:3, :3].T + back[:3, 3])[:, :2])
    bent = target._replace(field=_own_bend(target))
    bend = 1.5 / 6.0 * (noise / target.pitch / SLOPE_NOISE) ** 2  # of planes through 3 x 3 noisy slopes
    bias = torch.diag(bend * torch.tensor([0.1, 0.1, 1.0, 1.0, 1.0, 0.1], dtype=torch.float64))
    found = torch.zeros(6, 0, dtype=torch.float64), torch.zeros(6, 0, dtype=torch.float64)
    names: list[str] = []
    for part in (inside, inside & (points[:, 2] > DEEP * points[:, 2].max())):
        if int(part.sum()) < 6 or (part is not inside and not _one_hill(target)):
            continue
        common = target._replace(points=points[part], slopes=slopes[part])
        center, units = common.points.double().mean(0), _units(common)
        information = _information(common, bent, center, units)
        free, shifts = free_directions(information, bias, LEAST_INFORMATION)
        if part is not inside:
            motions = torch.linalg.eigh(information).eigenvectors
            rolls = _rolls(source, target, pose, common, center, units, motions)
            free, shifts = motions[:, rolls], shifts[:, :0]
        if free.shape[1] > found[0].shape[1]:
            moved = units[:, None] * free  # rad and mm; turns about the contact's center become turns about the origin and shifts
            moved[3:] = moved[3:] - torch.linalg.cross(moved[:3], center[:, None].expand_as(moved[:3]), dim=0)
            found, names = (moved, free), name_directions(free, shifts)
    return found[0], names


def _one_hill(relief: Relief) -> bool:
    """Whether every way from the contact's deep part leads down, or up by no more than a tenth: no other part stands by itself."""
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


def _rolls(source: Relief, target: Relief, pose: Tensor, common: Relief, center: Tensor, units: Tensor, motions: Tensor) -> Tensor:
    """Which motions (6, K), columns, turn the deep part's normals and leave its fit as it is; bool (K,)."""
    step = ROLL / float(units[0])  # mm: a share of the contact's radius
    twists = (motions * units[:, None]).T
    poses = torch.cat([pose] + [motion(share * step * twists, center) @ pose for share in (1.0, -1.0, 0.5, -0.5)])
    lin = linearise(source, target, poses, torch.zeros(1, 1, 3, dtype=torch.float64))
    deep = source.points[:, 2] > DEEP * source.points[:, 2].max()
    misfit = lin.slope.square().sum(-1) + (lin.height * (SLOPE_NOISE / (5.0 * DEPTH_NOISE_MM))).square()
    misfit = misfit[:, deep].clamp_max((CUT * SLOPE_NOISE) ** 2)
    tried = misfit[1:].reshape(4, len(twists), -1)  # (4, K, N)
    seen = (lin.counts[1:, deep].reshape(tried.shape) & lin.counts[0, deep]).double()
    least = seen.sum(-1)
    rise = (((tried - misfit[0]) * seen).sum(-1) / least.clamp_min(1.0)).amax(0)
    p, q = common.slopes.double().T
    turn = torch.stack((torch.stack((p * q, -(1 + p * p), -q), -1), torch.stack((1 + q * q, -p * q, p), -1)), 1)  # (N, 2, 3)
    turned = (turn @ twists[:, :3].T).square().sum(1).mean(0) * step**2
    noise = 2.0 * max(float(misfit[0][lin.counts[0, deep]].mean()), SLOPE_NOISE**2)
    whole = least.amin(0) > 0.5 * int(deep.sum())
    return whole & (rise < noise) & (turned > (3.0 * rise).clamp_min(noise))


def _own_bend(relief: Relief) -> Tensor:
    """The field with second derivatives of planes through the slopes of 3 x 3 pixels inside: beyond the rim the skin bends."""
    side = (-1.0, 0.0, 1.0)
    place = torch.tensor([[1.0, x, -y] for y in side for x in side])  # rows go down, y up
    place[:, 1:] *= relief.pitch
    weight = unfold(relief.inside.float()[None, None], 3, padding=1)[0].T  # (H W, 9)
    slopes = unfold(relief.field[1:3, None], 3, padding=1).permute(2, 1, 0)  # (H W, 9, 2)
    weighted = place.T * weight[:, None]  # (H W, 3, 9)
    ridge = 1e-3 * torch.diag(torch.tensor([0.0, 1.0, 1.0])) * relief.pitch**2 + 1e-9 * torch.eye(3)
    plane = torch.linalg.solve(weighted @ place + ridge, weighted @ slopes)  # (H W, 3, 2)
    p_x, p_y, q_x, q_y = plane[:, 1, 0], plane[:, 2, 0], plane[:, 1, 1], plane[:, 2, 1]
    bend = torch.stack((p_x, 0.5 * (p_y + q_x), q_y)).reshape(3, *relief.inside.shape)
    return torch.cat((relief.field[:3], bend))


def _spread(source: Relief, target: Relief, pose: Tensor) -> tuple[float, Tensor]:
    """RMS distance along the normal over what agrees, mm, and the covariance about the target's origin."""
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
    # depth errors are alike over the whole contact: all its pixels together tell as much as a few
    height_by = lin.height_by_twist[0][agrees].double() / max(depth_noise, 1e-4) * math.sqrt(4.0 / int(agrees.sum()))
    information = slope_by.T @ slope_by / ALIKE_PIXELS + height_by.T @ height_by
    information = information + torch.diag(torch.tensor([1.0] * 3 + [0.01] * 3, dtype=torch.float64))
    return rmse_mm, torch.linalg.inv(information)


def rigid(name: str, T: Tensor) -> Tensor:
    """``T`` as (4, 4) float64.

    Raises:
        ValueError: no rigid motion.
    """
    if not isinstance(T, Tensor) or tuple(T.shape) != (4, 4) or not bool(torch.isfinite(T).all()):
        raise ValueError(
            f"{name}: expected a finite (4, 4) tensor, got {tuple(T.shape) if isinstance(T, Tensor) else type(T).__name__}"
        )
    T = T.detach().cpu().double()
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    off = float((T[:3, :3] @ T[:3, :3].T - torch.eye(3, dtype=torch.float64)).abs().max())
    if off > 1e-3 or float(torch.linalg.det(T[:3, :3])) < 0 or float((T[3] - last).abs().max()) > 1e-6:
        raise ValueError(f"{name}: expected a rigid motion, rotation without scale or mirror, got one that is {off:.2g} off")
    return T
