"""Exact presses: surfaces given by a formula, with their depth, gradient, normal and contact, and a camera to see them."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import (
    check_camera_height,
    check_integer,
    check_least,
    check_numbers,
    check_positive,
    check_record,
    check_sequence,
    check_shape,
    check_size,
    check_tensor,
)
from ..core.geometry import normal_from_gradient, pixel_grid_mm
from ..model.lights import PointLights, cast_shadows, near_field_shading, seen_at

Segment = tuple[tuple[float, float], tuple[float, float]]
"""Start and end, (x, y) in mm."""


class Scene(NamedTuple):
    """One press, exact: depth_mm (1, 1, H, W), gradient (1, 2, H, W), normal (1, 3, H, W), contact (1, 1, H, W) bool.

    With a finite ``camera_height_mm`` all maps are what the pixels of a pinhole camera at that height see.
    """

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor
    mm_per_pixel: float
    camera_height_mm: float = math.inf


def surface(
    depth_mm: Callable[[Tensor, Tensor], Tensor],
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
    camera_height_mm: float = math.inf,
) -> Scene:
    """A press of any shape: depth as a function of x (right) and y (down) in mm; negative values mean no contact.

    The gradient comes by automatic differentiation of the formula in float64, so it is exact.

    Args:
        depth_mm: maps x and y, both (H, W) float64, to depth (H, W), mm.
        height, width: pixels. mm_per_pixel: pitch, mm, on the skin at rest. dtype: of the result.
        camera_height_mm: of a pinhole camera above the image centre; infinite for an orthographic camera. What each of its pixels
            sees is found by fixed-point iteration, which converges as long as the surface does not hide parts of itself.
    Raises:
        ValueError: a camera not above the skin, or a surface that hides parts of itself from it.
    Example:
        >>> scene = surface(lambda x, y: 1.0 - x**2 - y**2, 9, 9, 0.25)
        >>> float(scene.depth_mm.max()), bool(scene.contact[0, 0, 0, 0])
        (1.0, False)
    """
    check_size(height, width, mm_per_pixel, 3)
    if not callable(depth_mm):
        raise TypeError(f"depth_mm: expected a function of x and y, got {type(depth_mm).__name__}")
    with torch.inference_mode(False):
        x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
        x, y = x.expand(height, width), y.expand(height, width)
        if check_camera_height(camera_height_mm) < math.inf:
            x, y = _seen_by_pinhole(depth_mm, x, y, camera_height_mm)
        return surface_at(depth_mm, x, y, mm_per_pixel, dtype)._replace(camera_height_mm=camera_height_mm)


def surface_at(
    depth_mm: Callable[[Tensor, Tensor], Tensor], x: Tensor, y: Tensor, mm_per_pixel: float, dtype: torch.dtype = torch.float32
) -> Scene:
    """:func:`surface`, at any positions: what pixels see that do not look straight down at an even grid.

    Args:
        depth_mm: as for :func:`surface`. x, y: (H, W) float64, where each pixel meets the skin, mm.
        mm_per_pixel: the pitch that is called the scene's, mm.
    """
    if not callable(depth_mm):
        raise TypeError(f"depth_mm: expected a function of x and y, got {type(depth_mm).__name__}")
    for name, place in (("x", x), ("y", y)):
        check_tensor(name, place)
    if x.dim() != 2 or x.shape != y.shape:
        raise ValueError(f"y: expected (H, W) like x, got {tuple(x.shape)} and {tuple(y.shape)}")
    check_positive("mm_per_pixel", mm_per_pixel)
    with torch.inference_mode(False), torch.enable_grad():
        x, y = x.clone().requires_grad_(), y.clone().requires_grad_()
        depth = depth_mm(x, y)
        if not isinstance(depth, Tensor) or depth.shape != x.shape or not depth.requires_grad:
            got = tuple(depth.shape) if isinstance(depth, Tensor) else type(depth).__name__
            raise ValueError(f"depth_mm: expected a function that gives {tuple(x.shape)} computed from x and y, got {got}")
        p, q = torch.autograd.grad(depth.sum(), (x, y), materialize_grads=True)
    contact = (depth > 0).detach()[None, None]
    gradient = torch.where(contact, torch.stack((p, q))[None], 0.0).to(dtype)
    depth = depth.detach().clamp_min(0.0)[None, None].to(dtype)
    return Scene(depth, gradient, normal_from_gradient(gradient), contact, mm_per_pixel)


def _seen_by_pinhole(
    depth_mm: Callable[[Tensor, Tensor], Tensor], u: Tensor, v: Tensor, camera_height_mm: float, steps: int = 100
) -> tuple[Tensor, Tensor]:
    """x and y of the surface points behind pixels that see (u, v) of the skin at rest."""
    depth = torch.zeros_like(u)
    for _ in range(steps):
        before = depth
        x, y = seen_at(u, before, camera_height_mm), seen_at(v, before, camera_height_mm)
        depth = depth_mm(x, y).detach().clamp_min(0.0)
        if float((depth - before).abs().max()) < 1e-12:
            return x, y
    left = float((depth - before).abs().max())
    raise ValueError(
        f"camera_height_mm: the points seen from {camera_height_mm:g} mm were not found, {left:.2g} mm missing after {steps} "
        "steps: the surface hides parts of itself, or has cliffs; raise the camera"
    )


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
    """A ball pressed in by ``press_mm``: the paper's figure 3 at radius 10 mm, press 1 and 2 mm.

    Example:
        >>> round(float(sphere_press(10.0, 2.0).depth_mm.max()), 3)
        2.0
    """
    check_positive("press_mm", press_mm, check_positive("radius_mm", radius_mm))
    check_numbers("center_mm", center_mm, (2,))

    def depth(x: Tensor, y: Tensor) -> Tensor:
        squared = (x - center_mm[0]) ** 2 + (y - center_mm[1]) ** 2
        return _cap(squared, radius_mm, press_mm)

    return surface(depth, height, width, mm_per_pixel, dtype, camera_height_mm)


def cylinder_press(
    radius_mm: float = 4.0,
    press_mm: float = 0.5,
    length_mm: float = 16.0,
    angle_deg: float = 25.0,
    center_mm: tuple[float, float] = (0.0, 0.0),
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """A lying cylinder with round ends (a capsule), its axis turned by ``angle_deg`` from x towards y (down)."""
    check_positive("press_mm", press_mm, check_positive("radius_mm", radius_mm))
    check_numbers("center_mm", center_mm, (2,))
    check_positive("length_mm", length_mm), check_least("angle_deg", angle_deg, -math.inf)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        along, across = _turn(x - center_mm[0], y - center_mm[1], angle_deg)
        beyond = (along.abs() - 0.5 * length_mm).clamp_min(0.0)
        return _cap(across**2 + beyond**2, radius_mm, press_mm)

    return surface(depth, height, width, mm_per_pixel, dtype)


def cone_press(
    half_angle_deg: float = 65.0,
    press_mm: float = 1.0,
    tip_radius_mm: float = 0.5,
    center_mm: tuple[float, float] = (0.0, 0.0),
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """A cone with a ball tip; ``half_angle_deg`` is between axis and wall, so walls slope by its cotangent."""
    check_positive("half_angle_deg", half_angle_deg, 89.9)
    check_positive("press_mm", press_mm), check_positive("tip_radius_mm", tip_radius_mm)
    check_numbers("center_mm", center_mm, (2,))
    wall = 1.0 / torch.tan(torch.deg2rad(torch.tensor(half_angle_deg, dtype=torch.float64)))
    touch = tip_radius_mm * wall / torch.sqrt(1 + wall**2)  # the ball meets the wall here, tangentially
    drop = tip_radius_mm - torch.sqrt(tip_radius_mm**2 - touch**2)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        r = torch.sqrt((x - center_mm[0]) ** 2 + (y - center_mm[1]) ** 2 + 1e-18)
        tip = _cap(torch.minimum(r, touch) ** 2, tip_radius_mm, press_mm)
        return torch.where(r < touch, tip, press_mm - drop - (r - touch) * wall)

    return surface(depth, height, width, mm_per_pixel, dtype)


def sine_press(
    amplitude_mm: float = 0.1,
    period_mm: float = 2.0,
    radius_mm: float = 8.0,
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """A smooth round pad with a sine texture in both directions; depth and slope vanish together at its rim."""
    check_positive("amplitude_mm", amplitude_mm), check_positive("period_mm", period_mm), check_positive("radius_mm", radius_mm)
    wave = 2.0 * torch.pi / period_mm

    def depth(x: Tensor, y: Tensor) -> Tensor:
        window = (1.0 - (x**2 + y**2) / radius_mm**2).clamp_min(0.0) ** 2
        return amplitude_mm * window * (2.5 + torch.sin(wave * x) * torch.sin(wave * y))

    return surface(depth, height, width, mm_per_pixel, dtype)


def punch_press(
    radius_mm: float = 5.0,
    press_mm: float = 0.6,
    tilt_deg: float = 2.0,
    wall_mm: float = 1.0,
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """A flat round punch tilted about y; the skin falls away from its edge over ``wall_mm`` along a smooth flank."""
    check_positive("radius_mm", radius_mm), check_positive("press_mm", press_mm), check_positive("wall_mm", wall_mm)
    check_least("tilt_deg", tilt_deg, -math.inf)
    slope = torch.tan(torch.deg2rad(torch.tensor(tilt_deg, dtype=torch.float64)))

    def depth(x: Tensor, y: Tensor) -> Tensor:
        outside = (torch.sqrt(x**2 + y**2 + 1e-18) - radius_mm) / wall_mm
        return (press_mm + slope * x).clamp_min(0.0) * (1.0 - smooth_step(outside))

    return surface(depth, height, width, mm_per_pixel, dtype)


def letters_press(
    text: str = "VTS",
    press_mm: float = 0.5,
    size_mm: float = 6.0,
    stroke_mm: float = 1.0,
    bevel_mm: float = 0.6,
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
) -> Scene:
    """A stamp with raised letters: strokes of constant width with smooth flanks, from the signed distance to their axes.

    Args:
        text: capital letters and blanks. press_mm: height of the letters' tops. size_mm: height of a letter in the image.
        stroke_mm: width of the flat top. bevel_mm: width of the flank.
    Raises:
        ValueError: a character without strokes, or an empty text.
    """
    check_positive("press_mm", press_mm), check_positive("size_mm", size_mm)
    check_positive("stroke_mm", stroke_mm), check_positive("bevel_mm", bevel_mm)
    segments = letter_segments(text, size_mm)

    def depth(x: Tensor, y: Tensor) -> Tensor:
        distance = distance_to_segments(x, y, segments)
        return press_mm * (1.0 - smooth_step((distance - 0.5 * stroke_mm) / bevel_mm))

    return surface(depth, height, width, mm_per_pixel, dtype)


def render(
    scene: Scene,
    lights: PointLights,
    *,
    noise_std: float = 0.0,
    bits: int | None = None,
    gamma: float = 1.0,
    vignetting: float = 0.0,
    spots: Tensor | None = None,
    shadows: bool = False,
    seed: int = 0,
) -> Tensor:
    """The camera image of a scene: shading, then what optics, skin and sensor do to it, in that order.

    Args:
        scene: a press, or :func:`undeformed` for the background.
        lights: the three lights.
        noise_std: standard deviation of Gaussian noise in image value.
        bits: quantise to this many bits; None leaves floats.
        gamma: the camera's response, value = light^(1/gamma).
        vignetting: relative loss of light in the image corners.
        spots: (1, 1, H, W) factor on the skin's albedo from :func:`skin_spots`; zero is a dead pixel.
        shadows: whether the relief casts shadows, :func:`torchvts.model.lights.cast_shadows`.
        seed: of the noise.
    Returns:
        (1, 3, H, W) in [0, 1].
    Raises:
        ValueError: shadows seen by a pinhole camera.
    """
    check_record("scene", scene, Scene, "sphere_press and its kin make one")
    check_least("noise_std", noise_std), check_positive("gamma", gamma), check_least("vignetting", vignetting, 0.0, 1.0)
    if bits is not None and check_integer("bits", bits, 1) > 16:
        raise ValueError(f"bits: expected 1 to 16, got {bits}")
    if spots is not None:
        check_shape("spots", spots, scene.depth_mm.shape, "the scene")
    image = near_field_shading(scene.depth_mm, scene.normal, lights, scene.mm_per_pixel, scene.camera_height_mm)
    if shadows:
        if not math.isinf(scene.camera_height_mm):
            raise ValueError("shadows: expected an orthographic camera, whose depth lies on an even grid; got a pinhole")
        image = image * cast_shadows(scene.depth_mm, lights, scene.mm_per_pixel)
    if vignetting:
        x, y = pixel_grid_mm(image.shape[2], image.shape[3], 1.0, image.dtype)
        image = image * (1.0 - vignetting * (x**2 + y**2) / float(x.max() ** 2 + y.max() ** 2))
    if spots is not None:
        image = image * spots.to(image.dtype)
    image = image.clamp(0.0, 1.0) ** (1.0 / gamma) if gamma != 1.0 else image.clamp(0.0, 1.0)
    if noise_std:
        generator = torch.Generator().manual_seed(seed)
        noise = noise_std * torch.randn(image.shape, generator=generator, dtype=torch.float64).to(image.dtype)
        noise = noise if spots is None else noise * (spots > 0)
        image = (image + noise).clamp(0.0, 1.0)
    if bits is not None:
        levels = 2**bits - 1
        image = torch.round(image * levels) / levels
    return image


def undeformed(scene: Scene) -> Scene:
    """The same sensor without contact."""
    check_record("scene", scene, Scene, "sphere_press and its kin make one")
    flat = torch.zeros_like(scene.normal)
    flat[:, 2] = 1.0
    return Scene(
        torch.zeros_like(scene.depth_mm),
        torch.zeros_like(scene.gradient),
        flat,
        torch.zeros_like(scene.contact),
        scene.mm_per_pixel,
        scene.camera_height_mm,
    )


def skin_spots(height: int, width: int, spots: int = 30, dead_pixels: int = 30, seed: int = 0) -> Tensor:
    """Albedo factor of a worn skin: round spots of 1 to 5 px radius that keep 30 to 90 % of the light, and dead pixels.

    Returns:
        (1, 1, H, W) in [0, 1].
    """
    check_integer("height", height, 1), check_integer("width", width, 1)
    check_integer("spots", spots, 0), check_integer("dead_pixels", dead_pixels, 0)
    generator = torch.Generator().manual_seed(seed)
    x, y = pixel_grid_mm(height, width, 1.0)
    factor = torch.ones(height, width)
    for draw in torch.rand(spots, 4, generator=generator):
        inside = (x - (draw[0] - 0.5) * width) ** 2 + (y - (draw[1] - 0.5) * height) ** 2 < (1 + 4 * draw[2]) ** 2
        factor = torch.where(inside, 0.3 + 0.6 * draw[3], factor)
    dead = torch.randint(height * width, (dead_pixels,), generator=generator)
    factor.view(-1)[dead] = 0.0
    return factor[None, None]


def _cap(squared: Tensor, radius_mm: float, press_mm: float) -> Tensor:
    """Height above the skin of a ball at squared distance from its axis; far outside it stays at its equator's height."""
    return torch.sqrt((radius_mm**2 - squared).clamp_min(1e-12)) - (radius_mm - press_mm)


def _turn(x: Tensor, y: Tensor, angle_deg: float) -> tuple[Tensor, Tensor]:
    angle = torch.deg2rad(torch.tensor(angle_deg, dtype=torch.float64))
    return x * torch.cos(angle) + y * torch.sin(angle), y * torch.cos(angle) - x * torch.sin(angle)


def smooth_step(t: Tensor) -> Tensor:
    """0 below 0, 1 above 1, between them the quintic with zero first and second derivative at both ends."""
    check_tensor("t", t)
    t = t.clamp(0.0, 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def letter_segments(text: str, size_mm: float) -> list[Segment]:
    """Strokes of capital letters as segments in mm, the text's middle at zero, y down; letters are ``size_mm`` high.

    Raises:
        ValueError: a character without strokes, or an empty text.
    """
    if not isinstance(text, str):
        raise TypeError(f"text: expected capital letters A-Z and blanks, got {type(text).__name__}")
    check_positive("size_mm", size_mm)
    unknown = sorted({letter for letter in text if letter != " " and letter not in _STROKES})
    if unknown or not text.strip():
        raise ValueError(f"text: expected capital letters A-Z and blanks, got {text!r}")
    unit = size_mm / 6.0
    left = -0.5 * unit * (6.0 * len(text) - 2.0)
    segments: list[Segment] = []
    for index, letter in enumerate(text):
        for line in _STROKES.get(letter, "").split():
            corners = [
                (left + unit * (int(x) + 6.0 * index), unit * (3.0 - int(y))) for x, y in zip(line[::2], line[1::2], strict=True)
            ]
            segments += list(itertools.pairwise(corners))
    return segments


def distance_to_segments(x: Tensor, y: Tensor, segments: Sequence[Segment]) -> Tensor:
    """Distance of each point to the nearest of the segments."""
    check_tensor("x", x)
    check_sequence("segments", segments, "segments")
    check_shape("y", y, x.shape, "x")
    check_numbers("segments", list(segments), (max(1, len(segments)), 2, 2))
    distance = torch.full_like(x, torch.inf)
    for start, end in segments:
        dx, dy = end[0] - start[0], end[1] - start[1]
        along = (((x - start[0]) * dx + (y - start[1]) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0)
        away = torch.sqrt((x - start[0] - along * dx) ** 2 + (y - start[1] - along * dy) ** 2 + 1e-18)
        distance = torch.minimum(distance, away)
    return distance


# Strokes of capital letters on a grid 4 wide and 6 high, y up: pairs of digits, a blank lifts the pen.
_BOWL, _RING = "00063645443303", "103041453616050110"
_STROKES = {
    "A": "002640 1232", "B": _BOWL + " 3342413000", "C": "4536160501103041", "D": "00062644422000", "E": "46060040 0333",
    "F": "000646 0333", "G": "45361605011030414323", "H": "0006 4046 0343", "I": "2026 1030 1636", "J": "4641301001",
    "K": "0006 4603 0340", "L": "060040", "M": "0006234640", "N": "00064046", "O": _RING, "P": _BOWL, "Q": _RING + " 2240",
    "R": _BOWL + " 2340", "S": "453616050413334241301001", "T": "2026 0646", "U": "060110304146", "V": "062046",
    "W": "0610243046", "X": "0046 0640", "Y": "2023 062346", "Z": "06460040",
}  # fmt: skip
