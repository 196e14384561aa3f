"""The forward model: image of a skin under one near point light per colour channel, and its inverse at known depth."""

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from ..core.checks import brief, check_batch, check_camera_height, check_positive, check_record, check_same_size, check_values
from ..core.geometry import pixel_grid_mm


class PointLights(nn.Module):
    """Three near point lights, one per colour channel.

    Args:
        position_mm: (3, 3), rows R, G, B; columns x right, y down, z towards the camera, from the image centre.
        albedo: (3,), skin albedo times light power per channel, in image value times mm^2.
        gloss: (3,), strength of a broad specular lobe per channel (:func:`gloss_lobe`); None for a matt skin, as in the paper.
    Raises:
        ValueError: wrong shape, values not finite, albedo not positive, gloss negative, or a light not above the skin
            (z <= 0).
    Source:
        eq. 1 of the paper: S^j and rho^j.
    Example:
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> lights.position_mm.shape
        torch.Size([3, 3])
    """

    gloss: Tensor

    def __init__(
        self, position_mm: Tensor | list[list[float]], albedo: Tensor | list[float], gloss: Tensor | list[float] | None = None
    ) -> None:
        super().__init__()
        position, rho = _numbers("position_mm", position_mm), _numbers("albedo", albedo)
        dtype = torch.promote_types(torch.promote_types(position.dtype, rho.dtype), torch.float32)
        position, rho = position.to(dtype), rho.to(dtype)
        shine = torch.zeros(3, dtype=dtype) if gloss is None else _numbers("gloss", gloss).to(dtype)
        check_values("position_mm", position, (3, 3))
        check_values("albedo", rho, (3,), "above 0")
        check_values("gloss", shine, (3,), "of at least 0")
        if not bool((position[:, 2] > 0).all()):
            raise ValueError(
                f"position_mm: expected lights above the skin (z > 0), got z = {position[:, 2].tolist()}: z points to the camera"
            )
        self.position_mm = nn.Parameter(position.detach().clone())
        self.albedo = nn.Parameter(rho.detach().clone())
        self.register_buffer("gloss", shine.detach().clone())
        self.glossy = bool((shine > 0).any())

    if TYPE_CHECKING:

        def __call__(self, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float, camera_height_mm: float = math.inf) -> Tensor: ...

    def forward(self, depth_mm: Tensor, normal: Tensor, mm_per_pixel: float, camera_height_mm: float = math.inf) -> Tensor:
        check_batch("depth_mm", depth_mm, 1)
        check_batch("normal", normal, 3)
        check_same_size("normal", normal, "depth_mm", depth_mm.shape[2], depth_mm.shape[3])
        if not torch.jit.is_scripting():
            mm_per_pixel, camera_height_mm = check_positive("mm_per_pixel", mm_per_pixel), check_camera_height(camera_height_mm)
        matrix = light_matrix(depth_mm, self.position_mm, self.albedo, mm_per_pixel, camera_height_mm)
        light = (matrix * normal.unsqueeze(1)).sum(2).clamp_min(0.0)
        if self.glossy:
            light = light * (1.0 + self.gloss.reshape(1, 3, 1, 1) * gloss_lobe(matrix, normal))
        return light

    @property
    def direction(self) -> Tensor:
        """(3, 3) unit vectors from the image centre to each light."""
        return nn.functional.normalize(self.position_mm, dim=1)

    def extra_repr(self) -> str:
        rows = [f"{c}: {[round(v, 3) for v in row]} mm" for c, row in zip("RGB", self.position_mm.tolist(), strict=True)]
        return ", ".join(rows)


def _numbers(name: str, values: object) -> Tensor:
    try:
        tensor = torch.as_tensor(values, dtype=torch.float32 if isinstance(values, list | tuple) else None)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(f"{name}: expected numbers, got {brief(values)}: a tensor, or lists of floats") from error
    if tensor.is_complex() or tensor.element_size() < 2:
        raise TypeError(f"{name}: expected float32 or float64, got {tensor.dtype}: use .float()")
    return tensor


def near_field_shading(
    depth_mm: Tensor, normal: Tensor, lights: PointLights, mm_per_pixel: float, camera_height_mm: float = math.inf
) -> Tensor:
    """Image of a skin under near point lights; attached shadows are clamped to zero.

    ``I^j = max(0, rho^j (S^j - P) . n / |S^j - P|^3)`` at P = (x, y, depth), where x and y are the pixel's (:func:`seen_at`).

    Args:
        depth_mm: (B, 1, H, W), positive towards the camera.
        normal: (B, 3, H, W), unit, n_z > 0.
        lights: the three lights.
        mm_per_pixel: pixel pitch on the undeformed skin, mm.
        camera_height_mm: of a pinhole camera above the image centre; infinite for an orthographic camera.
    Returns:
        Linear light, (B, 3, H, W), channels R, G, B; not clamped at 1. Differentiable in every input.
    Raises:
        ValueError: wrong shapes.
        TypeError: not floating point.
    Source:
        eq. 1-2 of the paper.
    Example:
        >>> lights = PointLights([[20, 0, 30], [-10, 17, 30], [-10, -17, 30]], [900, 900, 900])
        >>> flat = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, 8, 8)
        >>> near_field_shading(torch.zeros(1, 1, 8, 8), flat, lights, 0.1).shape
        torch.Size([1, 3, 8, 8])
    """
    check_record("lights", lights, PointLights, "PointLights(position_mm, albedo) makes them")
    image: Tensor = lights(depth_mm, normal, mm_per_pixel, camera_height_mm)
    return image


def cast_shadows(depth_mm: Tensor, lights: PointLights, mm_per_pixel: float) -> Tensor:
    """Find cast shadows: 1 where a light reaches a pixel, 0 where the relief blocks it.

    From every pixel a ray goes to the light in steps of one pixel, until it is above all relief. Where the depth map (bilinear
    between pixels) is above the ray by more than a twentieth of a pixel, the light is blocked. Beyond the image the skin is
    undeformed. Attached shadows are not included: :func:`near_field_shading` clamps them.

    Returns:
        (B, 3, H, W), a factor for the image of each light, of depth (B, 1, H, W). Not differentiable: its edges are sharp.
    Example:
        >>> wall = torch.zeros(1, 1, 8, 16); wall[..., 8] = 2.0
        >>> lights = PointLights([[40, 0, 20], [-40, 0, 20], [0, 40, 20]], [900, 900, 900])
        >>> cast_shadows(wall, lights, 0.5)[0, :, 4].int()[:, 4:12]  # no light from the right to the left of the wall
        tensor([[0, 0, 0, 0, 1, 1, 1, 1],
                [1, 1, 1, 1, 1, 0, 0, 0],
                [1, 1, 1, 1, 1, 1, 1, 1]], dtype=torch.int32)
    """
    check_batch("depth_mm", depth_mm, 1)
    depth = depth_mm.detach()
    height, width = depth.shape[2], depth.shape[3]
    x, y = pixel_grid_mm(height, width, mm_per_pixel, depth.dtype, depth.device)
    half = depth.new_tensor([width, height]) * 0.5 * mm_per_pixel
    highest = float(depth.amax())
    reached = []
    for light in lights.position_mm.detach().to(depth.dtype):
        to_x, to_y, to_z = light[0] - x, light[1] - y, light[2] - depth  # (1, W), (H, 1), (B, 1, H, W)
        across = torch.sqrt(to_x**2 + to_y**2).clamp_min(1e-6)  # (H, W)
        rise = to_z / across  # mm of height per mm of way
        furthest = float(across.max())
        if float(light[2]) > highest:
            furthest = min(furthest, float(((highest - depth) / rise).max()))
        lit = torch.ones_like(depth, dtype=torch.bool)
        for step in range(1, math.ceil(furthest / mm_per_pixel) + 1):
            way = torch.minimum(across, torch.full_like(across, step * mm_per_pixel))
            place = torch.stack(((x + to_x / across * way) / half[0], (y + to_y / across * way) / half[1]), dim=-1)
            place = place.expand(depth.shape[0], height, width, 2)
            relief = nn.functional.grid_sample(depth, place, align_corners=False)
            lit &= relief <= depth + rise * way + 0.05 * mm_per_pixel
        reached.append(lit)
    return torch.cat(reached, dim=1).to(depth_mm.dtype)


def flat_image(lights: PointLights, height: int, width: int, mm_per_pixel: float) -> Tensor:
    """Image of the undeformed skin: (3, H, W), linear light."""
    reference = lights.position_mm
    depth_mm = torch.zeros(1, 1, height, width, dtype=reference.dtype, device=reference.device)
    flat = torch.zeros(1, 3, 1, 1, dtype=reference.dtype, device=reference.device)
    flat[:, 2] = 1.0
    return near_field_shading(depth_mm, flat.expand(1, 3, height, width), lights, mm_per_pixel)[0]


def seen_at(undeformed_mm: Tensor, depth_mm: Tensor, camera_height_mm: float) -> Tensor:
    """x or y of the point that a pixel sees at a depth, which is u on the undeformed skin: u (h - z) / h; u for infinite h.

    Example:
        >>> seen_at(torch.tensor([-10.0, 10.0]), torch.tensor(2.0), 20.0)
        tensor([-9.,  9.])
    """
    if math.isinf(camera_height_mm):
        return undeformed_mm
    return undeformed_mm - undeformed_mm * (depth_mm / camera_height_mm)


def light_matrix(
    depth_mm: Tensor, position_mm: Tensor, albedo: Tensor, mm_per_pixel: float, camera_height_mm: float = math.inf
) -> Tensor:
    """The matrix L of ``I = L n``, (B, 3, 3, H, W), light, axis, row, column: row j is rho^j (S^j - P) / |S^j - P|^3.

    Source:
        eq. 2 of the paper.
    """
    depth = depth_mm.unsqueeze(1)  # (B, 1, 1, H, W)
    x, y = pixel_grid_mm(depth_mm.shape[2], depth_mm.shape[3], mm_per_pixel, depth_mm.dtype, depth_mm.device)
    x, y = seen_at(x, depth, camera_height_mm), seen_at(y, depth, camera_height_mm)
    light = position_mm.reshape(1, 3, 3, 1, 1)
    to_light = torch.cat(
        (
            (light[:, :, 0:1] - x).expand(depth.shape[0], 3, 1, depth.shape[3], depth.shape[4]),
            (light[:, :, 1:2] - y).expand(depth.shape[0], 3, 1, depth.shape[3], depth.shape[4]),
            light[:, :, 2:3] - depth,
        ),
        dim=2,
    )
    squared = (to_light * to_light).sum(2, keepdim=True)
    return albedo.reshape(1, 3, 1, 1, 1) * to_light * (squared.rsqrt() / squared)


GLOSS_ROUGHNESS = 0.8
"""Roughness of the specular lobe that ``PointLights.gloss`` scales: a satin skin, and what pyrender, and so TACTO, gives a surface
without a material of its own."""


def gloss_lobe(matrix: Tensor, normal: Tensor) -> Tensor:
    """Rough specular lobe relative to matt shading at unit gloss, (B, 3, H, W); the camera looks along z.

    Args:
        matrix: (B, 3, 3, H, W), light matrix, or anything whose rows point to the lights.
        normal: (B, 3, H, W), unit.
    Source:
        Walter, Marschner, Li, Torrance, Microfacet models for refraction through rough surfaces, EGSR 2007 (GGX); Karis, Real
        shading in Unreal Engine 4, SIGGRAPH course 2013, for the masking term, which renderers of glTF take.
    """
    to_light = matrix * torch.rsqrt((matrix * matrix).sum(2, keepdim=True))  # (B, 3, 3, H, W)
    n_l = (to_light * normal.unsqueeze(1)).sum(2).clamp_min(1e-3)
    n_v = normal[:, 2:3].clamp_min(1e-3)
    n_h = (n_l + n_v) * torch.rsqrt(2.0 + 2.0 * to_light[:, :, 2])
    return microfacet(n_l, n_v, n_h)


def microfacet(n_l: Tensor, n_v: Tensor, n_h: Tensor, roughness: float = GLOSS_ROUGHNESS) -> Tensor:
    """D V of the metallic-roughness model, from the cosines normal-light, normal-view, normal-half-way: GGX, Schlick's masking."""
    a, k = roughness**4, (roughness + 1.0) ** 2 / 8.0
    spread = a / (n_h * n_h * (a - 1.0) + 1.0) ** 2
    return spread / ((n_l * (1.0 - k) + k) * (n_v * (1.0 - k) + k))


def log_slope_of_lobe(n_l: Tensor, n_h: Tensor, roughness: float = GLOSS_ROUGHNESS) -> Tensor:
    """d log :func:`microfacet` / d n_l where the view is along the normal, so that n_h^2 = (1 + n_l) / 2."""
    a, k = roughness**4, (roughness + 1.0) ** 2 / 8.0
    return (1.0 - a) / (n_h * n_h * (a - 1.0) + 1.0) - (1.0 - k) / (n_l * (1.0 - k) + k)


def glossy_light(rows: Tensor, normal: Tensor, gloss: Tensor, roughness: float = GLOSS_ROUGHNESS) -> tuple[Tensor, Tensor]:
    """Light of N pixels of a glossy skin, (N, 3), and its derivative in the normal, without the clamp of attached shadows.

    Args:
        rows: (N, 3, 3), light matrix.
        normal: (N, 3), unit.
        gloss: (3,).
    Returns:
        (N, 3); (N, 3, 3): light, axis.
    """
    to_light = rows * torch.rsqrt((rows * rows).sum(2, keepdim=True))
    to_half = torch.rsqrt(2.0 + 2.0 * to_light[:, :, 2])
    n_l, n_v = (to_light * normal[:, None]).sum(2).clamp_min(1e-3), normal[:, 2:3].clamp_min(1e-3)
    n_h = (n_l + n_v) * to_half
    matt, lobe = (rows * normal[:, None]).sum(2), gloss * microfacet(n_l, n_v, n_h, roughness)
    # the lobe's logarithm along the light and along the view
    a, k = roughness**4, (roughness + 1.0) ** 2 / 8.0
    by_half = 4.0 * (1.0 - a) * n_h / (1.0 - (1.0 - a) * n_h * n_h) * to_half
    by_light, by_view = by_half - (1.0 - k) / (n_l * (1.0 - k) + k), by_half - (1.0 - k) / (n_v * (1.0 - k) + k)
    turned = by_light[:, :, None] * to_light
    turned = torch.cat((turned[:, :, 0:2], turned[:, :, 2:3] + by_view[:, :, None]), dim=2)
    return matt * (1.0 + lobe), rows * (1.0 + lobe)[:, :, None] + (matt * lobe)[:, :, None] * turned


def inverse_light_matrix(
    depth_mm: Tensor, position_mm: Tensor, albedo: Tensor, mm_per_pixel: float, camera_height_mm: float = math.inf
) -> Tensor:
    r"""Inverse of the light matrix at every pixel, in closed form.

    With a_j = S^j - P the rows of L are rho^j a_j / |a_j|^3, so column j of the inverse is
    (a_k x a_l) |a_j|^3 / (rho^j det[a_1 a_2 a_3]), j, k, l cyclic, and a_k x a_l = S^k x S^l - P x (S^l - S^k) is linear in P.

    Returns:
        (B, 3, 3, H, W): normal axis, light, row, column.
    Source:
        eq. 3 and 10 of the paper.
    """
    x, y = pixel_grid_mm(depth_mm.shape[2], depth_mm.shape[3], mm_per_pixel, depth_mm.dtype, depth_mm.device)
    second, third = position_mm.roll(-1, 0), position_mm.roll(-2, 0)
    constant = torch.linalg.cross(second, third, dim=1)  # (light, axis)
    along = third - second
    z = depth_mm[:, 0]  # (B, H, W)
    x, y = seen_at(x, z, camera_height_mm), seen_at(y, z, camera_height_mm)
    columns: list[Tensor] = []
    determinant = torch.zeros_like(z)
    for j in range(3):
        u, v, w = along[j, 0], along[j, 1], along[j, 2]
        cross_x = constant[j, 0] - (y * w - z * v)
        cross_y = constant[j, 1] - (z * u - x * w)
        cross_z = constant[j, 2] - (x * v - y * u)
        a_x, a_y, a_z = position_mm[j, 0] - x, position_mm[j, 1] - y, position_mm[j, 2] - z
        if j == 0:
            determinant = a_x * cross_x + a_y * cross_y + a_z * cross_z
        squared = a_x * a_x + a_y * a_y + a_z * a_z
        scale = squared * squared.sqrt() / (albedo[j] * determinant)
        columns.append(torch.stack((cross_x * scale, cross_y * scale, (cross_z * scale).expand_as(scale)), dim=1))
    return torch.stack(columns, dim=2)


def normal_at_depth(
    image: Tensor,
    depth_mm: Tensor,
    position_mm: Tensor,
    albedo: Tensor,
    mm_per_pixel: float,
    camera_height_mm: float = math.inf,
) -> Tensor:
    r"""Unit normals along L^-1 I at a known depth, without the inverse: a third of its operations.

    The columns of L^-1 (:func:`inverse_light_matrix`) share the determinant, of which a direction needs the sign only. With
    t_j = I^j |a_j|^3 / rho^j the rest is sum_j t_j S^k x S^l - P x sum_j t_j (S^l - S^k), j, k, l cyclic.

    Returns:
        (B, 3, H, W), of linear light (B, 3, H, W); zero where the image is zero.
    Source:
        eq. 10 of the paper.
    """
    x, y = pixel_grid_mm(depth_mm.shape[2], depth_mm.shape[3], mm_per_pixel, depth_mm.dtype, depth_mm.device)
    x, y = seen_at(x, depth_mm, camera_height_mm), seen_at(y, depth_mm, camera_height_mm)
    second, third = position_mm.roll(-1, 0), position_mm.roll(-2, 0)
    cross = torch.linalg.cross(second, third, dim=1)
    place = position_mm.reshape(3, 3, 1, 1)
    away = depth_mm - place[:, 2]
    squared = torch.addcmul((x - place[:, 0]).square() + (y - place[:, 1]).square(), away, away)  # (B, 3, H, W)
    share = image * squared * squared.sqrt()
    table = torch.cat((cross, third - second), dim=1) / albedo[:, None]  # (light, 6)
    # results near 1, however far the lights
    table = table / (table.detach().abs().amax(dim=(0, 1)) * position_mm.detach().norm() ** 3)
    sums = (table.t().to(share.dtype) @ share.flatten(2)).unflatten(2, depth_mm.shape[2:])  # (B, 6, H, W)
    u, v, w = sums[:, 3:4], sums[:, 4:5], sums[:, 5:6]
    n_x = torch.addcmul(torch.addcmul(sums[:, 0:1], y, w, value=-1.0), depth_mm, v)
    n_y = torch.addcmul(torch.addcmul(sums[:, 1:2], x, w), depth_mm, u, value=-1.0)
    n_z = torch.addcmul(torch.addcmul(sums[:, 2:3], x, v, value=-1.0), y, u)
    plane = cross.sum(0)  # the determinant is linear in P too
    determinant = (position_mm[0] * cross[0]).sum() - plane[0] * x - plane[1] * y - plane[2] * depth_mm
    squared = torch.addcmul(torch.addcmul(n_x * n_x, n_y, n_y), n_z, n_z)
    scale = torch.rsqrt(squared + 1e-24) * determinant.sign()
    return torch.cat((n_x * scale, n_y * scale, n_z * scale), dim=1)
