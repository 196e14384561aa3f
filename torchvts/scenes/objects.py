"""Objects with a pose: surfaces in their own coordinates, pressed into the skin at any place, turned and tilted; exact.

An object is a function that gives its height over its own plane, mm. Its frame is right-handed: u to the right, v up, z out of the
object, towards the camera when the object is pressed. The highest parts are near height 0.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import (
    check_dtype,
    check_integer,
    check_least,
    check_numbers,
    check_positive,
    check_seed,
    check_size,
)
from ..core.geometry import check_rigid, normal_from_gradient, pixel_grid_mm
from .letters import Segment, distance_to_segments, letter_segments
from .surfaces import Scene, check_function, smooth_step, with_slope

Height = Callable[[Tensor, Tensor], Tensor]
"""Height of an object, mm, as a function of u and v, mm."""


class Target(NamedTuple):
    """An object whose pose is to be found.

    Attributes:
        height_mm: function of u and v, mm, that returns the height, mm.
        period_deg: the object looks the same after a turn by this angle about its z axis; 360 without symmetry.
        free: motions that its surface does not determine, as the first words of the names in
            :attr:`torchvts.pose.Registration.ambiguous`.
        freedom: number of such motions.
    """

    height_mm: Height
    period_deg: float = 360.0
    free: tuple[str, ...] = ()
    freedom: int = 0


def pose(
    angle_deg: float = 0.0,
    shift_mm: tuple[float, float] = (0.0, 0.0),
    press_mm: float = 0.5,
    tilt_deg: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """T_sensor_object (4, 4) float64: turned in the plane, tilted about the sensor's x and y, moved.

    Args:
        angle_deg: turn about z, from x (right) to y (up), degrees.
        shift_mm: shift along x (right) and y (up), mm.
        press_mm: how far the origin of the object is pressed in, mm.
        tilt_deg: tilt about x and about y, degrees.
    Returns:
        The transform from the frame of the object to that of the sensor.
    Example:
        >>> pose(90.0, (1.0, 2.0))[:2] + 0.0
        tensor([[ 0., -1.,  0.,  1.],
                [ 1.,  0.,  0.,  2.]], dtype=torch.float64)
    """
    check_least("angle_deg", angle_deg, -math.inf), check_least("press_mm", press_mm, -math.inf)
    check_numbers("shift_mm", shift_mm, (2,)), check_numbers("tilt_deg", tilt_deg, (2,))
    turn = math.radians(angle_deg)
    about_z = torch.zeros(3, 3, dtype=torch.float64)
    about_z[2, 2] = 1.0
    about_z[0, 0], about_z[0, 1] = math.cos(turn), -math.sin(turn)
    about_z[1, 0], about_z[1, 1] = math.sin(turn), math.cos(turn)
    about_z = torch.where(about_z.abs() < 1e-15, torch.zeros_like(about_z), about_z)
    a, b = (math.radians(t) for t in tilt_deg)
    axis = torch.tensor([[0.0, 0.0, b], [0.0, 0.0, -a], [-b, a, 0.0]], dtype=torch.float64)
    transform = torch.eye(4, dtype=torch.float64)
    transform[:3, :3] = torch.linalg.matrix_exp(axis) @ about_z
    transform[:3, 3] = torch.tensor([*shift_mm, press_mm], dtype=torch.float64)
    return transform


def press(
    height_mm: Height,
    T_sensor_object: Tensor,
    height: int = 240,
    width: int = 320,
    mm_per_pixel: float = 0.0625,
    fillet_mm: float = 0.02,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """The skin over an object in a pose: exact depth and gradient, with a smooth fillet where the skin leaves the object.

    The tilted surface is sampled on the grid of the sensor by fixed-point iteration, which converges if tilt times steepness is
    well below 1.

    Args:
        height_mm: height of the object, see :class:`Target`.
        T_sensor_object: pose (4, 4), see :func:`pose`.
        height, width, mm_per_pixel, dtype: as for :func:`torchvts.scenes.surface`.
        fillet_mm: depth over which the skin bends away from the object, mm; there it is off by at most a quarter of this.
    Returns:
        The scene; its contact is where the object reaches below the undeformed skin.
    Raises:
        TypeError: ``height_mm`` is no function.
        ValueError: T_sensor_object is not (4, 4), not rigid, or tilted too far for the iteration.
    Example:
        >>> scene = press(lambda u, v: -(u**2 + v**2), pose(press_mm=0.5), 9, 9, 0.25)
        >>> round(float(scene.depth_mm.max()), 6)
        0.5
    """
    check_size(height, width, mm_per_pixel, 3)
    fillet_mm = check_positive("fillet_mm", fillet_mm)
    check_dtype("dtype", dtype)
    check_function("height_mm", height_mm)
    transform = check_rigid("T_sensor_object", T_sensor_object)
    rotation, shift = transform[:3, :3], transform[:3, 3]
    if float(rotation[2, 2]) < 0.9:
        raise ValueError(f"T_sensor_object: expected a tilt below 25 degrees, got cos {float(rotation[2, 2]):.3f}")
    x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
    plane = torch.stack((x.expand(height, width) - shift[0], -y.expand(height, width) - shift[1]))  # (2, H, W), y up
    inverse = torch.linalg.inv(rotation[:2, :2])

    def across(matrix: Tensor, field: Tensor) -> Tensor:
        return torch.einsum("ij,jhw->ihw", matrix, field)

    at = across(inverse, plane)
    if float(rotation[:2, 2].norm()) > 0:
        for _ in range(7):
            at = across(inverse, plane - rotation[:2, 2, None, None] * height_mm(at[0], at[1]))
    relief, slope = with_slope("height_mm", height_mm, at[0], at[1])
    z = rotation[2, 0] * at[0] + rotation[2, 1] * at[1] + rotation[2, 2] * relief + shift[2]
    normal = across(rotation, torch.stack((-slope[0], -slope[1], torch.ones_like(relief))))
    gradient = torch.stack((-normal[0], normal[1])) / normal[2]  # back to y down
    # 0 below -fillet, z above it, a parabola between: the skin is stiff, it does not fold
    bend = ((z + fillet_mm) / (2.0 * fillet_mm)).clamp(0.0, 1.0)
    depth = torch.where(z > fillet_mm, z, fillet_mm * bend**2)
    gradient = (gradient * bend)[None].to(dtype)
    return Scene(depth[None, None].to(dtype), gradient, normal_from_gradient(gradient), (z > 0)[None, None], mm_per_pixel)


def tool_handle() -> Height:
    """A tapered round grip with unequal grooves and a dimple, 14 mm long."""

    def height(u: Tensor, v: Tensor) -> Tensor:
        radius = 6.0 + 0.08 * u
        height = torch.sqrt((radius**2 - v**2).clamp_min(4.0)) - radius
        for place, depth in ((-4.4, 0.35), (-2.6, 0.35), (0.2, 0.5), (4.6, 0.3)):
            height = height - depth * torch.exp(-(((u - place) / 0.5) ** 2))
        height = height - 0.4 * torch.exp(-(((u - 2.4) ** 2 + (v - 0.5) ** 2) / 0.7**2))
        return height - _wall(u.abs() - 6.5, 1.2, 1.2)

    return height


def bottle_cap(ribs: int = 18) -> Height:
    """A round cap with a raised ring and ribs around it, 12 mm across."""
    check_integer("ribs", ribs, 1)

    def height(u: Tensor, v: Tensor) -> Tensor:
        r, along, across = _fold(u, v, ribs)
        ring = (r - 4.0).abs() - 0.45
        rib = _box(along - 5.1, across, 0.75, 0.22)
        outside = torch.minimum(torch.minimum(ring, rib), r - 1.0)
        return -_wall(outside, 0.9, 0.9)

    return height


def stamp(text: str = "VTS", size_mm: float = 4.2) -> Height:
    """Raised letters of constant stroke with soft flanks."""
    segments = [((a[0], -a[1]), (b[0], -b[1])) for a, b in letter_segments(text, size_mm)]

    def height(u: Tensor, v: Tensor) -> Tensor:
        return -_wall(distance_to_segments(u, v, segments) - 0.3, 0.9, 0.9)

    return height


def bolt_head(across_flats_mm: float = 9.0) -> Height:
    """A hexagon head, slightly domed, with a round chamfer."""
    across_flats_mm = check_positive("across_flats_mm", across_flats_mm)

    def height(u: Tensor, v: Tensor) -> Tensor:
        r, along, across = _fold(u, v, 6)
        apothem = 0.5 * across_flats_mm
        beyond = (across.abs() - apothem * math.tan(math.pi / 6)).clamp_min(0.0)
        hexagon = torch.where(along > apothem, torch.sqrt((along - apothem).clamp_min(0) ** 2 + beyond**2 + 1e-18), along - apothem)
        chamfer = (r - 1.04 * apothem).clamp_min(0.0)
        return -_wall(hexagon + 0.2, 0.9, 0.9) - 0.01 * r**2 - 0.6 * chamfer**2

    return height


def key() -> Height:
    """A key's blade: bitting on one side, a groove along it, 14 mm long."""
    top = [(-7.0, 2.0), (-5.2, 2.0), (-4.4, 0.9), (-3.4, 0.9), (-2.6, 1.6), (-1.8, 0.5), (-0.8, 0.5), (0.2, 1.9), (1.2, 1.1)]
    top += [(2.2, 1.1), (3.2, 2.1), (4.2, 1.3), (5.0, 1.3), (6.6, -0.4)]
    corners = [*top, (5.6, -2.2), (-7.0, -2.2)]
    sides = list(zip(corners, corners[1:] + corners[:1], strict=True))

    def height(u: Tensor, v: Tensor) -> Tensor:
        outside = _polygon(u, v, sides)
        groove = 0.3 * (1.0 - smooth_step(((v + 1.0).abs() - 0.15) / 0.5))
        return -_wall(outside, 0.9, 0.9) - groove

    return height


def gear(teeth: int = 12) -> Height:
    """A flat gear with a bore, 11 mm across."""
    check_integer("teeth", teeth, 1)

    def height(u: Tensor, v: Tensor) -> Tensor:
        r, along, across = _fold(u, v, teeth)
        tooth = _box(along - 4.6, across, 0.9, 0.45 - 0.12 * (along - 4.6))
        return -_wall(torch.maximum(torch.minimum(r - 4.0, tooth), 1.5 - r), 0.9, 0.9)

    return height


def textured_patch(bumps: int = 60, radius_mm: float = 5.5, seed: int = 3) -> Height:
    """A round pad with bumps and dents of random sizes at random places."""
    check_integer("bumps", bumps, 1, 10_000), check_positive("radius_mm", radius_mm)
    generator = torch.Generator().manual_seed(check_seed("seed", seed))
    draws = torch.rand(bumps, 5, generator=generator, dtype=torch.float64)
    reach, turn = radius_mm * draws[:, 0].sqrt(), 2.0 * math.pi * draws[:, 1]
    places = torch.stack(
        (reach * turn.cos(), reach * turn.sin(), 0.4 + 0.5 * draws[:, 2], 0.3 * (draws[:, 3] - 0.5)), dim=1
    ).tolist()

    def height(u: Tensor, v: Tensor) -> Tensor:
        total = torch.zeros_like(u)
        for across, up, size, high in places:
            total = total + high * torch.exp(-((u - across) ** 2 + (v - up) ** 2) / size**2)
        return total - _wall(torch.sqrt(u**2 + v**2 + 1e-18) - radius_mm, 1.5, 1.5)

    return height


def sphere(radius_mm: float = 10.0) -> Height:
    """A ball; near its equator and beyond, the height stays constant."""
    radius_mm = check_positive("radius_mm", radius_mm)

    def height(u: Tensor, v: Tensor) -> Tensor:
        return torch.sqrt((radius_mm**2 - u**2 - v**2).clamp_min(0.25 * radius_mm**2)) - radius_mm

    return height


def cylinder(radius_mm: float = 6.0) -> Height:
    """An endless cylinder along u."""
    radius_mm = check_positive("radius_mm", radius_mm)

    def height(u: Tensor, v: Tensor) -> Tensor:
        return torch.sqrt((radius_mm**2 - v**2).clamp_min(0.25 * radius_mm**2)) - radius_mm + 0.0 * u

    return height


def capsule(radius_mm: float = 1.0, length_mm: float = 4.0) -> Height:
    """A cylinder with round ends, lying along u; ``length_mm`` is between the centers of its ends."""
    check_positive("radius_mm", radius_mm), check_positive("length_mm", length_mm)

    def height(u: Tensor, v: Tensor) -> Tensor:
        beyond = (u.abs() - 0.5 * length_mm).clamp_min(0.0)
        return torch.sqrt((radius_mm**2 - beyond**2 - v**2).clamp_min(0.05 * radius_mm**2)) - radius_mm

    return height


def prism(slope: float = 0.4, length_mm: float = 6.0) -> Height:
    """A roof: a ridge along u, flat faces of constant slope on both sides, ends at the same slope."""
    check_positive("slope", slope), check_positive("length_mm", length_mm)

    def height(u: Tensor, v: Tensor) -> Tensor:
        beyond = (u.abs() - 0.5 * length_mm).clamp_min(0.0)
        ridge = 0.1  # the radius of the edge, mm: no tool is sharper
        return slope * (ridge - torch.sqrt(v**2 + beyond**2 + ridge**2))

    return height


def plane() -> Height:
    """An endless plane: it touches only where it is tilted."""

    def height(u: Tensor, v: Tensor) -> Tensor:
        return 0.0 * (u + v)

    return height


TARGETS: dict[str, Target] = {
    "tool handle": Target(tool_handle()),
    "bottle cap": Target(bottle_cap(), 20.0),
    "stamp": Target(stamp()),
    "bolt head": Target(bolt_head(), 60.0),
    "key": Target(key()),
    "gear": Target(gear(), 30.0),
    "textured patch": Target(textured_patch()),
}
"""The seven objects of the pose bench."""

FREE_TARGETS: dict[str, Target] = {
    "sphere": Target(sphere(), free=("rotation about",), freedom=3),
    "cylinder": Target(cylinder(), 180.0, free=("translation along", "rotation about"), freedom=2),
    "plane": Target(plane(), free=("translation along x", "translation along y", "rotation about z"), freedom=3),
}
"""Surfaces that can slide along themselves, so part of their pose cannot be determined."""


def _wall(outside: Tensor, high_mm: float, wide_mm: float) -> Tensor:
    """Drop outside of an outline: 0 inside, a smooth flank of ``wide_mm``, then ``high_mm``."""
    return high_mm * smooth_step(outside / wide_mm)


def _fold(u: Tensor, v: Tensor, times: int) -> tuple[Tensor, Tensor, Tensor]:
    """Radius, and coordinates along and across the nearest of ``times`` evenly spaced rays."""
    r = torch.sqrt(u**2 + v**2 + 1e-18)
    angle = torch.atan2(v, u + 1e-30)
    step = 2.0 * math.pi / times
    offset = angle - step * torch.round(angle / step)
    return r, r * torch.cos(offset), r * torch.sin(offset)


def _box(along: Tensor, across: Tensor, half_along: float, half_across: Tensor | float) -> Tensor:
    """Signed distance to a box."""
    a, b = along.abs() - half_along, across.abs() - half_across
    outside = torch.sqrt(a.clamp_min(0.0) ** 2 + b.clamp_min(0.0) ** 2 + 1e-18)
    return outside + torch.maximum(a, b).clamp_max(0.0)


def _polygon(u: Tensor, v: Tensor, sides: list[Segment]) -> Tensor:
    """Signed distance to a closed polygon, negative inside."""
    inside = torch.zeros(u.shape, dtype=torch.bool)
    for (x0, y0), (x1, y1) in sides:
        if y0 != y1:
            crosses = (v > min(y0, y1)) & (v <= max(y0, y1))
            inside = inside ^ (crosses & (u.detach() < x0 + (v.detach() - y0) * (x1 - x0) / (y1 - y0)))
    distance = distance_to_segments(u, v, sides)
    return torch.where(inside, -distance, distance)
