"""Objects pressed straight into the skin: ball, capsule, cone, texture, punch and letters, as depths for :func:`surface`."""

import math

import torch
from torch import Tensor

from ..core.checks import check_least, check_numbers, check_positive
from .letters import distance_to_segments, letter_segments
from .surfaces import Depth, Scene, smooth_step, surface


def sphere_press(
    radius_mm: float = 10.0,
    press_mm: float = 1.0,
    center_mm: tuple[float, float] = (0.0, 0.0),
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
    camera_height_mm: float = math.inf,
) -> Scene:
    """A ball. With a radius of 10 mm and presses of 1 and 2 mm it is figure 3 of the paper.

    Args:
        radius_mm: radius of the ball, mm.
        press_mm: how far the ball is pressed in, at most its radius, mm.
        center_mm: (x, y) of its centre in image axes, mm.
        height, width, mm_per_pixel, dtype, camera_height_mm: as for :func:`surface`.
    Example:
        >>> round(float(sphere_press(10.0, 2.0).depth_mm.max()), 3)
        2.0
    """
    check_positive("press_mm", press_mm, check_positive("radius_mm", radius_mm))
    check_numbers("center_mm", center_mm, (2,))

    def depth(x: Tensor, y: Tensor) -> Tensor:
        return _cap((x - center_mm[0]) ** 2 + (y - center_mm[1]) ** 2, radius_mm, press_mm)

    return surface(depth, height, width, mm_per_pixel, dtype, camera_height_mm)


def cylinder_depth(
    radius_mm: float = 4.0,
    press_mm: float = 0.5,
    length_mm: float = 16.0,
    angle_deg: float = 25.0,
    center_mm: tuple[float, float] = (0.0, 0.0),
) -> Depth:
    """A lying cylinder with round ends (a capsule).

    Args:
        radius_mm: radius of the cylinder, mm.
        press_mm: how far it is pressed in, at most its radius, mm.
        length_mm: length of the straight part, mm.
        angle_deg: direction of its axis, from x towards y (down), degrees.
        center_mm: (x, y) of its middle in image axes, mm.
    """
    check_positive("press_mm", press_mm, check_positive("radius_mm", radius_mm))
    check_numbers("center_mm", center_mm, (2,))
    check_positive("length_mm", length_mm), check_least("angle_deg", angle_deg, -math.inf)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        along, across = _turn(x - center_mm[0], y - center_mm[1], angle_deg)
        beyond = (along.abs() - 0.5 * length_mm).clamp_min(0.0)
        return _cap(across**2 + beyond**2, radius_mm, press_mm)

    return depth


def cone_depth(
    half_angle_deg: float = 65.0,
    press_mm: float = 1.0,
    tip_radius_mm: float = 0.5,
    center_mm: tuple[float, float] = (0.0, 0.0),
) -> Depth:
    """A cone with a rounded tip.

    Args:
        half_angle_deg: angle between axis and wall, degrees; the slope of the wall is its cotangent.
        press_mm: how far the tip is pressed in, mm.
        tip_radius_mm: radius of the tip, mm.
        center_mm: (x, y) of the axis in image axes, mm.
    """
    half_angle_deg = check_positive("half_angle_deg", half_angle_deg, 89.9)
    check_positive("press_mm", press_mm), check_positive("tip_radius_mm", tip_radius_mm)
    check_numbers("center_mm", center_mm, (2,))
    wall = 1.0 / torch.tan(torch.deg2rad(torch.tensor(half_angle_deg, dtype=torch.float64)))
    touch = tip_radius_mm * wall / torch.sqrt(1 + wall**2)  # radius where the tip meets the wall, tangentially
    drop = tip_radius_mm - torch.sqrt(tip_radius_mm**2 - touch**2)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        r = torch.sqrt((x - center_mm[0]) ** 2 + (y - center_mm[1]) ** 2 + 1e-18)
        tip = _cap(torch.minimum(r, touch) ** 2, tip_radius_mm, press_mm)
        return torch.where(r < touch, tip, press_mm - drop - (r - touch) * wall)

    return depth


def sine_depth(amplitude_mm: float = 0.1, period_mm: float = 2.0, radius_mm: float = 8.0) -> Depth:
    """A smooth round pad with a sine texture in both directions; depth and slope are both zero at its rim.

    Args:
        amplitude_mm: amplitude of the texture, mm.
        period_mm: period of the texture in x and in y, mm.
        radius_mm: radius of the pad, mm.
    """
    check_positive("amplitude_mm", amplitude_mm), check_positive("period_mm", period_mm), check_positive("radius_mm", radius_mm)
    wave = 2.0 * torch.pi / period_mm

    def depth(x: Tensor, y: Tensor) -> Tensor:
        window = (1.0 - (x**2 + y**2) / radius_mm**2).clamp_min(0.0) ** 2
        return amplitude_mm * window * (2.5 + torch.sin(wave * x) * torch.sin(wave * y))

    return depth


def punch_depth(radius_mm: float = 5.0, press_mm: float = 0.6, tilt_deg: float = 2.0, wall_mm: float = 1.0) -> Depth:
    """A flat round punch, tilted about y, with a smooth flank.

    Args:
        radius_mm: radius of the flat face, mm.
        press_mm: depth in the middle, mm.
        tilt_deg: tilt about y, degrees.
        wall_mm: width of the flank, mm.
    """
    check_positive("radius_mm", radius_mm), check_positive("press_mm", press_mm), check_positive("wall_mm", wall_mm)
    check_least("tilt_deg", tilt_deg, -math.inf)
    slope = torch.tan(torch.deg2rad(torch.tensor(tilt_deg, dtype=torch.float64)))

    def depth(x: Tensor, y: Tensor) -> Tensor:
        outside = (torch.sqrt(x**2 + y**2 + 1e-18) - radius_mm) / wall_mm
        return (press_mm + slope * x).clamp_min(0.0) * (1.0 - smooth_step(outside))

    return depth


def letters_depth(
    text: str = "VTS",
    press_mm: float = 0.5,
    size_mm: float = 6.0,
    stroke_mm: float = 1.0,
    bevel_mm: float = 0.6,
) -> Depth:
    """A stamp with raised letters: strokes of constant width with smooth flanks.

    Args:
        text: capital letters A-Z and spaces.
        press_mm: depth of the letters' tops, mm.
        size_mm: height of a letter in the image, mm.
        stroke_mm: width of the flat top of a stroke, mm.
        bevel_mm: width of the flank, mm.
    Raises:
        ValueError: a character that is not a capital letter, or an empty text.
    """
    check_positive("press_mm", press_mm), check_positive("size_mm", size_mm)
    check_positive("stroke_mm", stroke_mm), check_positive("bevel_mm", bevel_mm)
    segments = letter_segments(text, size_mm)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        return press_mm * (1.0 - smooth_step((distance_to_segments(x, y, segments) - 0.5 * stroke_mm) / bevel_mm))

    return depth


def _cap(squared: Tensor, radius_mm: float, press_mm: float) -> Tensor:
    """Depth of a ball at a squared distance from its axis; beyond the equator it stays at the height of the equator."""
    return torch.sqrt((radius_mm**2 - squared).clamp_min(1e-12)) - (radius_mm - press_mm)


def _turn(x: Tensor, y: Tensor, angle_deg: float) -> tuple[Tensor, Tensor]:
    """Coordinates along and across an axis."""
    angle = torch.deg2rad(torch.tensor(angle_deg, dtype=torch.float64))
    return x * torch.cos(angle) + y * torch.sin(angle), y * torch.cos(angle) - x * torch.sin(angle)
