"""A scene: depth, gradient, normal and contact of any surface that is given by a formula, exact."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from ..core.checks import check_camera_height, check_dtype, check_float_tensor, check_positive, check_record, check_size
from ..core.geometry import normal_from_gradient, pixel_grid_mm
from ..model.lights import seen_at

Depth = Callable[[Tensor, Tensor], Tensor]
"""Depth of a surface, mm, as a function of x (right) and y (down), mm; negative where it does not touch the skin."""


class Scene(NamedTuple):
    """The exact geometry of one press.

    Attributes:
        depth_mm: (1, 1, H, W), mm, positive where the skin is pressed in.
        gradient: (1, 2, H, W), (dz/dx, dz/dy), mm per mm.
        normal: (1, 3, H, W), unit normals that face the camera.
        contact: (1, 1, H, W) bool, where the object touches the skin.
        mm_per_pixel: pixel pitch on the undeformed skin, mm.
        camera_height_mm: height of a pinhole camera above the skin, mm; all maps are then what its pixels see. Infinite for an
            orthographic camera.
    """

    depth_mm: Tensor
    gradient: Tensor
    normal: Tensor
    contact: Tensor
    mm_per_pixel: float
    camera_height_mm: float = math.inf


def surface(
    depth_mm: Depth,
    height: int = 480,
    width: int = 640,
    mm_per_pixel: float = 0.0625,
    dtype: torch.dtype = torch.float32,
    camera_height_mm: float = math.inf,
) -> Scene:
    """Make a scene from any surface, given as a function of x (right) and y (down) in mm; a negative depth means no contact.

    The gradient is computed by automatic differentiation of the function in float64, so it is exact.

    Args:
        depth_mm: function of x and y, both (H, W) float64 in mm, that returns the depth (H, W), mm.
        height: rows of the image.
        width: columns of the image.
        mm_per_pixel: pixel pitch on the undeformed skin, mm.
        dtype: type of the returned maps.
        camera_height_mm: height of a pinhole camera above the image centre, mm; infinite for an orthographic camera. The surface
            point behind each pixel is found by fixed-point iteration, which converges if the surface does not hide parts of itself.
    Raises:
        TypeError: ``depth_mm`` is no function.
        ValueError: the camera is not above the skin, or the surface hides parts of itself from it.
    Example:
        >>> scene = surface(lambda x, y: 1.0 - x**2 - y**2, 9, 9, 0.25)
        >>> float(scene.depth_mm.max()), bool(scene.contact[0, 0, 0, 0])
        (1.0, False)
    """
    check_size(height, width, mm_per_pixel, 3)
    check_dtype("dtype", dtype)
    check_function("depth_mm", depth_mm)
    with torch.inference_mode(False):
        x, y = pixel_grid_mm(height, width, mm_per_pixel, torch.float64)
        x, y = x.expand(height, width), y.expand(height, width)
        if check_camera_height(camera_height_mm) < math.inf:
            x, y = _seen_by_pinhole(depth_mm, x, y, camera_height_mm)
        return surface_at(depth_mm, x, y, mm_per_pixel, dtype)._replace(camera_height_mm=camera_height_mm)


def surface_at(depth_mm: Depth, x: Tensor, y: Tensor, mm_per_pixel: float, dtype: torch.dtype = torch.float32) -> Scene:
    """Make a scene whose pixels see the surface at given positions, which need not form an even grid.

    Args:
        depth_mm: function of x and y, as for :func:`surface`.
        x: (H, W) float64, position that each pixel sees, mm.
        y: (H, W) float64, the same for y.
        mm_per_pixel: pixel pitch that the scene reports, mm.
        dtype: type of the returned maps.
    """
    for name, place in (("x", x), ("y", y)):
        check_float_tensor(name, place)
    if x.dim() != 2 or x.shape != y.shape:
        raise ValueError(f"y: expected (H, W) like x, got {tuple(x.shape)} and {tuple(y.shape)}")
    mm_per_pixel = check_positive("mm_per_pixel", mm_per_pixel)
    check_dtype("dtype", dtype)
    depth, slope = with_slope("depth_mm", depth_mm, x, y)
    contact = (depth > 0)[None, None]
    gradient = torch.where(contact, slope[None], 0.0).to(dtype)
    depth = depth.clamp_min(0.0)[None, None].to(dtype)
    return Scene(depth, gradient, normal_from_gradient(gradient), contact, mm_per_pixel)


def check_function(name: str, function: object) -> None:
    """Raise unless ``function`` can be called."""
    if not callable(function):
        raise TypeError(f"{name}: expected a function of two coordinates, got {type(function).__name__}")


def with_slope(name: str, function: Callable[[Tensor, Tensor], Tensor], one: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
    """A function of two coordinates (H, W): its value (H, W) and, by automatic differentiation, its slopes (2, H, W)."""
    check_function(name, function)
    with torch.inference_mode(False), torch.enable_grad():
        one, other = one.clone().requires_grad_(), other.clone().requires_grad_()
        value = function(one, other)
        if not isinstance(value, Tensor) or value.shape != one.shape or not value.requires_grad:
            got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"{name}: expected a function that gives {tuple(one.shape)} computed from its arguments, got {got}")
        slope = torch.autograd.grad(value.sum(), (one, other), materialize_grads=True)
    return value.detach(), torch.stack(slope)


def _seen_by_pinhole(depth_mm: Depth, u: Tensor, v: Tensor, camera_height_mm: float, steps: int = 100) -> tuple[Tensor, Tensor]:
    """x and y of the surface points behind the pixels that see (u, v) on the undeformed skin."""
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
        "steps: the surface hides parts of itself or has vertical walls; raise the camera"
    )


def undeformed(scene: Scene) -> Scene:
    """The same sensor without contact: depth and gradient are zero."""
    check_record("scene", scene, Scene, "surface or sphere_press makes one")
    flat = torch.zeros_like(scene.normal)
    flat[:, 2] = 1.0
    depth_mm, gradient, contact = (torch.zeros_like(part) for part in (scene.depth_mm, scene.gradient, scene.contact))
    return scene._replace(depth_mm=depth_mm, gradient=gradient, normal=flat, contact=contact)


def smooth_step(t: Tensor) -> Tensor:
    """Step from 0 (below 0) to 1 (above 1) along the quintic whose first and second derivatives are zero at both ends."""
    check_float_tensor("t", t)
    t = t.clamp(0.0, 1.0)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t**2)
