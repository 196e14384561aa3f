"""Normals from intensity: eq. 9, eq. 10, and where a light is blocked."""

import numpy as np
import pytest
import references
import torch
from conftest import LONG

import torchvts as vts
from lab import metrics
from torchvts.core.geometry import MAX_SLOPE, gradient_from_normal, normal_from_gradient

scenes = vts.scenes


def press(press_mm=1.0, dtype=torch.float64, height=60, width=80):
    return scenes.sphere_press(10.0, press_mm, (1.0, -0.5), height, width, 30.0 / height, dtype)


def block_for(lights, scene, **options):
    return vts.NormalFromIntensity(lights, scene.depth_mm.shape[2], scene.depth_mm.shape[3], scene.mm_per_pixel, **options)


def rms_deg(normal, scene, region):
    return float(metrics.normal_angle_deg(normal, scene.normal, region).square().mean().sqrt())


def test_the_flat_inverse_is_exact_for_slopes_without_depth(ring):
    """eq. 9: right whatever the slope, as long as the surface has not moved."""
    lights, scene = ring(dtype=torch.float64), press()
    image = vts.near_field_shading(torch.zeros_like(scene.depth_mm), scene.normal, lights, scene.mm_per_pixel)
    assert metrics.normal_angle_deg(block_for(lights, scene)(image), scene.normal).max() < 1e-12


def test_the_inverse_at_the_true_depth_is_exact(ring):
    """eq. 10, given the depth; eq. 9 is not."""
    lights, scene = ring(dtype=torch.float64), press()
    image, block = scenes.render(scene, lights), block_for(lights, scene)
    assert metrics.normal_angle_deg(block(image, scene.depth_mm), scene.normal).max() < 1e-12
    assert metrics.normal_angle_deg(block(image), scene.normal).max() > 0.4


@pytest.mark.parametrize("gloss", [[0.03, 0.06, 0.09]])
def test_gloss_is_divided_out_on_undeformed_skin_and_nearly_so_in_contact(ring, gloss):
    lights, scene = ring(dtype=torch.float64, gloss=gloss), press()
    block = block_for(lights, scene)
    rest = scenes.undeformed(scene)
    assert metrics.normal_angle_deg(block(scenes.render(rest, lights)), rest.normal).max() < 1e-12
    image = scenes.render(scene, lights)
    matt = block_for(ring(dtype=torch.float64), scene)
    inside = scene.contact & (scene.depth_mm > 0.1)
    assert rms_deg(block(image, scene.depth_mm), scene, inside) < 0.25 * rms_deg(matt(image, scene.depth_mm), scene, inside)


@pytest.mark.parametrize(
    "out_mm, height_mm, turn_deg, before_px", [(30.0, 17.0, 30.0, (1.61, 1.31)), (24.0, 14.0, 70.0, (1.75, 1.82))]
)
def test_a_glossy_skin_under_low_lights(ring, out_mm, height_mm, turn_deg, before_px):
    """Fast: the lobe at the slope found, not at the flat skin's. Precise, one light blocked: the lobe as part of the model."""
    lights, errors = ring(out_mm, height_mm, turn_deg, level=0.24, gloss=[0.12] * 3), []
    for press_mm, mode in ((1.0, "fast"), (2.0, "precise")):
        scene = scenes.sphere_press(10.0, press_mm, (0.0, 0.0), 120, 160, 0.25)
        background, image = (
            ((255 * scenes.render(of, lights).clamp(0, 1) ** (1 / 2.2)).round() / 255) for of in (scenes.undeformed(scene), scene)
        )
        unit = vts.Calibration.from_lights(lights, vts.Sensor("rig", 120, 160, 0.25, gamma=2.2), background[0])
        found = vts.DepthPipeline.from_calibration(unit, mode)(image).depth_mm
        errors.append(float((found - scene.depth_mm).abs().max()) / 0.0625)
    assert errors[0] < 0.45 * before_px[0] and errors[1] < 0.65 * before_px[1]


def test_the_stored_inverse_equals_the_twin(ring):
    lights, scene = ring(dtype=torch.float64), press(height=12, width=16)
    expected = references.inverse_light(np.zeros((12, 16)), lights.position_mm.numpy(), lights.albedo.numpy(), scene.mm_per_pixel)
    assert np.abs(block_for(lights, scene).inverse.numpy() - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("noise_std, bound_deg, share", [(0.0, 1.5, 0.45), (0.001, 2.0, 0.6), (0.002, 2.4, 0.7)])
def test_a_blocked_light_does_not_spoil_the_normal(ring, noise_std, bound_deg, share):
    """Low lights, 2 mm: walls that one light does not reach. The plain inverse reads black as a number."""
    lights = ring(22.0, [15.0, 16.5, 18.0], level=0.2, dtype=torch.float64)
    scene = press(2.0, height=120, width=160)
    image = scenes.render(scene, lights, noise_std=noise_std)
    blocked = (scenes.render(scene, lights).amin(1, keepdim=True) == 0) & scene.contact
    assert int(blocked.sum()) > 200
    block = block_for(lights, scene, noise_std=torch.full((3,), max(noise_std, 0.001), dtype=torch.float64))
    plain = references.inverse_light(
        scene.depth_mm[0, 0].numpy(), lights.position_mm.numpy(), lights.albedo.numpy(), scene.mm_per_pixel
    )
    plain = torch.from_numpy(np.einsum("ijhw,jhw->ihw", plain, image[0].numpy()))[None]
    ours, theirs = rms_deg(block(image, scene.depth_mm), scene, blocked), rms_deg(plain, scene, blocked)
    assert ours < bound_deg and ours < share * theirs


@pytest.mark.parametrize("dead, press_mm, worst_px", [(0, 0.5, 0.08), (1, 1.0, 0.4), (2, 1.0, 0.4)])
def test_two_leds_go_on_when_one_fails(ring, press_mm, worst_px, dead):
    """What is left of the third channel is noise. The plain inverse errs by more than the press is deep."""
    lights, scene = ring(), press(press_mm, torch.float32, 120, 160)
    rest = scenes.render(scenes.undeformed(scene), lights, noise_std=0.004, bits=8, seed=1)[0]
    sensor = vts.Sensor("rig", 120, 160, scene.mm_per_pixel)
    image = scenes.render(scene, lights, noise_std=0.004, bits=8, seed=2)
    image[:, dead] = (0.004 * torch.randn(120, 160, generator=torch.Generator().manual_seed(3))).clamp_min(0.0)
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor, rest), "precise")
    out = pipe(torch.cat((image, rest[None])))
    assert metrics.mask_iou(out.contact[:1], scene.contact) > 0.87 and not bool(out.contact[1].any())
    assert metrics.depth_error(out.depth_mm[:1], scene.depth_mm, 0.0625).rms_px < worst_px
    assert out.depth_mm[1].abs().max() == 0


def fan(azimuth_deg):
    """Three lights, the outer two so many degrees from the one in the middle: coplanar as that goes to zero."""
    angle = torch.deg2rad(torch.tensor([0.0, azimuth_deg, -azimuth_deg]))
    position = torch.stack((31.0 * angle.cos(), 31.0 * angle.sin(), torch.full((3,), 40.0)), 1)
    return vts.PointLights(position, 0.45 * position.norm(dim=1) ** 3 / 40.0).requires_grad_(False)


@pytest.mark.parametrize(
    "azimuth_deg, rms_px, share", [(120.0, 0.1, None), (60.0, 0.2, None), (15.0, 0.3, 0.05), (2.0, 2.0, 0.09), (0.0, 4.0, 0.05)]
)
def test_lights_that_nearly_lie_in_a_plane_are_damped(azimuth_deg, rms_px, share):
    """Where the inverse makes more of the noise than slopes are; else bit for bit the plain inverse."""
    lights, scene = fan(azimuth_deg), press(1.0, torch.float32, 120, 160)
    rest, image = (
        scenes.render(s, lights, noise_std=0.004, bits=8, seed=k) for k, s in enumerate((scenes.undeformed(scene), scene))
    )
    sensor = vts.Sensor("rig", 120, 160, scene.mm_per_pixel)
    pipe = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, sensor, rest[0]), "precise")
    assert bool(pipe.normals.shadowed.ill_conditioned.all()) == (share is not None) and bool(
        pipe.normals.shadowed.ill_conditioned.any()
    ) == (share is not None)
    out = pipe(image)
    pipe.normals.shadowed.ill_conditioned.fill_(False)
    pipe.normals.shadowed.any_ill_conditioned = False
    plain = pipe(image)
    ours = metrics.depth_error(out.depth_mm, scene.depth_mm, 0.0625).rms_px
    assert ours < rms_px
    if share is None:
        assert torch.equal(out.depth_mm, plain.depth_mm)
    else:
        theirs = plain.depth_mm.nan_to_num(100.0)
        assert ours < share * metrics.depth_error(theirs, scene.depth_mm, 0.0625).rms_px


def test_slopes_are_bounded_however_wild_the_image():
    lights = vts.PointLights([[22, 0, 15], [-11, 19, 16.5], [-11, -19, 18]], [500, 500, 500])
    image = torch.rand(4, 3, 24, 32, generator=torch.Generator().manual_seed(0))
    image[0] = 0.0
    gradient = gradient_from_normal(vts.NormalFromIntensity(lights, 24, 32, 1.0)(image))
    assert bool(torch.isfinite(gradient).all())
    assert float(gradient.norm(dim=1).max()) < MAX_SLOPE * (1 + 1e-6)


@pytest.mark.parametrize("max_slope", [0.5, 10.0])
def test_steepness_stops_at_the_bound_and_keeps_its_direction(max_slope):
    normal = torch.tensor([[3.0, 4.0, 0.01], [3.0, 4.0, -2.0], [0.0, 0.0, -1.0], [0.03, 0.04, 1.0]], dtype=torch.float64)
    gradient = gradient_from_normal(normal.reshape(4, 3, 1, 1), max_slope)[..., 0, 0]
    expected = torch.tensor([[-0.6, -0.8], [-0.6, -0.8], [0.0, 0.0]], dtype=torch.float64) * max_slope
    assert torch.allclose(gradient[:3], expected, atol=1e-11)
    assert torch.allclose(gradient[3], torch.tensor([-0.03, -0.04], dtype=torch.float64), atol=1e-12)
    assert torch.equal(vts.GradientFromNormal(max_slope)(normal.reshape(4, 3, 1, 1))[..., 0, 0], gradient)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_gradient_to_normal_and_back(dtype, tolerance):
    gradient = torch.randn(2, 2, 20, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)
    normal = normal_from_gradient(gradient)
    assert (normal.norm(dim=1) - 1).abs().max() < tolerance
    assert (gradient_from_normal(normal) - gradient).abs().max() < tolerance
    assert (gradient_from_normal(7 * normal) - gradient).abs().max() < tolerance


def test_derivatives_of_gradient_and_normal():
    gradient = torch.randn(1, 2, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_(True)
    assert torch.autograd.gradcheck(normal_from_gradient, gradient)
    assert torch.autograd.gradcheck(gradient_from_normal, normal_from_gradient(gradient.detach()).requires_grad_(True))
    flat = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).requires_grad_(True)
    gradient_from_normal(flat).sum().backward()
    assert flat.grad.flatten().tolist() == [-1.0, -1.0, 0.0]


@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.parametrize("gloss", [None, [0.1, 0.2, 0.1]])
def test_derivatives_in_image_depth_and_lights(ring, with_depth, gloss):
    lights, scene = ring(dtype=torch.float64, gloss=gloss), press(height=6, width=8)
    block = block_for(lights, scene).requires_grad_(True)
    depth = scene.depth_mm.clone() if with_depth else None

    def normals(image, position, albedo, *depth):
        names = {"lights.position_mm": position, "lights.albedo": albedo}
        return torch.func.functional_call(block, names, (image, *depth))

    inputs = [scenes.render(scene, lights), lights.position_mm.clone(), lights.albedo.clone(), *([depth] if with_depth else [])]
    assert torch.autograd.gradcheck(normals, [value.requires_grad_(True) for value in inputs], fast_mode=not LONG)
