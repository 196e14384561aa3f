"""The conventions of docs/conventions.md, line by line."""

import pytest
import torch

import torchvts as vts
from lab import metrics
from torchvts.core.geometry import gradient_from_normal, normal_from_gradient, pixel_grid_mm


def flat(height, width):
    return torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, height, width)


def test_image_channels_are_red_green_blue_on_disk_too(tmp_path):
    import cv2

    image = torch.zeros(3, 8, 8)
    image[0] = 1.0
    vts.write_image(tmp_path / "red.png", image)
    assert cv2.imread(str(tmp_path / "red.png"))[0, 0].tolist() == [0, 0, 255]  # OpenCV's order is blue first
    assert vts.read_image(tmp_path / "red.png")[:, 0, 0].tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("height, width", [(3, 5), (4, 6)])
def test_origin_is_the_image_centre(height, width):
    x, y = pixel_grid_mm(height, width, 0.5, torch.float64)
    assert x[0].tolist() == [0.5 * (c - (width - 1) / 2) for c in range(width)]
    assert y[:, 0].tolist() == [0.5 * (r - (height - 1) / 2) for r in range(height)]


def test_x_runs_right_and_y_runs_down_in_images():
    lights = vts.PointLights([[9, 0, 9], [0, 9, 9], [0, 0, 9]], [40, 40, 40])
    image = vts.near_field_shading(torch.zeros(1, 1, 9, 9), flat(9, 9), lights, 1.0)[0].detach()
    assert image[0].argmax() % 9 == 8, "the red light stands at x > 0"
    assert image[1].argmax() // 9 == 8, "the green light stands at y > 0"
    assert image[2].argmax() == 4 * 9 + 4, "the blue light stands over the centre"


def test_depth_is_positive_where_pressed_and_zero_on_undeformed_skin():
    scene = vts.scenes.sphere_press(10.0, 2.0, height=121, width=161, mm_per_pixel=0.25)
    assert scene.depth_mm.max() == pytest.approx(2.0, abs=1e-6)
    assert scene.depth_mm[0, 0, 60, 80] == scene.depth_mm.max()
    assert scene.depth_mm[~scene.contact].abs().max() == 0


def test_pressed_skin_is_nearer_to_lights_with_positive_z():
    lights = vts.PointLights([[0, 0, 10], [0, 0, 10], [0, 0, 10]], [10, 10, 10]).requires_grad_(False)
    rest, pressed = (vts.near_field_shading(torch.full((1, 1, 3, 3), z), flat(3, 3), lights, 1.0)[0, 0, 1, 1] for z in (0.0, 1.0))
    assert rest == pytest.approx(0.1)
    assert pressed == pytest.approx(10 / 81)


def test_gradient_is_the_change_of_depth_per_mm_to_the_right_and_down():
    ramp = vts.scenes.surface(lambda x, y: 3.0 + 0.2 * x - 0.1 * y, 9, 11, 0.25)
    assert torch.allclose(ramp.gradient[0, 0], torch.tensor(0.2)) and torch.allclose(ramp.gradient[0, 1], torch.tensor(-0.1))
    z = ramp.depth_mm[0, 0]
    assert torch.allclose((z[:, 1:] - z[:, :-1]) / 0.25, torch.tensor(0.2), atol=1e-5)
    assert torch.allclose((z[1:] - z[:-1]) / 0.25, torch.tensor(-0.1), atol=1e-5)


def test_normals_face_the_camera_and_lean_down_the_slope():
    gradient = torch.tensor([0.75, -0.5], dtype=torch.float64).reshape(1, 2, 1, 1)
    expected = torch.tensor([-0.75, 0.5, 1.0], dtype=torch.float64)
    normal = normal_from_gradient(gradient).flatten()
    assert torch.allclose(normal, expected / expected.norm(), atol=1e-15)
    assert torch.allclose(gradient_from_normal(normal.reshape(1, 3, 1, 1)), gradient, atol=1e-15)


def test_points_have_x_right_y_up_z_to_the_camera():
    depth = torch.zeros(1, 1, 3, 5)
    depth[..., 0, 4] = 1.5  # top right
    points = vts.depth_to_points(depth, 0.5, depth > 0)
    assert points.tolist() == [[1.0, 0.5, 1.5]]


def test_depth_and_gradient_of_a_pipeline_follow_the_same_conventions(ring, small_sensor, small_press):
    lights, scene = ring(), small_press(1.0, (5.0, 3.0))  # right of and below the centre
    out = vts.DepthPipeline.from_calibration(vts.Calibration.from_lights(lights, small_sensor), "precise")(
        vts.scenes.render(scene, lights)
    )
    fit = metrics.fit_sphere(out.depth_mm, 0.25, out.contact)
    assert fit.center_mm == pytest.approx((5.0, -3.0, -9.0), abs=0.06)
    assert torch.equal(out.normal[:, 2] > 0, torch.ones_like(out.contact[:, 0]))
    assert torch.equal(out.normal, normal_from_gradient(out.gradient))
