"""The camera: the image of a scene, with noise, quantisation, gamma, vignetting, spots and cast shadows."""

import math

import torch
from torch import Tensor

from ..core.checks import (
    check_float_tensor,
    check_image_size,
    check_integer,
    check_least,
    check_positive,
    check_record,
    check_seed,
    check_shape,
    check_switch,
)
from ..core.geometry import pixel_grid_mm
from ..model.lights import PointLights, cast_shadows, near_field_shading
from .surfaces import Scene


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
    """The camera image of a scene: shading, shadows, vignetting and spots, then gamma, noise and quantisation.

    Args:
        scene: a press; its :func:`undeformed` scene gives the background.
        lights: the three lights.
        noise_std: standard deviation of Gaussian noise of the image value.
        bits: quantise to this many bits; None leaves floats.
        gamma: response of the camera, value = light^(1/gamma).
        vignetting: relative loss of light in the image corners.
        spots: (1, 1, H, W) factor on the albedo from :func:`skin_spots`; zero is a dead pixel.
        shadows: whether the relief casts shadows, see :func:`torchvts.model.lights.cast_shadows`.
        seed: seed of the noise.
    Returns:
        The image (1, 3, H, W) in [0, 1], channels R, G, B; it records gradients in the lights: ``.detach()`` makes data of it.
    Raises:
        ValueError: ``shadows`` with a pinhole camera.
    """
    check_record("scene", scene, Scene, "surface or sphere_press makes one")
    noise_std, gamma = check_least("noise_std", noise_std), check_positive("gamma", gamma)
    vignetting, seed = check_least("vignetting", vignetting, 0.0, 1.0), check_seed("seed", seed)
    if bits is not None and check_integer("bits", bits, 1) > 16:
        raise ValueError(f"bits: expected 1 to 16, got {bits}")
    if spots is not None:
        check_float_tensor("spots", spots)
        check_shape("spots", spots, scene.depth_mm.shape, "the scene")
    image = near_field_shading(scene.depth_mm, scene.normal, lights, scene.mm_per_pixel, scene.camera_height_mm)
    if check_switch("shadows", shadows):
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


def skin_spots(height: int, width: int, spots: int = 30, dead_pixels: int = 30, seed: int = 0) -> Tensor:
    """Albedo factor of a worn skin: round spots of 1 to 5 px radius that keep 30 to 90 % of the light, and dead pixels.

    Args:
        height: rows of the image.
        width: columns of the image.
        spots: number of spots.
        dead_pixels: number of dead pixels, whose factor is 0.
        seed: seed of places and sizes.
    Returns:
        The factor (1, 1, H, W) in [0, 1].
    """
    check_image_size("height", height, "width", width)
    check_integer("spots", spots, 0, 10_000), check_integer("dead_pixels", dead_pixels, 0)
    generator = torch.Generator().manual_seed(check_seed("seed", seed))
    x, y = pixel_grid_mm(height, width, 1.0)
    factor = torch.ones(height, width)
    for draw in torch.rand(spots, 4, generator=generator):
        inside = (x - (draw[0] - 0.5) * width) ** 2 + (y - (draw[1] - 0.5) * height) ** 2 < (1 + 4 * draw[2]) ** 2
        factor = torch.where(inside, 0.3 + 0.6 * draw[3], factor)
    dead = torch.randint(height * width, (dead_pixels,), generator=generator)
    factor.view(-1)[dead] = 0.0
    return factor[None, None]
