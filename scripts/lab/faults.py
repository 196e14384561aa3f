"""Camera images of exact scenes with effects of light, skin, lens and sensor that the shading model does not contain."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import kornia
import torch
from torch import Tensor, nn

from torchvts.core.files import rgb_from_bgr
from torchvts.core.geometry import lengths, pixel_grid_mm
from torchvts.model.lights import PointLights, cast_shadows, seen_at
from torchvts.scenes import Scene

SHININESS = 30.0
"""Exponent of the specular lobe, which has half its height 12 degrees from the mirror direction."""

BOUNCE_MM = 2.0
"""Standard deviation of the Gaussian that models the bounce of light from skin to skin, mm."""


@dataclass(frozen=True, eq=False)
class Conditions:
    """Conditions of an image; the defaults add nothing to the shading model.

    Attributes:
        lights: the three lights.
        light_level: (R, G, B) factor on each light.
        albedo: (1, 1, H, W) or (1, 3, H, W) factor on the albedo of the skin; None for 1.
        shadows: whether the relief casts shadows.
        specular: strength of a Blinn-Phong lobe, relative to the diffuse light.
        bounce: share of the light that arrives from other skin.
        ambient: share of the light that comes from all directions.
        vignetting: relative loss in the corners.
        blur_px: defocus, standard deviation, pixels.
        motion_px: motion along x during the exposure, pixels.
        crosstalk: share of red that is read as blue, and of blue that is read as red; 1 swaps the channels.
        exposure: factor on the light.
        black: light below this level is black.
        gamma: value = light^(1/gamma).
        noise_std: standard deviation of the noise of the image value.
        bits: bits of a value; None for floats.
        dead: (1, 1, H, W) bool, pixels whose value is zero.
        jpeg_quality: quality of OpenCV's JPEG, 4:2:0; None for no compression.
    """

    lights: PointLights
    light_level: Sequence[float] = (1.0, 1.0, 1.0)
    albedo: Tensor | None = None
    shadows: bool = False
    specular: float = 0.0
    bounce: float = 0.0
    ambient: float = 0.0
    vignetting: float = 0.0
    blur_px: float = 0.0
    motion_px: float = 0.0
    crosstalk: float = 0.0
    exposure: float = 1.0
    black: float = 0.0
    gamma: float = 1.0
    noise_std: float = 0.0
    bits: int | None = None
    dead: Tensor | None = None
    jpeg_quality: int | None = None


def ring_lights(
    out_mm: float, up_mm: float, turn_deg: float = 10.0, level: float = 0.45, spacing_deg: float = 120.0
) -> PointLights:
    """Three lights on a ring around the axis, that give a flat skin ``level`` in the middle of the image.

    Args:
        out_mm: their distance from the axis.
        up_mm: their height above the skin.
        turn_deg: direction of the first.
        level: value of the image.
        spacing_deg: from one to the next.
    """
    angles = [math.radians(turn_deg + spacing_deg * k) for k in range(3)]
    albedo = level * math.hypot(out_mm, up_mm) ** 3 / up_mm
    return PointLights([[out_mm * math.cos(a), out_mm * math.sin(a), up_mm] for a in angles], [albedo] * 3).requires_grad_(False)


def photograph(scene: Scene, conditions: Conditions, seed: int = 0, at_mm: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """The camera image of a scene: light and skin, then the lens, then the sensor, then the file.

    Args:
        scene: what each pixel sees.
        conditions: of the image.
        seed: of the noise.
        at_mm: x and y (H, W) of the skin that each pixel sees; None for those of the scene's camera.
    Returns:
        The image (1, 3, H, W) in [0, 1].
    Example:
        >>> from torchvts.scenes import sphere_press
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [500, 500, 500])
        >>> photograph(sphere_press(6.0, 1.0, height=24, width=32, mm_per_pixel=0.5), Conditions(lights, bits=8)).shape
        torch.Size([1, 3, 24, 32])
    """
    return _read_out(_through_lens(radiance(scene, conditions, at_mm), conditions), conditions, seed)


def radiance(scene: Scene, conditions: Conditions, at_mm: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """Light that leaves the skin towards the camera, (1, 3, H, W), linear, before lens and sensor; as :func:`photograph`.

    Raises:
        ValueError: cast shadows with a camera that is not orthographic.
    """
    depth, lights = scene.depth_mm, conditions.lights
    place = _place(scene, at_mm)  # (3, H, W)
    to_light = lights.position_mm.detach().to(depth.dtype)[:, :, None, None] - place  # (light, axis, H, W)
    squared = to_light.square().sum(1)
    direction = to_light / squared.sqrt()[:, None]
    strength = lights.albedo.detach().to(depth.dtype)[:, None, None] / squared
    strength = strength * torch.tensor(conditions.light_level, dtype=depth.dtype)[:, None, None]
    facing = (direction * scene.normal).sum(1)
    light: Tensor = strength * facing.clamp_min(0.0)
    if conditions.specular:
        half_way = direction + torch.tensor([0.0, 0.0, 1.0], dtype=depth.dtype)[:, None, None]
        lobe = ((half_way * scene.normal).sum(1) / lengths(half_way, 1)).clamp_min(0.0) ** SHININESS * (facing > 0)
        light = light + conditions.specular * strength * lobe
    if conditions.shadows:
        if at_mm is not None or not math.isinf(scene.camera_height_mm):
            raise ValueError("shadows: expected a camera that looks straight down, whose depth lies on an even grid, got another")
        light = light * cast_shadows(depth, lights, scene.mm_per_pixel)[0]
    return _with_indirect_light(light[None], conditions, scene.mm_per_pixel)


def _place(scene: Scene, at_mm: tuple[Tensor, Tensor] | None) -> Tensor:
    """Position (3, H, W) of the skin that each pixel sees, mm."""
    depth = scene.depth_mm
    height, width = depth.shape[2], depth.shape[3]
    if at_mm is None:
        x, y = pixel_grid_mm(height, width, scene.mm_per_pixel, depth.dtype)
        x, y = seen_at(x, depth[0, 0], scene.camera_height_mm), seen_at(y, depth[0, 0], scene.camera_height_mm)
    else:
        x, y = (t.to(depth.dtype) for t in at_mm)
    return torch.stack((x.expand(height, width), y.expand(height, width), depth[0, 0]))


def _with_indirect_light(light: Tensor, conditions: Conditions, mm_per_pixel: float) -> Tensor:
    """Albedo, then light that comes from other skin and from all directions."""
    if conditions.albedo is not None:
        light = light * conditions.albedo.to(light.dtype)
    if conditions.bounce:
        light = (1.0 - conditions.bounce) * light + conditions.bounce * gaussian_blur(light, BOUNCE_MM / mm_per_pixel)
    if conditions.ambient:
        lights = conditions.lights
        upright = lights.position_mm[:, 2] * lights.albedo / lights.position_mm.norm(dim=1) ** 3  # of flat skin in the middle
        light = (1.0 - conditions.ambient) * light + conditions.ambient * upright.detach().to(light.dtype)[None, :, None, None]
    return light


def _through_lens(light: Tensor, conditions: Conditions) -> Tensor:
    if conditions.vignetting:
        x, y = pixel_grid_mm(light.shape[2], light.shape[3], 1.0, light.dtype)
        light = light * (1.0 - conditions.vignetting * (x**2 + y**2) / float(x.max() ** 2 + y.max() ** 2))
    if conditions.blur_px:
        light = gaussian_blur(light, conditions.blur_px)
    return smear(light, conditions.motion_px) if conditions.motion_px else light


def _read_out(light: Tensor, conditions: Conditions, seed: int) -> Tensor:
    if conditions.crosstalk:
        light = (1.0 - conditions.crosstalk) * light + conditions.crosstalk * light.flip(1)  # green stays
    value = ((light * conditions.exposure - conditions.black) / (1.0 - conditions.black)).clamp(0.0, 1.0)
    value = value if conditions.gamma == 1.0 else value ** (1.0 / conditions.gamma)
    if conditions.noise_std:
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(value.shape, generator=generator, dtype=torch.float64).to(value.dtype)
        value = (value + conditions.noise_std * noise).clamp(0.0, 1.0)
    if conditions.dead is not None:
        value = torch.where(conditions.dead, 0.0, value)
    if conditions.bits is not None:
        levels = 2**conditions.bits - 1
        value = torch.round(value * levels) / levels
    return value if conditions.jpeg_quality is None else jpeg(value, conditions.jpeg_quality)


def gaussian_blur(image: Tensor, std_px: float) -> Tensor:
    """Blur by a Gaussian of ``std_px``, the border repeated."""
    size = 2 * math.ceil(3.0 * std_px) + 1
    blurred: Tensor = kornia.filters.gaussian_blur2d(image, (size, size), (std_px, std_px), "replicate")
    return blurred


def smear(image: Tensor, length_px: float) -> Tensor:
    """Mean over ``length_px`` along x, the border repeated: the blur of an object that moves during the exposure."""
    reach = math.ceil(0.5 * length_px + 0.5) - 1
    place = torch.arange(-reach, reach + 1, dtype=torch.float64)
    weight = (0.5 * length_px - place.abs() + 0.5).clamp(0.0, min(1.0, length_px))
    padded = nn.functional.pad(image, [reach, reach, 0, 0], mode="replicate")
    return sum(
        (float(w) * padded[..., k : k + image.shape[3]] for k, w in enumerate(weight / weight.sum())), torch.zeros_like(image)
    )


def jpeg(image: Tensor, quality: int) -> Tensor:
    """An image (1, 3, H, W) after JPEG compression with 8 bits and colours at half resolution, as cameras store it."""
    import cv2

    levels = torch.round(image[0].clamp(0, 1) * 255).to(torch.uint8).flip(0).permute(1, 2, 0).contiguous().numpy()
    done, data = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR) if done else None
    if pixels is None:
        raise OSError("OpenCV could not encode the image as JPEG")
    return rgb_from_bgr(pixels)[None].to(image.dtype)
