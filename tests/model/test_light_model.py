"""The forward model against its twin."""

import numpy as np
import pytest
import references
import torch

import torchvts as vts
from torchvts.core.geometry import normal_from_gradient
from torchvts.model.lights import glossy_light, inverse_light_matrix, light_matrix, normal_at_depth


def random_scene(batch=1, height=5, width=7, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    depth = torch.rand(batch, 1, height, width, generator=generator, dtype=torch.float64)
    gradient = torch.randn(batch, 2, height, width, generator=generator, dtype=torch.float64)
    return depth.to(dtype), normal_from_gradient(gradient).to(dtype)


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-13), (torch.float32, 1e-6)])
@pytest.mark.parametrize("height_mm", [40.0, 6.0])
def test_shading_equals_the_twin(ring, dtype, tolerance, height_mm):
    lights = ring(12.0, height_mm, dtype=dtype)
    depth, normal = random_scene(2, dtype=dtype)
    image = vts.near_field_shading(depth, normal, lights, 0.8)
    assert image.dtype == dtype
    position, albedo = lights.position_mm.double().numpy(), lights.albedo.double().numpy()
    for item in range(2):
        expected = references.shade(depth[item, 0].double().numpy(), normal[item].double().numpy(), position, albedo, 0.8)
        assert np.abs(image[item].double().numpy() - expected).max() < tolerance * max(1, expected.max())


def test_attached_shadows_are_black_and_not_negative(ring):
    lights = ring(12.0, 6.0, dtype=torch.float64)
    depth, normal = random_scene(height=12, width=12)
    unclamped = (light_matrix(depth, lights.position_mm, lights.albedo, 0.8) * normal.unsqueeze(1)).sum(2)
    image = vts.near_field_shading(depth, normal, lights, 0.8)
    assert (unclamped < 0).any()
    assert torch.equal(image, unclamped.clamp_min(0))


@pytest.mark.parametrize("gloss", [None, [0.1, 0.2, 0.3]])
def test_derivatives_in_depth_normal_position_and_albedo(ring, gloss):
    depth, normal = random_scene(height=4, width=4)
    lights = ring(12.0, 20.0, dtype=torch.float64, gloss=gloss).requires_grad_(True)

    def shade(depth, normal, position, albedo):
        return torch.func.functional_call(lights, {"position_mm": position, "albedo": albedo}, (depth, normal, 0.8))

    inputs = (depth, normal, lights.position_mm.detach().clone(), lights.albedo.detach().clone())
    assert torch.autograd.gradcheck(shade, [value.requires_grad_(True) for value in inputs])


def test_zero_gloss_is_a_matt_skin(ring):
    depth, normal = random_scene()
    matt, zero = (ring(dtype=torch.float64, gloss=gloss) for gloss in (None, [0.0, 0.0, 0.0]))
    assert torch.equal(vts.near_field_shading(depth, normal, matt, 0.5), vts.near_field_shading(depth, normal, zero, 0.5))
    glossy = ring(dtype=torch.float64, gloss=[0.0, 0.0, 0.5])
    change = vts.near_field_shading(depth, normal, glossy, 0.5) - vts.near_field_shading(depth, normal, matt, 0.5)
    assert change[:, :2].abs().max() == 0 and change.min() >= 0 and change[:, 2].max() > 0.01


def test_the_lobe_is_that_of_a_renderer(ring):
    """pyrender's metallic-roughness material of roughness 0.8."""
    lights, scene = (
        ring(30.0, 17.0, dtype=torch.float64),
        vts.scenes.sphere_press(10.0, 1.0, (0.0, 0.0), 60, 80, 0.25, torch.float64),
    )
    depth, normal, position = scene.depth_mm[0, 0].numpy(), scene.normal[0].numpy(), lights.position_mm.detach().numpy()
    expected = torch.from_numpy(references.metallic_roughness_image(depth, normal, position, np.ones(3), 0.25))
    f0, diffuse = 0.04 * 0.8 + 0.2, 0.96 * 0.8
    gloss = f0 / (4.0 * (1.0 - f0) * diffuse)
    glossy = vts.PointLights(lights.position_mm.detach(), torch.full((3,), (1.0 - f0) * diffuse / np.pi), [gloss] * 3)
    found = vts.near_field_shading(scene.depth_mm, scene.normal, glossy, 0.25)[0].detach()
    lit = expected > 0.02 * expected.amax()
    assert float((found / expected - 1.0)[lit].abs().max()) < 0.01


def test_the_light_of_single_glossy_pixels_and_its_derivative(ring):
    lights = ring(12.0, 20.0, dtype=torch.float64, gloss=[0.1, 0.2, 0.3])
    depth, normal = random_scene()
    rows = light_matrix(depth, lights.position_mm, lights.albedo, 0.5)[0].flatten(2).permute(2, 0, 1)
    normals = normal[0].flatten(1).t()
    light, derivative = glossy_light(rows, normals, lights.gloss)
    expected = vts.near_field_shading(depth, normal, lights, 0.5)[0].flatten(1).t()
    assert torch.allclose(light.clamp_min(0.0), expected, rtol=1e-12)
    lit = normals[(light > 0.05 * light.amax()).all(dim=1)].requires_grad_()
    kept = rows[(light > 0.05 * light.amax()).all(dim=1)]
    for j in range(3):
        of_light = torch.autograd.grad(glossy_light(kept, lit, lights.gloss)[0][:, j].sum(), lit)[0]
        assert torch.allclose(glossy_light(kept, lit, lights.gloss)[1][:, j], of_light, rtol=1e-10)
    assert len(lit) > 3 and derivative.shape == (len(normals), 3, 3)


@pytest.mark.parametrize("camera_height_mm", [float("inf"), 30.0])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-11), (torch.float32, 4e-5)])
def test_inverse_times_matrix_is_the_identity(ring, dtype, tolerance, camera_height_mm):
    lights = ring(22.0, [15.0, 16.5, 18.0], dtype=dtype)
    depth, _ = random_scene(2, 24, 32, dtype)
    arguments = (depth, lights.position_mm, lights.albedo, 1.25, camera_height_mm)
    product = torch.einsum("bijhw,bjkhw->bhwik", inverse_light_matrix(*arguments), light_matrix(*arguments))
    assert (product - torch.eye(3, dtype=dtype)).abs().max() < tolerance


def test_inverse_equals_the_twin(ring):
    lights = ring(22.0, [15.0, 16.5, 18.0], dtype=torch.float64)
    depth, _ = random_scene()
    inverse = inverse_light_matrix(depth, lights.position_mm, lights.albedo, 2.0)[0].numpy()
    expected = references.inverse_light(depth[0, 0].numpy(), lights.position_mm.numpy(), lights.albedo.numpy(), 2.0)
    assert np.abs(inverse / expected - 1).max() < 1e-11


SOUND = [[20, 0, 30], [-10, 17, 30], [-10, -17, 30]]


def test_lights_keep_the_wider_dtype_and_own_their_values():
    position = torch.tensor(SOUND, dtype=torch.float64)
    lights = vts.PointLights(position, torch.ones(3))
    position[0, 0] = 99
    assert lights.albedo.dtype == torch.float64 and lights.position_mm[0, 0] == 20
    assert torch.allclose(lights.direction.norm(dim=1), torch.ones(3, dtype=torch.float64))
    assert "R: [20.0, 0.0, 30.0] mm" in repr(lights)


@pytest.mark.parametrize("camera_height_mm", [float("inf"), 30.0])
@pytest.mark.parametrize("far", [1.0, 1e3, 1e6])
def test_the_normal_at_a_depth_is_along_the_inverse_times_the_image(camera_height_mm, far):
    position = far * torch.tensor([[20.0, 9.0, 25.0], [-18.0, 13.0, 26.0], [-2.0, -22.0, 24.0]])
    albedo, generator = far**2 * torch.tensor([600.0, 650.0, 700.0]), torch.Generator().manual_seed(1)
    depth = 2.0 * torch.rand(2, 1, 12, 17, generator=generator)
    image = torch.rand(2, 3, 12, 17, generator=generator)
    vector = (inverse_light_matrix(depth, position, albedo, 0.25, camera_height_mm) * image[:, None]).sum(2)
    found = normal_at_depth(image, depth, position, albedo, 0.25, camera_height_mm)
    assert (found - vector / vector.norm(dim=1, keepdim=True)).abs().max() < 2e-6
    assert not normal_at_depth(0 * image, depth, position, albedo, 0.25, camera_height_mm).any()
